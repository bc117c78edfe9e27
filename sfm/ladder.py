"""What is tried, one step after the other, where too few frames register."""

from collections.abc import Iterator
from dataclasses import dataclass

from sfm.settings import SfmSettings


@dataclass(frozen=True)
class Attempt:
    """One step of the ladder and what came of it; `kept` are the frames of each kept model, the largest first."""

    name: str
    mapper: str
    pairs: int
    verified: int
    kept: list[int]
    outcome: str

    def __str__(self) -> str:
        sizes = " + ".join(map(str, self.kept)) or "no"
        return f"{self.name} ({self.mapper}): {self.verified} of {self.pairs} pairs verified, models of {sizes} frames"


def ladder(settings: SfmSettings) -> Iterator[tuple[str, SfmSettings]]:
    """Attempts with their settings: each keeps what the one before it gained. VIO as a start comes last."""
    yield "as set", settings
    if not settings.retries:
        return
    tried = settings.model_copy(
        update={
            "sequence_pairs": 2 * settings.sequence_pairs,
            "vio_pairs": 2 * settings.vio_pairs + 5,
            "retrieval_pairs": 2 * settings.retrieval_pairs + 5,
            "transitive_pairs": 2 * settings.transitive_pairs + 5,
        }
    )
    yield "more pairs", tried
    # A feature needs more pixels around it than there are in a small image: doubling it finds more.
    tried = tried.model_copy(update={"max_features": 2 * settings.max_features, "first_octave": -1})
    yield "more features", tried
    if settings.mapper != "global":
        yield "other mapper", tried.model_copy(update={"mapper": "global"})
    if settings.mapper != "incremental":
        yield "other mapper", tried.model_copy(update={"mapper": "incremental"})
    if settings.mapper != "vio":
        yield "from VIO", tried.model_copy(update={"mapper": "vio"})
