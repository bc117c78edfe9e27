"""The report's recording: its tables as text, and the drawn test walks with their errors over time."""

import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from groundwalk.reports.grids import Grid, markdown
from groundwalk.reports.inputs import SceneInputs
from groundwalk.store import colours, recording
from groundwalk.store.tables import poses_of


def blueprint(scenes: list[SceneInputs], grids: list[Grid]) -> rrb.Blueprint:
    """Tables on the left; on the right a tab a scene with its walks from above their errors."""
    tables = [rrb.TextDocumentView(origin=f"tables/{grid.key}", name=grid.title) for grid in grids]
    walks = [
        rrb.Vertical(
            rrb.Spatial3DView(origin=f"{scene.name}/map", name="test walks"),
            rrb.TimeSeriesView(origin=f"{scene.name}/error/position", name=f"position error ({scene.unit.symbol})"),
            rrb.TimeSeriesView(origin=f"{scene.name}/error/rotation", name="rotation error (°)"),
            row_shares=[3, 1, 1],
            name=scene.name,
        )
        for scene in scenes
    ]
    return rrb.Blueprint(rrb.Horizontal(rrb.Tabs(*tables, active_tab=1), rrb.Tabs(*walks)), collapse_panels=True)


def record(stream: rr.RecordingStream, scenes: list[SceneInputs], grids: list[Grid]) -> None:
    """Write everything that the blueprint shows."""
    for grid in grids:
        document = rr.TextDocument(markdown(grid), media_type=rr.MediaType.MARKDOWN)
        stream.log(f"tables/{grid.key}", document, static=True)
    for scene in scenes:
        stream.log(f"{scene.name}/map", recording.UP_AXIS, static=True)
        truth = scene.ground_truth[scene.ground_truth["split"] == "test"].sort_values(["session_id", "t_ns"])
        for session_id, walk in truth.groupby("session_id"):
            path = f"{scene.name}/map/ground_truth/{session_id}"
            recording.log_path(stream, path, poses_of(walk, "map_cam")[:, :3, 3], colours.GROUND_TRUTH)
        for model in scene.models:
            _walks(stream, scene, model)


def _walks(stream: rr.RecordingStream, scene: SceneInputs, model: str) -> None:
    raw = scene.predictions[scene.predictions["model"] == model]
    kinds = [("apr", raw, scene.raw_errors(model), "apr", colours.APR)]
    if scene.fused_method is not None:
        fused = scene.fused_poses(model, scene.fused_method)
        kinds.append(("fused", fused, scene.frame_errors(model), "live", colours.FUSED))
    for kind, table, every, prefix, colour in kinds:
        errors = every[every["split"] == "test"].sort_values(["session_id", "t_ns"])
        group = "live_map_cam" if prefix == "live" else "map_cam"
        matched = errors[["session_id", "frame_id"]].merge(table, on=["session_id", "frame_id"], how="left")
        xyz = poses_of(matched, group)[:, :3, 3]
        for session_id in matched["session_id"].unique():
            here = (matched["session_id"] == session_id).to_numpy()
            recording.log_path(stream, f"{scene.name}/map/{kind}/{model}/{session_id}", xyz[here], colour)
            for quantity, unit in (("position", "m"), ("rotation", "deg")):
                path = f"{scene.name}/error/{quantity}/{model}/{kind}/{session_id}"
                _curve(stream, path, errors[here], f"{prefix}_{quantity}_{unit}", colour)


def _curve(
    stream: rr.RecordingStream, path: str, errors: pd.DataFrame, column: str, colour: tuple[int, int, int]
) -> None:
    """One walk's errors over the time since it began, so that walks lie over each other."""
    since_start = errors["t_ns"] - errors["t_ns"].min()
    known = errors[column].notna()
    stream.log(path, rr.SeriesLines(colors=[colour], names=[path.split("/", 3)[3]]), static=True)
    times = rr.TimeColumn(recording.TIMELINE, duration=since_start[known].to_numpy().astype("timedelta64[ns]"))
    stream.send_columns(path, [times], rr.Scalars.columns(scalars=errors.loc[known, column].to_numpy(float)))
