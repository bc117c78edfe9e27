"""The relative poses of verified pairs by their images alone."""

from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.poses import Array, make_pose, relative
from groundwalk.sfm.database import image_id, inverse_of, keypoints_px
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.odometry import Odometry, compare_with_vio, without_tilted
from groundwalk.store.choices import PairInconsistency

# COLMAP's bound for a match that fits, px, and the fraction of a pair's matches that another pose has to explain.
MAX_ERROR_PX = 4.0
_MIN_EXPLAINED_FRACTION = 0.8
_LOSS_PX = 1.0
_MAX_EVALUATIONS = 30
_MIN_STEP_M = 1e-3


def compare_pairs(database: Path, pairs: Pairs, vio: Odometry) -> tuple[Array, pd.DataFrame]:
    """Relative poses a_T_b (P, 4, 4) of verified pairs, translations of length 1 or 0, and their comparison with VIO.

    Where a pair is inconsistent, its pose is fitted again from VIO's: points on a plane, or few of them, may be
    explained by two poses, of which the other is consistent.
    """
    a_T_b, angle = np.full((len(pairs), 4, 4), np.nan), np.full(len(pairs), np.nan)
    with pycolmap.Database.open(database) as opened:
        rows = np.unique(pairs).tolist()
        cameras = {row: opened.read_camera(image_id(row)) for row in rows}
        keypoints = {row: keypoints_px(opened, row) for row in rows}
        for index, (a, b) in enumerate(pairs.tolist()):
            geometry = opened.read_two_view_geometry(image_id(a), image_id(b))
            ends = (cameras[a], keypoints[a], cameras[b], keypoints[b])
            if pycolmap.estimate_two_view_geometry_pose(*ends, geometry):
                assert geometry.cam2_from_cam1 is not None
                a_T_b[index], angle[index] = inverse_of(geometry.cam2_from_cam1), geometry.tri_angle
        vio = without_tilted(vio, pairs, a_T_b)
        compared = compare_with_vio(pairs, a_T_b, angle, vio)
        for index in np.flatnonzero(compared["reason"] != PairInconsistency.NONE).tolist():
            a, b = pairs[index].tolist()
            matches = opened.read_two_view_geometry(image_id(a), image_id(b)).inlier_matches
            ray_a = np.asarray(cameras[a].cam_from_img(keypoints[a][matches[:, 0]]))
            ray_b = np.asarray(cameras[b].cam_from_img(keypoints[b][matches[:, 1]]))
            focal = cameras[a].mean_focal_length(), cameras[b].mean_focal_length()
            other, error_px = fitted_near(start_by_vio(a_T_b[index], vio, a, b), ray_a, ray_b, *focal)
            again = compare_with_vio(pairs[[index]], other[None], angle[[index]], vio)
            explained = np.mean(error_px < MAX_ERROR_PX)
            if explained >= _MIN_EXPLAINED_FRACTION and again["reason"].iloc[0] == PairInconsistency.NONE:
                a_T_b[index] = other
                compared.iloc[index] = again.iloc[0]
    return a_T_b, compared


def fitted_near(start: Array, ray_a: Array, ray_b: Array, focal_a: float, focal_b: float) -> tuple[Array, Array]:
    """The pose a_T_b (4, 4) next to `start` that explains matches best, and their distances from it (M,), px.

    Rays (M, 2; z = 1) and focal lengths in pixels; Sampson's distance in Cauchy's loss, minimised from `start` on.
    """
    rays = [np.concatenate([ray, np.ones((len(ray), 1))], axis=1) for ray in (ray_a, ray_b)]
    focal = [np.full((len(ray_a), 2), focal_a), np.full((len(ray_a), 2), focal_b)]

    def pose(change: Array) -> Array:
        shift = start[:3, 3] + change[3:]
        turned = start[:3, :3] @ Rotation.from_rotvec(change[:3]).as_matrix()
        return make_pose(turned, shift / max(float(np.linalg.norm(shift)), 1e-12))

    def errors_px(change: Array) -> Array:
        return np.nan_to_num(sampson_px(pose(change)[None], *rays, *focal))

    fit = least_squares(errors_px, np.zeros(6), loss="cauchy", f_scale=_LOSS_PX, max_nfev=_MAX_EVALUATIONS)
    return pose(fit.x), errors_px(fit.x)


def start_by_vio(a_T_b: Array, vio: Odometry, a: int, b: int) -> Array:
    """A pair's pose with what VIO gives of it: the whole pose within a session, across sessions the tilt alone."""
    start = a_T_b.copy()
    by_vio = relative(vio.vio_T_cam[a], vio.vio_T_cam[b])
    if vio.session[a] == vio.session[b] and np.isfinite(by_vio).all():
        step_m = float(np.linalg.norm(by_vio[:3, 3]))
        start[:3, :3] = by_vio[:3, :3]
        if step_m > _MIN_STEP_M:
            start[:3, 3] = by_vio[:3, 3] / step_m
        return start
    down_a, down_b = vio.gravity_cam[a], a_T_b[:3, :3] @ vio.gravity_cam[b]
    upright, _ = Rotation.align_vectors(down_a[None], down_b[None])
    start[:3, :3] = upright.as_matrix() @ a_T_b[:3, :3]
    start[:3, 3] = upright.as_matrix() @ a_T_b[:3, 3]
    return start
