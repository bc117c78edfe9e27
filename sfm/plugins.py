"""What other packages can add to sfm, mappers: their record, groundwalk's own, and the registry."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

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


@dataclass(frozen=True, kw_only=True)
class MapperEntry(Entry):
    """A mapper: `run(source, folder, registered)`. `folder` is to write in; `registered` is called for each registered
    image, where it can be."""

    noun: ClassVar[str] = "mapper"

    run: Callable[[MappingInput, Path, Callable[[], None]], "list[pycolmap.Reconstruction]"] = field(repr=False)

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["run"])


MAPPERS = Registry("groundwalk.mappers", MapperEntry)

INCREMENTAL, GLOBAL = (
    MapperEntry(
        id=name,
        label=name,
        meaning=f"COLMAP's {name} mapping",
        run=Lazy(f"groundwalk.sfm.mapping.mappers:{name}_mapping"),
    )
    for name in ("incremental", "global")
)
