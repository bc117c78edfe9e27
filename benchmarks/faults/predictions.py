"""Predictions of other regressors that are wrong in type, unit, order, scene or content."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.random import Generator

from benchmarks.faults.case import DONE, REFUSED, Case
from benchmarks.faults.sandbox import PROFILE, SCENE, Sandbox

Change = Callable[[pd.DataFrame], pd.DataFrame]
_T = [f"map_cam_t{a}" for a in "xyz"]
_Q = [f"map_cam_q{a}" for a in "xyzw"]
_POSE = [*_T, *_Q]


def _set(columns: list[str], value: Any) -> Change:
    return lambda t: t.assign(**dict.fromkeys(columns, value))


def _each(t: pd.DataFrame, value: list[float]) -> "pd.Series[Any]":
    """A column with a list in every row."""
    return pd.Series([value] * len(t), index=t.index)


def _some(columns: list[str], value: float) -> Change:
    def change(t: pd.DataFrame) -> pd.DataFrame:
        t = t.copy()
        t.loc[t.index[::7], columns] = value
        return t

    return change


def _order(order: str) -> Change:
    return lambda t: t.assign(**{new: t[f"map_cam_q{a}"] for new, a in zip(_Q, order, strict=True)})


# The change, and whether it must be refused; otherwise the first lines have to name it, or it does no harm.
REFUSE, SAY = (REFUSED,), (DONE, REFUSED)
CHANGES: dict[str, tuple[Change, tuple[int, ...]]] = {
    "no rows": (lambda t: t[:0], REFUSE),
    "one row": (lambda t: t[:1], SAY),
    "all NaN": (_set(_POSE, np.nan), REFUSE),
    "some NaN": (_some(_POSE, np.nan), SAY),
    "NaN positions": (_set(_T, np.nan), REFUSE),
    "infinite": (_set(_T, np.inf), REFUSE),
    "some infinite": (_some(_T, np.inf), SAY),
    "huge": (_set(_T, 1e300), SAY),
    "tiny": (_set(_T, 1e-320), SAY),
    "zero quaternions": (_set(_Q, 0.0), REFUSE),
    "some zero quaternions": (_some(_Q, 0.0), SAY),
    "Euler degrees": (lambda t: t.assign(**dict(zip(_Q, (10.0, 170.0, -20.0, 0.0), strict=True))), REFUSE),
    "quaternions doubled": (lambda t: t.assign(**{q: 2 * t[q] for q in _Q}), SAY),
    "quaternions wxyz": (_order("wxyz"), SAY),
    "quaternions negative": (lambda t: t.assign(**{q: -t[q] for q in _Q}), (DONE,)),
    "text positions": (_set(_T, "1.0"), REFUSE),
    "integer positions": (_set(_T, 1), SAY),
    "boolean positions": (_set(_T, True), REFUSE),
    "null positions": (_set(_T, None), REFUSE),
    "list positions": (lambda t: t.assign(map_cam_tx=_each(t, [1.0])), REFUSE),
    "centimetres": (lambda t: t.assign(**{n: 100 * t[n] for n in _T}), SAY),
    "another scene": (lambda t: t.assign(map_cam_tx=t["map_cam_tx"] + 5000), SAY),
    "another scene's frames": (lambda t: t.assign(frame_id="other/" + t["frame_id"]), REFUSE),
    "rows twice": (lambda t: pd.concat([t, t]), REFUSE),
    "shuffled": (lambda t: t.sample(frac=1, random_state=0), (DONE,)),
    "frame_id missing": (lambda t: t.drop(columns="frame_id"), REFUSE),
    "a pose column missing": (lambda t: t.drop(columns="map_cam_qw"), REFUSE),
    "model missing": (lambda t: t.drop(columns="model"), SAY),
    "model null": (_set(["model"], None), REFUSE),
    "model empty": (_set(["model"], ""), REFUSE),
    "model a path": (_set(["model"], "../../outside/x"), SAY),
    "model markup": (_set(["model"], "<script>alert(1)</script>"), SAY),
    "model escape codes": (_set(["model"], "\x1b[2J"), SAY),
    "model long": (_set(["model"], "x" * 5000), SAY),
    "model a million": (lambda t: t.assign(model=[f"m{i}" for i in range(len(t))]), SAY),
    "frame_id numbers": (lambda t: t.assign(frame_id=range(len(t))), REFUSE),
    "frame_id null": (_set(["frame_id"], None), REFUSE),
    "extra columns": (lambda t: t.join(pd.DataFrame(0.0, t.index, [f"c{i}" for i in range(300)])), SAY),
    "times unlike the frames'": (lambda t: t.assign(t_ns=t["t_ns"] + 10**9), SAY),
    "covariance of 5 numbers": (lambda t: t.assign(covariance=_each(t, [0.0] * 5)), SAY),
    "covariance negative": (lambda t: t.assign(covariance=_each(t, (-np.eye(6)).ravel().tolist())), SAY),
    "covariance NaN": (lambda t: t.assign(covariance=_each(t, [np.nan] * 36)), SAY),
}
TABLES = ("frames", "ground_truth", "predictions")


def _tables(folder: Path) -> None:
    sandbox = Sandbox(folder)
    sources = {"frames": "import", "ground_truth": "align", "predictions": "train"}
    for name, stage in sources.items():
        table = pq.read_table(sandbox.run_of(stage) / f"{name}.parquet")
        pq.write_table(table.replace_schema_metadata(None), folder / "data" / f"{name}.parquet")


def _changed(folder: Path, _: Generator, name: str) -> str:
    _tables(folder)
    path = folder / "data" / "predictions.parquet"
    frame = CHANGES[name][0](pd.read_parquet(path))
    pq.write_table(pa.Table.from_pandas(frame, preserve_index=False), path)
    return name


def _other_file(folder: Path, rng: Generator, table: str, how: str) -> str:
    _tables(folder)
    path = folder / "data" / f"{table}.parquet"
    content = path.read_bytes()
    path.unlink()
    if how == "folder":
        path.mkdir()
    elif how == "link":
        path.symlink_to("/dev/zero")
    elif how != "gone":
        texts = {"text": b"frame_id,session_id\n", "empty": b"", "cut": content[: len(content) // 2]}
        texts["noise"] = content[:4] + rng.bytes(len(content) - 8) + content[-4:]
        path.write_bytes(texts[how])
    return f"{table} {how}"


def cases() -> Iterator[Case]:
    """Every change of the predictions, and each table as a file that is none."""
    evaluate = ("evaluate", *(f for n in TABLES for f in (f"--{n.replace('_', '-')}", f"data/{n}.parquet")))
    evaluate += ("--out", "data/evaluated", "--scene", f"{SCENE}-{PROFILE}")
    for name, (_, codes) in CHANGES.items():
        yield Case("predictions", name, partial(_changed, name=name), evaluate, codes, "data/evaluated")
    for table in TABLES:
        for how in ("text", "empty", "cut", "noise", "folder", "link", "gone"):
            spoil = partial(_other_file, table=table, how=how)
            yield Case("predictions", f"{table} {how}", spoil, evaluate, REFUSE, "data/evaluated")
