"""What other packages can add to sfm, mappers: their record, groundwalk's own, and the registry."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Protocol

from groundwalk.store.registry import Entry, Lazy, Registry, callable_faults

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class MappingInput:
    """What a mapper starts from: the database of verified pairs and its images. Every mapper holds the database's
    intrinsics fixed."""

    database: Path
    images: Path
    seed: int


class Mapper(Protocol):
    """`folder` is for the mapper to write in; `registered` is called for each registered image, where it can be."""

    def __call__(
        self, source: MappingInput, folder: Path, registered: Callable[[], None]
    ) -> "list[pycolmap.Reconstruction]": ...


@dataclass(frozen=True, kw_only=True)
class MapperEntry(Entry):
    """A mapper: `run(source, folder, registered)`, as `Mapper` describes."""

    noun: ClassVar[str] = "mapper"

    run: Mapper = field(repr=False)

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["run"])


MAPPERS = Registry("groundwalk.mappers", MapperEntry)

INCREMENTAL = MapperEntry(
    id="incremental",
    label="incremental",
    meaning="COLMAP's incremental mapping",
    run=Lazy("groundwalk.sfm.mapping.mappers:incremental"),
)
GLOBAL = MapperEntry(
    id="global", label="global", meaning="COLMAP's global mapping", run=Lazy("groundwalk.sfm.mapping.mappers:global_")
)
HIERARCHICAL = MapperEntry(
    id="hierarchical",
    label="hierarchical",
    meaning="COLMAP's hierarchical mapping",
    run=Lazy("groundwalk.sfm.mapping.mappers:hierarchical"),
)
