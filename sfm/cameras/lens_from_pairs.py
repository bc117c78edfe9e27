"""Lens and rolling shutter from verified pairs of images, before anything is mapped.

The epipolar constraint of a pair holds for the rays of its matches once the lens is taken out of them (Zhang, "On the
epipolar geometry between two images with lens distortion", ICPR 1996). The relative poses of all pairs and the one lens
and readout time that they share are adjusted together by Gauss-Newton on Sampson's distance, with a Cauchy loss. It is
taken in the image as it was captured: without its lens an image can be smaller, and so would all errors in it. The
focal length stays as it is logged: pairs hardly tell it, and the adjustment of the whole model does.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort_with_slope, undistort
from groundwalk.geometry.poses import Array, skew
from groundwalk.geometry.robust import CAUCHY_WIDTH, SIGMA_OF_MEDIAN
from groundwalk.geometry.rows import summed

Ints = NDArray[np.int64]
EXACT_INFORMATION = 1e12
"""Of a prior that holds what it is of."""
_MAX_STEPS = 16
_MIN_STEP, _MIN_POSE_STEP = 1e-3, 3e-4  # of the sd; rad, of nine pairs in ten
_MIN_SD_PX = 0.02
_DIFFERENCE = 1e-5  # of numerical derivatives
_MAX_TURN = 0.3
_NO_RAY_PX = 1e3
_WIDE_STEPS, _FIRST_WIDENING = 4, 4.0


@dataclass(frozen=True)
class PairMatches:
    """M matches of P pairs of one lens, in both images. Distorted image points at unit focal length (M, 2, 2), the
    share of the readout at which each one's row was exposed (M, 2), -0.5 to 0.5, mean focal lengths in pixels (M, 2);
    per pair: relative poses a_T_b (P, 4, 4) with translations of length 1, the twist of each camera (P, 2, 6): angular
    velocity (rad/s) and velocity in units of the pair's translation per second, in its axes; and the rows of its frames
    (P, 2). `stated_6` are the lens's p1, p2, k3 to k6, which stay as they are."""

    pair: Ints
    xy: Array
    row: Array
    focal_px: Array
    a_T_b: Array
    twist: Array
    frames: Ints
    stated_6: Array

    def of_pairs(self, keep_P: NDArray[np.bool_]) -> "PairMatches":
        """Some of the pairs, with all of their matches."""
        keep_M = keep_P[self.pair]
        kept = {name: getattr(self, name)[keep_M] for name in ("xy", "row", "focal_px")}
        kept |= {name: getattr(self, name)[keep_P] for name in ("a_T_b", "twist", "frames")}
        return replace(self, pair=(np.cumsum(keep_P) - 1)[self.pair[keep_M]], **kept)


@dataclass(frozen=True)
class LensEstimate:
    """k1, k2 and readout time in s (3,), their covariance (3, 3), and the relative poses (P, 4, 4)."""

    parameters: Array
    covariance: Array
    a_T_b: Array


def sampson_of(matches: PairMatches, a_T_b: Array, parameters: Array) -> Array:
    """Signed Sampson distances (M,) in pixels of the captured images with a lens and readout time, poses (P, 4, 4); far
    away where the lens can't see the image point."""
    return _sampson(matches, a_T_b, *_rays(matches, parameters), float(parameters[2]))


def _sampson(matches: PairMatches, a_T_b: Array, rays: Array, to_ideal: Array, readout_s: float) -> Array:
    T = a_T_b[matches.pair]
    rotation, translation = T[:, :3, :3], T[:, :3, 3]
    if readout_s:
        # mid_T_row: how a camera has moved at the time of a row.
        moved = (readout_s * matches.row)[:, :, None] * matches.twist[matches.pair]
        turn_a, turn_b = (Rotation.from_rotvec(moved[:, side, :3]).as_matrix() for side in (0, 1))
        shift_a, shift_b = moved[:, 0, 3:], moved[:, 1, 3:]
        translation = np.einsum(
            "mji,mj->mi", turn_a, translation + np.einsum("mij,mj->mi", rotation, shift_b) - shift_a
        )
        rotation = np.swapaxes(turn_a, 1, 2) @ rotation @ turn_b
    essential = skew(translation) @ rotation
    line_a = np.einsum("mij,mj->mi", essential, rays[:, 1])
    line_b = np.einsum("mji,mj->mi", essential, rays[:, 0])
    slope = np.einsum("msi,msij->msj", np.stack([line_a, line_b], axis=1)[:, :, :2], to_ideal)
    gradient = np.sum(np.sum(slope**2, axis=2) / matches.focal_px**2, axis=1)
    distance = np.sum(rays[:, 0] * line_a, axis=1) / np.sqrt(np.maximum(gradient, 1e-24))
    return np.where(np.isfinite(distance), distance, _NO_RAY_PX)


