"""What mapping starts from where a capture doesn't say, or says wrongly: focal lengths and lenses.

Pairs' essential matrices need focal lengths to some per cent; the adjustment of the whole model then finds them as it
finds others, from a wider prior. Within a phone's usual range any lens will do; one that is far off, as an ultra-wide
camera's that nobody states or one in another convention, bends the relative poses of pairs.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
import pycolmap

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.sfm.cameras.lenses import PHONE_K1_K2, SceneLenses
from groundwalk.sfm.database import (
    Ints,
    Workspace,
    create_database,
    extract_features,
    image_id,
    inverse_of,
    keypoints_px,
)
from groundwalk.sfm.mapping.mappers import pipeline_options
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.matching import match_pairs
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report
from groundwalk.store.parallel import one_thread

ESTIMATED_SD = 0.05
"""Of such a focal length, as a fraction: round one object, or of few images, it comes out some per cent off. So ones
that are known better aren't estimated."""
# As many images, all pairs of which are matched; of each session such as follow each other, and so many of each even
# where these are more together.
_MAX_IMAGES, _IMAGES_OF_EACH = 30, 10
# Where nothing is stated: what mapping starts from, in longer sides of the image. Phones' main cameras, and others.
_STARTS, _GUESS_SD = (0.75, 1.2), 0.2
_MIN_IMAGES = 3
# A stated focal length stays where, with it held, a camera loses a smaller share of its observations and their error
# grows by a smaller share: 10 % off, photos of a courtyard lose 6 and 18 %, and are off by half as much again.
_MAX_LOST, _MAX_EXCESS = 0.05, 0.1
# Fewer images' lens is a phone's: a free one of four took up half of their focal length.
_MIN_LENS_IMAGES = 10
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


