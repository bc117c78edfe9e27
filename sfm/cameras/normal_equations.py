"""Blocks of a bundle adjustment's normal equations, and what a similarity does to its poses.

A pose's errors are a rotation (rad, 3) and a position (sfm units, 3) along the sfm axes: true rotation =
exp(rotation) @ sfm_R_cam, true position = position of sfm_T_cam + position.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from groundwalk.geometry.poses import Array, skew


def block_rows(
    blocks: Array, frame_M: NDArray[np.int64], point_M: NDArray[np.int64], frames: int, points: int
) -> bsr_array:
    """Blocks (M, b, k), one an observation, as a sparse (b frames, k points) matrix of blocks: products of such are
    three times as fast as of single numbers."""
    order = np.lexsort((point_M, frame_M))
    starts = np.concatenate([[0], np.cumsum(np.bincount(frame_M, minlength=frames))])
    shape = (blocks.shape[1] * frames, blocks.shape[2] * points)
    return bsr_array((blocks[order], point_M[order], starts), shape=shape)


def similarities(position_N3: Array) -> Array:
    """What a turn, a shift and a growth of the whole model about its middle do to each pose, (N, 6, 7)."""
    centred = position_N3 - position_N3.mean(axis=0)
    gauge = np.zeros((len(position_N3), 6, 7))
    gauge[:, :3, :3] = np.eye(3)
    gauge[:, 3:, :3] = -skew(centred)
    gauge[:, 3:, 3:6] = np.eye(3)
    gauge[:, 3:, 6] = centred
    return gauge
