"""Digital zoom within a session, where no model is consistent: by the matches of neighbouring frames and VIO.

Across a zoom a model of one focal length bends, and its own estimates say nothing. Two neighbouring frames have the
same zoom, but for those that it lies between, and VIO says how they turned: that tells their focal length.
"""

from pathlib import Path

import numpy as np
import pycolmap
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.poses import Array, make_pose, relative
from groundwalk.sfm.database import Ints, image_id
from groundwalk.sfm.pairs.odometry import Odometry
from groundwalk.sfm.pairs.two_views import start_by_vio
from groundwalk.sfm.quality.focal_steps import FocalStep, focal_step

_MIN_MATCHES = 30
# How far VIO may be off between neighbours, a turn in radians and a direction, and the logarithm of a focal length's
# factor.
_TURN_SD, _DIRECTION_SD, _FOCAL_SD = np.radians(0.15), 0.1, 1.0
_LOSS_PX = 1.0
# Pairs that tell less, as where the camera neither turned nor moved aside, are left out.
_MAX_SD = 0.05
# Pairs are noisier than models.
_PAIRS = 15


def zoom_of_session(database: Path, rows: Ints, vio: Odometry, limit: float) -> FocalStep | None:
    """Where the focal length of a session's frames, `rows` (N,) in the order of time, changes by more than the fraction
    `limit`: `first` is one of the rows, right to a frame or two. None where it doesn't."""
    firsts, factors = [], []
    with pycolmap.Database.open(database) as opened:
        for a, b in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
            estimate = _focal_factor(opened, a, b, vio)
            if estimate is not None and estimate[1] < _MAX_SD:
                firsts.append(b)
                factors.append(estimate[0])
    step = focal_step(np.exp(factors), limit, _PAIRS)
    return None if step is None else FocalStep(firsts[step.first], step.factor)


def _focal_factor(opened: pycolmap.Database, a: int, b: int, vio: Odometry) -> tuple[float, float] | None:
    """The logarithm of the factor of two frames' focal lengths to the logged ones, and its standard error; None where
    they have no verified matches or no VIO."""
    matches = opened.read_two_view_geometry(image_id(a), image_id(b)).inlier_matches
    if len(matches) < _MIN_MATCHES or not np.isfinite(relative(vio.vio_T_cam[a], vio.vio_T_cam[b])).all():
        return None
    rays, focal_px = [], []
    for row, column in ((a, 0), (b, 1)):
        camera, keypoints = opened.read_camera(image_id(row)), opened.read_keypoints(image_id(row))
        ray = np.asarray(camera.cam_from_img(keypoints[matches[:, column], :2].astype(float)))
        rays.append(np.insert(ray, 2, 1.0, axis=1))
        focal_px.append(camera.mean_focal_length())
    start = start_by_vio(np.eye(4), vio, a, b)

    def residuals(x: Array) -> Array:
        turned = start[:3, :3] @ Rotation.from_rotvec(x[:3]).as_matrix()
        pose = make_pose(turned, start[:3, 3] + x[3:6])
        shrunk = [ray * [np.exp(-x[6]), np.exp(-x[6]), 1.0] for ray in rays]
        focal = [np.full(2, np.exp(x[6]) * f) for f in focal_px]
        error = np.nan_to_num(sampson_px(pose[None], *shrunk, *focal)) / _LOSS_PX
        prior = [x[:3] / _TURN_SD, x[3:6] / _DIRECTION_SD, x[6:] / _FOCAL_SD]
        return np.concatenate([np.sqrt(np.log1p(error**2)), *prior])

    fit = least_squares(residuals, np.zeros(7))
    return float(fit.x[6]), float(np.sqrt(np.linalg.inv(fit.jac.T @ fit.jac)[6, 6]))
