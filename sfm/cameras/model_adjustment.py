"""Adjusting a COLMAP model with the cameras of phones (module `adjustment`), and the file of the result."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.linalg import LinAlgError

from groundwalk.geometry.lens import k1_k2_of_k3
from groundwalk.geometry.poses import Array, inverse
from groundwalk.sfm.cameras.adjustment import (
    LENS_UNKNOWNS,
    Adjusted,
    Bundle,
    CameraPriors,
    Cameras,
    adjust,
    folded,
    frame_variances,
    is_large,
    loss_variance,
    marginal_readout,
    project,
)
from groundwalk.sfm.cameras.lenses import (
    EXACT_SD,
    FAR_SD,
    K3_SD,
    KNOWN_K3_SD,
    STATED_SD,
    LensPrior,
    SceneLenses,
    lines_of,
    prior_lenses,
)
from groundwalk.sfm.cameras.motion import Motion, motion_by_vio, offset_of_frames
from groundwalk.sfm.cameras.tracks import chosen_tracks, of_points, triangulated
from groundwalk.sfm.database import Ints, image_id, pose_of
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin
from groundwalk.store.tables import poses_of

# Shorter steps of VIO say too little of the length of an sfm unit.
_MIN_STEP_M = 0.02
# Priors of the logarithm of a session's focal factor, and of a frame's focus: phones log their focus, and wider priors
# would turn noise into millimetres. The prior of the scatter counts as some frames, so that a focus that isn't logged
# but shows in the images is followed.
_LOG_FOCAL_SD = 0.01
_FOCUS_SD, _PRIOR_FRAMES = 0.0003, 5
_VARIANCE_STEPS, _MAX_SIGMAS = 100, 3.0
# By how much of the image's longer side a principal point is off: one that is stated (0.02 to 0.25 % in chair and
# charuco), and the image's centre where there is no VIO: those of five phones and two cameras in public captures are
# 0.2 to 1.4 % from it along a side, 0.7 % RMS.
_CENTRE_SD, _GUESSED_CENTRE_SD = 0.002, 0.008
# Of k1, k2 and readout of a lens as another model of its frames has it, and of its principal point.
_SAME_LENS_SD, _SAME_CENTRE_SD = np.array([*STATED_SD, 0.002]), 0.0005
# Of a stated lens, which is held where images don't deny it: as captures state them, and where images do deny it, if
# not beyond chance.
_STATED_COVARIANCE = np.diag([*STATED_SD**2, KNOWN_K3_SD**2, 0.0, 0.0, 0.0])
_UNDECIDED_COVARIANCE = np.diag([*FAR_SD**2, K3_SD**2, 0.0, 0.0, 0.0])
_OUTLIER_SIGMAS = 4.0
# A point that two frames see tells one number of their poses, which have six each.
_MIN_OBSERVATIONS, _MIN_FRAMES = 8, 2


@dataclass(frozen=True)
class CameraLog:
    """The cameras of N frames before a model of them is adjusted.

    `intrinsics` (N, 4), `readout_line` (N, 3) as in `Cameras`, `session` (N,) names, `t_s` (N,) on each session's
    clock, vio_T_cam (N, 4, 4), and `focal_sd` (N,) of the focal lengths where cameras don't log them. `held_velocity`
    (N, 3) in sfm units/s is of frames whose cameras stay as they are, NaN for others.
    """

    intrinsics: Array
    readout_line: Array
    session: np.ndarray
    t_s: Array
    vio_T_cam: Array
    focal_sd: Array
    lenses: SceneLenses
    motion: Motion
    motion_at: Callable[[Array], Motion]
    """Of all frames so many seconds (N,) before their time stamps."""
    held_velocity: Array | None = None

    def at_middle_rows(self, model: pycolmap.Reconstruction) -> "CameraLog":
        """The same with the motion at the times of middle rows, where a model's frames tell them."""
        registered = np.array(sorted(model.reg_image_ids()), np.int64) - 1
        offset_s = np.zeros(len(self.t_s))
        for lens in np.unique(self.lenses.lens[registered]).tolist():
            is_free = self.lenses.lens == lens
            poses = np.where(is_free[:, None, None], self.vio_T_cam, np.nan)
            offset_s[is_free] = offset_of_frames(model, self.session, self.t_s, poses, self.motion.angular)
        return replace(self, motion=self.motion_at(offset_s)) if offset_s.any() else self

    def with_priors(self, priors: Mapping[int, LensPrior]) -> "CameraLog":
        """The same with other priors of some lenses, by their numbers."""
        changed = [priors.get(number, prior) for number, prior in enumerate(self.lenses.priors)]
        return replace(self, lenses=replace(self.lenses, priors=changed))


