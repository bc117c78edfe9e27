"""The layouts that ground truth and regressors are exported in: what a record of one says, and those that there are."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from groundwalk.export.dataset import Dataset, Images
from groundwalk.store.registry import Entry, Registry, callable_faults

if TYPE_CHECKING:
    from groundwalk.export.regressor import TrainedRegressor


@dataclass(frozen=True, kw_only=True)
class Exporter(Entry):
    """A layout: `write(dataset, folder, images)` writes it into an empty folder and returns each frame's image path in
    it, "" where it has none, in the order of `dataset.frames`.

    distortion_coefficients: how many of OpenCV's (k1, k2, p1, p2, k3, ...) its cameras hold, None for any number. The
    dataset's images with more are those of a pinhole by then.
    """

    noun: ClassVar[str] = "export format"

    write: Callable[[Dataset, Path, Images], list[str]] = field(repr=False)
    distortion_coefficients: int | None

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["write"])
        if self.distortion_coefficients is not None and not isinstance(self.distortion_coefficients, int):
            yield f"distortion_coefficients is {self.distortion_coefficients!r}, not a whole number or None"


EXPORTERS = Registry("groundwalk.exporters", Exporter)


@dataclass(frozen=True, kw_only=True)
class ModelExporter(Entry):
    """A layout of a trained regressor: `write(regressor, folder)` writes it into an empty folder and returns what to
    tell the user of it, a line each.

    note: the file in the folder that tells an export from another folder, a JSON object with the members `format` and
    `files`, the names of all other files (a list, or an object's keys).
    """

    noun: ClassVar[str] = "model format"

    write: Callable[["TrainedRegressor", Path], list[str]] = field(repr=False)
    note: str

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["write"])
        if not isinstance(self.note, str):
            yield f"note is {self.note!r}, not a file's name"


MODEL_EXPORTERS = Registry("groundwalk.model_exporters", ModelExporter)
