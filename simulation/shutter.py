"""A rolling shutter: the rows of a picture are exposed one after another while the camera moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import inverse, quaternion_from_matrix
from groundwalk.simulation.place import Vec

F32 = NDArray[np.float32]
_ROWS = (-0.5, -0.25, 0.25, 0.5)  # of the height, from the middle row


@dataclass(frozen=True)
class Shutter:
    """The camera's motion over the rows, in the axes of its pose at the middle row, as polynomials without constant in
    a row's height u = y / height - 0.5: `turn_33` (axis times the tangent of half the angle), `shift_33` (metres).
    """

    turn_33: Vec
    shift_33: Vec

    def motion(self, u: F32) -> tuple[list[F32], list[F32]]:
        """Turn and shift at rows u (N,): three arrays (N,) each."""
        return [_polynomial(c, u) for c in self.turn_33.T], [_polynomial(c, u) for c in self.shift_33.T]


def row_times(readout_s: float) -> Vec:
    """When the rows are exposed whose poses `shutter` asks for, seconds from the middle row."""
    return readout_s * np.array(_ROWS)


def shutter(world_T_middle: Vec, world_T_row: Vec) -> Shutter:
    """The shutter of a camera whose poses are `world_T_middle` (4, 4) at the middle row and `world_T_row` (4, 4, 4) at
    `row_times`."""
    middle_T_row = inverse(world_T_middle) @ world_T_row
    quaternion = quaternion_from_matrix(middle_T_row[:, :3, :3])
    powers = np.stack([np.array(_ROWS) ** k for k in (1, 2, 3)], axis=1)
    return Shutter(
        np.linalg.lstsq(powers, quaternion[:, :3] / quaternion[:, 3:])[0],
        np.linalg.lstsq(powers, middle_T_row[:, :3, 3])[0],
    )


def turned(turn: list[F32], x: F32, y: F32) -> tuple[F32, F32, F32]:
    """Vectors (x, y, 1), each turned by its own rotation (axis times the tangent of half the angle)."""
    a, b, c = turn
    # v + 2 / (1 + |g|²) (g x v + g x (g x v))
    p, q, r = b - c * y, c * x - a, a * y - b * x
    scale = np.float32(2) / (1 + a * a + b * b + c * c)
    return (
        x + scale * (p + b * r - c * q),
        y + scale * (q + c * p - a * r),
        1 + scale * (r + a * q - b * p),
    )


def _polynomial(coefficients_3: Vec, u: F32) -> F32:
    first, second, third = (np.float32(c) for c in coefficients_3)
    return np.asarray(u * (first + u * (second + u * third)), np.float32)
