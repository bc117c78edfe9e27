"""From SfM's poses and the phones' VIO to ground truth: the whole computation, tables in, tables out."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from alignment.agreement import Allowance, PoseSd, Window, compare, fit_rigid, worst_by_frame
from alignment.drift import DriftSamples, drift_table, measure_drift
from alignment.gate import Gate
from alignment.map_frame import MapScale, Vertical, common_scale, common_vertical
from alignment.segments import Segment, cut_segments
from alignment.sessions import SessionFit, fit_session, residuals_table, sessions_table
from alignment.settings import AlignSettings
from alignment.uncertainty import SharedSd, covariance_in_map, largest_sd, quality_classes, shared_covariance
from artefacts import UserError
from artefacts.tables import pose_frame, poses_of
from geometry.fits import Sim3, direction_angles, rotation_to_up
from geometry.poses import Array, inverse

NOT_REGISTERED = "SfM didn't register it"
DISAGREES = "SfM and VIO disagree here"


@dataclass(frozen=True)
class Aligned:
    """The stage's tables, and what the recording and the summary show."""

    ground_truth: pd.DataFrame
    sessions: pd.DataFrame
    drift: pd.DataFrame
    gate: pd.DataFrame
    residuals: pd.DataFrame
    map_S_sfm: Sim3
    scale: MapScale
    vertical: Vertical
    fits: list[SessionFit]


def align(
    frames: pd.DataFrame,
    images: pd.DataFrame,
    jumps: pd.DataFrame,
    recordings: dict[str, str],
    settings: AlignSettings,
    *,
    gt_uses_vio: bool,
) -> Aligned:
    """Build the map frame, check the model against VIO, and give out ground truth.

    `frames` and `jumps` are import's tables, `images` is SfM's; `recordings` names the recording of each session.
    Raises UserError where the map can't be built, or where too much of the model fails the gate.
    """
    frames = frames.reset_index(drop=True)
    if not images["registered"].any():
        raise UserError(
            "there is nothing to align: SfM registered no frame",
            where="sfm.images",
            found=f"0 of {len(images)} frames registered",
            do="look at the sfm recording and its pairs table",
        )
    segments = cut_segments(
        frames, images, jumps, recordings, jump_m=settings.segment_jump_m, jump_deg=settings.segment_jump_deg
    )
    # Scale and agreement are compared between all jumps, also those that an alignment lives with.
    pieces = cut_segments(frames, images, jumps, recordings, jump_m=0.0, jump_deg=0.0)
    scale = common_scale(
        pieces,
        window_m=settings.window_m,
        least_extent_m=settings.least_extent_m,
        window_sd=settings.window_scale_sd,
        phone_sd=settings.phone_scale_sd,
    )
    vertical = common_vertical(segments, phone_sd=float(np.radians(settings.phone_tilt_sd_deg)))
    # Metric and upright; origin and heading wait for the gate, as they hang on one session.
    metric_S_sfm = Sim3(float(np.exp(scale.log)), rotation_to_up(vertical.up_sfm), np.zeros(3))

    sd = PoseSd(settings.position_sd_m, float(np.radians(settings.rotation_sd_deg)))
    windows, worst_m, worst_rad, wrong = _compare_all(pieces, metric_S_sfm, settings, sd, len(frames))
    gate = _check(segments, windows, scale, vertical, settings)
    registered = np.zeros(len(frames), dtype=bool)
    for segment in segments:
        registered[segment.rows] = segment.registered
    used = registered & ~wrong
    _refuse_gross_failure(gate, registered, used, windows, settings)

    origin_S_metric = _origin(segments, metric_S_sfm, used, sd)
    map_S_sfm = origin_S_metric @ metric_S_sfm
    fits = [fit_session(s, map_S_sfm.poses(s.sfm_T_cam), used[s.rows], sd) for s in segments]
    ground_truth = _ground_truth(
        frames,
        images,
        map_S_sfm,
        registered,
        wrong,
        np.isfinite(worst_m),
        SharedSd(scale.sd, vertical.sd),
        settings,
        gt_uses_vio,
    )
    return Aligned(
        ground_truth,
        sessions_table(fits, scale, vertical),
        _drift(fits, map_S_sfm),
        gate.table(),
        residuals_table(fits, frames["frame_id"].to_numpy(str), worst_m, np.degrees(worst_rad)),
        map_S_sfm,
        scale,
        vertical,
        fits,
    )


