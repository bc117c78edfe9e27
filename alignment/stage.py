"""Stage 3: ground truth in a metric, gravity-aligned map, and how VIO drifts from it."""

import numpy as np
import pandas as pd

from alignment.components import Placed
from alignment.depth import DepthSamples, check_depth, depth_clouds, has_depth, sample_frames
from alignment.depth import agreement_table as depth_table
from alignment.drift import ALL
from alignment.examination import Examination, examine
from alignment.ground_truth import Aligned, build, camera_sd
from alignment.map_frame import BY_GRAVITY
from alignment.picture import draw_gate
from alignment.recording import write_recording
from alignment.reference import Reference, describe_agreement
from alignment.rulers.measurement import find_rulers, read_rulers
from alignment.rulers.picture import draw_rulers
from alignment.rulers.verdict import describe, rulers_table
from alignment.sessions import SessionFit
from alignment.settings import AlignSettings
from alignment.sfm_tables import SfmTables
from artefacts import Stage, StageRun, UserError
from artefacts.tables import dataset_frames, with_cameras
from geometry.poses import Array

PICTURE, RULERS_PICTURE = "gate.png", "rulers.png"


def run(r: StageRun[AlignSettings]) -> None:
    frames, sessions = r.read("import", "frames").reset_index(drop=True), r.read("import", "sessions")
    jumps = r.read("import", "jumps")
    sfm = SfmTables.of(frames, r.read("sfm", "images"), r.read("sfm", "intrinsics"), r.read("sfm", "pairs"))
    images = sfm.images
    # SfM's poses go with these cameras.
    frames = with_cameras(frames, images)
    recordings = dict(zip(sessions["session_id"], sessions["recording"], strict=True))
    with r.step("rulers"):
        sightings = find_rulers(r.settings.rulers, frames, r.image_path)
        readings = read_rulers(
            sightings,
            frames,
            images,
            least_angle=float(np.radians(r.settings.ruler_min_angle_deg)),
            largest_sd=r.settings.ruler_max_sd,
        )
    for reading in readings:
        if reading.problem:
            r.say(f"ruler {reading.ruler.name}: undecided: {reading.problem}")
    reference = Reference.of(frames, r.read("import", "reference"), sessions)
    with r.step("examine"):
        found = examine(frames, sfm, jumps, recordings, r.settings, readings, reference)
    with r.step("picture"):
        shown = found.where(~frames["support"].to_numpy(bool))
        draw_gate(r.work / PICTURE, shown, r.scene.name, simulated=r.simulated)
        if found.rulers:
            draw_rulers(r.work / RULERS_PICTURE, found.rulers, frames, images, r.image_path)
    for judged in found.rulers:
        if not judged.reading.problem:
            r.say(describe(judged))
    r.write("rulers", rulers_table(found.rulers))
    if found.refusal:
        r.write("gate", found.gate.table())
        told = found.refusal.details
        raise UserError(
            found.refusal.what,
            where=told["where"],
            expected=told["expected"],
            found=told["found"],
            do=f"look at {r.work / PICTURE}; {told['do']}",
        )
    with r.step("depth"):
        depth = _judge_by_depth(r, frames, images, found)
    r.write("depth_agreement", depth)
    with r.step("align"):
        aligned = build(frames, images, found, r.settings)
    frames = dataset_frames(frames)
    for table in ("ground_truth", "sessions", "drift", "gate", "residuals", "reference_agreement"):
        r.write(table, getattr(aligned, table))
    _figures(r, frames, aligned)
    clouds = {}
    if len(depth) and found.is_metric:
        clouds = depth_clouds(frames, aligned.map_T_cam, shown.used, r.image_path)
    with r.step("recording"):
        write_recording(r, aligned, frames, r.read("sfm", "points"), clouds)


def _judge_by_depth(
    r: StageRun[AlignSettings], frames: pd.DataFrame, images: pd.DataFrame, found: Examination
) -> pd.DataFrame:
    """The depth_agreement table, with its checks in the gate where the map is metric."""
    if not has_depth(frames):
        return depth_table(DepthSamples.none(), r.seed)
    folders = r.read("sfm", "models").set_index("model_id")["folder"]
    samples = sample_frames(
        frames, images, found.used, found.placed, lambda model_id: r.folder("sfm") / folders[model_id], r.image_path
    )
    agreement = depth_table(samples, r.seed)
    if found.is_metric:
        for line in check_depth(found.gate, agreement, r.settings):
            r.say(line)
    return agreement


