"""The stage's Rerun recording: what each query was matched with, what it answered, and what was refused."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.localisation.localisers import LOCALISERS
from groundwalk.localisation.results import QueryResult
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, REJECTED
from groundwalk.store.images import read_image
from groundwalk.store.recording import FRAME_TIMELINE, UP_AXIS, log_camera, log_path, set_time, tabbed
from groundwalk.store.tables import poses_of

_MOST_QUERIES = 120
_IMAGE_SIDE = 480


def blueprint(models: list[str]) -> rrb.Blueprint:
    """A tab a localiser: the map with the query's rays; its image with what was matched; what it said."""
    tabs = [
        rrb.Horizontal(
            rrb.Spatial3DView(
                origin="/",
                contents=["/ground_truth/**", f"/{model}/map", f"/{model}/query/**", f"/{model}/rays/**"],
                name=f"{model}: rays to inliers in its colour, to outliers red; ground truth green",
            ),
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin="/image", contents=["/image", f"/{model}/seen/**"], name="query: inliers and outliers (red)"
                ),
                rrb.TextDocumentView(origin=f"/{model}/answer", name="answer"),
                rrb.TimeSeriesView(origin=f"/{model}/inliers", name="inliers; 0: refused"),
                row_shares=[3, 1, 1],
            ),
            column_shares=[2, 1],
            name=model,
        )
        for model in models
    ]
    return tabbed(tabs)


def record(
    stream: rr.RecordingStream,
    queries: pd.DataFrame,
    truth: pd.DataFrame,
    points: dict[str, Array],
    answers: dict[str, list[QueryResult]],
    image_path: Callable[[str], Path],
) -> None:
    """Log everything; row i of `queries` has the answers[model][i]. Queries beyond so many are left out evenly."""
    stream.log("/", UP_AXIS, static=True)
    for session, rows in truth.sort_values("t_ns").groupby("session_id", sort=True):
        split = "test" if (rows["split"] == "test").any() else "train"
        log_path(stream, f"/ground_truth/{split}/{session}", poses_of(rows, "map_cam")[:, :3, 3], GROUND_TRUTH)
    for model, xyz in points.items():
        stream.log(f"/{model}/map", rr.Points3D(xyz, colors=NEUTRAL, radii=rr.Radius.ui_points(1)), static=True)
        stream.log(f"/{model}/inliers", rr.SeriesLines(colors=LOCALISERS[model].colour, names="inliers"), static=True)
    starts = queries.groupby("session_id")["t_ns"].min()
    true = poses_of(truth.set_index("frame_id").reindex(queries["frame_id"]), "map_cam")
    for row in evenly(len(queries), _MOST_QUERIES).tolist() if answers else []:
        frame = queries.iloc[row]
        stream.set_time(FRAME_TIMELINE, sequence=row)
        set_time(stream, int(frame["t_ns"] - starts[frame["session_id"]]))
        image = read_image(image_path(frame["image"]))
        factor = min(1.0, _IMAGE_SIDE / max(image.shape[:2]))
        small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        stream.log("/image", rr.Image(np.asarray(small, np.uint8)).compress(75))
        if np.isfinite(true[row]).all():
            log_camera(stream, "/ground_truth/query", true[row], frame, GROUND_TRUTH, 0.5)
        else:
            stream.log("/ground_truth/query", rr.Clear(recursive=True))
        for model, said in answers.items():
            _log_answer(stream, model, said[row], points[model], frame, factor)


def _log_answer(
    stream: rr.RecordingStream, model: str, answer: QueryResult, xyz: Array, frame: "pd.Series", factor: float
) -> None:
    """An answer: its camera, the rays to its points, its keypoints, and what it says."""
    colour, seen = LOCALISERS[model].colour, answer.seen
    stream.log(f"/{model}/inliers", rr.Scalars(float(answer.inliers if answer.map_T_cam is not None else 0)))
    what = f"{answer.inliers} inliers of {answer.candidates} candidates"
    text = f"refused, {answer.refusal}: {answer.reason}" if answer.refusal else what
    stream.log(f"/{model}/answer", rr.TextDocument(f"{frame['frame_id']}: {text}"))
    for kind, rows, shade in (("inliers", seen.inlier, colour), ("outliers", ~seen.inlier, REJECTED)):
        keypoints = rr.Points2D(factor * seen.px[rows], colors=shade, radii=rr.Radius.ui_points(2))
        stream.log(f"/{model}/seen/{kind}", keypoints)
        if answer.map_T_cam is not None:
            ends = xyz[seen.points[rows]]
            rays = np.stack([np.broadcast_to(answer.map_T_cam[:3, 3], ends.shape), ends], axis=1)
            lines = rr.LineStrips3D(rays.astype(np.float32), colors=shade, radii=rr.Radius.ui_points(0.5))
            stream.log(f"/{model}/rays/{kind}", lines)
    if answer.map_T_cam is not None:
        log_camera(stream, f"/{model}/query", answer.map_T_cam, frame, colour, 0.5)
    else:
        stream.log(f"/{model}/query", rr.Clear(recursive=True))
        stream.log(f"/{model}/rays", rr.Clear(recursive=True))
