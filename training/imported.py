"""Predictions of regressors that were trained elsewhere, out of files, as if they had been trained here."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.store import UserError
from groundwalk.store.files import sha256_of
from groundwalk.store.registry import AN_ID, is_id
from groundwalk.store.tables import covariance_numbers, pose_columns, read_parquet, refuse_other_types
from groundwalk.training.inputs import TrainRun

_POSE = pose_columns("map_cam")
_NEEDED = ["model", "frame_id", *_POSE]
_OPTIONAL = ["picked_scene", "covariance", "inference_ms"]
_MIN_QUATERNION, _MAX_QUATERNION = 0.2, 5.0  # what a network puts out may not be normalised; degrees are far from it


def read_imported(r: TrainRun, frames: pd.DataFrame) -> Iterator[tuple[str, pd.DataFrame, str]]:
    """Each imported regressor's name, its rows of train.predictions, and where they are from.

    Rows of frames that there aren't, and rows without a finite pose, are left out, counted and said. UserError for a
    file that isn't there or isn't such a table, values of another type, a frame listed twice, rotations that are no
    quaternions, and a name that is taken.
    """
    names: dict[str, str] = {}
    for file in r.settings.predictions:
        path = r.data.root / file
        table = _read(path)
        origin = f"predictions imported from {path.name}, sha256 {sha256_of(path)[:12]}"
        for model, rows in table.groupby("model", sort=False):
            name = str(model)
            if name in names or name in r.settings.models:
                other = f"another file, {names[name]}" if name in names else "the models that are trained here"
                raise UserError(f"two regressors are called {name!r}", where=path, found=f"one more in {other}")
            names[name] = file
            yield name, _of_frames(r, name, rows, frames, path), origin


def imported_card(r: TrainRun, name: str, rows: pd.DataFrame, origin: str) -> dict[str, Any]:
    """A row of train.models for imported predictions: what training alone knows is null."""
    unknown = ("parameters", "bytes", "train_frames", "val_frames", "epochs", "best_epoch", "train_seconds")
    view = ("resize_px", "crop_px", "width_px", "upright", "focal_px")
    return {
        "model": name,
        "label": name,
        "scenes": r.leaves,
        "file": "",
        "layers": "",
        "weights": origin,
        **dict.fromkeys((*unknown, *view)),
        "seed": r.seed,
        "config": "{}",
        "reduced": None,
        "device": "elsewhere",
        "inference_ms": None if rows["inference_ms"].isna().all() else float(rows["inference_ms"].median()),
    }


def _read(path: Path) -> pd.DataFrame:
    table = read_parquet(path)
    missing = [column for column in _NEEDED if column not in table.columns]
    if missing or table.empty:
        fault = f"no {', '.join(missing)}" if missing else "no rows"
        raise UserError("a file of predictions lacks something", where=path, expected=", ".join(_NEEDED), found=fault)
    refuse_other_types(table, ["frame_id", "scene", "picked_scene", *_POSE, "inference_ms"], "predictions", f"{path}, ")
    if "covariance" in table.columns:
        table["covariance"] = _covariances(table, path)
    wrong = [name for name in table["model"].unique() if not is_id(name)]
    if wrong:
        what = "predictions are of a regressor whose name can't be used"
        raise UserError(what, where=f"{path}, column model", expected=AN_ID, found=repr(wrong[0]))
    return table


def _covariances(table: pd.DataFrame, path: Path) -> "pd.Series[Any]":
    """The table's covariances as 36 numbers each, null where there is none."""
    stated = table["covariance"].dropna()
    numbers = stated.map(covariance_numbers)
    if numbers.isna().any():
        row = int(np.flatnonzero(numbers.isna())[0])
        found, frame_id = stated.iloc[row], table.loc[stated.index, "frame_id"].iloc[row]
        raise UserError(
            "a covariance of predictions isn't 36 numbers",
            where=f"{path}, column covariance, frame {frame_id}",
            expected="a list of 36 numbers, 6x6 row by row, or six lists of six",
            found=f"{type(found).__name__} {found!s:.60}",
        )
    return numbers.reindex(table.index)


def _of_frames(r: TrainRun, name: str, rows: pd.DataFrame, frames: pd.DataFrame, path: Path) -> pd.DataFrame:
    """The rows as train.predictions has them, in the order of `frames`, whose ids may repeat in a group's scenes."""
    keys = ["scene", "frame_id"] if "scene" in rows.columns else ["frame_id"]
    if "scene" not in rows.columns and len(r.leaves) > 1:
        raise UserError("predictions for a group of scenes lack a column", where=path, expected="scene", found="none")
    twice = rows[rows.duplicated(keys)]
    if len(twice):
        raise UserError(f"predictions of {name} have a frame twice", where=path, found=twice.iloc[0]["frame_id"])
    rows = rows.assign(**{column: rows.get(column) for column in _OPTIONAL})
    stated = rows[[*keys, *_POSE, *_OPTIONAL]]
    usable = frames[["scene", "frame_id", "session_id", "split", "t_ns"]].merge(stated, on=keys)
    finite = np.isfinite(usable[_POSE].to_numpy(float, na_value=np.nan)).all(axis=1)
    for what, count, meaning in (
        ("unknown", len(rows) - len(usable), "are of frames that this scene doesn't have"),
        ("not_finite", int((~finite).sum()), "have no finite pose"),
    ):
        r.figure(f"{name} predictions left out: {what}", count)
        if count:
            r.say(f"warning: {name}: {count} predictions {meaning}")
    usable = usable[finite].reset_index(drop=True)
    if usable.empty:
        expected, found = f"frame_id as {frames['frame_id'].iloc[0]}", f"{rows['frame_id'].iloc[0]}, {len(rows)} rows"
        raise UserError(
            f"no prediction of {name} is of a frame of this scene", where=path, expected=expected, found=found
        )
    length = np.linalg.norm(usable[_POSE[3:]].to_numpy(float), axis=1)
    wrong = (length < _MIN_QUATERNION) | (length > _MAX_QUATERNION)
    if wrong.any():
        raise UserError(
            f"rotations of {name} are no quaternions",
            where=f"{path}, columns map_cam_qx, _qy, _qz, _qw",
            expected="unit quaternions, length 1",
            found=f"{int(wrong.sum())} of {len(wrong)} have lengths up to {length.max():.3g}",
            do="convert Euler angles or other rotations to unit quaternions",
        )
    usable[_POSE[3:]] = usable[_POSE[3:]].to_numpy(float) / length[:, None]
    usable["picked_scene"] = usable["picked_scene"].fillna(usable["scene"])
    return usable.assign(model=name)
