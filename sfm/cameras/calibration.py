"""Each lens of a scene before mapping: which frames share it, its distortion and readout time, from pairs of images.

ARKit and most apps state a pinhole matrix while the images have a lens's distortion, alike on the phones that were
measured (docs/explanation/sfm.md, Cameras). The estimate is shrunk to a prior: what the capture states, or else what
phones have.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from scipy.spatial.transform import Rotation
from scipy.special import ndtr, stdtrit

from groundwalk.geometry.lens import distort, distort_with_slope, max_shift, undistort
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.geometry.rows import evenly
from groundwalk.geometry.shutter import readout_fraction, readout_lines
from groundwalk.sfm.cameras.lens_from_pairs import (
    EXACT_INFORMATION,
    LensEstimate,
    PairMatches,
    estimate_lens,
    sampson_of,
)
from groundwalk.sfm.cameras.motion import Motion
from groundwalk.sfm.cameras.time_offset import estimate_time_offset
from groundwalk.sfm.database import Ints, create_database, image_id
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.matching import match_pairs
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report
from groundwalk.store.choices import CameraOrigin
from groundwalk.store.files import written_aside
from groundwalk.store.parallel import one_thread
from groundwalk.store.tables import poses_of

# k1 and k2 of phones' main cameras (docs/explanation/sfm.md, Cameras), in OpenCV's convention, and their covariance.
PHONE_K1_K2 = np.array([0.08, -0.12])
_PHONE_COVARIANCE = np.array([[0.05**2, -0.8 * 0.05 * 0.08], [-0.8 * 0.05 * 0.08, 0.08**2]])
# What a capture states is meant to be right.
STATED_SD = np.array([0.005, 0.01])
_STATED_READOUT_SD_S = 0.001
SAME_LENS_SD = np.array([*STATED_SD, 0.002])
"""Of k1, k2 and readout of a lens as another model of its frames has it."""
# k3, which pairs hardly tell, is left to the adjustment of the model: of a lens that nothing is known of, and others.
_K3_SD, KNOWN_K3_SD = 0.4, 0.02
_READOUT_SD_S = 0.02
_WEAK_PRIOR = np.diag([0.1**2, 0.2**2, _READOUT_SD_S**2])
_MAX_PAIRS = 160
_MAX_MATCHES = 120
_MIN_MATCHES = 40
_MIN_PAIRS = 5
_HELD_OUT_FRACTION = 0.25
_MIN_DISTANCE_M = 0.02
_MAX_FOCAL_STEP = 0.08
# A stated lens is wrong where the estimate is so many sigmas and pixels away from it, doesn't stretch or shrink the
# image at its corners by more than this fraction, and errors of held-out pairs become smaller by another one and so
# many standard errors; a stated readout time where it is so many sigmas and seconds away.
_MIN_WRONG_SIGMAS, _MIN_WRONG_PX, _MAX_CORNER_GROWTH = 5.0, 1.0, 0.6
_MIN_WRONG_GAIN, _MIN_GAIN_SIGMAS, _MIN_ERROR_PX = 0.04, 3.0, 0.01
_MIN_WRONG_READOUT_S = 0.004


@dataclass(frozen=True)
class CalibratedLens:
    """A lens: its frames' device, size and coefficients (OpenCV's order, 8), readout time, covariance (3, 3) of k1, k2
    and readout, where they are from, the stated lens (8) and readout time, and the median Sampson distance in held-out
    pairs, px, with the prior's lens and with the estimated one; None where nothing was estimated. `stamp_offset_s` is
    the estimate of time stamps minus times of the middle rows, with its standard error, `time_offset_s` the same where
    held-out pairs accept it, else 0."""

    lens_id: str
    frames: int
    coefficients: list[float]
    readout_s: float
    covariance: list[list[float]]
    origin: CameraOrigin
    stated: list[float]
    prior_coefficients: list[float]
    prior_readout_s: float
    prior_covariance: list[list[float]]
    prior_k3_sd: float = _K3_SD
    stated_readout_s: float | None = None
    held_out_prior_px: float | None = None
    held_out_px: float | None = None
    stated_is_wrong: bool = False
    stated_is_undecided: bool = False
    stated_readout_is_wrong: bool = False
    stamp_offset_s: float | None = None
    stamp_offset_sd_s: float | None = None
    time_offset_s: float = 0.0


@dataclass(frozen=True)
class Calibration:
    """The lenses of a scene and which one each of N frames has (N,)."""

    lenses: list[CalibratedLens]
    lens: Ints = field(repr=False)

    @property
    def coefficients(self) -> Array:
        """(L, 8)"""
        return np.array([lens.coefficients for lens in self.lenses], float).reshape(-1, 8)

    @property
    def readout_s(self) -> Array:
        """(L,)"""
        return np.array([lens.readout_s for lens in self.lenses], float)

    @property
    def time_offset_s(self) -> Array:
        """(L,) time stamps minus times of the middle rows."""
        return np.array([lens.time_offset_s for lens in self.lenses], float)

    def save(self, path: Path) -> None:
        """Write it whole or not at all."""
        content = {"lenses": [asdict(lens) for lens in self.lenses], "lens": self.lens.tolist()}
        with written_aside(path) as partial:
            partial.write_text(json.dumps(content), encoding="utf-8")

    @classmethod
    def load(cls, path: Path) -> "Calibration":
        """What `save` wrote."""
        content = json.loads(path.read_text(encoding="utf-8"))
        return cls([CalibratedLens(**lens) for lens in content["lenses"]], np.array(content["lens"], np.int64))


def lenses_of(frames: pd.DataFrame, device_of_session: dict[str, str]) -> tuple[Ints, list[str]]:
    """Which lens each of N frames was taken with (N,), and the lenses' names.

    Frames share a lens where their device, image size, stated distortion and readout time and, about, focal length are
    the same; an ultra-wide camera's focal length is half of the main one's.
    """
    device = frames["session_id"].map(device_of_session).fillna("").to_numpy(str)
    size = [f"{w}x{h}" for w, h in zip(frames["width"], frames["height"], strict=True)]
    stated = [",".join(f"{k:.6g}" for k in row) for row in frames["distortion"]]
    readout = frames["stated_readout_s"].to_numpy(str)
    group = pd.Series(["|".join(key) for key in zip(device, size, stated, readout, strict=True)])
    focal = np.log(frames["fx"].to_numpy(float) / frames["width"].to_numpy(float))
    lens = np.zeros(len(frames), np.int64)
    names: list[str] = []
    for _, rows in group.groupby(group, sort=True).indices.items():
        first = int(rows[0])
        order = np.sort(rows)[np.argsort(focal[np.sort(rows)], kind="stable")]
        cluster = np.concatenate([[0], np.cumsum(np.diff(focal[order]) > _MAX_FOCAL_STEP)])
        for number in range(cluster[-1] + 1):
            members = order[cluster == number]
            lens[members] = len(names)
            widths = np.exp(focal[members].mean())
            names.append(f"{device[first] or 'unknown device'}, {size[first]}, focal length {widths:.2f} widths")
    return lens, names


def prior_lenses(frames: pd.DataFrame, device_of_session: dict[str, str], settings: SfmSettings) -> Calibration:
    """Each lens as it is stated, or as phones have it where nothing is stated and lenses are to be estimated."""
    lens_N, names = lenses_of(frames, device_of_session)
    lenses = []
    for number, name in enumerate(names):
        members = np.flatnonzero(lens_N == number)
        stated = np.zeros(8)
        distortion = np.asarray(frames["distortion"].iloc[members[0]], float)
        stated[: len(distortion)] = distortion
        covariance = np.diag([*STATED_SD**2, _READOUT_SD_S**2])
        coefficients, origin, k3_sd = stated.copy(), CameraOrigin.STATED, KNOWN_K3_SD
        if settings.lens == "stated":
            covariance[:2, :2] = np.eye(2) / EXACT_INFORMATION
            k3_sd = 1 / np.sqrt(EXACT_INFORMATION)
        elif not len(distortion):
            coefficients[:2], origin, k3_sd = PHONE_K1_K2, CameraOrigin.PRIOR, _K3_SD
            covariance[:2, :2] = _PHONE_COVARIANCE
        readout_s, stated_readout_s = 0.0, None
        if settings.readout_s is not None:
            readout_s, covariance[2, 2] = settings.readout_s, 1 / EXACT_INFORMATION
        elif not np.isnan(frames["stated_readout_s"].iloc[members[0]]):
            readout_s = stated_readout_s = float(frames["stated_readout_s"].iloc[members[0]])
            covariance[2, 2] = _STATED_READOUT_SD_S**2
        prior = (coefficients.tolist(), readout_s, covariance.tolist())
        lenses.append(
            CalibratedLens(name, len(members), *prior, origin, stated.tolist(), *prior, float(k3_sd), stated_readout_s)
        )
    return Calibration(lenses, lens_N)


def with_lenses(frames: pd.DataFrame, calibration: Calibration) -> pd.DataFrame:
    """The frames table with the distortion of their lenses."""
    return frames.assign(
        distortion=pd.Series(distortion_lists(calibration.coefficients[calibration.lens]), frames.index)
    )


def distortion_lists(coefficients_N8: Array) -> list[list[float]]:
    """Coefficients as tables have them: four, or eight where the lens needs them."""
    return [row[: 8 if row[4:].any() else 4].tolist() for row in coefficients_N8]


@one_thread()
def calibrate(
    report: Report, database: Path, frames: pd.DataFrame, motion: Motion, pairs: Pairs, prior: Calibration, seed: int
) -> Calibration:
    """The lenses by some of the pairs (P, 2) of frames, which are matched by their features in the database; its
    cameras have the prior's lenses."""
    lens = prior.lens
    pairs = pairs[lens[pairs[:, 0]] == lens[pairs[:, 1]]]
    all_of_lens = [pairs[lens[pairs[:, 0]] == k] for k in range(len(prior.lenses))]
    of_lens = [of_one[evenly(len(of_one), _MAX_PAIRS)] for of_one in all_of_lens]
    sample = np.concatenate([np.empty((0, 2), np.int64), *of_lens])
    match_pairs(report, database, sample, seed)
    lenses = []
    for before, lens_pairs in zip(prior.lenses, of_lens, strict=True):
        rng, stated_6 = np.random.default_rng(seed), np.array(before.coefficients[2:])
        matches = _pair_matches(database, frames, motion, lens_pairs, stated_6, rng)
        lenses.append(before if matches is None else estimated_lens(before, matches, frames, seed))
    return replace(prior, lenses=lenses)


