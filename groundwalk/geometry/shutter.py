"""A rolling shutter: when each pixel of an image is exposed, and where its camera is then.

A sensor reads its rows one after another. They run along the image's rows where the image is as the sensor has it, and
along its columns where an app has turned it upright.
"""

from collections.abc import Iterable

import numpy as np
import scipy
from numpy.typing import ArrayLike

from groundwalk.geometry.poses import Array, make_pose

# Phones' sensors take up to 35 ms; what is stated beyond this is no readout time.
MAX_READOUT_S = 0.1
# By the side of the image that is read out first: factors of x / width and y / height, and the constant, of the share
# of the readout.
_SHARE = {"top": (0, 1, -0.5), "right": (-1, 0, 0.5), "bottom": (0, -1, 0.5), "left": (1, 0, -0.5)}


def usual_first_row(width: int, height: int) -> str:
    """The side of a phone's image that is read out first where nothing says so: sensors read the rows of landscape
    images from the top, and apps turn these clockwise to make portrait ones."""
    return "right" if height > width else "top"


def turned_side(side: str, quarters: int) -> str:
    """Where a side of an image lies after quarter turns clockwise."""
    sides = list(_SHARE)
    return sides[(sides.index(side) + quarters) % len(sides)]


def readout_lines(first_row: Iterable[str], width_N: ArrayLike, height_N: ArrayLike) -> Array:
    """(N, 3) a, b, c of each image, for `readout_fraction`.

    `first_row` are the sides that the sensor reads out first (`top`, `right`, `bottom`, `left`), sizes are in pixels.
    """
    lines = np.array([_SHARE[side] for side in first_row], float).reshape(-1, 3)
    lines[:, 0] /= np.asarray(width_N, float)
    lines[:, 1] /= np.asarray(height_N, float)
    return lines


def readout_fraction(line: Array, xy_M2: Array) -> Array:
    """(M,) when pixels (M, 2) are exposed after the middle row, as a share of the readout time, -0.5 to 0.5:
    a x + b y + c, with `line` (3,) of all or (M, 3) of each, and the first pixel's outer corner at (0, 0)."""
    return line[..., 0] * xy_M2[:, 0] + line[..., 1] * xy_M2[:, 1] + line[..., 2]


def sensor_axes(readout_line_N3: Array) -> Array:
    """(N, 2, 2) along what the sensor's rows and columns run in each image, which may have been turned."""
    down = np.sign(readout_line_N3[:, :2])
    return np.stack([np.column_stack([down[:, 1], -down[:, 0]]), down], axis=1)


def rows_in_camera(angular_M3: Array, velocity_M3: Array, tau_M: Array) -> Array:
    """cam_T_row (M, 4, 4): the camera at a row's time, `tau_M` seconds after the middle row, in its axes at that.

    It turns by its angular velocity (M, 3), rad/s, and moves by its velocity (M, 3), both in its axes.
    """
    tau = np.asarray(tau_M, float)[:, None]
    return make_pose(scipy.spatial.transform.Rotation.from_rotvec(angular_M3 * tau).as_matrix(), velocity_M3 * tau)