def camera_log(
    frames: pd.DataFrame,
    device_of_session: dict[str, str],
    log: pd.DataFrame,
    jumps: pd.DataFrame,
    settings: SfmSettings,
) -> CameraLog:
    """From import's frames, the sessions' devices, and all poses of the log and its jumps (tables import.vio and
    import.jumps)."""
    return CameraLog(
        frames[["fx", "fy", "cx", "cy"]].to_numpy(float),
        lines_of(frames),
        frames["session_id"].to_numpy(str),
        frames["t_ns"].to_numpy(np.int64) * 1e-9,
        poses_of(frames, "vio_cam"),
        frames["focal_sd"].to_numpy(float),
        prior_lenses(frames, device_of_session, settings),
        motion_by_vio(frames, log, jumps),
        partial(motion_by_vio, frames[["session_id", "t_ns"]], log, jumps),
    )


@dataclass(frozen=True)
class Held:
    """Frames, by their ids, and points of a model that stay as they are."""

    frames: frozenset[int] = frozenset()
    points: frozenset[int] = frozenset()


def adjust_model(
    model: pycolmap.Reconstruction, keypoints: list[Array], log: CameraLog, settings: SfmSettings, held: Held = Held()
) -> tuple[Adjusted, Ints]:
    """Adjust a model in place; `keypoints` are those of all N frames as extracted. Returns the adjusted model and the
    rows (R,) of its frames, of those that are `held` only such as see points that aren't. Raises LinAlgError where its
    images don't determine it.

    Frames that have too few observations for a pose are deregistered, before and where outliers leave them so few.
    Observations beyond four sigma, and those that the distortion polynomial folds back into the image, are removed on
    the way. Sds of focus and of angular velocities are learned twice: the cautious ones hold the estimates, as each
    frame's focus would else take up what the camera model lacks, and the likeliest ones, which come back with the
    model, say how uncertain the estimates are. The model then has the cameras' focal lengths and lenses, and its
    observations where a camera without rolling shutter would have them.
    """
    observations = pycolmap.ObservationManager(model)
    observations.filter_observations_with_negative_depth()
    _deregister_undetermined(model)
    if model.num_reg_frames() < _MIN_FRAMES:
        raise LinAlgError("hardly any frame has enough observations for a pose")
    rows, point_ids, bundle, features = _bundle_of(model, keypoints, held)
    cameras, priors = _cameras_of(rows, bundle, log, settings)
    adjusted, whole, _ = _adjust_chosen(bundle, cameras, priors, rough=True)
    _write_back(model, rows, point_ids, whole, adjusted.cameras, features)
    residual = project(whole, adjusted.cameras) - bundle.observed_px
    outliers = np.linalg.norm(residual, axis=1) > _OUTLIER_SIGMAS * np.sqrt(loss_variance(adjusted.loss_px))
    outliers |= folded(whole, adjusted.cameras)
    for row, feature in zip(rows[bundle.frame[outliers]].tolist(), features[outliers].tolist(), strict=True):
        if model.image(image_id(row)).point2D(feature).has_point3D():
            observations.delete_observation(image_id(row), feature)
    observations.filter_observations_with_negative_depth()
    if _deregister_undetermined(model):
        return adjust_model(model, keypoints, log, settings, held)
    _, point_ids, bundle, features = _bundle_of(model, keypoints, held, rows)
    learned = priors
    if settings.refine_cameras != "never":
        priors = with_shrunk_sds(adjusted)
        learned = with_likeliest_sds(adjusted)
        lenses = [log.lenses.priors[k] for k in np.unique(log.lenses.lens[rows])]
        learned = replace(learned, lens_covariance=learned.lens_covariance + np.array([*map(_doubt, lenses)]))
    adjusted, whole, is_adjusted = _adjust_chosen(bundle, adjusted.cameras, priors)
    _write_back(model, rows, point_ids, whole, adjusted.cameras, features)
    observations.filter_observations_with_negative_depth()
    model.update_point_3d_errors()
    _, left_ids, left, _ = _bundle_of(model, keypoints, held, rows)
    point_ids = point_ids[is_adjusted]
    is_adjusted = np.isin(left_ids, point_ids)
    noise = adjusted.noise[np.searchsorted(point_ids, left_ids[is_adjusted])]
    return replace(adjusted, bundle=of_points(left, is_adjusted), priors=learned, noise=noise), rows


