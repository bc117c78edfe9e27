"""What is tried, one step after the other, where too few frames register or the models move otherwise than VIO."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from groundwalk.sfm.settings import SfmSettings

TAKEN = "taken"
TOO_FEW = "too few frames registered"
NO_MODEL = "no model"
MISSING = "frames missing"
OTHERWISE = "moves otherwise than VIO"

Found = TypeVar("Found")


@dataclass(frozen=True)
class Attempt:
    """One step of the ladder and what came of it; `kept` are the frames of each kept model, the largest first, and
    `agreeing` how many of them move as VIO does. `no_help` says what makes the others move otherwise
    where neither pairs nor mapper do."""

    name: str
    mapper: str
    pairs: int
    verified: int
    kept: list[int]
    agreeing: int
    outcome: str
    no_help: str = ""

    def __str__(self) -> str:
        sizes = " + ".join(map(str, self.kept)) or "no"
        moving = f", {self.agreeing / sum(self.kept):.0%} of which move as VIO does" if self.kept else ""
        return (
            f"{self.name} ({self.mapper}): {self.verified} of {self.pairs} pairs verified, "
            f"models of {sizes} frames{moving}"
        )


@dataclass(frozen=True)
class Step:
    """A step of the ladder: what it changes, and the outcomes of the attempt before that it may help with."""

    name: str
    changes: dict[str, Any]
    helps: tuple[str, ...] = (TOO_FEW, NO_MODEL, OTHERWISE)


def outcome_of(kept: list[int], agreeing: int, frames: int, settings: SfmSettings) -> str:
    """What came of an attempt whose kept models have so many of the `frames`, of which `agreeing` move as VIO does."""
    registered = sum(kept)
    if not kept:
        return NO_MODEL
    if registered < settings.min_registered * frames:
        return TOO_FEW
    if agreeing < settings.min_agreeing * registered:
        return OTHERWISE
    return TAKEN if registered >= settings.wanted_registered * frames else MISSING


def ladder(settings: SfmSettings) -> list[Step]:
    """All steps in order; VIO as a start comes last."""
    steps = [Step("as set", {})]
    if not settings.retries:
        return steps
    more = {
        "sequence_pairs": 2 * settings.sequence_pairs,
        "vio_pairs": 2 * settings.vio_pairs + 5,
        "retrieval_pairs": 2 * settings.retrieval_pairs + 5,
        "transitive_pairs": 2 * settings.transitive_pairs + 5,
    }
    steps.append(Step("more pairs", more, (TOO_FEW, NO_MODEL, MISSING)))
    # Pairs are what bends a model or folds it: those of far frames, and those that few matches speak for.
    surer = {
        "vio_max_distance_m": settings.vio_max_distance_m / 2,
        "vio_max_angle_deg": 0.75 * settings.vio_max_angle_deg,
        "min_inliers": 2 * settings.min_inliers,
    }
    steps.append(Step("surer pairs", surer, (OTHERWISE,)))
    # A feature needs more pixels around it than there are in a small image: doubling it finds more.
    steps.append(Step("more features", {"max_features": 2 * settings.max_features, "first_octave": -1}))
    steps += [Step("other mapper", {"mapper": m}) for m in ("global", "incremental") if m != settings.mapper]
    if settings.mapper != "vio":
        steps.append(Step("from VIO", {"mapper": "vio"}))
    return steps


def climb(
    settings: SfmSettings,
    attempt: Callable[[int, str, SfmSettings], tuple[Attempt, Found]],
    say: Callable[[str], None],
) -> tuple[list[Attempt], int | None, Found | None]:
    """The attempts that were made, and the index and find of the one to take: the first that passes, or else, of those
    with frames enough, the first of those of whose frames most move as VIO does. None where none has enough.

    `attempt` gets the number, the name and the settings of each. A step keeps what the ones before it changed, but not
    where that cost it the frames that it had.
    """
    attempts: list[Attempt] = []
    index: int | None = None
    best: Found | None = None
    for step in ladder(settings):
        if attempts:
            if attempts[-1].outcome not in step.helps:
                continue
            say(f"{attempts[-1]}; trying again: {step.name}")
        changed = settings.model_copy(update=step.changes)
        told, found = attempt(len(attempts), step.name, changed)
        lost = bool(attempts) and attempts[-1].outcome in (MISSING, OTHERWISE) and told.outcome in (TOO_FEW, NO_MODEL)
        attempts.append(told)
        passing = (TAKEN, MISSING, OTHERWISE)
        if told.outcome in passing and (index is None or told.agreeing > attempts[index].agreeing):
            index, best = len(attempts) - 1, found
        if told.outcome == TAKEN or (told.outcome == OTHERWISE and told.no_help):
            break
        if len(attempts) > 1 and any(tried.outcome == MISSING for tried in attempts):
            # One that moves as VIO does is good enough without the rest of the frames.
            break
        if not lost:
            settings = changed
    return attempts, index, best
