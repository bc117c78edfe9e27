"""Which way is up by the straight lines in images? Edges of most rooms and houses run along three directions at right
angles, one of which is vertical.

A line's image and the camera's centre span a plane in which the line's direction lies: edges along one direction have
planes whose normals are at right angles to it, in whatever images they are seen. After Coughlan and Yuille, "Manhattan
World", ICCV 1999.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from groundwalk.geometry.fits import rotation_to_up
from groundwalk.geometry.poses import Array

# A line counts less the further its normal is from a right angle to an axis, and nothing from here on; an axis is
# fitted to more of them at first.
_WIDTH = np.radians(1.5)
_FITTED_WIDTHS = 2 * _WIDTH, 1.5 * _WIDTH, _WIDTH
# Directions at which lines are counted, two degrees apart; the best of them, not too near to each other, are tried as
# axes, two by two where they are nearly at right angles.
_DIRECTIONS, _TRIED, _APART = 5000, 25, np.radians(5.0)
# Axes are upright with one within this of +y.
_UPRIGHT = np.radians(5.0)
# The lines' longest in all are enough, and fit into memory.
_MAX_LINES = 2000
# Axes count if they explain so much of the lines' length, each of them so much, and so many times what others do. Of
# rooms, corridors and houses they explain 0.43 and more, 0.09 the least axis, 2.4 times the others'; of a chair in the
# middle or a board on the floor the best axes have 0.07 and 0.03 on the least (docs/explanation/import.md).
_MIN_EXPLAINED, _MIN_AXIS, _MIN_RATIO = 0.35, 0.06, 2.0
# Of a walk with upright images the mean of the cameras' up is within 16 degrees of the vertical axis; of images that
# look down at a table it is 78 off.
_MAX_FROM_CAMERAS = np.radians(30.0)


@dataclass(frozen=True)
class LineAxes:
    """How much of the lines' length the best three axes at right angles explain of which one is +y (`upright`), and the
    best of which none is (`tilted`, whose nearest axis is `tilt` radians from +y). `is_up`: what they say of +y; None
    where neither are the axes of a room."""

    upright: float
    tilted: float
    tilt: float
    is_up: bool | None


def up_by_lines(normals_N3: Array, lengths_N: Array, world_R_cam: Array) -> Array | None:
    """Up (3,) in a world whose vertical isn't known: of the best three axes the one that the upright images' mean up is
    near to, and that the cameras (K, 3, 3) turn about more than about the others. None where they aren't the axes of a
    room, or none is both."""
    longest = np.argsort(-lengths_N, kind="stable")[:_MAX_LINES]
    normals, weights = normals_N3[longest], lengths_N[longest]
    fitted = [_fitted(axes, normals, weights) for axes in _candidates(normals, weights)]
    best = max(fitted, key=lambda axes: float(_explained(axes, normals, weights).sum()))
    cameras_up = -world_R_cam[:, :, 1].mean(axis=0)
    towards = best @ cameras_up / max(float(np.linalg.norm(cameras_up)), 1e-12)
    nearest = int(np.abs(towards).argmax())
    first, second = np.triu_indices(len(world_R_cam), 1)
    turns = Rotation.from_matrix(world_R_cam[second] @ np.swapaxes(world_R_cam[first], 1, 2)).as_rotvec()
    turned_about = int(np.abs(turns @ best.T).sum(axis=0).argmax())
    if nearest != turned_about or np.abs(towards[nearest]) < np.cos(_MAX_FROM_CAMERAS):
        return None
    up = best[nearest] * np.sign(towards[nearest])
    return up if line_axes(normals_N3 @ rotation_to_up(up).T, lengths_N).is_up else None


def line_axes(normals_N3: Array, lengths_N: Array) -> LineAxes:
    """Of lines in a world: unit normals of their planes through the camera's centre, and lengths that weigh them."""
    longest = np.argsort(-lengths_N, kind="stable")[:_MAX_LINES]
    normals, weights = normals_N3[longest], lengths_N[longest] / max(float(lengths_N[longest].sum()), 1e-12)
    upright, tilted = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)  # explained by all axes, by the least, tilt
    for axes in _candidates(normals, weights):
        fitted = _fitted(axes, normals, weights)
        explained = _explained(fitted, normals, weights)
        tilt = float(np.arccos(min(1.0, np.abs(fitted[:, 1]).max())))
        of_axes = float(explained.sum()), float(explained.min()), tilt
        if tilt <= _UPRIGHT:
            upright = max(upright, of_axes)
        else:
            tilted = max(tilted, of_axes)
    is_up = True if _is_room(upright, tilted) else False if _is_room(tilted, upright) else None
    return LineAxes(upright[0], tilted[0], tilted[2], is_up)


def _is_room(axes: tuple[float, float, float], others: tuple[float, float, float]) -> bool:
    return axes[0] >= max(_MIN_EXPLAINED, _MIN_RATIO * others[0]) and axes[1] >= _MIN_AXIS


def _candidates(normals: Array, weights: Array) -> list[Array]:
    """Axes (3, 3), one a row, of which two are directions along which many lines may run, or +y and one of them."""
    # Unit vectors with y >= 0, evenly: Fibonacci's lattice.
    index = np.arange(_DIRECTIONS) + 0.5
    y, turn = 1 - index / _DIRECTIONS, np.pi * (1 + np.sqrt(5)) * index
    directions = np.column_stack([np.sqrt(1 - y**2) * np.cos(turn), y, np.sqrt(1 - y**2) * np.sin(turn)])
    across = np.abs(normals.astype(np.float32) @ directions.T.astype(np.float32))
    counted = weights.astype(np.float32) @ np.clip(1 - across / np.float32(np.sin(_WIDTH)), 0, None)
    tried = [np.array([0.0, 1.0, 0.0])]
    for _ in range(_TRIED):
        best = directions[int(np.argmax(counted))]
        tried.append(best)
        counted[np.abs(directions @ best) > np.cos(_APART)] = -1
    frames = []
    for a, b in combinations(tried, 2):
        if abs(a @ b) < np.sin(_APART):
            second = b - a * (a @ b)
            second /= np.linalg.norm(second)
            frames.append(np.stack([a, second, np.cross(a, second)]))
    return frames


def _fitted(axes: Array, normals: Array, weights: Array) -> Array:
    """The axes, turned to where the lines near to each are at right angles to it: Gauss and Newton's steps."""
    for width in _FITTED_WIDTHS:
        off = normals @ axes.T
        nearest = np.abs(off).argmin(axis=1)
        residual = np.take_along_axis(off, nearest[:, None], axis=1)[:, 0]
        weight = weights * (np.abs(residual) < np.sin(width))
        slope = np.cross(axes[nearest], normals)
        hessian = (slope * weight[:, None]).T @ slope + 1e-12 * np.eye(3)
        step = -np.linalg.solve(hessian, slope.T @ (weight * residual))
        axes = axes @ Rotation.from_rotvec(step).as_matrix().T
    return axes


def _explained(axes: Array, normals: Array, weights: Array) -> Array:
    """The part of the lines' length along each axis (3,); a line counts for the nearest."""
    near = np.clip(1 - np.abs(normals @ axes.T) / np.sin(_WIDTH), 0, None)
    counted = near.max(axis=1) * weights
    explained: Array = np.bincount(near.argmax(axis=1), counted, minlength=3).astype(float)
    return explained
