"""The layouts that ground truth is exported in: what a record of one says, and those that there are."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal, get_args

from groundwalk.export.dataset import Dataset, Images
from groundwalk.store.registry import Entry, Registry, callable_faults

Cameras = Literal["frame", "alike", "pinhole"]


@dataclass(frozen=True, kw_only=True)
class Exporter(Entry):
    """A layout: `write(dataset, folder, images)` writes it into an empty folder and returns each frame's image path in
    it, "" where it has none, in the order of `dataset.frames`.

    distortion_coefficients: how many of OpenCV's (k1, k2, p1, p2, k3, ...) its cameras hold, None for any number. The
    dataset's images with more are those of a pinhole by then.
    cameras: "frame", each frame has its own; "alike", frames of one device and lens share one where it hardly matters;
    "pinhole", all images are those of one undistorted pinhole a device and lens.
    """

    noun: ClassVar[str] = "export format"

    write: Callable[[Dataset, Path, Images], list[str]] = field(repr=False)
    distortion_coefficients: int | None
    cameras: Cameras = "frame"

    def with_its_cameras(self, dataset: Dataset) -> Dataset:
        """The dataset with cameras that the layout can hold."""
        if self.cameras == "pinhole":
            return dataset.with_pinholes()
        if self.cameras == "alike":
            dataset = dataset.with_shared_cameras()
        most = self.distortion_coefficients
        return dataset if most is None else dataset.without_distortion(most)

    def faults(self) -> Iterable[str]:
        yield from super().faults()
        yield from callable_faults(self, ["write"])
        if self.distortion_coefficients is not None and not isinstance(self.distortion_coefficients, int):
            yield f"distortion_coefficients is {self.distortion_coefficients!r}, not a whole number or None"
        if self.cameras not in get_args(Cameras):
            yield f"cameras is {self.cameras!r}, not one of {', '.join(get_args(Cameras))}"


EXPORTERS = Registry("groundwalk.exporters", Exporter)
