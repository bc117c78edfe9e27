"""The lens that mapping starts from: a stated one, or phones' usual one, unless pairs of images say that it's far off.

Within a phone's usual range any lens will do: the model tells it. One that is far off, as an ultra-wide camera's that
nobody states or one in another convention, bends the relative poses of pairs.
"""

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
            tried = [prior.coefficients, *(np.r_[k1_k2, np.zeros(6)] for k1_k2 in _TRIED)]
            costs = np.array([[_cost(opened, a, b, lens, seed) for a, b in each.tolist()] for lens in tried])
            gain = (costs[0] - costs)[:, np.isfinite(costs).all(axis=0)]
            best = 0
            if gain.shape[1] >= _MIN_PAIRS:
                best = int(gain.mean(axis=1).argmax())
                limit = _MIN_GAIN_SIGMAS * gain[best].std(ddof=1) / np.sqrt(gain.shape[1])
                best = best if gain[best].mean() > max(_MIN_GAIN, limit) else 0
            starts.append(tried[best].tolist())
    return starts


def _cost(opened: pycolmap.Database, a: int, b: int, lens: Array, seed: int) -> float:
    """The mean of log(1 + squared error) of a pair's matches, with a lens and the relative pose that goes best with it;
    NaN of too few matches, or without a pose."""
    matches = opened.read_matches(image_id(a), image_id(b))
    cameras, points, rays = [], [], []
    for row, feature in zip((a, b), matches.T.astype(np.int64), strict=True):
        camera = opened.read_camera(image_id(row))
        params = np.array([*camera.params[:4], *lens])
        model = pycolmap.CameraModelId.FULL_OPENCV
        cameras.append(pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params))
        points.append(opened.read_keypoints(image_id(row))[:, :2].astype(float))
        ideal = undistort((points[-1][feature] - params[2:4]) / params[:2], lens)
        rays.append(np.column_stack([ideal, np.ones(len(ideal))]))
    sd_px = _ERROR_SD * max(cameras[0].width, cameras[0].height)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed, options.ransac.max_error = seed, _MAX_ERRORS * sd_px
    options.compute_relative_pose = True
    (camera_a, camera_b), (points_a, points_b) = cameras, points
    geometry = pycolmap.estimate_calibrated_two_view_geometry(camera_a, points_a, camera_b, points_b, matches, options)
    if len(matches) < _MIN_MATCHES or geometry.cam2_from_cam1 is None:
        return float("nan")
    b_T_a = geometry.cam2_from_cam1.matrix()
    a_T_b = inverse(make_pose(b_T_a[:, :3], b_T_a[:, 3]))[None]
    focal = [np.array(camera.params[:2]) for camera in cameras]
    error = np.nan_to_num(sampson_px(a_T_b, rays[0], rays[1], *focal), nan=np.inf) / sd_px
    return float(np.log1p(np.minimum(error, _FAR) ** 2).mean())
