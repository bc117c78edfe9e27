"""From an image to a network's input, in the steps that preprocessing.json lists.

docs/reference/bundle-format.md says what each does.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry import Array
from groundwalk.geometry.cameras import Camera, centred_pinhole
from groundwalk.geometry.gravity import upright_rotation, with_tilt_of_gravity
from groundwalk.runtime.queries import Query
from groundwalk.store.errors import UserError
from groundwalk.store.resizing import pinhole_image, small_image, turned_crop

_SAME_ASPECT = 0.02


@dataclass(frozen=True)
class _View:
    """What a step is given and gives: pixels (H, W, 3) uint8, or at last the network's input (1, 3, H, W) float32; the
    camera is that of the whole image, before a crop."""

    pixels: NDArray[Any]
    camera: Camera
    gravity: Array | None


@dataclass(frozen=True)
class Preprocessing:
    """The content of preprocessing.json.

    `image` is what the network was trained on (width, height, px); `lens` is what its training images' lens adds to the
    stated intrinsics (focal_factor, distortion); `steps` are run in their order.
    """

    image: Mapping[str, Any]
    lens: Mapping[str, Any]
    steps: tuple[Mapping[str, Any], ...]

    @classmethod
    def parsed(cls, content: Mapping[str, Any], where: object) -> "Preprocessing":
        """From JSON; UserError where it isn't one or has a step that there is not."""
        try:
            made = cls(content["image"], content["lens"], tuple(content["steps"]))
            names = [step["step"] for step in made.steps]
        except (KeyError, TypeError):
            raise UserError("a bundle's preprocessing isn't complete", where=where, do="export it again") from None
        unknown = [name for name in names if name not in _STEPS]
        if unknown:
            raise UserError(
                f"a bundle's preprocessing has a step that isn't known: {unknown[0]!r}",
                where=where,
                expected=f"one of {', '.join(_STEPS)}",
                do="update groundwalk",
            )
        return made

    @property
    def is_upright(self) -> bool:
        """Whether the network sees images that are turned until gravity points down."""
        return any(step["step"] == "upright_crop" for step in self.steps)

    def takes(self, width: int, height: int) -> bool:
        """Whether images of this size have a shape that the network can be asked about."""
        wanted_width, wanted_height = int(self.image["width_px"]), int(self.image["height_px"])
        turned = (width > height) != (wanted_width > wanted_height) and wanted_width != wanted_height
        is_alike = abs(width / height / (wanted_width / wanted_height) - 1) <= _SAME_ASPECT
        return not turned and (is_alike or any(step["step"] == "pinhole" for step in self.steps))

    def camera_rotation(self, map_R_seen: Array, gravity: Array | None) -> Array:
        """map_R_cam (3, 3) of the network's answer (3, 3), which is of the camera whose image it sees.

        An upright one is turned back, and tilted as gravity says, which knows better.
        """
        if not self.is_upright or gravity is None:
            return map_R_seen
        return with_tilt_of_gravity(map_R_seen @ upright_rotation(gravity).T, gravity)

    def run(self, query: Query) -> Iterator[tuple[str, NDArray[Any]]]:
        """Name and output of each step; the last is the network's input (1, 3, H, W), float32. UserError for an image
        that the network can't be asked about."""
        pixels = query.image if query.image.ndim == 3 else np.repeat(query.image[:, :, None], 3, axis=2)
        self._check(pixels, query)
        camera = query.camera.resized(pixels.shape[1], pixels.shape[0])
        factor = float(self.lens["focal_factor"])
        distortion = tuple(map(float, self.lens["distortion"]))
        camera = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor, distortion=distortion)
        view = _View(pixels, camera, query.gravity)
        for step in self.steps:
            view = _STEPS[step["step"]](view, step)
            yield step["step"], view.pixels

    def _check(self, pixels: NDArray[Any], query: Query) -> None:
        camera = query.camera
        height, width = pixels.shape[:2]
        wanted = int(self.image["width_px"]), int(self.image["height_px"])
        # A network that learnt from enlarged images may be asked about such ones, too.
        short = min(*wanted, *(int(step["short_side_px"]) for step in self.steps if "short_side_px" in step))
        expected = f"like the training images, {wanted[0]} x {wanted[1]} px, as the sensor delivers them"
        if min(width, height) < short:
            raise UserError(
                "an image is too small for this network",
                expected=f"{short} px or more on its shorter side",
                found=f"{width} x {height} px",
            )
        if not self.takes(width, height):
            raise UserError("an image has another shape", expected=expected, found=f"{width} x {height} px")
        if self.is_upright and query.gravity is None:
            raise UserError(
                "an image has no gravity, by which this network's images are turned upright",
                expected="down in camera axes: x right, y down, z forward",
            )
        if abs(camera.width / camera.height / (width / height) - 1) > _SAME_ASPECT:
            raise UserError(
                "intrinsics are of an image of another shape",
                expected=f"{width} x {height} px",
                found=f"{camera.width} x {camera.height} px",
            )


def _pinhole(view: _View, step: Mapping[str, Any]) -> _View:
    short, focal_px = int(step["short_side_px"]), float(step["focal_px"])
    pixels = pinhole_image(view.pixels, view.camera, short, focal_px / short)
    return replace(view, pixels=pixels, camera=centred_pinhole(pixels.shape[1], pixels.shape[0], focal_px))


def _resize(view: _View, step: Mapping[str, Any]) -> _View:
    pixels = small_image(view.pixels, int(step["short_side_px"]))
    return replace(view, pixels=pixels, camera=view.camera.resized(pixels.shape[1], pixels.shape[0]))


def _upright_crop(view: _View, step: Mapping[str, Any]) -> _View:
    assert view.gravity is not None
    cam_R_upright = upright_rotation(view.gravity)
    size = int(step["width_px"]), int(step["height_px"])
    return replace(view, pixels=turned_crop(view.pixels, view.camera.matrix, cam_R_upright, *size))


def _centre_crop(view: _View, step: Mapping[str, Any]) -> _View:
    height, width = int(step["height_px"]), int(step["width_px"])
    top, left = (view.pixels.shape[0] - height) // 2, (view.pixels.shape[1] - width) // 2
    return replace(view, pixels=view.pixels[top : top + height, left : left + width])


def _normalise(view: _View, step: Mapping[str, Any]) -> _View:
    mean, sd = np.array(step["mean"], np.float32), np.array(step["sd"], np.float32)
    values = (view.pixels.astype(np.float32) / np.float32(255) - mean) / sd
    return replace(view, pixels=np.ascontiguousarray(values.transpose(2, 0, 1)[None]))


_STEPS: dict[str, Callable[[_View, Mapping[str, Any]], _View]] = {
    "pinhole": _pinhole,
    "resize": _resize,
    "centre_crop": _centre_crop,
    "upright_crop": _upright_crop,
    "normalise": _normalise,
}