def _adjust_chosen(
    bundle: Bundle, cameras: Cameras, priors: CameraPriors, *, rough: bool = False
) -> tuple[Adjusted, Bundle, NDArray[np.bool_]]:
    """The adjusted bundle, of a large model that of some tracks; the bundle with all points after that; and
    which of them (P,) were adjusted."""
    kept = np.ones(len(bundle.xyz), bool)
    if is_large(len(bundle.sfm_T_cam) - len(bundle.held_frames)):
        kept = chosen_tracks(bundle, cameras)
    adjusted = adjust(of_points(bundle, kept), cameras, priors, rough=rough)
    if not rough:
        adjusted = marginal_readout(adjusted)
    whole = replace(bundle, sfm_T_cam=adjusted.bundle.sfm_T_cam, xyz=bundle.xyz.copy())
    whole.xyz[kept] = adjusted.bundle.xyz
    whole.xyz[~kept] = triangulated(of_points(whole, ~kept), adjusted.cameras, adjusted.loss_px)
    return adjusted, whole, kept


def _doubt(lens: LensPrior) -> Array:
    """(6, 6) how far a stated lens that is held may be off; 0 of others."""
    if lens.is_undecided:
        return _UNDECIDED_COVARIANCE
    return _STATED_COVARIANCE * (lens.origin == CameraOrigin.STATED)


def _deregister_undetermined(model: pycolmap.Reconstruction) -> bool:
    """Deregister frames with too few observations, and those that have too few without them; whether there were any."""
    any_few = False
    while few := [
        frame_id for frame_id in model.reg_frame_ids() if model.image(frame_id).num_points3D < _MIN_OBSERVATIONS
    ]:
        any_few = True
        for frame_id in few:
            model.deregister_frame(frame_id)
    return any_few


def with_lenses_of(log: CameraLog, adjusted: Adjusted, rows: Ints) -> CameraLog:
    """The log with the lenses of an adjusted model, whose frames are `rows` (R,), as a prior for further models."""
    cameras = adjusted.cameras
    of_cameras = zip(cameras.coefficients, cameras.readout_s.tolist(), cameras.centre_px, strict=True)
    return log.with_priors(
        {
            index: known_lens(log.lenses.priors[index], *of_lens)
            for index, of_lens in zip(np.unique(log.lenses.lens[rows]).tolist(), of_cameras, strict=True)
        }
    )


def known_lens(lens: LensPrior, coefficients: Array, readout_s: float, centre_px: Array) -> LensPrior:
    """A lens with the coefficients (8,), readout and principal point that a model of other frames of it has, as a
    prior."""
    sd = np.minimum(np.sqrt(np.diag(lens.covariance)), _SAME_LENS_SD)
    covariance, k3_sd = np.diag(sd**2), min(lens.k3_sd, KNOWN_K3_SD)
    found = replace(lens, coefficients=coefficients, readout_s=readout_s, centre_px=centre_px, is_known=True)
    return replace(found, covariance=covariance, k3_sd=k3_sd, start=None)


