"""The structure localisers: what a record of one says, what one does, and the features that it is built from."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from groundwalk.geometry import Array
from groundwalk.store.registry import Colour, Entry, Lazy, Registry, callable_faults, colour_faults
from groundwalk.store.settings import Settings

if TYPE_CHECKING:
    from groundwalk.features.sift import Features
    from groundwalk.geometry.cameras import Camera
    from groundwalk.localisation.prepared import Prepared, Track
    from groundwalk.localisation.results import QueryResult

Grey = NDArray[np.uint8]
Size = tuple[int, int]


class StructureSettings(Settings):
    """How training frames and queries are turned into features."""

    max_features: int = Field(1024, ge=64, description="SIFT features kept per image, of training frames and queries")
    max_side: int = Field(640, ge=160, description="images are shrunk to this many pixels on the longer side")


class LocaliserSettings(Settings):
    """Base of a structure localiser's settings."""


@dataclass(frozen=True)
class FeatureKind:
    """How images are described, and a query is matched with one.

    `extract(grey, max_features, max_side)` gives the features of an image (H, W), the strongest first. `match(query,
    image, query_size, image_size)` gives rows (M, 2) of features that match; descriptors are of unit length, sizes are
    width and height in px. Training frames, whose poses are known, are matched by mutually nearest descriptors whose
    second nearest are farther by `ratio`, where their rays meet.
    """

    id: str
    ratio: float
    extract: "Callable[[Grey, int, int], Features]" = field(repr=False)
    match: "Callable[[Features, Features, Size, Size], NDArray[np.int64]]" = field(repr=False)


SIFT = FeatureKind(
    "SIFT", 0.85, Lazy("groundwalk.features.sift:sift"), Lazy("groundwalk.localisation.matching:match_sift")
)


class Localiser(Protocol):
    """Answers queries from points of a map."""

    @property
    def xyz(self) -> Array:
        """The points (P, 3) in the map."""
        ...

    def bytes_by_part(self) -> dict[str, int]:
        """What a query needs, in bytes."""
        ...

    def localise(
        self, grey: Grey, camera: "Camera", gravity: Array | None = None, prior: Array | None = None, *, seed: int = 0
    ) -> "QueryResult":
        """The answer for a grey image (H, W). camera: as the phone logged it; gravity: unit vector (3,), down, in the
        camera; prior: about where the camera is, map_T_cam (4, 4). What a localiser has no use for it ignores."""
        ...


class FileLocaliser(Localiser, Protocol):
    """A localiser out of a file of its own."""

    @property
    def scene(self) -> str: ...


@dataclass(frozen=True)
class LocaliserFile:
    """How a localiser is kept: its file's suffix, `write(path, localiser)` and `read(path)`, which raises UserError for
    a file that it can't use."""

    suffix: str
    write: Callable[[Path, Any], None]
    read: Callable[[Path], FileLocaliser]


@dataclass(frozen=True, kw_only=True)
class StructureLocaliser(Entry):
    """A structure localiser: `build(prepared, settings, track)` makes it from training frames and
    shows progress with `track`.

    colour: of its poses in recordings. settings: its section [localise.localisers.<id>]. file: how it's kept for
    queries outside the stage; None where it isn't. features: the kind that the frames are prepared with. by_default:
    built where settings name none.
    """

    noun: ClassVar[str] = "structure localiser"

    colour: Colour
    settings: type[LocaliserSettings]
    build: Callable[["Prepared", Any, "Track"], Localiser] = field(repr=False)
    file: LocaliserFile | None
    features: FeatureKind = SIFT
    by_default: bool = False

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from colour_faults(self.colour)
        yield from callable_faults(self, ["build"])
        if not (isinstance(self.settings, type) and issubclass(self.settings, LocaliserSettings)):
            yield f"settings is {self.settings!r}, not a class derived from LocaliserSettings"
        if not (self.file is None or isinstance(self.file, LocaliserFile)):
            yield f"file is {self.file!r}, not a LocaliserFile or None"
        if not isinstance(self.features, FeatureKind):
            yield f"features is {self.features!r}, not a FeatureKind"


LOCALISERS = Registry("groundwalk.structure_localisers", StructureLocaliser)