def _pair_matches(
    database: Path, frames: pd.DataFrame, motion: Motion, pairs: Pairs, stated_6: Array, rng: np.random.Generator
) -> PairMatches | None:
    """The verified matches of pairs (P, 2) of one lens, some of each; `stated_6` are its p1, p2, k3 to k6. None of too
    few pairs."""
    intrinsics = frames[["fx", "fy", "cx", "cy"]].to_numpy(float)
    line, session = lines_of(frames), frames["session_id"].to_numpy(str)
    centre = frames[["vio_cam_tx", "vio_cam_ty", "vio_cam_tz"]].to_numpy(float)
    poses, twists, ends, points, rows = [], [], [], [], []
    with pycolmap.Database.open(database) as opened:
        for a, b in pairs.tolist():
            geometry = opened.read_two_view_geometry(image_id(a), image_id(b))
            matches = geometry.inlier_matches
            if len(matches) < _MIN_MATCHES:
                continue
            xy = [opened.read_keypoints(image_id(row))[:, :2].astype(float) for row in (a, b)]
            cameras = [opened.read_camera(image_id(row)) for row in (a, b)]
            if not pycolmap.estimate_two_view_geometry_pose(cameras[0], xy[0], cameras[1], xy[1], geometry):
                continue
            assert geometry.cam2_from_cam1 is not None
            b_T_a = geometry.cam2_from_cam1.matrix()
            length = np.linalg.norm(b_T_a[:, 3])
            if not length:
                continue
            poses.append(inverse(make_pose(b_T_a[:, :3], b_T_a[:, 3] / length)))
            # VIO's metres in units of the pair's translation; across sessions it has none.
            apart_m = np.linalg.norm(centre[a] - centre[b]) if session[a] == session[b] else np.inf
            apart_m = max(float(np.nan_to_num(apart_m, nan=np.inf, posinf=np.inf)), _MIN_DISTANCE_M)
            twists.append([np.r_[motion.angular[row], motion.velocity[row] / apart_m] for row in (a, b)])
            ends.append([a, b])
            sample = matches[np.sort(rng.permutation(len(matches))[:_MAX_MATCHES])]
            observed_px = [points_px[sample[:, side]] for side, points_px in enumerate(xy)]
            rows.append(
                np.stack([readout_fraction(line[row], px) for row, px in zip((a, b), observed_px, strict=True)], 1)
            )
            points.append((np.stack(observed_px, axis=1) - intrinsics[[a, b], 2:]) / intrinsics[[a, b], :2])
    if len(poses) < _MIN_PAIRS:
        return None
    pair, frames_P2 = np.repeat(np.arange(len(poses)), [len(part) for part in rows]), np.array(ends, np.int64)
    focal_px = intrinsics[:, :2].mean(axis=1)[frames_P2[pair]]
    xy_M22, row_M2, twist_P26 = np.concatenate(points), np.concatenate(rows), np.array(twists)
    return PairMatches(pair, xy_M22, row_M2, focal_px, np.stack(poses), twist_P26, frames_P2, stated_6)


