"""The layouts that ground truth is exported in: what a record of one says, and those that there are."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from groundwalk.export.dataset import Dataset, Images
from groundwalk.store.registry import Entry, Registry, callable_faults


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
