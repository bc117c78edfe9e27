"""Tables keep their schema's promises on the way out and in."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from groundwalk.store.schemas import Column, TableSchema, all_tables, tables
from groundwalk.store.tables import pose_frame, poses_of, read_table, write_table
from tests.known import cells

(SCHEMA,) = tables(
    "sfm",
    """
example 2.1: An example.
    frame_id (string): key
    t_ns (int64, ns): time
    map_cam (pose?): map_T_cam
    covariance (list<float64>?): 6x6
    split (Split?): what it is for
""",
)


def example() -> pd.DataFrame:
    poses = np.stack([make_pose(np.eye(3), [1, 2, 3]), np.full((4, 4), np.nan)])
    frame = pd.DataFrame({"frame_id": ["a/000001", "a/000002"], "t_ns": [1, 2]}).join(pose_frame("map_cam", poses))
    return frame.assign(covariance=cells([np.arange(36.0), None]), split=cells(["train", None]))


def test_table_round_trip(tmp_path: Path) -> None:
    write_table(tmp_path / "t.parquet", example(), SCHEMA)
    back = read_table(tmp_path / "t.parquet", SCHEMA)
    assert list(back.columns) == SCHEMA.column_names
    poses = poses_of(back, "map_cam")
    assert np.array_equal(poses[0, :3, 3], [1, 2, 3])
    assert np.isnan(poses[1]).all()
    assert np.array_equal(back.covariance[0], np.arange(36))
    assert back.covariance[1] is None
    field = pq.read_schema(tmp_path / "t.parquet").field("t_ns")
    assert field.metadata == {b"unit": b"ns", b"meaning": b"time"}
    assert [p.name for p in tmp_path.iterdir()] == ["t.parquet"]


def test_tables_of_the_same_major_version_are_read(tmp_path: Path) -> None:
    """An older one may lack columns that can be null; a newer one has more."""
    write_table(tmp_path / "t.parquet", example(), SCHEMA)
    newer = replace(SCHEMA, version="2.2", columns=[*SCHEMA.columns, Column("new", "float64", "new", nullable=True)])
    back = read_table(tmp_path / "t.parquet", newer)
    assert list(back.columns) == newer.column_names and back["new"].isna().all()
    required = replace(newer, columns=[*SCHEMA.columns, Column("new", "float64", "new")])
    with pytest.raises(UserError, match=r"(?s)lacks columns.*new"):
        read_table(tmp_path / "t.parquet", required)
    write_table(tmp_path / "t.parquet", example().assign(new=1.0), newer)
    assert list(read_table(tmp_path / "t.parquet", SCHEMA).columns) == SCHEMA.column_names


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: f.drop(columns="t_ns"), "missing columns"),
        (lambda f: f.assign(extra=1), "unknown columns"),
        (lambda f: f.assign(t_ns=[1.5, 2]), "t_ns"),
        (lambda f: f.assign(frame_id=["a", None]), "frame_id"),
        (lambda f: f.assign(map_cam_qw=[2.0, np.nan]), "quaternion"),
        (lambda f: f.assign(split=["train", "Train"]), r"sfm\.example\.split: Train; it can be train, val, test"),
    ],
)
def test_a_table_that_breaks_its_schema_is_not_written(
    tmp_path: Path, change: Callable[[pd.DataFrame], pd.DataFrame], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        write_table(tmp_path / "t.parquet", change(example()), SCHEMA)
    assert not list(tmp_path.iterdir())


def test_reader_refuses_another_major_version_and_what_is_no_table(tmp_path: Path) -> None:
    path = tmp_path / "t.parquet"
    with pytest.raises(UserError, match="isn't there"):
        read_table(path, SCHEMA)
    write_table(path, example(), SCHEMA)
    newer = TableSchema("sfm", "example", "", SCHEMA.columns, version="3.0")
    with pytest.raises(UserError, match=r"expected: +3.x"):
        read_table(path, newer)
    path.write_bytes(b"not parquet")
    with pytest.raises(UserError, match="can't be read"):
        read_table(path, SCHEMA)


@pytest.mark.parametrize("of", all_tables(), ids=lambda of: f"{of.stage}.{of.name}")
def test_a_path_that_leads_out_of_its_folder_is_refused(of: TableSchema, tmp_path: Path) -> None:
    """In every column whose text is a path or becomes part of one, as a frame's id does of an export's."""
    values: dict[str, Any] = {"float64": 1.0, "int64": 1, "bool": True, "string": "a", "list<float64>": [1.0]}
    row = {c.name: values.get(c.dtype, ["a"]) for c in of.columns}
    path = tmp_path / "table.parquet"
    columns = [c for c in of.columns if c.is_path and c.dtype == "string"]
    for column in columns:
        for outside in ("../up", "a/../../up", "/etc/passwd", "import:../up", "import:/etc/passwd", "..", "a\0"):
            pq.write_table(pa.Table.from_pylist([row, {**row, column.name: outside}], of.arrow()), path)
            with pytest.raises(UserError, match=f"^{column.name} of table .* leads out of its folder"):
                read_table(path, of)
    pq.write_table(pa.Table.from_pylist([row], of.arrow()), path)
    assert len(read_table(path, of)) == 1