def cameras_of_frames(log: CameraLog, parts: list[tuple[Adjusted, Ints]]) -> Cameras:
    """The cameras of all N frames, a lens and a session for each, as adjusted with their models; as before where a
    frame is in none."""
    count, lens = len(log.t_s), log.lenses.lens
    every = Cameras(
        log.intrinsics,
        log.readout_line,
        np.arange(count),
        np.arange(count),
        log.t_s,
        log.lenses.coefficients[lens],
        log.lenses.readout_s[lens],
        log.lenses.centre_px[lens],
        np.zeros(count),
        np.zeros(count),
        log.motion.angular.copy(),
        np.zeros((count, 3)),
    )
    for adjusted, rows in parts:
        part = adjusted.cameras
        every.coefficients[rows], every.readout_s[rows] = part.coefficients[part.lens], part.readout_s[part.lens]
        every.centre_px[rows] = part.centre_px[part.lens]
        every.log_focal[rows], every.focus[rows] = part.log_focal[part.session], part.focus
        every.angular[rows], every.velocity[rows] = part.angular, part.velocity
    if log.held_velocity is not None:
        is_held = np.isfinite(log.held_velocity).all(axis=1)
        every.velocity[is_held] = log.held_velocity[is_held]
    return every


def save_adjusted(path: Path, adjusted: Adjusted, rows: Ints) -> None:
    """Write what `load_adjusted` reads."""
    arrays: dict[str, Any] = {"rows": rows, "loss_px": adjusted.loss_px, "noise": adjusted.noise}
    parts = {"bundle": adjusted.bundle, "cameras": adjusted.cameras, "mean": adjusted.priors.mean}
    for name, part in (parts | {"priors": adjusted.priors}).items():
        arrays |= {f"{name}.{field}": value for field, value in vars(part).items() if field != "mean"}
    np.savez(path, **arrays)


def load_adjusted(path: Path) -> tuple[Adjusted, Ints]:
    """An adjusted model and the rows of its frames."""
    with np.load(path) as file:

        def part(name: str) -> dict[str, Any]:
            return {key.partition(".")[2]: file[key] for key in file.files if key.startswith(name + ".")}

        priors = CameraPriors(mean=Cameras(**part("mean")), **part("priors"))
        bundle, cameras = Bundle(**part("bundle")), Cameras(**part("cameras"))
        return Adjusted(bundle, cameras, priors, float(file["loss_px"]), file["noise"]), file["rows"]


def _bundle_of(
    model: pycolmap.Reconstruction, keypoints: list[Array], held: Held, rows: Ints | None = None
) -> tuple[Ints, Ints, Bundle, Ints]:
    """Rows of frames (R,), ids of points (P,), the bundle, and each observation's feature (M,): all of the model but
    for what held frames see of held points. `rows` are taken where they are given."""
    features, ids = {}, {}
    for row in sorted(i - 1 for i in model.reg_image_ids()):
        image = model.image(image_id(row))
        features[row] = np.asarray(image.get_observation_point2D_idxs(), np.int64)
        ids[row] = np.array([p.point3D_id for p in image.get_observation_points2D()], np.int64)
        if image_id(row) in held.frames:
            is_free = np.array([i not in held.points for i in ids[row].tolist()], bool)
            features[row], ids[row] = features[row][is_free], ids[row][is_free]
    if rows is None:
        rows = np.array([row for row in ids if image_id(row) not in held.frames or len(ids[row])], np.int64)
    point_ids, point = np.unique(np.concatenate([ids[row] for row in rows]), return_inverse=True)
    bundle = Bundle(
        np.stack([pose_of(model.image(image_id(row))) for row in rows.tolist()]),
        np.array([model.points3D[i].xyz for i in point_ids.tolist()]).reshape(-1, 3),
        np.repeat(np.arange(len(rows)), [len(ids[row]) for row in rows]),
        point,
        np.concatenate([keypoints[row][features[row]] for row in rows]),
        np.flatnonzero([image_id(row) in held.frames for row in rows.tolist()]),
        np.flatnonzero([i in held.points for i in point_ids.tolist()]),
    )
    return rows, point_ids, bundle, np.concatenate([features[row] for row in rows])