def _compare_all(
    pieces: list[Segment], metric_S_sfm: Sim3, settings: AlignSettings, sd: PoseSd, count: int
) -> tuple[list[Window], Array, Array, np.ndarray]:
    """All windows, and each frame's worst residuals (metres, radians) and verdict, (count,) each."""
    allowance = Allowance(
        settings.drift_m,
        settings.drift_m_per_m,
        float(np.radians(settings.drift_deg)),
        float(np.radians(settings.drift_deg_per_m)),
    )
    metres, radians, wrong = np.full(count, np.nan), np.full(count, np.nan), np.zeros(count, dtype=bool)
    windows = []
    for piece in pieces:
        found = compare(piece, metric_S_sfm, settings.window_m, allowance, sd)
        metres[piece.rows], radians[piece.rows], wrong[piece.rows] = worst_by_frame(piece, found)
        windows += found
    return windows, metres, radians, wrong


def _check(
    segments: list[Segment], windows: list[Window], scale: MapScale, vertical: Vertical, settings: AlignSettings
) -> Gate:
    gate = Gate()
    frames = sum(len(s.rows) for s in segments)
    registered = sum(int(s.registered.sum()) for s in segments)
    gate.check(
        "registered",
        registered / frames,
        settings.least_registered,
        "share",
        f"SfM registered {registered} of {frames} frames",
        frames=frames,
        at_least=True,
    )
    for session_id in dict.fromkeys(s.session_id for s in segments):
        own = [s for s in segments if s.session_id == session_id]
        recording, count = own[0].recording, sum(len(s.rows) for s in own)
        known = sum(int(s.registered.sum()) for s in own)
        gate.check(
            "session_registered",
            known / count,
            settings.least_registered,
            "share",
            f"SfM registered {known} of the session's {count} frames",
            session_id=session_id,
            frames=count,
            at_least=True,
        )
        # One recording has no other to differ from.
        if recording in scale.recordings and len(scale.recordings) > 1:
            off = float(np.expm1(abs(scale.recordings[recording].log - scale.log)))
            # What the session's own windows can't tell apart isn't held against it.
            limit = settings.session_scale_limit + 2 * scale.recordings[recording].sd
            gate.check(
                "session_scale",
                off,
                limit,
                "share",
                "this session's VIO has another scale than the others'",
                session_id=session_id,
                frames=count,
            )
        if recording in vertical.recordings and len(vertical.recordings) > 1:
            tilt = direction_angles(vertical.recordings[recording][None], vertical.up_sfm)[0]
            gate.check(
                "session_vertical",
                float(np.degrees(tilt)),
                settings.session_tilt_limit_deg,
                "deg",
                "this session's gravity points elsewhere than the others'",
                session_id=session_id,
                frames=count,
            )
    for window in windows:
        gate.check_window(window)
    return gate


def _refuse_gross_failure(
    gate: Gate, registered: np.ndarray, used: np.ndarray, windows: list[Window], settings: AlignSettings
) -> None:
    share = registered.mean()
    if share < settings.least_registered:
        raise UserError(
            "SfM registered too few frames for ground truth",
            where="sfm.images",
            expected=f"at least {settings.least_registered:.0%} of them",
            found=f"{registered.sum()} of {len(registered)} ({share:.0%})",
            do="look at the sfm recording; more overlap between frames or sessions may be needed",
        )
    good = used.sum() / registered.sum()
    if good < settings.least_agreeing:
        largest = max(windows, key=lambda w: float(w.position_m.max() / w.limit_m))
        raise UserError(
            "the SfM model is wrong: it moves otherwise than VIO in most places",
            where=f"worst in session {largest.segment.session_id}, frames "
            f"{largest.segment.rows[largest.inside[0]]} to {largest.segment.rows[largest.inside[-1]]} of the table",
            expected=f"at least {settings.least_agreeing:.0%} of the frames within what VIO can drift",
            found=f"{used.sum()} of {registered.sum()} ({good:.0%}); {len(gate.failed)} of {len(gate.rows)} checks "
            f"failed; off by up to {float(largest.position_m.max()):.2f} m where {largest.limit_m:.2f} m is allowed",
            do="look at the sfm recording; repeated structure ties look-alike places together",
        )


