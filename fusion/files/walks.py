"""Frames, ground truth and predictions joined into walks, and what is wrong with them said clearly."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from groundwalk.fusion.files.conventions import shares_vertical
from groundwalk.fusion.methods.localiser import is_covariance
from groundwalk.fusion.walk import Texts, Walk, known, with_odometry
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import sure_enough
from groundwalk.store import UserError
from groundwalk.store.choices import MapUnit
from groundwalk.store.tables import (
    covariance_numbers,
    dataset_frames,
    map_unit,
    pose_columns,
    poses_of,
    read_parquet,
    refuse_other_types,
)

MIN_OVERLAP = 0.5
_MIN_QUATERNION = 1e-6
_UNIT_QUATERNION = 1e-3
_SMALLEST_PLACE_M = 10.0
# What a network puts out may not be normalised; angles in degrees are far from it.
_QUATERNION_LENGTHS = (0.2, 5.0)
_ON_EARTH_M = 1e8  # farther from the origin there is no place for a camera
_QUALITIES = ("A", "B", "C", "none")


@dataclass(frozen=True)
class Inputs:
    """One scene's frames, ground truth and predictions; `made_here` are the models whose predictions the stages train
    and localise made, so that the order of their quaternions is known."""

    scene: str
    frames: pd.DataFrame
    truth: pd.DataFrame
    predictions: pd.DataFrame
    made_here: frozenset[str] = frozenset()


@dataclass(frozen=True)
class Files:
    """The three tables of one scene, as Parquet."""

    frames: Path
    ground_truth: Path
    predictions: Path

    def read(self, scene: str) -> Inputs:
        """UserError where a file isn't a Parquet table."""
        frames = read_parquet(self.frames)
        if "split" not in frames.columns:
            frames = frames.assign(split="test")
        if "support" in frames.columns:
            frames = dataset_frames(frames)
        return Inputs(scene, frames, read_parquet(self.ground_truth), read_parquet(self.predictions))


@dataclass
class Evaluated:
    """The walks of one scene and model, and the rows that were not what they should be, counted by what was wrong."""

    walks: list[Walk]
    frame_counts: dict[str, int]
    prediction_counts: dict[str, int]


def check(inputs: Inputs) -> None:
    """Refuse tables that can't be evaluated.

    Raises UserError for a column that is missing or of another type, a frame listed twice (of predictions: for one
    model), two frames of a session at one time, ground truth or predictions of another session or time than their
    frames, ground truth of other frames or of an unknown quality class, and predictions without any pose or with
    rotations that can't be quaternions.
    """
    frames, truth, predictions = inputs.frames, inputs.truth, inputs.predictions
    in_frames, in_truth, in_predictions = (
        f"{what} of {inputs.scene}" for what in ("frames", "ground truth", "predictions")
    )
    _need(frames, ["frame_id", "session_id", "t_ns", "split"], "vio_cam", in_frames)
    _need(truth, ["frame_id"], "map_cam", in_truth)
    _refuse_unknown_quality(truth, in_truth)
    _refuse_duplicates(frames, ["frame_id"], in_frames)
    _refuse_duplicates(frames, ["session_id", "t_ns"], in_frames)
    _refuse_duplicates(truth, ["frame_id"], in_truth)
    _refuse_disagreement(frames, truth, in_truth)
    if not truth["frame_id"].isin(frames["frame_id"]).any():
        raise UserError(
            f"no frame has ground truth of {inputs.scene}", do="give frames and ground truth of the same captures"
        )
    _need(predictions, ["model", "frame_id"], "map_cam", in_predictions)
    _refuse_no_quaternions(predictions, in_predictions)
    _refuse_duplicates(predictions, ["model", "frame_id"], in_predictions)
    _refuse_disagreement(frames, predictions, in_predictions)


