"""The train stage's recording: where each model places the frames."""

from collections.abc import Mapping

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import colours
from groundwalk.store.recording import FRAME_TIMELINE, UP_AXIS, log_camera, log_path, set_time, tabbed
from groundwalk.store.registry import Colour
from groundwalk.store.tables import poses_of
from groundwalk.training.data import ImageCache

_MAX_IMAGES = 500  # keeps the file small; cameras and errors of all frames are there
_JPEG_QUALITY = 80


def blueprint(scenes: list[str], models: list[str]) -> rrb.Blueprint:
    """A tab a scene with each model's places, the image and the errors over time."""
    tabs: list[rrb.Container] = []
    for scene in scenes:
        places = [
            rrb.Spatial3DView(
                origin=f"/{scene}",
                contents=[f"/{scene}/ground_truth/**", f"/{scene}/{model}/**"],
                name=f"ground truth green, {model} in its colour; lines: test frames' errors",
            )
            for model in models
        ]
        tabs.append(
            rrb.Vertical(
                rrb.Horizontal(*places),
                rrb.Horizontal(
                    rrb.Spatial2DView(origin=f"/{scene}/image", name="what the models see"),
                    rrb.TimeSeriesView(origin=f"/{scene}/position_error_m", name="position error, m"),
                    rrb.TimeSeriesView(origin=f"/{scene}/rotation_error_deg", name="rotation error, degrees"),
                    column_shares=[1, 2, 2],
                ),
                row_shares=[2, 1],
                name=scene,
            )
        )
    return tabbed(tabs)


def record(
    stream: rr.RecordingStream,
    frames: pd.DataFrame,
    predictions: pd.DataFrame,
    cache: ImageCache,
    crop: int,
    shades: Mapping[str, Colour],
) -> None:
    """Log everything; row i of `frames` has its image in cache[i]. `shades` are the models' colours."""
    map_T_cam = poses_of(frames, "map_cam")
    keys = ["scene", "frame_id"]
    estimates = {
        str(model): poses_of(frames[keys].merge(mine, on=keys, how="left"), "map_cam")
        for model, mine in predictions.groupby("model", sort=False)
    }
    starts = frames.groupby(["scene", "session_id"])["t_ns"].transform("min").to_numpy()
    every = -(-len(frames) // _MAX_IMAGES)
    for scene in frames["scene"].unique():
        rows = np.flatnonzero(frames["scene"] == scene)
        stream.log(f"/{scene}", UP_AXIS, static=True)
        for (session, split), block in frames.iloc[rows].groupby(["session_id", "split"], sort=False):
            at = block.index.to_numpy()
            path = f"/{scene}/ground_truth/path/{session}/{split}"
            log_path(stream, path, map_T_cam[at, :3, 3], colours.GROUND_TRUTH)
        for number, row in enumerate(rows):
            frame = frames.iloc[row]
            stream.set_time(FRAME_TIMELINE, sequence=number)
            set_time(stream, int(frame["t_ns"]) - starts[row])
            has_truth = np.isfinite(map_T_cam[row]).all()
            if has_truth:
                log_camera(stream, f"/{scene}/ground_truth/now", map_T_cam[row], frame, colours.GROUND_TRUTH, 1.0)
            for model, estimate in estimates.items():
                if not np.isfinite(estimate[row]).all():
                    continue
                log_camera(stream, f"/{scene}/{model}/now", estimate[row], frame, shades[model], 1.0)
                if has_truth:
                    metres, degrees = (e(estimate[row], map_T_cam[row]) for e in (position_error, rotation_error_deg))
                    stream.log(f"/{scene}/position_error_m/{model}", rr.Scalars(float(metres)))
                    stream.log(f"/{scene}/rotation_error_deg/{model}", rr.Scalars(float(degrees)))
            if number % every == 0:
                image = cache[int(row)]
                top, left = (image.shape[0] - crop) // 2, (image.shape[1] - crop) // 2
                seen = rr.Image(image[top : top + crop, left : left + crop])
                stream.log(f"/{scene}/image", seen.compress(_JPEG_QUALITY))
        for model, estimate in estimates.items():
            for name in ("position_error_m", "rotation_error_deg"):
                series = rr.SeriesLines(colors=shades[model], names=model)
                stream.log(f"/{scene}/{name}/{model}", series, static=True)
            # A line from where the camera was to where the model puts it.
            both = np.stack([map_T_cam[rows, :3, 3], estimate[rows, :3, 3]], axis=1)
            both = both[(frames["split"].to_numpy()[rows] == "test") & np.isfinite(both).all(axis=(1, 2))]
            lines = rr.LineStrips3D(both, colors=shades[model], radii=rr.Radius.ui_points(0.5))
            stream.log(f"/{scene}/{model}/test_errors", lines, static=True)