def _figures(r: StageRun[AlignSettings], frames: pd.DataFrame, aligned: Aligned) -> None:
    gt, sessions, main = aligned.ground_truth, aligned.sessions, aligned.main
    known = gt["quality"] != "none"
    registered = int(sessions["registered"].sum())
    counts = {name: int((gt["quality"] == name).sum()) for name in ("A", "B", "C", "none")}
    verdicts = aligned.gate["verdict"]
    figures = {
        "frames": len(gt),
        "registered": registered,
        "with_ground_truth": int(known.sum()),
        **{f"quality_{name}": count for name, count in counts.items()},
        "components": len(aligned.placed),
        "bridged": int(gt["gt_uses_vio"].sum()),
        "metres_per_sfm_unit": main.map_S_sfm.scale,
        "scale_sd": main.component.scale.sd,
        "scale_source": main.component.scale.source,
        "vertical_source": main.component.vertical.source,
        "session_scale_spread": _or_none(sessions["scale"].max() - sessions["scale"].min()),
        "vertical_sd_deg": float(np.degrees(main.component.vertical.sd)),
        "camera_sd_deg": float(np.degrees(camera_sd(frames, r.settings))),
        "vertical_correction_deg": _or_none(sessions["up_error_deg"].max()),
        "position_rms_m": _pooled_rms(sessions["position_rms_m"], sessions["used"]),
        "rotation_rms_deg": _pooled_rms(sessions["rotation_rms_deg"], sessions["used"]),
        "sim3_position_rms_m": _pooled_rms(sessions["sim3_position_rms_m"], sessions["registered"]),
        "sim3_rotation_median_deg": _or_none(sessions["sim3_rotation_median_deg"].max()),
        "vio_5m_median_percent": _over_5m(aligned.drift, "median"),
        "vio_5m_max_percent": _over_5m(aligned.drift, "max"),
        "reference_position_rms_m": _pooled_rms(
            aligned.reference_agreement["position_rms_m"], aligned.reference_agreement["compared"]
        ),
        "checks": len(aligned.gate),
        "checks_failed": int((verdicts == "failed").sum()),
        "checks_undecided": int((verdicts == "undecided").sum()),
    }
    for name, value in figures.items():
        r.figure(name, value)
    r.say(
        f"{registered} of {len(gt)} frames registered, {int(known.sum())} with ground truth "
        f"(A {counts['A']}, B {counts['B']}, C {counts['C']})"
    )
    r.say(_describe_map(main))
    for line in describe_agreement(aligned.reference_agreement, gt):
        r.say(line)
    for placed in aligned.placed[1:]:
        if placed.bridge is not None:
            r.say(
                f"model {placed.component.index}, {placed.component.frames} frames: in the map by VIO alone, over "
                f"{placed.bridge.gap_m:.1f} m of {placed.bridge.session_id}"
            )
    for fit in aligned.fits:
        if fit.segment.tracked.any():
            r.say(_describe(fit))
    _report_gate(r, aligned.gate)


def _report_gate(r: StageRun[AlignSettings], gate: pd.DataFrame) -> None:
    failures, undecided = gate[gate["verdict"] == "failed"], int((gate["verdict"] == "undecided").sum())
    failed = f"{len(failures)} of {len(gate)} checks failed" if len(failures) else "no check failed"
    r.say(f"gate: {f'{failed}, {undecided} undecided' if len(failures) or undecided else 'all checks passed'}")
    for (cause, session_id), rows in failures.groupby(["cause", "session_id"]):
        r.say(f"  {cause}{f', {session_id}' if session_id else ''}: {rows['reason'].iloc[0]} ({len(rows)} checks)")


def _describe_map(main: Placed) -> str:
    """One line on the map's scale and vertical, and what gave them."""
    scale, vertical = main.component.scale, main.component.vertical
    text = (
        f"map: {main.map_S_sfm.scale:.6g} m per SfM unit ± {100 * scale.sd:.2f} %, vertical "
        f"± {np.degrees(vertical.sd):.2f}°, from "
    )
    if vertical.source != BY_GRAVITY:
        return f"{text}{scale.source} (± of the fit to it; what it is off by itself isn't known)"
    text += f"{len(vertical.recordings)} VIO recordings"
    return f"{text}; scale by {scale.source}" if scale.rulers else text


def _describe(fit: SessionFit) -> str:
    """One line on how a session's VIO compares with the ground truth."""
    name = f"{fit.segment.session_id}, part {fit.segment.index}"
    if fit.segment.component:
        name += f" in model {fit.segment.component}"
    if not len(fit.compared):
        return f"{name}: too few frames with ground truth and VIO to align"
    text = (
        f"{name}: VIO off by {_rms(fit.position_m):.3f} m RMS, rotation median {np.median(fit.rotation_deg):.2f}° "
        f"over {fit.segment.travelled_m[-1]:.1f} m"
    )
    if not len(fit.sim3_position_m):
        return text
    return (
        f"{text}; after a Sim3 fit of its own {1000 * _rms(fit.sim3_position_m):.1f} mm RMS, rotation median "
        f"{np.median(fit.sim3_rotation_deg):.2f}°"
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _pooled_rms(rms: pd.Series, counts: pd.Series) -> float | None:
    """Root mean square over all frames from each session's own."""
    known = rms.notna()
    if not counts[known].any():
        return None
    return float(np.sqrt(np.average(rms[known].astype(float) ** 2, weights=counts[known])))


def _over_5m(drift: pd.DataFrame, statistic: str) -> float | None:
    """How far VIO's relative position is from the ground truth's over 5 m, in percent, over all sessions."""
    wanted = (drift["session_id"] == ALL) & (drift["definition"] == "distance_position") & (drift["interval"] == 5.0)
    return float(drift.loc[wanted, statistic].iloc[0]) if wanted.any() else None


def _or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


STAGE = Stage(
    name="align",
    version=10,
    settings=AlignSettings,
    needs=("import", "sfm"),
    run=run,
    help="Ground truth: SfM's model put into a metric map with +y up, checked against the phones' VIO. Metric scale "
    "and vertical come from all sessions together; writes each frame's pose with covariance and quality, where each "
    "session's VIO frame lies, how VIO drifts, and what was checked.",
)
