"""Attempts at models: what is tried, one after the other, where too few frames register or their motion is inconsistent
with VIO."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import AttemptName, AttemptOutcome
from groundwalk.store.errors import UserError

Result = TypeVar("Result")
_USABLE = (AttemptOutcome.ACCEPTED, AttemptOutcome.FRAMES_MISSING, AttemptOutcome.INCONSISTENT_WITH_VIO)
_TOO_SMALL = (AttemptOutcome.TOO_FEW_REGISTERED, AttemptOutcome.NO_MODEL)


@dataclass(frozen=True, kw_only=True)
class Attempt:
    """One attempt and its outcome.

    `model_frames` are the frames of each selected model, the largest first, and `consistent` how many of them move as
    VIO does; all where no frame `has_vio`. `input_fault` says what is wrong with the input where no
    further attempt would mend that.
    """

    name: AttemptName
    mapper: str
    pairs: int
    verified: int
    model_frames: list[int]
    consistent: int
    outcome: AttemptOutcome
    input_fault: str = ""
    has_vio: bool = True

    @property
    def registered(self) -> int:
        """Frames in any of the models."""
        return sum(self.model_frames)

    def __str__(self) -> str:
        sizes = " + ".join(map(str, self.model_frames)) or "no"
        motion = (
            f", {self.consistent / self.registered:.0%} of them consistent with VIO"
            if self.model_frames and self.has_vio
            else ""
        )
        return (
            f"{self.name} ({self.mapper}): {self.verified} of {self.pairs} pairs verified, "
            f"models of {sizes} frames{motion}"
        )


@dataclass(frozen=True)
class Step:
    """What an attempt changes, and the outcomes of the attempt before that it may help with."""

    name: AttemptName
    changes: dict[str, Any]
    helps: tuple[AttemptOutcome, ...] = (*_TOO_SMALL, AttemptOutcome.INCONSISTENT_WITH_VIO)


@dataclass(frozen=True)
class Attempts(Generic[Result]):
    """All attempts in order, and the index and result of the selected one; None where none has enough frames."""

    attempts: list[Attempt]
    selected: int | None
    result: Result | None


def outcome_of(model_frames: list[int], consistent: int, frames: int, settings: SfmSettings) -> AttemptOutcome:
    """The outcome of an attempt at `frames`, whose models have `model_frames` each, `consistent` of them with VIO."""
    registered = sum(model_frames)
    if not model_frames:
        return AttemptOutcome.NO_MODEL
    if registered < settings.min_registered_fraction * frames:
        return AttemptOutcome.TOO_FEW_REGISTERED
    if consistent < settings.min_consistent_fraction * registered:
        return AttemptOutcome.INCONSISTENT_WITH_VIO
    is_enough = registered >= settings.target_registered_fraction * frames
    return AttemptOutcome.ACCEPTED if is_enough else AttemptOutcome.FRAMES_MISSING


def steps_of(settings: SfmSettings) -> list[Step]:
    """All steps in order; VIO as a start comes last."""
    steps = [Step(AttemptName.DEFAULT, {})]
    if not settings.retry:
        return steps
    more = {
        "sequence_pairs": 2 * settings.sequence_pairs,
        "vio_pairs": 2 * settings.vio_pairs + 5,
        "retrieval_pairs": 2 * settings.retrieval_pairs + 5,
        "transitive_pairs": 2 * settings.transitive_pairs + 5,
    }
    steps.append(Step(AttemptName.MORE_PAIRS, more, (*_TOO_SMALL, AttemptOutcome.FRAMES_MISSING)))
    # Pairs of far frames, and those of few matches, are what bends a model or merges distinct places.
    stricter = {
        "vio_max_distance_m": settings.vio_max_distance_m / 2,
        "vio_max_angle_deg": 0.75 * settings.vio_max_angle_deg,
        "min_inliers": 2 * settings.min_inliers,
    }
    steps.append(Step(AttemptName.STRICTER_PAIRS, stricter, (AttemptOutcome.INCONSISTENT_WITH_VIO,)))
    finer = {
        "max_features": 2 * settings.max_features,
        "max_image_size": 2 * settings.max_image_size,
        "min_contrast": settings.min_contrast / 2,
    }
    steps.append(Step(AttemptName.MORE_FEATURES, finer))
    others = (m for m in ("global", "incremental") if m != settings.mapper)
    steps += [Step(AttemptName.OTHER_MAPPER, {"mapper": mapper}) for mapper in others]
    if settings.mapper != "vio":
        steps.append(Step(AttemptName.VIO_START, {"mapper": "vio"}))
    return steps


def run_attempts(
    settings: SfmSettings,
    attempt: Callable[[int, AttemptName, SfmSettings], tuple[Attempt, Result]],
    report: Callable[[str], None],
) -> Attempts[Result]:
    """Attempt until the outcome is good enough; the first accepted one is selected, or else, of those with enough
    frames, one that is consistent with VIO, and of several the first of those with the most consistent frames. An error
    ends it where one can be selected already, and is raised where none can.

    `attempt` gets the number, the name and the settings of each. A step keeps what the ones before it changed, but not
    where that cost it frames. `report` gets a line for each further attempt.
    """
    attempts: list[Attempt] = []
    selected: int | None = None
    result: Result | None = None
    for step in steps_of(settings):
        if attempts:
            if attempts[-1].outcome not in step.helps:
                continue
            report(f"{attempts[-1]}; trying again: {step.name}")
        changed = settings.model_copy(update=step.changes)
        try:
            current, made = attempt(len(attempts), step.name, changed)
        except UserError as error:
            if selected is None:
                raise
            report(f"{step.name} ended with an error, an earlier attempt is used: {error.what}")
            break
        cost_frames = bool(attempts) and attempts[-1].outcome in _USABLE and current.outcome in _TOO_SMALL
        attempts.append(current)
        is_better = selected is None or _merit(current) > _merit(attempts[selected])
        if current.outcome in _USABLE and is_better:
            selected, result = len(attempts) - 1, made
        if _is_last(attempts):
            break
        if not cost_frames:
            settings = changed
    return Attempts(attempts, selected, result)


def _merit(attempt: Attempt) -> tuple[bool, bool, int]:
    """By which of two usable attempts the larger one is selected."""
    outcome = attempt.outcome
    return outcome is AttemptOutcome.ACCEPTED, outcome is not AttemptOutcome.INCONSISTENT_WITH_VIO, attempt.consistent


def _is_last(attempts: list[Attempt]) -> bool:
    """Whether no further attempt is needed, or would help."""
    current = attempts[-1]
    if current.outcome is AttemptOutcome.ACCEPTED:
        return True
    if current.outcome is AttemptOutcome.INCONSISTENT_WITH_VIO and current.input_fault:
        return True
    # A model that is consistent with VIO is good enough without the rest of the frames, once more pairs were tried.
    return len(attempts) > 1 and any(a.outcome is AttemptOutcome.FRAMES_MISSING for a in attempts)
