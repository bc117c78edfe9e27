"""The lens that mapping starts from: a stated one, or phones' usual one, unless pairs of images say that it's far off.

Within a phone's usual range any lens will do: the model tells it. One that is far off, as an ultra-wide camera's that
nobody states or one in another convention, bends the relative poses of pairs.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.geometry.rows import evenly
from groundwalk.sfm.cameras.lenses import PHONE_K1_K2, SceneLenses
from groundwalk.sfm.database import image_id
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.matching import match_pairs
from groundwalk.store.child import Report
from groundwalk.store.parallel import one_thread

# k1 and k2 that are tried: none, phones' usual ones, a stronger one of theirs, and wide-angle lenses.
_TRIED = np.array([(0.0, 0.0), PHONE_K1_K2, (0.16, -0.4), (-0.15, 0.03), (-0.28, 0.07)])
# Another one is taken where the mean over pairs of their matches' robust cost becomes smaller by this and by so many
# standard errors; errors are in units of this fraction of the image's longer side, those of inliers below so
# many of them.
_MIN_GAIN, _MIN_GAIN_SIGMAS = 0.05, 3.0
_MAX_GAIN = 1.0  # that a pair counts as: one without a right pose under either lens is off by any amount
_ERROR_SD, _MAX_ERRORS = 0.0008, 3.0
_MAX_PAIRS, _MIN_MATCHES, _MIN_PAIRS = 60, 40, 5
_FAR = 1e3  # of points that the lens can't see


@one_thread()
def start_lenses(report: Report, database: Path, lenses: SceneLenses, pairs: Pairs, seed: int) -> list[list[float]]:
    """The coefficients (8,) that mapping starts from, of each lens, by some of the pairs (P, 2) of frames, which are
    matched in the database of their features."""
    of_lens = [pairs[(lenses.lens[pairs] == number).all(axis=1)] for number in range(len(lenses.priors))]
    of_lens = [each[evenly(len(each), _MAX_PAIRS)] for each in of_lens]
    match_pairs(report, database, np.concatenate([np.empty((0, 2), np.int64), *of_lens]), seed)
    starts = []
    with pycolmap.Database.open(database) as opened:
        for prior, each in zip(lenses.priors, of_lens, strict=True):
            others = (np.r_[k1_k2, np.zeros(6)] for k1_k2 in _TRIED)
            tried = [prior.coefficients, *(lens for lens in others if not np.array_equal(lens, prior.coefficients))]
            costs = np.array([_costs(opened, a, b, tried, seed) for a, b in each.tolist()]).reshape(-1, len(tried)).T
            gain = np.clip(costs[0] - costs, -_MAX_GAIN, _MAX_GAIN)[:, np.isfinite(costs).all(axis=0)]
            best = 0
            if gain.shape[1] >= _MIN_PAIRS:
                best = int(gain.mean(axis=1).argmax())
                limit = _MIN_GAIN_SIGMAS * gain[best].std(ddof=1) / np.sqrt(gain.shape[1])
                best = best if gain[best].mean() > max(_MIN_GAIN, limit) else 0
            starts.append(tried[best].tolist())
    return starts


def _costs(opened: pycolmap.Database, a: int, b: int, lenses: Sequence[Array], seed: int) -> list[float]:
    """The mean of log(1 + squared error) of a pair's matches, with each lens and the relative pose that goes best with
    it; NaN of too few matches, or without a pose."""
    matches = opened.read_matches(image_id(a), image_id(b))
    if len(matches) < _MIN_MATCHES:
        return [float("nan")] * len(lenses)
    stored_a, stored_b = (opened.read_camera(image_id(row)) for row in (a, b))
    points_a, points_b = (opened.read_keypoints(image_id(row))[:, :2].astype(float) for row in (a, b))
    sd_px = _ERROR_SD * max(stored_a.width, stored_a.height)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.max_error = seed, _MAX_ERRORS * sd_px
    options.compute_relative_pose = True
    costs = []
    for lens in lenses:
        camera_a, camera_b = _with_lens(stored_a, lens), _with_lens(stored_b, lens)
        geometry = pycolmap.estimate_calibrated_two_view_geometry(
            camera_a, points_a, camera_b, points_b, matches, options
        )
        if geometry.cam2_from_cam1 is None:
            costs.append(float("nan"))
            continue
        b_T_a = geometry.cam2_from_cam1.matrix()
        a_T_b = inverse(make_pose(b_T_a[:, :3], b_T_a[:, 3]))[None]
        ray_a, ray_b = _rays(camera_a, points_a[matches[:, 0]], lens), _rays(camera_b, points_b[matches[:, 1]], lens)
        error_px = sampson_px(a_T_b, ray_a, ray_b, np.array(camera_a.params[:2]), np.array(camera_b.params[:2]))
        error = np.nan_to_num(error_px, nan=np.inf) / sd_px
        costs.append(float(np.log1p(np.minimum(error, _FAR) ** 2).mean()))
    return costs


def _with_lens(camera: pycolmap.Camera, lens: Array) -> pycolmap.Camera:
    params = np.array([*camera.params[:4], *lens])
    model = pycolmap.CameraModelId.FULL_OPENCV
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params)


def _rays(camera: pycolmap.Camera, px: Array, lens: Array) -> Array:
    ideal = undistort((px - camera.params[2:4]) / camera.params[:2], lens)
    return np.column_stack([ideal, np.ones(len(ideal))])