def estimated_lens(prior: CalibratedLens, matches: PairMatches, frames: pd.DataFrame, seed: int) -> CalibratedLens:
    """The lens by its matches; the prior's where held-out pairs, whose poses alone are fitted, fit that one better."""
    count = len(matches.a_T_b)
    held_out_P = np.zeros(count, bool)
    held_out_P[np.random.default_rng(seed).permutation(count)[: max(int(_HELD_OUT_FRACTION * count), 2)]] = True
    fitted, checked = matches.of_pairs(~held_out_P), matches.of_pairs(held_out_P)
    start = np.array([*prior.coefficients[:2], prior.readout_s])
    information = np.linalg.inv(np.array(prior.covariance))
    at_prior = _errors_px(checked, start)
    errors = _errors_px(checked, estimate_lens(fitted, start, information).parameters)
    wrong, undecided, readout_is_wrong = False, False, False
    is_held = bool(np.diag(information)[0] > EXACT_INFORMATION / 2)
    if prior.origin == CameraOrigin.STATED or prior.stated_readout_s is not None:
        weak = estimate_lens(fitted, start, np.linalg.inv(_WEAK_PRIOR))
        at_weak = _errors_px(checked, weak.parameters)
        is_better = _is_better(checked, at_prior, at_weak)
        denied = _distortion_is_denied(prior, weak, matches.stated_6, frames.iloc[matches.frames[0, 0]])
        wrong, undecided = denied and is_better, denied and not is_better
        if prior.stated_readout_s is not None:
            limit_s = max(_MIN_WRONG_SIGMAS * np.sqrt(weak.covariance[2, 2]), _MIN_WRONG_READOUT_S)
            is_denied = abs(weak.parameters[2] - prior.stated_readout_s) > limit_s
            readout_is_wrong = bool(is_denied and np.median(at_weak) < np.median(at_prior))
        is_open = prior.origin == CameraOrigin.STATED and not is_held
        if readout_is_wrong or is_open:
            covariance, k3_sd = np.array(prior.prior_covariance), prior.prior_k3_sd
            if is_open and not wrong:
                # What leads pairs astray, as a rolling shutter without VIO, would lead the model further.
                covariance[:2, :2], k3_sd, is_held = np.eye(2) / EXACT_INFORMATION, EXACT_INFORMATION**-0.5, True
            elif is_open:
                covariance[:2, :2], k3_sd = _WEAK_PRIOR[:2, :2], _K3_SD
            if readout_is_wrong:
                covariance[2, 2] = _WEAK_PRIOR[2, 2]
            prior = replace(prior, prior_covariance=covariance.tolist(), prior_k3_sd=k3_sd)
            information = np.linalg.inv(covariance)
            errors = _errors_px(checked, estimate_lens(fitted, start, information).parameters)
        if wrong and is_held:
            errors = at_weak
    prior_px, estimated_px = float(np.median(at_prior)), float(np.median(errors))
    check: dict[str, Any] = {"held_out_prior_px": prior_px, "held_out_px": estimated_px, "stated_is_wrong": wrong}
    check |= {"stated_is_undecided": undecided, "stated_readout_is_wrong": readout_is_wrong}
    stays = estimated_px > prior_px
    chosen = estimate_lens(matches, start, EXACT_INFORMATION * np.eye(3) if stays else information)
    rotation, session = poses_of(frames, "vio_cam")[:, :3, :3], frames["session_id"].to_numpy(str)
    a, b = matches.frames.T
    vio_a_R_b: Array = np.swapaxes(rotation[a], 1, 2) @ rotation[b]
    vio_a_R_b[session[a] != session[b]] = np.nan
    offset = estimate_time_offset(chosen, matches, held_out_P, vio_a_R_b)
    if offset is not None:
        check |= {"stamp_offset_s": offset.offset_s, "stamp_offset_sd_s": offset.sd_s}
        check["time_offset_s"] = offset.offset_s if offset.accepted else 0.0
    if stays:
        return replace(prior, **check)
    return replace(
        prior,
        **check,
        coefficients=[*chosen.parameters[:2].tolist(), *prior.coefficients[2:]],
        readout_s=float(chosen.parameters[2]),
        covariance=chosen.covariance.tolist(),
        origin=CameraOrigin.STATED if is_held else CameraOrigin.ESTIMATED,
    )


