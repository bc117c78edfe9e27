"""Frames, ground truth and predictions joined into walks, and what is wrong with them said clearly."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from pandas.api.types import is_numeric_dtype

from artefacts import UserError
from artefacts.tables import poses_of
from geometry.poses import Array

Flags = NDArray[np.bool_]

MIN_OVERLAP = 0.5
_MIN_QUATERNION = 1e-6

FRAME_COLUMNS = ["frame_id", "session_id", "t_ns", "split"]
TRUTH_COLUMNS = ["frame_id"]
PREDICTION_COLUMNS = ["model", "frame_id"]


@dataclass(frozen=True)
class Walk:
    """One session's evaluated frames in order of time. A pose that is missing is all NaN.

    frame_id (N,) str, t_ns (N,) int64, gravity (N, 3) unit vectors in camera axes, and the poses (N, 4, 4).
    """

    scene: str
    session_id: str
    split: str
    frame_id: NDArray[np.object_]
    t_ns: NDArray[np.int64]
    gravity: Array
    vio_T_cam: Array
    map_T_cam_apr: Array
    map_T_cam: Array  # ground truth

    def __len__(self) -> int:
        return len(self.t_ns)


def known(poses: Array) -> Flags:
    """Which of poses (N, 4, 4) are there, (N,)."""
    return np.asarray(np.isfinite(poses).all(axis=(-1, -2)))


@dataclass
class Evaluated:
    """The walks of one scene and model, and the rows that were not what they should be, counted by what was wrong."""

    walks: list[Walk]
    frame_counts: dict[str, int]
    prediction_counts: dict[str, int]


def check_frames(frames: pd.DataFrame, truth: pd.DataFrame, where: str = "") -> None:
    """Refuse frames and ground truth that can't be evaluated.

    Raises UserError for a missing column, a frame listed twice, two frames of a session at one time, ground truth of
    other frames or another session or time, and for frames without any ground truth.
    """
    _need(frames, FRAME_COLUMNS, "vio_cam", f"frames {where}")
    _need(truth, TRUTH_COLUMNS, "map_cam", f"ground truth {where}")
    _refuse_duplicates(frames, ["frame_id"], f"frames {where}")
    _refuse_duplicates(frames, ["session_id", "t_ns"], f"frames {where}")
    _refuse_duplicates(truth, ["frame_id"], f"ground truth {where}")
    _refuse_disagreement(frames, truth, f"ground truth {where}")
    if not truth["frame_id"].isin(frames["frame_id"]).any():
        raise UserError(f"no frame has ground truth {where}", do="give frames and ground truth of the same captures")


def check_predictions(frames: pd.DataFrame, predictions: pd.DataFrame, where: str = "") -> None:
    """Refuse predictions with a missing column, a frame listed twice for a model, or of another session or time."""
    _need(predictions, PREDICTION_COLUMNS, "map_cam", f"predictions {where}")
    _refuse_duplicates(predictions, ["model", "frame_id"], f"predictions {where}")
    _refuse_disagreement(frames, predictions, f"predictions {where}")


def evaluated(
    scene: str, frames: pd.DataFrame, truth: pd.DataFrame, predictions: pd.DataFrame, splits: Iterable[str]
) -> Evaluated:
    """The walks of one scene and one model's `predictions`, over frames of the named splits.

    A walk ends where the session or the split changes. Frames are taken in order of time. Counted, not refused: rows
    out of that order, frames without odometry, without a prediction or without ground truth, predictions that aren't
    finite and predictions for unknown frames. Raises UserError where fewer than half of the frames have a prediction.
    """
    chosen = frames[frames["split"].isin(list(splits))]
    if chosen.empty:
        found = ", ".join(sorted(frames["split"].unique()))
        raise UserError(f"scene {scene} has no frames to evaluate", expected=f"split {', '.join(splits)}", found=found)
    ordered = chosen.sort_values(["session_id", "t_ns"], kind="stable")
    apr_T = poses_for(ordered, predictions, "map_cam")
    walks = []
    vio_T, true_T = _poses(ordered, "vio_cam"), poses_for(ordered, truth, "map_cam")
    gravity = _gravity(ordered)
    # A new piece begins where the session or the split changes in time.
    key = ordered["session_id"].astype(str) + "/" + ordered["split"]
    piece = (key != key.shift()).cumsum().to_numpy()
    for number in np.unique(piece):
        rows = piece == number
        first = ordered.iloc[int(np.argmax(rows))]
        walks.append(
            Walk(
                scene,
                str(first["session_id"]),
                str(first["split"]),
                ordered["frame_id"].to_numpy(object)[rows],
                ordered["t_ns"].to_numpy(np.int64)[rows],
                gravity[rows],
                vio_T[rows],
                apr_T[rows],
                true_T[rows],
            )
        )
    listed = ordered["frame_id"].isin(predictions["frame_id"]).to_numpy()
    unknown = int((~predictions["frame_id"].isin(frames["frame_id"])).sum())
    frame_counts = {
        "frames": len(ordered),
        "frames_out_of_order": int((chosen.groupby("session_id")["t_ns"].diff() < 0).sum()),
        "frames_without_odometry": int((~known(vio_T)).sum()),
        "frames_without_ground_truth": int((~known(true_T)).sum()),
    }
    prediction_counts = {
        "frames_without_prediction": int((~listed).sum()),
        "predictions_not_finite": int((listed & ~known(apr_T)).sum()),
        "predictions_of_unknown_frames": unknown,
    }
    if listed.mean() < MIN_OVERLAP:
        raise UserError(
            f"scene {scene}: predictions and frames hardly overlap",
            expected=f"a prediction for at least {MIN_OVERLAP:.0%} of the {len(ordered)} evaluated frames",
            found=f"{int(listed.sum())}, and {unknown} predictions of unknown frames",
            do="check that frame_id is <session>/<six digits> as in the frames table",
        )
    return Evaluated(walks, frame_counts, prediction_counts)


def poses_for(frames: pd.DataFrame, table: pd.DataFrame, prefix: str) -> Array:
    """A pose group (N, 4, 4) of `table` for each row of `frames`, NaN where it has none."""
    return _poses(table.set_index("frame_id").reindex(frames["frame_id"]), prefix)


def _poses(table: pd.DataFrame, prefix: str) -> Array:
    """A pose group as (N, 4, 4); NaN where a value isn't finite or the quaternion has no length."""
    columns = _pose_columns(prefix)
    values = table[columns].astype(float)
    sound = np.isfinite(values).all(axis=1) & (np.linalg.norm(values[columns[3:]], axis=1) > _MIN_QUATERNION)
    return poses_of(values.where(sound), prefix)