def evaluated(
    scene: str, frames: pd.DataFrame, truth: pd.DataFrame, predictions: pd.DataFrame, splits: Iterable[str]
) -> Evaluated:
    """The walks of one scene and one model's `predictions`, over frames of the named splits.

    A walk ends where the session or the split changes. Frames are taken in order of time. In a map without metric
    scale they are without odometry. Counted, not refused: rows out of order, frames without odometry (of walks that
    have some, or none), prediction or ground truth, ground truth too uncertain for the accuracy levels or of no stated
    quality, predictions that aren't finite, are of unknown frames, or in the map of another scene, which count as
    missing, quaternions that aren't of unit length. Raises
    UserError where no evaluated frame has ground truth, or fewer than half have a prediction.
    """
    splits = list(splits)
    chosen = frames[frames["split"].isin(splits)]
    if chosen.empty:
        actual = ", ".join(sorted(frames["split"].unique()))
        raise UserError(f"scene {scene} has no frames to evaluate", expected=f"split {', '.join(splits)}", found=actual)
    ordered = chosen.sort_values(["session_id", "t_ns"], kind="stable")
    # Of each evaluated frame, null where it has none.
    predicted, stated = (table.set_index("frame_id").reindex(ordered["frame_id"]) for table in (predictions, truth))
    vio_T, apr_T, true_T = _poses(ordered, "vio_cam"), _poses(predicted, "map_cam"), true_poses(stated)
    covariance, unsound = _covariances(predicted)
    if map_unit(truth) is not MapUnit.METRE:
        vio_T[:] = np.nan  # metres can't be fused with poses in another unit
    quality, true = _qualities(stated), known(true_T)
    if not true.any():
        raise UserError(
            f"scene {scene}: no evaluated frame has ground truth",
            found=f"{len(ordered)} frames of split {', '.join(splits)}",
            do="look at the align stage's table checks, or give ground truth of the evaluated frames",
        )
    refused = np.zeros(len(predicted), dtype=bool)
    if "refusal" in predicted:  # a pose that is there is used, whatever stands beside it
        refused = (predicted["refusal"].notna() & predicted["refusal"].ne(False)).to_numpy(bool) & ~known(apr_T)
    elsewhere = np.zeros(len(predicted), dtype=bool)
    if {"scene", "picked_scene"} <= set(predicted.columns):  # the pose is in the map of the scene that was picked
        picked = predicted["picked_scene"]
        elsewhere = (picked.notna() & picked.ne(predicted["scene"])).to_numpy(bool)
        apr_T[elsewhere] = np.nan
    walks = _walks(scene, ordered, (vio_T, apr_T, true_T), quality, covariance)
    listed = ordered["frame_id"].isin(predictions["frame_id"]).to_numpy()
    unknown = int((~predictions["frame_id"].isin(frames["frame_id"])).sum())
    evaluated_predictions = predictions[predictions["frame_id"].isin(ordered["frame_id"])]
    frame_counts = {
        "frames": len(ordered),
        "frames_out_of_order": int((chosen.groupby("session_id")["t_ns"].diff() < 0).sum()),
        "frames_of_walks_without_odometry": sum(len(walk) for walk in walks if not walk.has_odometry),
        "frames_without_odometry": sum(int((~known(walk.vio_T_cam)).sum()) for walk in with_odometry(walks)),
        "frames_without_common_vertical": sum(known(w.vio_T_cam).sum() for w in walks if not w.shares_vertical),
        "frames_without_ground_truth": int((~true).sum()),
        "frames_too_uncertain_for_levels": int((true & ~sure_enough(quality)).sum()),
        "frames_of_unstated_quality": int((true & pd.isna(quality)).sum()),
        "odometry_quaternions_not_of_unit_length": _not_unit(ordered, "vio_cam"),
        "ground_truth_quaternions_not_of_unit_length": _not_unit(truth[truth["frame_id"].isin(ordered["frame_id"])]),
    }
    prediction_counts = {
        "prediction_quaternions_not_of_unit_length": _not_unit(evaluated_predictions),
        "frames_without_prediction": int((~listed).sum()),
        "predictions_refused": int(refused.sum()),
        "predictions_of_another_scene": int(elsewhere.sum()),
        "predictions_not_finite": int((listed & ~known(apr_T) & ~refused & ~elsewhere).sum()),
        "prediction_covariances_not_positive_definite": unsound,
        "predictions_outside_the_place": _outside(apr_T, true_T),
        "predictions_of_unknown_frames": unknown,
    }
    if listed.mean() < MIN_OVERLAP:
        raise UserError(
            f"scene {scene}: predictions of {predictions['model'].iloc[0]} and frames hardly overlap",
            expected=f"a prediction for at least {MIN_OVERLAP:.0%} of the {len(ordered)} evaluated frames",
            found=f"{int(listed.sum())}, and {unknown} predictions of unknown frames",
            do="check that frame_id is <session>/<six digits> as in the frames table",
        )
    return Evaluated(walks, frame_counts, prediction_counts)