def _cameras_of(rows: Ints, bundle: Bundle, log: CameraLog, settings: SfmSettings) -> tuple[Cameras, CameraPriors]:
    """The cameras to start from and their priors; lenses and sessions are those that the rows have."""
    lenses, lens = np.unique(log.lenses.lens[rows], return_inverse=True)
    sessions, session = np.unique(log.session[rows], return_inverse=True)
    units_per_m = _units_per_m(bundle.sfm_T_cam, log.vio_T_cam[rows], session)
    cameras = Cameras(
        log.intrinsics[rows],
        log.readout_line[rows],
        lens,
        session,
        log.t_s[rows],
        log.lenses.coefficients[lenses],
        log.lenses.readout_s[lenses],
        log.lenses.centre_px[lenses],
        np.zeros(len(sessions)),
        np.zeros(len(rows)),
        log.motion.angular[rows],
        log.motion.velocity[rows] * units_per_m,
    )
    prior = [log.lenses.priors[k] for k in lenses]
    corner = cameras.intrinsics[:, 2:] / cameras.intrinsics[:, :2]
    radius = float(np.median(np.linalg.norm(corner, axis=1)))
    has_vio = np.bincount(lens, np.isfinite(log.vio_T_cam[rows, 0, 3])) > 0
    longer_px = np.array([2 * cameras.intrinsics[lens == number, 2:].max() for number in range(len(lenses))])
    is_stated = has_vio | np.array([one.origin == CameraOrigin.STATED for one in prior])
    centre_sd = np.where(is_stated, _CENTRE_SD, _GUESSED_CENTRE_SD)
    centre_sd[[one.is_known for one in prior]] = _SAME_CENTRE_SD
    log_focal_sd = np.full(len(sessions), _LOG_FOCAL_SD)
    np.maximum.at(log_focal_sd, session, log.focal_sd[rows])
    is_fixed = settings.refine_cameras == "never"
    priors = CameraPriors(
        cameras,
        np.array([_lens_covariance(*of_lens, radius) for of_lens in zip(prior, centre_sd * longer_px, strict=True)]),
        np.full(len(sessions), EXACT_SD) if is_fixed else log_focal_sd,
        np.full(len(sessions), EXACT_SD if is_fixed else _FOCUS_SD),
        np.tile(log.motion.angular_sd[rows, None], 3),
    )
    if is_fixed:
        priors = replace(priors, lens_covariance=np.tile(EXACT_SD**2 * np.eye(LENS_UNKNOWNS), (len(lenses), 1, 1)))
    return cameras, priors


def _lens_covariance(lens: LensPrior, centre_sd_px: float, radius: float) -> Array:
    """Prior covariance (6, 6) of k1, k2, k3, readout and principal point of a lens whose images reach out to `radius`
    (focal lengths).

    The priors of k1 and k2 are of lenses without k3. With one they are what comes nearest to that in the image.
    """
    direction = np.array([*-k1_k2_of_k3(radius), 1.0, 0.0, 0.0, 0.0])
    covariance = lens.k3_sd**2 * np.outer(direction, direction) + centre_sd_px**2 * np.diag([0, 0, 0, 0, 1, 1])
    others = np.ix_([0, 1, 3], [0, 1, 3])
    covariance[others] += lens.covariance
    return covariance


def _units_per_m(sfm_T_cam: Array, vio_T_cam: Array, session: Ints) -> float:
    """How many sfm units a metre is by all steps of VIO between following frames, 0 where there are none."""
    same = session[1:] == session[:-1]
    units = np.linalg.norm(np.diff(sfm_T_cam[:, :3, 3], axis=0), axis=1)[same]
    metres = np.linalg.norm(np.diff(vio_T_cam[:, :3, 3], axis=0), axis=1)[same]
    moved = metres > _MIN_STEP_M
    return float(np.median(units[moved] / metres[moved])) if moved.any() else 0.0


def with_shrunk_sds(adjusted: Adjusted) -> CameraPriors:
    """The priors with sds of each session's focus and of its VIO's angular velocities by the scatter of the adjusted
    ones, which is too small: their priors hold them back."""
    cameras, priors = adjusted.cameras, adjusted.priors
    count = _PRIOR_FRAMES + np.bincount(cameras.session)
    square = _PRIOR_FRAMES * priors.focus_sd**2 + np.bincount(cameras.session, cameras.focus**2)
    moved = np.mean((cameras.angular - priors.mean.angular) ** 2 / priors.angular_sd**2, axis=1)
    growth = np.sqrt(np.maximum((_PRIOR_FRAMES + np.bincount(cameras.session, moved)) / count, 1.0))
    return replace(
        priors, focus_sd=np.sqrt(square / count), angular_sd=priors.angular_sd * growth[cameras.session, None]
    )


