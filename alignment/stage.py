"""Stage 3: ground truth in a metric, gravity-aligned map, and how VIO drifts from it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from groundwalk.alignment import depth, georeference, given_frame, held, recording
from groundwalk.alignment.check_models import AlignInputs, CheckedMap, check_models, refusal
from groundwalk.alignment.checks.results import CheckResult, checks_table, describe
from groundwalk.alignment.components import MAX_SCALE_SD, MAX_VERTICAL_SD, NOT_GIVEN, GivenFrame, MapScale, Vertical
from groundwalk.alignment.control import check as control_check
from groundwalk.alignment.control.check import ControlCheck
from groundwalk.alignment.control.points import ControlPoints, find_points
from groundwalk.alignment.control.tables import control_table, draw_control, points_table
from groundwalk.alignment.depth import check_depth
from groundwalk.alignment.georeference import NoGeoreference
from groundwalk.alignment.ground_truth import AlignResult, build, camera_sd, poses_in_map
from groundwalk.alignment.plot import draw_checks
from groundwalk.alignment.reference.agreement import describe_agreement
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.rulers import scale_check
from groundwalk.alignment.rulers.detection import find_rulers
from groundwalk.alignment.rulers.measurement import measure_rulers
from groundwalk.alignment.sessions import SessionFit, rms
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables
from groundwalk.consistency.decisions import Status
from groundwalk.scoring.bootstrap import finite
from groundwalk.store import StageRun
from groundwalk.store.choices import QualityClass, ScaleSource, UpSource, VerticalSource
from groundwalk.store.files import write_json
from groundwalk.store.georeference import FILE, Georeference
from groundwalk.store.tables import dataset_frames, with_cameras

CHECKS_PLOT, CONTROL_PLOT = "checks.png", "control.png"
AlignRun = StageRun[AlignSettings]
_TABLES = ("ground_truth", "sessions", "drift", "checks", "residuals", "reference_agreement")


def run(r: AlignRun) -> None:
    inputs = _read(r)
    frames, images, reference = inputs.frames, inputs.sfm.images, inputs.reference
    before = r.before if r.holds else None
    with r.step("rulers"):
        rulers = measure_rulers(find_rulers(r.settings.rulers, frames, r.image_path), frames, images)
        controls = [find_points(survey, frames, r.data.root, r.image_path) for survey in r.settings.controls]
    with r.step("checks"):
        checked = _check_models(r, replace(inputs, rulers=rulers), controls)
        ruler_checks = scale_check.check_rulers(checked.components, rulers, r.settings.max_ruler_size_error)
        checked = replace(checked, checks=[*checked.checks, *(check.result for check in ruler_checks)])
    with r.step("plots"):
        dataset = checked.where(~frames["support"].to_numpy(bool))
        draw_checks(r.work / CHECKS_PLOT, dataset, reference, r.scene.name, simulated=r.simulated)
    for check in ruler_checks:
        r.say(scale_check.describe(check))
    r.write("rulers", scale_check.rulers_table(ruler_checks))
    if before is None:
        error = refusal(checked, frames, r.settings)
    else:
        checked = held.in_map_before(checked, frames, images, before)
        error = held.refusal_of_added(checked, frames, r.settings, before)
    if error is not None:
        r.write("checks", checks_table(checked.checks))
        if (r.work / CHECKS_PLOT).is_file():
            error.details["do"] = f"look at {r.work / CHECKS_PLOT}; {error.details['do']}"
        raise error
    with r.step("depth"):
        checked = replace(checked, checks=[*checked.checks, *_check_by_depth(r, frames, images, checked)])
    with r.step("control"):
        surveys = _check_by_control(r, controls, inputs, checked)
        checked = replace(checked, checks=[*checked.checks, *(survey.result for survey in surveys)])
        _place_on_earth(r, inputs, checked, surveys)
    with r.step("align"):
        result = build(frames, images, checked, reference)
        if before is not None:
            result = held.with_rows_before(result, before)
        versions = held.versions_table(result.ground_truth, before)
        r.write("versions", versions)
        r.figure("version", int(versions["version"].max()))
    for table in _TABLES:
        r.write(table, getattr(result, table))
    registered, frames = int(dataset.frames.registered.sum()), dataset_frames(frames)
    _write_figures(r, frames, result, registered)
    origin = reference.origin if reference is not None and reference.gives_map else None
    for axis, value in zip("xyz", origin or [None] * 3, strict=True):
        r.figure(f"map_origin_{axis}", value)
    for line in _summary(result, checked.checks, registered):
        r.say(line)
    if origin is not None and any(origin):
        r.say(f"map: its origin is at ({', '.join(f'{v:.12g}' for v in origin)}) of the reference's own coordinates")
    with r.step("recording"), r.recording(recording.blueprint(sorted(frames["session_id"].unique()))) as rec:
        recording.log_models(rec, result.placed, r.read("sfm", "points"))
        recording.log_frames(rec, result.ground_truth, result.map_T_cam, frames)
        recording.log_sessions(rec, result.fits, frames, recording.camera_length_m(result.ground_truth))
        recording.log_session_images(rec, frames, r.image_path)


def _read(r: AlignRun) -> AlignInputs:
    frames, sessions = r.read("import", "frames").reset_index(drop=True), r.read("import", "sessions")
    sfm = SfmTables.of(frames, r.read("sfm", "images"), r.read("sfm", "intrinsics"), r.read("sfm", "pairs"))
    # SfM's poses go with its cameras.
    frames = with_cameras(frames, sfm.images)
    is_tested = sessions["up_source"].isin([UpSource.ACCELEROMETER, UpSource.LINES])
    return AlignInputs(
        numbers=held.model_numbers(sfm.images, r.before) if r.before is not None and r.holds else {},
        frames=frames,
        sfm=sfm,
        jumps=r.read("import", "jumps"),
        recordings=dict(zip(sessions["session_id"], sessions["recording"], strict=True)),
        reference=Reference.of(frames, r.read("import", "reference"), sessions),
        gravity_tested=frozenset(sessions.loc[is_tested, "recording"]),
    )


def _check_models(r: AlignRun, inputs: AlignInputs, controls: Sequence[ControlPoints]) -> CheckedMap:
    """The checked map; where it lacks scale or vertical, with those that something else gives, one after the other."""
    checked = check_models(inputs, r.settings)
    if inputs.reference is not None and inputs.reference.gives_map:
        return checked

    def by_surveys(checked: CheckedMap) -> GivenFrame:
        return given_frame.by_surveys(_control_checks(controls, inputs, checked), checked.placed[0])

    def by_lines(checked: CheckedMap) -> GivenFrame:
        return given_frame.by_lines(r, inputs.frames, inputs.sfm.images, checked.placed[0])

    def by_gps(checked: CheckedMap) -> GivenFrame:
        try:
            return given_frame.by_gps(_by_gps(r, inputs, checked), checked.placed[0])
        except NoGeoreference:  # said where the map is to be placed on earth
            return NOT_GIVEN

    for give in (by_surveys, by_lines, *([by_gps] if _asks_for_gps(r) else [])):
        if not checked.placed:
            break
        main = checked.placed[0].component
        if main.scale.is_known and main.vertical.source.is_known:
            break
        given, before = give(checked), inputs.given
        if given != NOT_GIVEN:
            inputs = replace(inputs, given=GivenFrame(before.scale or given.scale, before.vertical or given.vertical))
            checked = check_models(inputs, r.settings)
    return checked


def _check_by_depth(r: AlignRun, frames: pd.DataFrame, images: pd.DataFrame, checked: CheckedMap) -> list[CheckResult]:
    """The checks by a depth sensor, where the map is metric; the table of its agreement is written."""

    def folder(model_id: str) -> Path:  # read only where frames have depth
        return r.folder("sfm") / r.read("sfm", "models").set_index("model_id")["folder"][model_id]

    usable = checked.frames.has_ground_truth
    samples = depth.sample_frames(frames, images, usable, checked.placed, folder, r.image_path)
    agreement = depth.agreement_table(samples, r.seed)
    r.write("depth_agreement", agreement)
    if not checked.placed[0].component.scale.is_known:
        return []
    components = [each.component for each in checked.placed]
    checks, lines = check_depth(agreement, {component.index: component.scale.sd for component in components})
    for line in lines:
        r.say(line)
    return checks


def _control_checks(controls: Sequence[ControlPoints], inputs: AlignInputs, checked: CheckedMap) -> list[ControlCheck]:
    frames, images, usable = inputs.frames, inputs.sfm.images, checked.frames.has_ground_truth
    return [control_check.check_control(points, frames, images, checked.placed, usable) for points in controls]


def _check_by_control(
    r: AlignRun, controls: Sequence[ControlPoints], inputs: AlignInputs, checked: CheckedMap
) -> list[ControlCheck]:
    """The checks by surveyed points; their tables and picture are written."""
    checks = _control_checks(controls, inputs, checked)
    for check in checks:
        r.say(control_check.describe(check))
    r.write("control", control_table(checks))
    r.write("control_points", points_table(checks))
    if checks:
        map_T_cam = poses_in_map(inputs.sfm.images, checked.placed)[checked.frames.has_ground_truth]
        draw_control(r.work / CONTROL_PLOT, checks, map_T_cam[:, :3, 3])
    return checks


def _asks_for_gps(r: AlignRun) -> bool:
    return (r.folder("import") / "gps.parquet").is_file()


def _by_gps(r: AlignRun, inputs: AlignInputs, checked: CheckedMap) -> Georeference:
    map_T_cam = poses_in_map(inputs.sfm.images, checked.placed)
    map_T_cam[~checked.frames.has_ground_truth] = np.nan
    return georeference.of_gps(r.read("import", "gps"), inputs.frames, inputs.recordings, map_T_cam, checked.placed)


def _place_on_earth(r: AlignRun, inputs: AlignInputs, checked: CheckedMap, surveys: Sequence[ControlCheck]) -> None:
    """A file that says where on earth the map is, where a survey or import's setting gps asks for it, or why it doesn't
    know."""
    asks = _asks_for_gps(r)
    if not asks and all(survey.points.origin is None for survey in surveys):
        return
    try:
        found = georeference.of_surveys(surveys, checked.placed)
        if found is None:
            if not asks:
                raise NoGeoreference("no survey in WGS84 passes its check: see its line, and correct it")
            found = _by_gps(r, inputs, checked)
    except NoGeoreference as reason:
        write_json(r.work / FILE, {"refused": str(reason)})
        r.say(f"no georeference: {reason}")
    else:
        found.write(r.work / FILE)
        r.say(found.describe())


def _write_figures(r: AlignRun, frames: pd.DataFrame, result: AlignResult, registered: int) -> None:
    gt, main = result.ground_truth, result.main
    scale, vertical, status = main.component.scale, main.component.vertical, result.checks["status"]
    figures = {
        "frames": len(gt),
        "registered": registered,
        "with_ground_truth": int((gt["quality"] != QualityClass.NONE).sum()),
        **{f"quality_{name}": int((gt["quality"] == name).sum()) for name in QualityClass},
        "components": len(result.placed),
        "metres_per_sfm_unit": main.map_S_sfm.scale,
        "scale_source": scale.source,
        "vertical_source": vertical.source,
        "scale_sd": finite(scale.sd),
        "vertical_sd_deg": finite(float(np.degrees(vertical.sd))),
        "camera_sd_deg": float(np.degrees(camera_sd(frames))),
        "checks": len(status),
        "checks_failed": int((status == Status.FAILED).sum()),
        "checks_undecided": int((status == Status.UNDECIDED).sum()),
    }
    for name, value in figures.items():
        r.figure(name, value)


def _summary(result: AlignResult, checks: Sequence[CheckResult], registered: int) -> list[str]:
    """Lines for the user."""
    quality = result.ground_truth["quality"]
    counts = {name: int((quality == name).sum()) for name in QualityClass}
    with_pose = len(quality) - counts.pop(QualityClass.NONE)
    classes = ", ".join(f"{name} {count}" for name, count in counts.items())
    scale, has_vio = result.main.component.scale, any(fit.segment.has_vio.any() for fit in result.fits)
    return [
        f"{registered} of {len(quality)} frames registered, {with_pose} with ground truth ({classes})",
        *(f"  {line}" for line in result.class_counts),
        f"map: {_describe_scale(scale, has_vio)}, vertical {_describe_vertical(result.main.component.vertical)}",
        *describe_agreement(result.reference_agreement, result.ground_truth),
        *(
            f"model {placed.component.index}, {placed.component.frames} frames: in the map by VIO alone, over "
            f"{placed.link.gap_m:.1f} m of {placed.link.session_id}"
            for placed in result.placed[1:]
            if placed.link is not None
        ),
        *(_describe_fit(fit) for fit in result.fits if fit.segment.has_vio.any()),
        *describe(checks),
    ]


def _describe_scale(scale: MapScale, has_vio: bool) -> str:
    if scale.reference is ScaleSource.REFERENCE_UNIT_UNKNOWN:
        per_unit = f"{np.exp(scale.log):.6g} of it per SfM unit"
        return f"NO METRIC SCALE: all lengths are in the reference's unknown unit, {per_unit}"
    if not scale.is_known:
        why = "VIO hardly moves" if has_vio else "there is no VIO, or none but of limited tracking"
        add = "a longer walk or a ruler" if has_vio else "a ruler, surveyed points or a recording with VIO"
        return f"NO METRIC SCALE: {why}, all lengths are in SfM's unit; add {add}"
    by = f"{len(scale.recordings)} VIO recordings" if scale.by == ScaleSource.VIO else scale.by
    if scale.reference:
        by += " (± of the fit to it; its own error is unknown)"
    text = f"{np.exp(scale.log):.6g} m per SfM unit ± {100 * scale.sd:.2f} % from {by}"
    return text if scale.sd <= MAX_SCALE_SD else f"{text}, UNCERTAIN: above {100 * MAX_SCALE_SD:g} %"


def _describe_vertical(vertical: Vertical) -> str:
    if vertical.source is VerticalSource.NONE:
        differ = "the sessions' gravity differs, and nothing tells which is right"
        return f"UNKNOWN: {differ if vertical.recordings else 'no session has gravity'}; +y may point anywhere"
    text = f"± {np.degrees(vertical.sd):.2f}° from {vertical.source}"
    return text if vertical.sd <= MAX_VERTICAL_SD else f"{text}, UNCERTAIN: above {np.degrees(MAX_VERTICAL_SD):g}°"


def _describe_fit(fit: SessionFit) -> str:
    """One line on how a session's VIO compares with the ground truth."""
    name = f"{fit.segment.session_id}, segment {fit.segment.index}"
    if fit.segment.component:
        name += f" in model {fit.segment.component}"
    if not len(fit.compared):
        return f"{name}: too few frames with ground truth and VIO to align"
    text = (
        f"{name}: VIO off by {rms(fit.rigid.position_m):.3f} m RMS, rotation median "
        f"{np.median(fit.rigid.rotation_deg):.2f}° over {fit.segment.path_m:.1f} m"
    )
    if not len(fit.sim3.position_m):
        return text
    return (
        f"{text}; after a Sim3 fit {rms(fit.sim3.position_m):.3f} m RMS, rotation median "
        f"{np.median(fit.sim3.rotation_deg):.2f}°"
    )
