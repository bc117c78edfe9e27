"""The registries of mappers and of retrieval, and the records in them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from groundwalk.store.registry import Entry, Registry, callable_faults

if TYPE_CHECKING:
    from groundwalk.sfm.database import Descriptors
    from groundwalk.sfm.mapping.mappers import Mapper


@dataclass(frozen=True, kw_only=True)
class MapperEntry(Entry):
    """A mapper: `run(source, folder, registered)`, as `mappers.Mapper` describes."""

    noun: ClassVar[str] = "mapper"

    run: "Mapper" = field(repr=False)

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["run"])


@dataclass(frozen=True, kw_only=True)
class RetrievalEntry(Entry):
    """A way to describe images by their features: `describe(descriptors, words, seed)` gives unit vectors (N, D) of N
    images, whose dot product is their similarity; zero for an image without features."""

    noun: ClassVar[str] = "retrieval"

    describe: "Callable[[Sequence[Descriptors], int, int], NDArray[np.float32]]" = field(repr=False)

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["describe"])


MAPPERS = Registry("groundwalk.mappers", MapperEntry)
RETRIEVALS = Registry("groundwalk.retrieval", RetrievalEntry)


def described_by(name: str, descriptors: "Sequence[Descriptors]", words: int, seed: int) -> NDArray[np.float32]:
    """The images' vectors by a retrieval; PluginError where one of another package fails or gives something else."""
    with RETRIEVALS.guard(name):
        vectors = RETRIEVALS.find(name).describe(descriptors, words, seed)
        if np.ndim(vectors) != 2 or len(vectors) != len(descriptors) or not np.isfinite(vectors).all():
            raise ValueError(
                f"describe gave an array of shape {np.shape(vectors)} for {len(descriptors)} images, "
                "expected finite numbers, a row an image"
            )
    return vectors