def _origin(segments: list[Segment], metric_S_sfm: Sim3, used: np.ndarray, sd: PoseSd) -> Sim3:
    """Origin and heading: those of the VIO frame of the first segment that has 3 or more frames to tell by."""
    for segment in segments:
        known = segment.both & used[segment.rows]
        if known.sum() >= 3:
            metric_T_cam = metric_S_sfm.poses(segment.sfm_T_cam[known])
            metric_T_vio, _, _ = fit_rigid(metric_T_cam, segment.vio_T_cam[known], sd, yaw_only=True)
            vio_T_metric = inverse(metric_T_vio)
            return Sim3(1.0, vio_T_metric[:3, :3], vio_T_metric[:3, 3])
    raise UserError(
        "no session has 3 frames in which SfM and VIO agree",
        found=f"{int(used.sum())} frames that could be used, in {len(segments)} parts of sessions",
        do="capture longer sessions, or import more frames of these",
    )


def _ground_truth(
    frames: pd.DataFrame,
    images: pd.DataFrame,
    map_S_sfm: Sim3,
    registered: np.ndarray,
    wrong: np.ndarray,
    checked: np.ndarray,
    shared: SharedSd,
    settings: AlignSettings,
    gt_uses_vio: bool,
) -> pd.DataFrame:
    images = images.set_index("frame_id").loc[frames["frame_id"]].reset_index()
    known = registered & ~wrong
    map_T_cam = map_S_sfm.poses(poses_of(images, "sfm_cam"))
    map_T_cam[~known] = np.nan
    own = covariance_in_map(_covariances(images["covariance"]), map_S_sfm)
    own[~known] = np.nan
    xyz = map_T_cam[:, :3, 3]
    total = own + shared_covariance(xyz, xyz[known].mean(axis=0), shared)
    sd_m, sd_rad = largest_sd(own)
    judged = pd.DataFrame(
        {
            "position_sd_m": sd_m,
            "rotation_sd_deg": np.degrees(sd_rad),
            "observations": images["observations"].to_numpy(float, na_value=0.0),
            # Pixels mean different angles at different image sizes.
            "reprojection_deg": np.degrees(
                np.arctan2(images["reprojection_px"].to_numpy(float, na_value=np.nan), frames["fx"].to_numpy(float))
            ),
            "checked": checked,
        }
    )
    quality = quality_classes(judged, {"A": settings.quality_a.limits(), "B": settings.quality_b.limits()})
    reason = np.where(~registered, NOT_REGISTERED, np.where(wrong, DISAGREES, ""))
    table = frames[["frame_id", "session_id", "split", "t_ns"]].copy()
    table["covariance"] = [c.ravel().tolist() if np.isfinite(c).all() else None for c in total]
    table["position_sd_m"] = sd_m
    table["rotation_sd_deg"] = np.degrees(sd_rad)
    table["quality"] = np.where(known, quality, "none")
    table["reason"] = reason
    table["gt_uses_vio"] = gt_uses_vio
    return pd.concat([table, pose_frame("map_cam", map_T_cam)], axis=1)


def _covariances(column: pd.Series) -> Array:
    """A column of 36 doubles or null as (N, 6, 6), NaN where null."""
    covariance = np.full((len(column), 6, 6), np.nan)
    for row, values in enumerate(column):
        if values is not None and len(values) == 36:
            covariance[row] = np.asarray(values, dtype=float).reshape(6, 6)
    return covariance


def _drift(fits: list[SessionFit], map_S_sfm: Sim3) -> pd.DataFrame:
    by_session: dict[str, DriftSamples] = {}
    for fit in fits:
        s = fit.segment.where(_mask(len(fit.segment.rows), fit.compared))
        found = measure_drift(s.t_ns, map_S_sfm.poses(s.sfm_T_cam), s.vio_T_cam)
        by_session.setdefault(s.session_id, DriftSamples()).extend(found)
    return drift_table(by_session)


def _mask(count: int, indices: np.ndarray) -> np.ndarray:
    mask = np.zeros(count, dtype=bool)
    mask[indices] = True
    return mask
