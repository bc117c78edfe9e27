"""Attempts at models: what is tried, one after the other, where too few frames register or their motion is inconsistent
with VIO."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.sfm.model import BuiltModel, Model, selected_models
from groundwalk.sfm.pairs.matched import are_verified
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import AttemptName, AttemptOutcome
from groundwalk.store.errors import UserError

# Of the frames those that models should register, or else more pairs are tried; fewer than the second one, and
# everything is. Of registered frames those whose motion has to be consistent with VIO.
_TARGET_REGISTERED, MIN_REGISTERED, MIN_CONSISTENT = 0.9, 0.5, 0.8
_RANKED = (
    AttemptOutcome.NO_MODEL,
    AttemptOutcome.TOO_FEW_REGISTERED,
    AttemptOutcome.INCONSISTENT_WITH_VIO,
    AttemptOutcome.FRAMES_MISSING,
    AttemptOutcome.ACCEPTED,
)


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """What an attempt at N frames made: its pairs (module `pairs.matched`) and all models `built` in `folder`; `model`
    are the selected ones, None where there is none, and `consistent` (N,) says which of their frames move as
    VIO does; all where no frame `has_vio`. `input_fault` says what is wrong with the input where no further attempt
    would mend that."""

    name: AttemptName
    settings: SfmSettings
    matched: pd.DataFrame
    built: list[BuiltModel]
    folder: Path
    model: Model | None
    consistent: NDArray[np.bool_]
    has_vio: bool
    input_fault: str = ""

    @property
    def mapping_input(self) -> Path:
        return self.folder.with_suffix(".db")

    @property
    def selected(self) -> list[BuiltModel]:
        """The selected models, the largest first."""
        return selected_models(self.built)

    @property
    def registered(self) -> int:
        """Frames in any of the selected models."""
        return sum(one.images for one in self.selected)

    @property
    def outcome(self) -> AttemptOutcome:
        """What is wrong with it, if anything."""
        fraction = self.registered / len(self.consistent)
        if not self.selected:
            return AttemptOutcome.NO_MODEL
        if fraction < MIN_REGISTERED:
            return AttemptOutcome.TOO_FEW_REGISTERED
        if self.consistent.sum() < MIN_CONSISTENT * self.registered:
            return AttemptOutcome.INCONSISTENT_WITH_VIO
        return AttemptOutcome.ACCEPTED if fraction >= _TARGET_REGISTERED else AttemptOutcome.FRAMES_MISSING

    def __str__(self) -> str:
        sizes = " + ".join(str(one.images) for one in self.selected) or "no"
        fraction = self.consistent.sum() / max(self.registered, 1)
        motion = f", {fraction:.0%} of them consistent with VIO" if self.selected and self.has_vio else ""
        return (
            f"{self.name} ({self.settings.mapper}): {are_verified(self.matched).sum()} of {len(self.matched)} pairs "
            f"verified, models of {sizes} frames{motion}"
        )


def next_step(attempts: list[Attempt]) -> tuple[AttemptName, dict[str, Any]] | None:
    """What to try after these attempts, and the settings that it changes; None where the best of them is good enough,
    or nothing is left that may help."""
    last, tried = attempts[-1], {attempt.name for attempt in attempts}
    outcomes = [attempt.outcome for attempt in attempts]
    # A model that is consistent with VIO is good enough without the rest of the frames, once more pairs were tried.
    is_enough = len(attempts) > 1 and AttemptOutcome.FRAMES_MISSING in outcomes
    if AttemptOutcome.ACCEPTED in outcomes or is_enough or last.input_fault or not last.settings.retry:
        return None
    settings, is_inconsistent = last.settings, last.outcome is AttemptOutcome.INCONSISTENT_WITH_VIO
    if not is_inconsistent and not tried & {AttemptName.MORE_PAIRS, AttemptName.MORE_FEATURES}:
        return AttemptName.MORE_PAIRS, {
            "sequence_pairs": 2 * settings.sequence_pairs,
            "vio_pairs": 2 * settings.vio_pairs + 5,
            "retrieval_pairs": 2 * settings.retrieval_pairs + 5,
        }
    if is_inconsistent and not tried & {AttemptName.STRICTER_PAIRS, AttemptName.MORE_FEATURES}:
        # Pairs of far frames are what bends a model or merges distinct places.
        return AttemptName.STRICTER_PAIRS, {"vio_max_distance_m": settings.vio_max_distance_m / 2}
    if AttemptName.MORE_FEATURES not in tried:
        return AttemptName.MORE_FEATURES, more_features(settings)
    if AttemptName.VIO_START not in tried and last.has_vio:
        return AttemptName.VIO_START, {}
    return None


def more_features(settings: SfmSettings) -> dict[str, Any]:
    """What the attempt of that name changes."""
    return {"max_features": 2 * settings.max_features, "max_image_size": 2 * settings.max_image_size}


def settings_of_size(settings: SfmSettings, frames: int) -> SfmSettings:
    """What the first attempt at so many frames takes: each of a few is seen by few others, and needs more features."""
    if frames > settings.few_frames:
        return settings
    more = {"max_features": 3 * settings.max_features, "max_image_size": settings.max_image_size * 3 // 2}
    return settings.model_copy(update=more)


def run_attempts(
    settings: SfmSettings, attempt: Callable[[int, AttemptName, SfmSettings], Attempt], report: Callable[[str], None]
) -> tuple[list[Attempt], Attempt]:
    """All attempts until the outcome is good enough, and the best of them: by its outcome, then by its consistent
    frames, then the first. An error ends it where a model is there already, and is raised where none is.

    `attempt` gets the number, the name and the settings of each: what it changes and what the ones before it did.
    `report` gets a line for each further attempt.
    """
    attempts = [attempt(0, AttemptName.DEFAULT, settings)]
    while step := next_step(attempts):
        name, changes = step
        report(f"{attempts[-1]}; trying again: {name}")
        try:
            attempts.append(attempt(len(attempts), name, attempts[-1].settings.model_copy(update=changes)))
        except UserError as error:
            if all(one.model is None for one in attempts):
                raise
            report(f"{name} ended with an error, an earlier attempt is used: {error.what}")
            break
    return attempts, max(attempts, key=lambda one: (_RANKED.index(one.outcome), one.consistent.sum()))