def _errors_px(matches: PairMatches, parameters: Array) -> Array:
    """Sampson distances (M,) of pairs whose poses are fitted with this lens and readout time."""
    fitted = estimate_lens(matches, parameters, EXACT_INFORMATION * np.eye(3))
    return np.abs(sampson_of(matches, fitted.a_T_b, fitted.parameters))


def _is_better(matches: PairMatches, before_M: Array, after_M: Array) -> bool:
    """The median errors of pairs become smaller by more than scatters from pair to pair (Student's t: few pairs hardly
    tell their scatter)."""
    medians = [pd.Series(errors).groupby(matches.pair).median().to_numpy() for errors in (before_M, after_M)]
    gain = np.log(np.maximum(medians[0], _MIN_ERROR_PX) / np.maximum(medians[1], _MIN_ERROR_PX))
    limit = stdtrit(len(gain) - 1, ndtr(_MIN_GAIN_SIGMAS)) * gain.std(ddof=1) / np.sqrt(len(gain))
    return bool(gain.mean() > max(limit, _MIN_WRONG_GAIN))


def _distortion_is_denied(prior: CalibratedLens, weak: LensEstimate, stated_6: Array, frame: pd.Series) -> bool:
    """Images of a stated lens, by which `weak` is estimated almost without a prior, show another one that a lens can
    have; `frame` is one of them."""
    if prior.origin != CameraOrigin.STATED:
        return False
    extent = (0.5 * frame.width / frame.fx, 0.5 * frame.height / frame.fy)
    coefficients = [*weak.parameters[:2], *stated_6]
    shift_px = max_shift(coefficients, prior.stated, extent) * frame.fx
    error = weak.parameters[:2] - prior.coefficients[:2]
    sigmas = np.sqrt(error @ np.linalg.solve(weak.covariance[:2, :2], error))
    corner = np.array([[float(np.hypot(*extent)), 0.0]])
    growth = distort_with_slope(undistort(corner, coefficients), coefficients)[1][0, 0, 0]
    # Not so where the polynomial has no such point: NaN.
    is_possible = abs(growth - 1) < _MAX_CORNER_GROWTH
    return bool(sigmas > _MIN_WRONG_SIGMAS and shift_px > _MIN_WRONG_PX and is_possible)