def _walks(
    scene: str, ordered: pd.DataFrame, poses: tuple[Array, Array, Array], quality: Texts, covariance: Array | None
) -> list[Walk]:
    """The walks of frames in order; `poses` are odometry's, the predictions' and the true ones (N, 4, 4)."""
    gravity, states_gravity = _gravity(ordered), set(_GRAVITY) <= set(ordered.columns)
    frame_ids, t_ns = ordered["frame_id"].to_numpy(object), ordered["t_ns"].to_numpy(np.int64)
    # A new walk begins where the session or the split changes in time.
    key = ordered["session_id"].astype(str) + "/" + ordered["split"]
    number = (key != key.shift()).cumsum().to_numpy()
    walks = []
    for rows in (number == n for n in np.unique(number)):
        session_id, split = (str(ordered.iloc[int(np.argmax(rows))][name]) for name in ("session_id", "split"))
        ids, times, down, states = frame_ids[rows], t_ns[rows], gravity[rows], quality[rows]
        vio_T, apr_T, true_T = (of_all[rows] for of_all in poses)
        uncertain = None if covariance is None else covariance[rows]
        has_vertical = not states_gravity or bool(np.isfinite(down).any())
        is_shared = has_vertical and shares_vertical(true_T, vio_T)
        walks.append(
            Walk(scene, session_id, split, ids, times, down, vio_T, apr_T, true_T, states, uncertain, is_shared)
        )
    return walks


def _covariances(predictions: pd.DataFrame) -> tuple[Array | None, int]:
    """The covariances (N, 6, 6) that predictions bring, NaN where there is none or what is there can't be one, and how
    many can't; None where no prediction brings any."""
    if "covariance" not in predictions.columns or not predictions["covariance"].notna().any():
        return None, 0
    covariances, unsound = np.full((len(predictions), 6, 6), np.nan), 0
    for i in np.flatnonzero(predictions["covariance"].notna()):
        numbers = covariance_numbers(predictions["covariance"].iloc[i])
        if numbers is not None and is_covariance(numbers.reshape(6, 6)):
            covariances[i] = numbers.reshape(6, 6)
        else:
            unsound += 1
    return covariances, unsound


def true_poses(truth: pd.DataFrame) -> Array:
    """Rows of ground truth as (N, 4, 4), NaN where there is none."""
    map_T_cam = _poses(truth, "map_cam")
    map_T_cam[_qualities(truth) == "none"] = np.nan
    return map_T_cam


def _outside(apr_T: Array, true_T: Array) -> int:
    """How many predicted positions lie farther from the box around the ground truth than that box is large."""
    true, predicted = true_T[known(true_T), :3, 3], apr_T[known(apr_T), :3, 3]
    low, high = true.min(axis=0), true.max(axis=0)
    extent_m = max(float(np.linalg.norm(high - low)), _SMALLEST_PLACE_M)
    away_m = np.linalg.norm(np.maximum(0, np.maximum(low - predicted, predicted - high)), axis=1)
    return int((away_m > extent_m).sum())


def _poses(table: pd.DataFrame, prefix: str) -> Array:
    """A pose group as (N, 4, 4); NaN where a value isn't finite, the place isn't on Earth or the quaternion has no
    length."""
    values = table[pose_columns(prefix)].astype(float)
    numbers = values.to_numpy()
    sound = np.isfinite(numbers).all(axis=1) & (np.abs(numbers[:, :3]) < _ON_EARTH_M).all(axis=1)
    sound &= _lengths(values, prefix) > _MIN_QUATERNION
    values[~sound] = np.nan
    return poses_of(values, prefix)


def _lengths(table: pd.DataFrame, prefix: str) -> Array:
    """Lengths of a pose group's quaternions, (N,)."""
    return np.linalg.norm(table[pose_columns(prefix)[3:]].to_numpy(float, na_value=np.nan), axis=1)


def _not_unit(table: pd.DataFrame, prefix: str = "map_cam") -> int:
    """How many quaternions of a pose group are used that aren't of unit length; they are taken for their direction."""
    lengths = _lengths(table, prefix)
    used = np.isfinite(lengths) & (lengths > _MIN_QUATERNION)
    return int((used & (np.abs(lengths - 1) > _UNIT_QUATERNION)).sum())


