"""A picture that is painted in metres: what every surface of a simulated place is textured with."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Concatenate, ParamSpec

import cv2
import numpy as np
from numpy.typing import NDArray

Bgr = tuple[float, float, float]
Field = NDArray[np.float32]
Material = Callable[["Canvas"], None]  # paints a whole canvas
Look = ParamSpec("Look")
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)


class Canvas:
    """An 8-bit BGR image addressed in metres: x to the right and y up from the bottom left corner.

    `image` is (H, W, 3); `rng` is the only source of chance, so a canvas painted twice is the same twice.
    """

    def __init__(self, width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> None:
        self.width_m = width_m
        self.height_m = height_m
        self.texel_m = texel_m
        self.rng = rng
        shape = (max(4, round(height_m / texel_m)), max(4, round(width_m / texel_m)))
        self.image = np.full((*shape, 3), 128, np.uint8)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.image.shape[0], self.image.shape[1]

    def px(self, x: float, y: float) -> tuple[int, int]:
        """The texel that holds (x, y) metres."""
        h, w = self.shape
        return round(x / self.width_m * w), round((1 - y / self.height_m) * h)

    def noise(self, wavelengths_m: Sequence[float], gains: Sequence[float] | None = None) -> Field:
        """Smooth random field (H, W) of about unit deviation: the sum of one octave a wavelength.

        Octaves finer than two texels are left out, as the picture can't show them.
        """
        h, w = self.shape
        total = np.zeros((h, w), np.float32)
        power = 0.0
        for wavelength, gain in zip(wavelengths_m, gains or [1.0] * len(wavelengths_m), strict=True):
            if wavelength < 2 * self.texel_m:
                continue
            total += gain * self._octave(wavelength)
            power += gain * gain
        return total / np.float32(max(math.sqrt(power), 1e-6))

    def _octave(self, wavelength_m: float) -> Field:
        h, w = self.shape
        step = max(1.0, wavelength_m / 2 / self.texel_m)
        rows, columns = math.ceil(h / step) + 3, math.ceil(w / step) + 3
        grid = self.rng.standard_normal((rows, columns), dtype=np.float32)
        offset = self.rng.uniform(0, 1, 2)
        scale = np.array([[1 / step, 0, 1 + offset[0]], [0, 1 / step, 1 + offset[1]]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        field = cv2.warpAffine(grid, scale, (w, h), flags=flags, borderMode=cv2.BORDER_REFLECT_101)
        return np.asarray(field, np.float32)

    def fill(self, colour: Bgr) -> None:
        self.image[:] = _byte(colour)

    def add(self, field: Field, colour: Bgr = (1.0, 1.0, 1.0)) -> None:
        """Add `field` (H, W) times `colour`, in grey levels."""
        for channel in range(3):
            if colour[channel]:
                levels = field * np.float32(colour[channel])
                self.image[..., channel] = cv2.add(self.image[..., channel], levels, dtype=cv2.CV_8U)

    def blend(self, amount: Field, colour: Bgr) -> None:
        """Mix in `colour` where `amount` (H, W; 0 to 1) says so."""
        amount = np.clip(amount, 0, 1)
        for channel in range(3):
            self.image[..., channel] = (1 - amount) * self.image[..., channel] + amount * colour[channel]

    def box(self, x0: float, y0: float, x1: float, y1: float, colour: Bgr) -> None:
        """A filled rectangle, x0..x1 by y0..y1 metres."""
        (c0, r1), (c1, r0) = self.px(x0, y0), self.px(x1, y1)
        self.image[max(r0, 0) : max(r1, 0), max(c0, 0) : max(c1, 0)] = _byte(colour)

    def polygon(self, points_m: Sequence[tuple[float, float]], colour: Bgr) -> None:
        cv2.fillPoly(self.image, [self._fine(points_m)], colour, cv2.LINE_AA, shift=4)

    def line(self, points_m: Sequence[tuple[float, float]], width_m: float, colour: Bgr) -> None:
        thickness = max(1, round(width_m / self.texel_m))
        cv2.polylines(self.image, [self._fine(points_m)], False, colour, thickness, cv2.LINE_AA, shift=4)

    def disc(self, x: float, y: float, radius_m: float, colour: Bgr) -> None:
        centre = self._fine([(x, y)])[0]
        cv2.circle(self.image, centre, round(16 * radius_m / self.texel_m), colour, -1, cv2.LINE_AA, shift=4)

    def text(self, x: float, y: float, height_m: float, text: str, colour: Bgr, max_width_m: float) -> None:
        """One line of text, its baseline at (x, y), made smaller where `max_width_m` asks for it."""
        font = _FONTS[self.rng.integers(len(_FONTS))]
        scale = height_m / self.texel_m / 22  # Hershey capitals are about 22 texels high at scale 1
        width = cv2.getTextSize(text, font, scale, 1)[0][0] * self.texel_m
        scale *= min(1.0, max_width_m / max(width, 1e-6))
        thickness = max(1, round(scale * 2.2))
        cv2.putText(self.image, text, self.px(x, y), font, scale, colour, thickness, cv2.LINE_AA)

    def inset(self, x0: float, y0: float, x1: float, y1: float, paint: Callable[["Canvas"], None]) -> None:
        """Paint a rectangle as a canvas of its own; what lies outside this canvas is cut off."""
        part = Canvas(x1 - x0, y1 - y0, self.texel_m, self.rng)
        paint(part)
        column, bottom = self.px(x0, y0)
        row = bottom - part.shape[0]
        h, w = self.shape
        r0, c0 = max(row, 0), max(column, 0)
        r1, c1 = min(row + part.shape[0], h), min(column + part.shape[1], w)
        if r1 > r0 and c1 > c0:
            self.image[r0:r1, c0:c1] = part.image[r0 - row : r1 - row, c0 - column : c1 - column]

    def area(self, points_m: Sequence[tuple[float, float]], paint: Callable[["Canvas"], None]) -> None:
        """Paint the inside of a polygon with a material."""
        points = np.array(points_m)
        (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
        mask = np.zeros(self.shape, np.uint8)
        cv2.fillPoly(mask, [self._fine(points_m)], 255, cv2.LINE_AA, shift=4)
        under = self.image.copy()
        self.inset(x0, y0, x1, y1, paint)
        opacity = (mask.astype(np.float32) / 255)[..., None]
        self.image = (opacity * self.image + (1 - opacity) * under).astype(np.uint8)

    def _fine(self, points_m: Sequence[tuple[float, float]]) -> NDArray[np.int32]:
        """Points in 1/16 texel, as cv2 takes them with shift=4 (its pixel centres are whole numbers)."""
        h, w = self.shape
        points = np.asarray(points_m, float)
        columns = points[:, 0] / self.width_m * w - 0.5
        rows = (1 - points[:, 1] / self.height_m) * h - 0.5
        return np.round(np.stack([columns, rows], axis=1) * 16).astype(np.int32)


def material(paint: Callable[Concatenate[Canvas, Look], None]) -> Callable[Look, Material]:
    """A function that paints a canvas by further arguments, as one that takes these and returns the material."""

    @functools.wraps(paint)
    def of(*args: Look.args, **kwargs: Look.kwargs) -> Material:
        return lambda c: paint(c, *args, **kwargs)

    return of


def _byte(colour: Bgr) -> NDArray[np.uint8]:
    return np.clip(np.round(colour), 0, 255).astype(np.uint8)


def vary(colour: Bgr, rng: np.random.Generator, amount: float) -> Bgr:
    """A colour near `colour`: brighter or darker, and a little off in hue."""
    shift = rng.normal(0, amount) + rng.normal(0, amount / 3, 3)
    blue, green, red = np.clip(np.asarray(colour) + shift, 0, 255)
    return float(blue), float(green), float(red)
