"""What a stage is: everything that must be known of it to tell whether it is to run."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

from groundwalk.store.settings import Settings

if TYPE_CHECKING:
    from groundwalk.store.stage import StageRun

S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Stage(Generic[S]):
    """A stage of the pipeline.

    `version` goes up when the same input gives another output, so that old artefacts are made again.
    `run` is a `Lazy`, as what it needs takes seconds to import, and most commands don't run it.
    `reads_captures` is for import, the one stage whose input is the capture folder.
    """

    name: str
    version: int
    settings: type[S]
    needs: tuple[str, ...]
    run: Callable[["StageRun[S]"], None]
    help: str
    wants: tuple[str, ...] = ()
    """Further stages that it reads where they are finished and made from what is there now."""
    reads_captures: bool = False
    reads_shipped: tuple[str, ...] = ()  # folders of data/, whose files come with groundwalk
    files: Callable[[S], Iterable[str]] = lambda settings: ()
    """Further files that the settings name, relative to the data folder."""
    reads_images: Callable[[S], bool] = lambda settings: False
    """Whether it reads the images of import.frames, which are then verified before."""
    plugins: Callable[[S], Mapping[str, str]] = lambda settings: {}
    """Package and version of what other packages bring to a run with these settings, by id."""
    space_bytes: Callable[[S, int], int] = lambda settings, frames: (16 << 20) + 50_000 * frames
    """About what a run with so many frames takes of the disk, checkpoints and all."""