def estimate_lens(matches: PairMatches, start: Array, prior_information: Array) -> LensEstimate:
    """The lens and readout time that explain the matches best, from `start` (3,), which is the prior's mean, too.

    `prior_information` (3, 3) is the prior's inverse covariance. The errors of one pair's matches are correlated, and
    so are those of pairs that share an image: the matches' information is scaled by the ratio of a sandwich that
    clusters by both (Aronow, Samii and Assenova, "Cluster-robust variance estimation for dyadic data", Political
    Analysis 23, 2015) to plain least squares.
    """
    a_T_b, theta = matches.a_T_b.copy(), start.astype(float)
    covariance = np.linalg.inv(prior_information)
    for number in range(_MAX_STEPS):
        residual = sampson_of(matches, a_T_b, theta)
        sigma_px = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(residual))), _MIN_SD_PX)
        # At first a wrong lens makes corners look like outliers.
        loss_px = CAUCHY_WIDTH * sigma_px * (_FIRST_WIDENING if number < _WIDE_STEPS else 1.0)
        variance = sigma_px**2
        weight = 1 / (1 + (residual / loss_px) ** 2)
        is_held = bool((np.diag(prior_information) >= EXACT_INFORMATION).all())
        by_pose, by_lens = _derivatives(matches, a_T_b, theta, residual, is_held=is_held)
        solved, bread, pull, force = _without_poses(matches, weight, residual, by_pose, by_lens)
        # Products of the pulls of pairs that share an image, each product once.
        of_frame = summed(np.concatenate([force, force]), matches.frames.T.ravel(), int(matches.frames.max()) + 1)
        scatter = of_frame.T @ of_frame - force.T @ force
        inflation = max(1.0, float(np.trace(np.linalg.pinv(bread) @ scatter) / len(theta) / variance))
        total = bread / variance / inflation + prior_information
        step = -np.linalg.solve(total, pull / variance / inflation + prior_information @ (theta - start))
        theta, covariance = theta + step, np.linalg.inv(total)
        pose_step = np.clip(-solved[:, :, 3] - solved[:, :, :3] @ step, -_MAX_TURN, _MAX_TURN)
        a_T_b = _moved(a_T_b, pose_step)
        # A lens that the prior holds doesn't move while the poses still do.
        is_still = np.all(np.abs(step) < _MIN_STEP * np.sqrt(np.diag(covariance)))
        if number > _WIDE_STEPS and is_still and np.quantile(np.abs(pose_step).max(axis=1), 0.9) < _MIN_POSE_STEP:
            break
    return LensEstimate(theta, np.asarray(covariance, float), a_T_b)


def _without_poses(
    matches: PairMatches, weight: Array, residual: Array, by_pose: Array, by_lens: Array
) -> tuple[Array, Array, Array, Array]:
    """Normal equations with each pair's pose eliminated: the poses' answer to the lens and to their own residuals
    (P, 5, 4), the lens's system (3, 3) and gradient (3,), and each pair's share of that gradient (P, 3)."""
    pairs = len(matches.a_T_b)
    of_pose = weight[:, None, None] * by_pose[:, :, None]
    system = summed(of_pose * by_pose[:, None, :], matches.pair, pairs)
    # A pair that hardly moved tells no direction.
    system += (1e-6 * np.trace(system, axis1=1, axis2=2)[:, None, None] + 1e-9) * np.eye(5)
    cross = summed(of_pose * np.column_stack([by_lens, residual])[:, None, :], matches.pair, pairs)
    solved = np.linalg.solve(system, cross)
    free = by_lens - np.einsum("mi,mij->mj", by_pose, solved[matches.pair, :, :3])
    force = summed((weight * residual)[:, None] * free, matches.pair, pairs)
    bread = (weight[:, None] * by_lens).T @ by_lens - np.einsum("pij,pik->jk", cross[:, :, :3], solved[:, :, :3])
    pull = (weight * residual) @ by_lens - np.einsum("pij,pi->j", cross[:, :, :3], solved[:, :, 3])
    return np.asarray(solved, float), bread, pull, force


def _rays(matches: PairMatches, parameters: Array) -> tuple[Array, Array]:
    """Of both images' points: rays (M, 2, 3) with z = 1, and their derivatives by the captured points (M, 2, 2, 2)."""
    lens = [*parameters[:2], *matches.stated_6]
    ideal = undistort(matches.xy.reshape(-1, 2), lens)
    slope = distort_with_slope(ideal, lens)[1]
    determinant = slope[:, 0, 0] * slope[:, 1, 1] - slope[:, 0, 1] * slope[:, 1, 0]
    turned = np.stack([slope[:, 1, 1], -slope[:, 0, 1], -slope[:, 1, 0], slope[:, 0, 0]], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        to_ideal = (turned / determinant[:, None]).reshape(-1, 2, 2, 2)
    return np.insert(ideal, 2, 1.0, axis=1).reshape(-1, 2, 3), to_ideal


def _derivatives(
    matches: PairMatches, a_T_b: Array, theta: Array, residual: Array, *, is_held: bool
) -> tuple[Array, Array]:
    """Of the residuals by each pair's pose (M, 5) and by the lens (M, 3; 0 where it is held), numerically."""
    rays, to_ideal = _rays(matches, theta)

    def slope(moved: Array) -> Array:
        # A match beyond what the lens can see tells nothing of it.
        return np.where((residual < _NO_RAY_PX) & (moved < _NO_RAY_PX), (moved - residual) / _DIFFERENCE, 0.0)

    pose_steps, lens_steps = _DIFFERENCE * np.eye(5), _DIFFERENCE * np.eye(3)
    moved_poses = [_moved(a_T_b, np.tile(step, (len(a_T_b), 1))) for step in pose_steps]
    by_pose = np.column_stack(
        [slope(_sampson(matches, moved, rays, to_ideal, float(theta[2]))) for moved in moved_poses]
    )
    if is_held:
        return by_pose, np.zeros((len(residual), 3))
    by_lens = np.column_stack([slope(sampson_of(matches, a_T_b, theta + step)) for step in lens_steps])
    return by_pose, by_lens


def _moved(a_T_b: Array, step_P5: Array) -> Array:
    """Poses turned by step[:3] and with translations turned on the sphere by step[3:] along two tangents."""
    t = a_T_b[:, :3, 3]
    helper = np.where(np.abs(t[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    u = np.cross(t, helper)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(t, u)
    moved = a_T_b.copy()
    moved[:, :3, :3] = Rotation.from_rotvec(step_P5[:, :3]).as_matrix() @ a_T_b[:, :3, :3]
    direction = t + step_P5[:, 3:4] * u + step_P5[:, 4:] * v
    moved[:, :3, 3] = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return moved