def _pose_columns(prefix: str) -> list[str]:
    return [f"{prefix}_{part}" for part in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]


def _gravity(frames: pd.DataFrame) -> Array:
    columns = [f"gravity_{a}" for a in "xyz"]
    if not set(columns) <= set(frames.columns):
        return np.full((len(frames), 3), np.nan)
    return frames[columns].to_numpy(float, na_value=np.nan)


def _need(table: pd.DataFrame, columns: list[str], prefix: str, what: str) -> None:
    wanted = [*columns, *_pose_columns(prefix)]
    missing = [c for c in wanted if c not in table.columns]
    if missing:
        raise UserError(f"{what.strip()} lack columns", expected=", ".join(wanted), found=f"no {', '.join(missing)}")
    text = [c for c in wanted if c.endswith("_ns") or c.startswith(prefix) if not is_numeric_dtype(table[c])]
    if text:
        raise UserError(f"{what.strip()} have text for numbers", where=f"column {text[0]}", found=table[text[0]].dtype)
    unset = [c for c in columns if table[c].isna().any()]
    if unset:
        raise UserError(f"{what.strip()} have empty values", where=f"column {unset[0]}", expected="a value in each row")


def _refuse_duplicates(table: pd.DataFrame, columns: list[str], what: str) -> None:
    twice = table[table.duplicated(columns)]
    if len(twice):
        example = ", ".join(f"{c} {twice.iloc[0][c]}" for c in columns)
        raise UserError(
            f"{what.strip()} have rows twice", expected=f"each {' and '.join(columns)} once", found=f"{example}, ..."
        )


def _refuse_disagreement(frames: pd.DataFrame, table: pd.DataFrame, what: str) -> None:
    """Rows of another session or time than the frame of their id has."""
    shared = [c for c in ("session_id", "t_ns") if c in table.columns]
    joined = frames[["frame_id", *shared]].merge(table[["frame_id", *shared]], on="frame_id", suffixes=("", "_other"))
    for column in shared:
        wrong = joined[joined[column] != joined[f"{column}_other"]]
        if len(wrong):
            row = wrong.iloc[0]
            raise UserError(
                f"{what.strip()}: {len(wrong)} rows have another {column} than their frames",
                where=f"frame {row['frame_id']}",
                expected=row[column],
                found=row[f"{column}_other"],
            )