def _refuse_no_quaternions(table: pd.DataFrame, what: str) -> None:
    """Rows without a single pose, or whose rotations are something else than quaternions: Euler angles, say."""
    finite = np.isfinite(table[pose_columns("map_cam")].to_numpy(float, na_value=np.nan)).all(axis=1)
    if not finite.any():
        raise UserError(f"{what}: none of {len(table)} rows has a finite pose", expected="numbers, not NaN")
    median = float(np.median(_lengths(table[finite], "map_cam")))
    if not _QUATERNION_LENGTHS[0] <= median <= _QUATERNION_LENGTHS[1]:
        raise UserError(
            f"{what}: the rotations are no quaternions",
            where="columns map_cam_qx, _qy, _qz, _qw",
            expected="unit quaternions, length 1",
            found=f"lengths of {median:.3g} (median of {finite.sum()} rows)",
            do="convert Euler angles or other rotations to unit quaternions",
        )


def _qualities(truth: pd.DataFrame) -> Texts:
    """The class of each row's ground truth, (N,); None where none is stated."""
    if "quality" not in truth.columns:
        return np.full(len(truth), None, dtype=object)
    quality = truth["quality"].to_numpy(object, copy=True)
    quality[pd.isna(quality)] = None
    return np.asarray(quality)


def _gravity(frames: pd.DataFrame) -> Array:
    """Down in camera axes as unit vectors (N, 3); NaN where it isn't given, isn't finite or has no length."""
    if not set(_GRAVITY) <= set(frames.columns):
        return np.full((len(frames), 3), np.nan)
    down = frames[_GRAVITY].to_numpy(float, na_value=np.nan)
    length = np.linalg.norm(down, axis=1, keepdims=True)
    sound = np.isfinite(length) & (length > 0)
    return np.where(sound, down / np.where(sound, length, 1.0), np.nan)


_GRAVITY = [f"gravity_{a}" for a in "xyz"]


def _need(table: pd.DataFrame, columns: list[str], prefix: str, what: str) -> None:
    wanted = [*columns, *pose_columns(prefix)]
    missing = [c for c in wanted if c not in table.columns]
    if missing:
        raise UserError(f"{what} lack columns", expected=", ".join(wanted), found=f"no {', '.join(missing)}")
    if table.empty:
        raise UserError(f"{what} have no rows", expected="a row for each frame")
    unset = [c for c in columns if table[c].isna().any()]
    if unset:
        raise UserError(f"{what} have empty values", where=f"column {unset[0]}", expected="a value in each row")
    refuse_other_types(table, [*wanted, *_GRAVITY, "session_id", "t_ns", "quality"], what)


def _refuse_unknown_quality(truth: pd.DataFrame, what: str) -> None:
    stated = truth["quality"].dropna() if "quality" in truth.columns else pd.Series(dtype=object)
    unknown = stated[~stated.isin(_QUALITIES)]
    if len(unknown):
        raise UserError(
            f"{what}: an unknown quality class",
            where="column quality",
            expected=f"{', '.join(_QUALITIES)} (docs/explanation/ground-truth.md), or no such column",
            found=unknown.iloc[0],
        )


def _refuse_duplicates(table: pd.DataFrame, columns: list[str], what: str) -> None:
    twice = table[table.duplicated(columns)]
    if len(twice):
        found = ", ".join(f"{c} {twice.iloc[0][c]}" for c in columns) + ", ..."
        raise UserError(f"{what} have rows twice", expected=f"each {' and '.join(columns)} once", found=found)


def _refuse_disagreement(frames: pd.DataFrame, table: pd.DataFrame, what: str) -> None:
    """Rows of another session or time than the frame of their id has."""
    shared = [c for c in ("session_id", "t_ns") if c in table.columns]
    joined = frames[["frame_id", *shared]].merge(table[["frame_id", *shared]], on="frame_id", suffixes=("", "_other"))
    for column in shared:
        wrong = joined[joined[column] != joined[f"{column}_other"]]
        if len(wrong):
            frame_id, expected, found = wrong.iloc[0][["frame_id", column, f"{column}_other"]]
            fault = f"{what}: {len(wrong)} rows have another {column} than their frames"
            raise UserError(fault, where=f"frame {frame_id}", expected=expected, found=found)
