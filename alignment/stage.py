"""Stage 3: ground truth in a metric, gravity-aligned map, and how VIO drifts from it."""

from dataclasses import replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks import ANY_SCENE, Check, describe, gate_table
from groundwalk.alignment.components import Placed
from groundwalk.alignment.depth import DepthSamples, check_depth, depth_clouds, has_depth, sample_frames
from groundwalk.alignment.depth import agreement_table as depth_table
from groundwalk.alignment.drift import ALL
from groundwalk.alignment.examination import Examination, examine
from groundwalk.alignment.ground_truth import Aligned, build, camera_sd
from groundwalk.alignment.map_frame import BY_REFERENCE_UNIT_UNKNOWN, MapScale
from groundwalk.alignment.picture import draw_gate
from groundwalk.alignment.recording import write_recording
from groundwalk.alignment.reference import Reference, describe_agreement
from groundwalk.alignment.rulers.measurement import find_rulers, read_rulers
from groundwalk.alignment.rulers.picture import draw_rulers
from groundwalk.alignment.rulers.verdict import describe as describe_ruler
from groundwalk.alignment.rulers.verdict import rulers_table
from groundwalk.alignment.sessions import SessionFit
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables
from groundwalk.artefacts import Stage, StageRun, UserError
from groundwalk.artefacts.tables import dataset_frames, with_cameras
from groundwalk.consistency.decisions import Status
from groundwalk.geometry.poses import Array

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
            r.say(describe_ruler(judged))
    r.write("rulers", rulers_table(found.rulers))
    if found.refusal:
        r.write("gate", gate_table(found.checks))
        told = found.refusal.details
        raise UserError(
            found.refusal.what,
            where=told["where"],
            expected=told["expected"],
            found=told["found"],
            do=f"look at {r.work / PICTURE}; {str(told['do']).replace(ANY_SCENE, r.scene.name)}",
        )
    with r.step("depth"):
        depth, depth_checks = _check_by_depth(r, frames, images, found)
    found = replace(found, checks=[*found.checks, *depth_checks])
    r.write("depth_agreement", depth)
    with r.step("align"):
        aligned = build(frames, images, found, r.settings)
    frames = dataset_frames(frames)
    for table in ("ground_truth", "sessions", "drift", "gate", "residuals", "reference_agreement"):
        r.write(table, getattr(aligned, table))
    _figures(r, frames, aligned, found.checks)
    clouds = {}
    if len(depth) and aligned.main.component.scale.is_known:
        clouds = depth_clouds(frames, aligned.map_T_cam, shown.used, r.image_path)
    with r.step("recording"):
        write_recording(r, aligned, frames, r.read("sfm", "points"), clouds)


def _check_by_depth(
    r: StageRun[AlignSettings], frames: pd.DataFrame, images: pd.DataFrame, found: Examination
) -> tuple[pd.DataFrame, list[Check]]:
    """The depth_agreement table, and the checks by it where the map is metric."""
    if not has_depth(frames):
        return depth_table(DepthSamples.none(), r.seed), []
    folders = r.read("sfm", "models").set_index("model_id")["folder"]
    samples = sample_frames(
        frames, images, found.used, found.placed, lambda model_id: r.folder("sfm") / folders[model_id], r.image_path
    )
    agreement = depth_table(samples, r.seed)
    if not found.placed[0].component.scale.is_known:
        return agreement, []
    checks, lines = check_depth(agreement, r.settings)
    for line in lines:
        r.say(line)
    return agreement, checks


def _figures(r: StageRun[AlignSettings], frames: pd.DataFrame, aligned: Aligned, checks: list[Check]) -> None:
    gt, sessions, main = aligned.ground_truth, aligned.sessions, aligned.main
    known = gt["quality"] != "none"
    registered = int(sessions["registered"].sum())
    counts = {name: int((gt["quality"] == name).sum()) for name in ("A", "B", "C", "none")}
    scale = main.component.scale
    figures = {
        "frames": len(gt),
        "registered": registered,
        "with_ground_truth": int(known.sum()),
        **{f"quality_{name}": count for name, count in counts.items()},
        "components": len(aligned.placed),
        "bridged": int(gt["gt_uses_vio"].sum()),
        "metres_per_sfm_unit": main.map_S_sfm.scale,
        "scale_source": scale.source(r.settings.max_scale_sd),
        "vertical_source": main.component.vertical.source,
        "scale_sd": _or_none(scale.sd),
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
        "checks_failed": int((aligned.gate["status"] == Status.FAILED).sum()),
        "checks_undecided": int((aligned.gate["status"] == Status.UNDECIDED).sum()),
    }
    for name, value in figures.items():
        r.figure(name, value)
    r.say(
        f"{registered} of {len(gt)} frames registered, {int(known.sum())} with ground truth "
        f"(A {counts['A']}, B {counts['B']}, C {counts['C']})"
    )
    for line in aligned.class_counts:
        r.say(f"  {line}")
    r.say(f"map: {_describe_scale(scale, r.settings)}, vertical {_describe_vertical(main, r.settings)}")
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
    for line in describe(checks):
        r.say(line.replace(ANY_SCENE, r.scene.name))


def _describe_scale(scale: MapScale, settings: AlignSettings) -> str:
    if scale.reference == BY_REFERENCE_UNIT_UNKNOWN:
        return f"NO METRIC SCALE: all lengths are in the reference's unit, {np.exp(scale.log):.6g} of it per SfM unit"
    if not scale.is_known:
        return "NO METRIC SCALE, VIO hardly moves: all lengths are in SfM's unit; a longer walk or a ruler gives one"
    by = scale.source(np.inf) if scale.rulers or scale.reference else f"{len(scale.recordings)} VIO recordings"
    if scale.reference:
        by += " (± of the fit to it; what it is off by itself isn't known)"
    text = f"{np.exp(scale.log):.6g} m per SfM unit ± {100 * scale.sd:.2f} % from {by}"
    return text if scale.sd <= settings.max_scale_sd else f"{text}, UNCERTAIN: above {100 * settings.max_scale_sd:g} %"


def _describe_vertical(main: Placed, settings: AlignSettings) -> str:
    sd_deg = float(np.degrees(main.component.vertical.sd))
    text = f"± {sd_deg:.2f}° from {main.component.vertical.source}"
    return (
        text
        if sd_deg <= settings.max_vertical_sd_deg
        else f"{text}, UNCERTAIN: above {settings.max_vertical_sd_deg:g}°"
    )


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
    version=11,
    settings=AlignSettings,
    needs=("import", "sfm"),
    run=run,
    help="Ground truth: SfM's model put into a metric map with +y up, checked against the phones' VIO. Metric scale "
    "and vertical come from all sessions together; writes each frame's pose with covariance and quality, where each "
    "session's VIO frame lies, how VIO drifts, and what was checked.",
    reads_images=lambda settings: bool(settings.rulers),
)