def lines_of(frames: pd.DataFrame) -> Array:
    """(N, 3) when each frame's pixels are exposed (`groundwalk.geometry.shutter`)."""
    return readout_lines(frames["first_row"], frames["width"], frames["height"])


def to_middle_row(xy_M2: Array, frame: Any, line: Array, readout_s: float, angular: Array) -> Array:
    """Pixels (M, 2) where a frame would have them if all rows were exposed with the middle one: turned by its angular
    velocity (3,). `line` (3,) says when they are exposed. The effect of its velocity depends on depth, and is left to
    the adjustment."""
    if not readout_s or not len(xy_M2):
        return xy_M2
    focal, centre = np.array([frame.fx, frame.fy]), np.array([frame.cx, frame.cy])
    coefficients = np.asarray(frame.distortion, float)
    rays = np.ones((len(xy_M2), 3))
    rays[:, :2] = undistort((xy_M2 - centre) / focal, coefficients)
    tau = readout_s * readout_fraction(line, xy_M2)
    rays = Rotation.from_rotvec(tau[:, None] * angular).apply(rays)
    return distort(rays[:, :2] / rays[:, 2:], coefficients) * focal + centre


def write_calibrated_database(
    source: Path, target: Path, frames: pd.DataFrame, names: Sequence[str], calibration: Calibration, motion: Motion
) -> None:
    """Write the database `target`: features of `source`, keypoints at the middle row's time, cameras with lenses."""
    partial = target.with_name(target.name + ".partial")
    partial.unlink(missing_ok=True)
    create_database(partial, frames, names)
    readout, line = calibration.readout_s[calibration.lens], lines_of(frames)
    with (
        pycolmap.Database.open(source) as features,
        pycolmap.Database.open(partial) as opened,
        pycolmap.DatabaseTransaction(opened),
    ):
        for row, frame in enumerate(frames.itertuples(index=False)):
            keypoints = features.read_keypoints(image_id(row))
            xy, angular = keypoints[:, :2].astype(float), motion.angular[row]
            keypoints[:, :2] = to_middle_row(xy, frame, line[row], float(readout[row]), angular)
            opened.write_keypoints(image_id(row), keypoints)
            opened.write_descriptors(image_id(row), features.read_descriptors(image_id(row)))
    partial.replace(target)