def sample_unstated(frames: pd.DataFrame) -> Ints:
    """Rows of the frames table whose focal lengths nothing states well, of each session those of its most usual size,
    of either orientation: all, or so many of each from the middle of its order."""
    sides = frames[["width", "height"]]
    size = sides.max(axis=1).astype(str) + "x" + sides.min(axis=1).astype(str)
    usual = size.groupby(frames["session_id"]).transform(lambda of_session: of_session.mode().iloc[0])
    rows = np.flatnonzero((frames["focal_sd"] >= ESTIMATED_SD) & (size == usual))
    of_session = frames.iloc[rows].groupby("session_id")["session_id"]
    place, count = of_session.cumcount(), of_session.transform("size")
    most = _MAX_IMAGES
    while most > _IMAGES_OF_EACH and of_session.size().clip(upper=most).sum() > _MAX_IMAGES:
        most -= 1
    first = ((count - most) // 2).clip(lower=0)
    return rows[((place >= first) & (place < first + most)).to_numpy(bool)]


def estimate_focal_lengths(
    report: Report, frames: pd.DataFrame, work: Workspace, settings: SfmSettings, seed: int
) -> tuple[dict[str, float], dict[str, list[float]]]:
    """The focal length in pixels of each session of these frames, by the largest model of them, or as stated where the
    images don't deny that, and k1 and k2 of those with enough images in it; of none where there is no model."""
    shutil.rmtree(work.scratch, ignore_errors=True)
    work.scratch.mkdir()
    database = work.scratch / "pairs.db"
    create_database(database, frames, work.names, _shared_cameras(frames, _STARTS[0]))
    extract_features(lambda done, note="": None, database, work, settings)
    _turn_alike(database, frames)
    # Of cameras without a prior by their fundamental matrices, whatever the focal length that they start from.
    match_pairs(report, database, np.stack(np.triu_indices(len(frames), 1), axis=1), seed)
    is_guess = bool((frames["focal_sd"] > _GUESS_SD).any())
    models = [_largest(frames, work, _shared_cameras(frames, start), seed) for start in _STARTS[: 2 if is_guess else 1]]
    best = max((model for model in models if model is not None), key=_size, default=None)
    if best is None or best.num_reg_images() < _MIN_IMAGES:
        return {}, {}
    # Flat ground from above, or a facade, tells hardly any focal length: what is stated stays unless images deny it.
    stated = _shared_cameras(frames, _STARTS[0])
    held = None if is_guess else _largest(frames, work, stated, seed, is_held=True)
    free_fit, held_fit = _fits(best), _fits(held) if held is not None else {}
    focal, k1_k2 = dict[str, float](), dict[str, list[float]]()
    for session_id, camera in stated.items():
        if (free := free_fit.get(camera.camera_id)) is None:
            continue
        model, fit = held, held_fit.get(camera.camera_id)
        least, most_px = (1 - _MAX_LOST) * free.seen, (1 + _MAX_EXCESS) * free.error_px
        if model is None or fit is None or fit.seen < least or fit.error_px > most_px:
            model, fit = best, free
        used = model.camera(camera.camera_id)
        focal[session_id] = float(used.mean_focal_length())
        if fit.images >= _MIN_LENS_IMAGES and _are_many(frames):
            k1_k2[session_id] = used.params[-2:].tolist()
    return focal, k1_k2


class _Fit(NamedTuple):
    """Images and observations that a model has of a camera, and the mean reprojection error of their points, pixels."""

    images: int
    seen: int
    error_px: float


def _largest(
    frames: pd.DataFrame, work: Workspace, cameras: dict[str, pycolmap.Camera], seed: int, *, is_held: bool = False
) -> pycolmap.Reconstruction | None:
    """The largest model that begins with these cameras: lenses are refined where each has enough images, and focal
    lengths unless held."""
    database, folder = work.scratch / "pairs.db", work.scratch / "models"
    with pycolmap.Database.open(database) as opened:
        for camera in cameras.values():
            camera.has_prior_focal_length = is_held
            opened.update_camera(camera)
    options = pipeline_options(MappingInput(database, work.images, seed))
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = not is_held
    largest = None
    for refines_lens in (True, False) if _are_many(frames) else (False,):
        options.ba_refine_extra_params = refines_lens
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        models = pycolmap.incremental_mapping(database, work.images, folder, options)
        largest = max(models.values(), key=_size, default=None)
        if largest is not None and largest.num_reg_images() >= _MIN_LENS_IMAGES:
            break
    return largest


def _are_many(frames: pd.DataFrame) -> bool:
    return bool(frames["session_id"].value_counts().min() >= _MIN_LENS_IMAGES)


def _size(model: pycolmap.Reconstruction) -> tuple[int, int]:
    return model.num_reg_images(), model.compute_num_observations()


def _fits(model: pycolmap.Reconstruction) -> dict[int, _Fit]:
    """By camera."""
    model.update_point_3d_errors()
    errors: dict[int, list[list[float]]] = {}
    for image in model.images.values():
        if image.has_pose:
            seen = [model.point3D(point.point3D_id).error for point in image.points2D if point.has_point3D()]
            errors.setdefault(image.camera_id, []).append(seen)
    return {
        camera: _Fit(len(images), sum(map(len, images)), float(np.mean(np.concatenate(images))))
        for camera, images in errors.items()
        if any(images)
    }


def _turn_alike(database: Path, frames: pd.DataFrame) -> None:
    """Turn the keypoints of images that lie across their session's first one: to a camera whose principal point is in
    the middle any quarter turn is the same."""
    width = frames["width"].to_numpy()
    lies_across = width != frames.groupby("session_id", sort=False)["width"].transform("first").to_numpy()
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for row in np.flatnonzero(lies_across).tolist():
            keypoints = opened.read_keypoints(image_id(row))[:, :2]
            turned = np.column_stack([keypoints[:, 1], width[row] - keypoints[:, 0]])
            opened.update_keypoints(image_id(row), turned.astype(np.float32))


def _shared_cameras(frames: pd.DataFrame, start: float) -> dict[str, pycolmap.Camera]:
    """A camera for each session with a phone's lens, of the stated focal length, or `start` of the longer side."""
    cameras = {}
    for number, (session_id, rows) in enumerate(frames.groupby("session_id", sort=False)):
        first = rows.iloc[0]
        width, height = int(first["width"]), int(first["height"])
        focal = float(first["fx"]) if first["focal_sd"] <= _GUESS_SD else start * max(width, height)
        cameras[str(session_id)] = pycolmap.Camera(
            camera_id=number + 1,
            model="RADIAL",
            width=width,
            height=height,
            params=[focal, width / 2, height / 2, *PHONE_K1_K2],
        )
    return cameras


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
    points_a, points_b = (keypoints_px(opened, row) for row in (a, b))
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
        a_T_b = inverse_of(geometry.cam2_from_cam1)[None]
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