def with_likeliest_sds(adjusted: Adjusted) -> CameraPriors:
    """The priors with sds of each session's focal length and focus, and of its VIO's angular velocities about each
    camera axis, as its images show them."""
    cameras, priors = adjusted.cameras, adjusted.priors
    focus_variance, angular_variance = frame_variances(adjusted)
    moved = cameras.angular - priors.mean.angular
    focus_sd, angular_sd = priors.focus_sd.copy(), priors.angular_sd.copy()
    for session in range(len(focus_sd)):
        members = cameras.session == session
        focus_sd[session] *= _sd_growth(cameras.focus[members], focus_variance[members], focus_sd[session])
        for axis in range(3):
            sd, moved_M = angular_sd[members, axis], moved[members, axis]
            angular_sd[members, axis] *= _sd_growth(moved_M, angular_variance[members, axis], sd)
    # A prior that images deny says nothing of how well they know better.
    log_focal_sd = np.maximum(priors.log_focal_sd, np.abs(cameras.log_focal))
    return replace(priors, log_focal_sd=log_focal_sd, focus_sd=focus_sd, angular_sd=angular_sd)


def _sd_growth(mean_M: Array, variance_M: Array, prior_sd: Array) -> float:
    """By what factor the sd of priors, each N(0, prior_sd^2), must grow for the posteriors (M,) that they gave.

    Means alone would tell too little: they are shrunk to the prior, as little as the images say. So the square is that
    which makes what images say of each frame likeliest (expectation maximisation, Dempster et al. 1977), the prior
    counts as some frames, and what is beyond three sigmas counts as three (Huber 1964): a frame of few points, or at a
    jump of VIO, says little of the others.
    """
    # Of each frame, in units of its prior's sd: the share of the posterior that images say, what, its variance.
    informed = np.clip(1 - variance_M / prior_sd**2, 1e-6, 1 - 1e-6)
    said, noise = mean_M / prior_sd / informed, 1 / informed - 1
    square = 1.0
    for _ in range(_VARIANCE_STEPS):
        kept = square / (square + noise)
        bounded = np.minimum(said**2, _MAX_SIGMAS**2 * (square + noise))
        square = (_PRIOR_FRAMES + np.sum(kept**2 * bounded + kept * noise)) / (_PRIOR_FRAMES + len(said))
    return float(np.sqrt(square))


def _write_back(
    model: pycolmap.Reconstruction, rows: Ints, point_ids: Ints, bundle: Bundle, cameras: Cameras, feature_M: Ints
) -> None:
    # The effect of the rolling shutter is removed from each observation.
    global_px = bundle.observed_px + project(bundle, cameras, shutter=False) - project(bundle, cameras)
    focal, centre = cameras.focal, cameras.centre
    bounds = np.searchsorted(bundle.frame, np.arange(len(rows) + 1))
    for number, row in enumerate(rows.tolist()):
        image = model.image(image_id(row))
        points = image.points2D
        members = slice(bounds[number], bounds[number + 1])
        for feature, xy in zip(feature_M[members].tolist(), global_px[members], strict=True):
            points[feature].xy = xy
        if number in bundle.held_frames:
            continue
        camera = model.camera(image.camera_id)
        params = np.array(camera.params)
        params[:2], params[2:4] = focal[number], centre[number]
        coefficients = cameras.coefficients[cameras.lens[number]]
        if coefficients[len(params) - 4 :].any():
            camera.model, params = pycolmap.CameraModelId.FULL_OPENCV, np.concatenate([params[:4], np.zeros(8)])
        params[4:] = coefficients[: len(params) - 4]
        camera.params = params.tolist()
        assert image.frame is not None
        image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(inverse(bundle.sfm_T_cam[number])[:3]))
    for number in np.setdiff1d(np.arange(len(point_ids)), bundle.held_points).tolist():
        model.points3D[int(point_ids[number])].xyz = bundle.xyz[number]
