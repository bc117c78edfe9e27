"""Parquet tables that are checked against their schema on the way out and on the way in, and users' CSVs."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pandas.api.types import is_float_dtype, is_integer_dtype, is_string_dtype

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.fits import sim3_between
from groundwalk.geometry.poses import Array, pose_from_tq, tq_from_pose
from groundwalk.store.choices import Clock, MapUnit, ScaleSource, VerticalSource
from groundwalk.store.errors import UserError
from groundwalk.store.files import leads_outside, written_aside
from groundwalk.store.schemas import TableSchema, schema

CAMERA_COLUMNS = ["fx", "fy", "cx", "cy", "distortion"]
GUESS_SD = 0.5
"""Of a guessed focal length, as a fraction: phones' are 0.7 to 0.9 of the longer side, other cameras' 1 to 3."""
_QUATERNION_TOLERANCE = 1e-6
_TEXT = ["frame_id", "session_id", "split", "model", "quality", "scene", "picked_scene"]
_MANY_GAPS = 0.5  # of frames; recordings at the right rate have fewer, even poor ones


def write_table(path: Path, frame: pd.DataFrame, schema: TableSchema) -> None:
    """Write `frame` as Parquet with the schema's metadata, atomically.

    Columns come out in the schema's order. A programming error here is a ValueError: a column missing, unknown,
    of another type, null where it may not be, a text that isn't one of the column's choices, or a quaternion that isn't
    unit.
    """
    name = f"{schema.stage}.{schema.name}"
    missing = [c for c in schema.column_names if c not in frame.columns]
    unknown = [c for c in frame.columns if c not in schema.column_names]
    if missing or unknown:
        raise ValueError(f"{name}: missing columns {missing}, unknown columns {unknown}")
    try:
        table = pa.Table.from_pandas(frame[schema.column_names], schema.arrow(), preserve_index=False)
    except (pa.ArrowInvalid, pa.ArrowTypeError) as error:
        raise ValueError(f"{name}: {error}") from error
    for column in schema.columns:
        if not column.nullable and table[column.name].null_count:
            raise ValueError(f"{name}.{column.name}: {table[column.name].null_count} nulls, none allowed")
        if column.choices is not None:
            unknown = sorted(set(table[column.name].unique().to_pylist()) - {*column.choices, None})
            if unknown:
                raise ValueError(f"{name}.{column.name}: {', '.join(unknown)}; it can be {', '.join(column.choices)}")
    for prefix in pose_prefixes(schema):
        q = frame[[f"{prefix}_q{a}" for a in "xyzw"]].to_numpy(float)
        norm = np.linalg.norm(q[~np.isnan(q).any(axis=1)], axis=1)
        if norm.size and np.abs(norm - 1).max() > _QUATERNION_TOLERANCE:
            raise ValueError(f"{name}.{prefix}_q*: quaternion lengths {norm.min():.6f}..{norm.max():.6f}, not 1")
    with written_aside(path) as partial:
        pq.write_table(table, partial)


def read_table(path: Path, schema: TableSchema) -> pd.DataFrame:
    """Read a table; UserError where the file is missing, unreadable, another table, or of another major version.

    A column that may be null, and that the file doesn't have, is null throughout.
    """
    name = f"{schema.stage}.{schema.name}"
    if not path.is_file():
        raise UserError(f"table {name} isn't there", where=path, do=f"run the {schema.stage} stage first")
    try:
        table = pq.read_table(path)
    except (pa.ArrowInvalid, OSError) as error:
        raise UserError(f"table {name} can't be read", where=path, found=error, expected="a Parquet file") from error
    metadata = {k.decode(): v.decode() for k, v in (table.schema.metadata or {}).items()}
    version = metadata.get("groundwalk.version", "none")
    written = metadata.get("groundwalk.table", "none")
    if written != name:
        raise UserError("a file holds another table", where=path, expected=name, found=written)
    if version.split(".")[0] != schema.version.split(".")[0]:
        raise UserError(
            f"table {name} has another version of its schema",
            where=path,
            expected=f"{schema.version.split('.')[0]}.x",
            found=version,
            do=f"run the {schema.stage} stage again",
        )
    missing = [c.name for c in schema.columns if not c.nullable and c.name not in table.column_names]
    if missing:
        do = f"run the {schema.stage} stage again"
        raise UserError(f"table {name} lacks columns", where=path, found=f"no {', '.join(missing)}", do=do)
    _refuse_paths_outside(table, schema, path)
    present = [c for c in schema.column_names if c in table.column_names]
    frame: pd.DataFrame = table.select(present).to_pandas().reindex(columns=schema.column_names)
    return frame


def table_of(run: Path, stage: str, table: str) -> pd.DataFrame:
    """A table of a stage of the run data/runs/<profile>/<scene>; UserError as of `read_table`."""
    return read_table(run / stage / f"{table}.parquet", schema(stage, table))


def read_parquet(path: Path) -> pd.DataFrame:
    """A Parquet table that another program may have written: pandas' index is columns, dictionaries of texts are texts.
    UserError where there is none, or a column is there twice."""
    if not path.is_file():
        actual = "a folder" if path.is_dir() else None
        raise UserError("there is no such table", where=path, expected="a Parquet file", found=actual)
    try:
        frame: pd.DataFrame = pq.read_table(path).to_pandas(ignore_metadata=True)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise UserError("a table can't be read", where=path, found=error, expected="a Parquet file") from None
    if len(twice := frame.columns[frame.columns.duplicated()]):
        raise UserError("a table has a column twice", where=path, found=twice[0])
    return frame.astype(dict.fromkeys(frame.select_dtypes("category").columns, object))


def refuse_other_types(table: pd.DataFrame, columns: Iterable[str], what: str, where: str = "") -> None:
    """UserError where one of the columns, of those that the table has, isn't what its name says: text, whole
    nanoseconds, or numbers. An empty column has no type."""
    for name in table.columns.intersection(list(columns)):
        column = table[name].dropna()
        if name in _TEXT:
            is_sound, kind = is_string_dtype(column), "text"
        elif name == "t_ns":
            is_sound, kind = is_integer_dtype(column), "whole numbers of nanoseconds (int64)"
        else:
            is_sound, kind = is_float_dtype(column) or is_integer_dtype(column), "numbers"
        if len(column) and not is_sound:
            raise UserError(
                f"{what}: a column has another type, no {kind}",
                where=f"{where}column {name}",
                expected=kind,
                found=column.dtype,
            )


def _refuse_paths_outside(table: pa.Table, schema: TableSchema, where: Path) -> None:
    """UserError where text that is a path, or becomes part of one, leads out of the folder that it's relative to."""
    for column in schema.columns:
        if column.is_path and column.name in table.column_names:
            for name in table[column.name].unique().to_pylist():
                if isinstance(name, str) and leads_outside(name):
                    raise UserError(
                        f"{column.name} of table {schema.stage}.{schema.name} leads out of its folder",
                        where=where,
                        found=repr(name),
                        do="groundwalk writes no such table: make it anew from the captures",
                    )


def dataset_frames(frames: pd.DataFrame) -> pd.DataFrame:
    """The rows of import.frames that are frames of the dataset, numbered from 0: without support frames, which only SfM
    and the checks of its model use."""
    return frames[~frames["support"].to_numpy(bool)].reset_index(drop=True)


def have_times(table: pd.DataFrame) -> NDArray[np.bool_]:
    """Which rows (N,) of import.frames or import.sessions are of recordings with times (`Clock.has_times`)."""
    return np.array([Clock(clock).has_times for clock in table["clock"]], dtype=bool)


def pose_prefixes(schema: TableSchema) -> list[str]:
    """The prefixes of a schema's pose groups: ``map_cam`` where it has map_cam_qw."""
    return [c.removesuffix("_qw") for c in schema.column_names if c.endswith("_qw")]


def with_cameras(frames: pd.DataFrame, images: pd.DataFrame) -> pd.DataFrame:
    """import.frames with the cameras that go with the poses of SfM and of the ground truth: those of sfm.images, which
    align.ground_truth has, too."""
    cameras = images.set_index("frame_id").loc[frames["frame_id"], CAMERA_COLUMNS]
    return frames.assign(**{name: cameras[name].to_numpy() for name in CAMERA_COLUMNS})


def camera_of(frame: Any) -> Camera:
    """The camera of a row of import.frames."""
    fx, fy, cx, cy = (float(value) for value in (frame.fx, frame.fy, frame.cx, frame.cy))
    distortion = tuple(map(float, frame.distortion))[:8]
    return Camera(int(frame.width), int(frame.height), fx, fy, cx, cy, distortion, frame.first_row)


def pose_columns(prefix: str) -> list[str]:
    """The columns of the pose group `prefix`."""
    return [f"{prefix}_{part}" for part in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]


def poses_of(frame: pd.DataFrame, prefix: str) -> Array:
    """The pose group `prefix` of a table as (N, 4, 4); rows with a null are all NaN."""
    values = frame[pose_columns(prefix)].to_numpy(float, na_value=np.nan)
    poses = np.full((len(frame), 4, 4), np.nan)
    has_pose = ~np.isnan(values).any(axis=1)
    if has_pose.any():
        poses[has_pose] = pose_from_tq(values[has_pose, :3], values[has_pose, 3:])
    return poses


def pose_frame(prefix: str, poses: Array) -> pd.DataFrame:
    """Poses (N, 4, 4) as the seven columns of the pose group `prefix`; a NaN pose gives nulls."""
    poses = np.asarray(poses, dtype=float).reshape(-1, 4, 4)
    has_pose = np.isfinite(poses).all(axis=(1, 2))
    values = np.full((len(poses), 7), np.nan)
    if has_pose.any():
        t, q = tq_from_pose(poses[has_pose])
        values[has_pose] = np.hstack([t, q])
    return pd.DataFrame(values, columns=pose_columns(prefix))


def covariance_numbers(cell: object) -> Array | None:
    """The numbers (36,) of a cell of a column of covariances, a list of them or of the matrix's six rows; None where it
    holds anything else."""
    if not isinstance(cell, list | np.ndarray):
        return None
    try:
        numbers = np.array(list(cell), dtype=float).ravel()
    except (TypeError, ValueError):
        return None
    return numbers if numbers.size == 36 else None


def map_unit(truth: pd.DataFrame) -> MapUnit:
    """The unit of the map, by the frames of its ground truth; metres where a table from elsewhere doesn't say."""
    sources = set(truth["scale_source"]) if "scale_source" in truth else set()
    if ScaleSource.NONE in sources:
        return MapUnit.SFM
    return MapUnit.REFERENCE if ScaleSource.REFERENCE_UNIT_UNKNOWN in sources else MapUnit.METRE


def has_vertical(truth: pd.DataFrame) -> bool:
    """Whether the +y of the map of align's ground truth is up; it is where a table from elsewhere doesn't say."""
    sources = set(truth["vertical_source"].dropna()) if "vertical_source" in truth else set()
    return all(VerticalSource(source).is_known for source in sources)


def with_gravity_of_map(frames: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """import.frames as later stages may use them: without gravity where the map of align's ground truth has no
    vertical, as what is down for a camera says nothing of such a map's axes."""
    return frames if has_vertical(truth) else frames.assign(gravity_x=np.nan, gravity_y=np.nan, gravity_z=np.nan)


def scale_warning(unit: MapUnit) -> str:
    """What stands by the positions of a map without metric scale; empty for a metric one."""
    return "" if unit is MapUnit.METRE else f"NO METRIC SCALE: positions are in {unit}, not in metres"


def gap_warning(reasons: pd.Series) -> str:
    """What stands by the results of a fusion method that checks each prediction by the one before, where it rarely can;
    empty elsewhere. reasons: those of its rows of fuse.poses."""
    apart = reasons.str.split(",").map(lambda codes: "gap" in codes).mean()
    if not apart > _MANY_GAPS:
        return ""
    return (
        f"{apart:.0%} of its frames aren't checked, as the time since the prediction before isn't interval_s within "
        "interval_tolerance_s: set these options to the predictions' rate"
    )


def points_in_map(points: pd.DataFrame, images: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """sfm.points with x, y, z in the map, of the models that align's ground truth has frames of."""
    images = images.merge(truth, on="frame_id", suffixes=("_sfm", ""), validate="1:1")
    images = images[images["map_cam_tx"].notna() & images["sfm_cam_tx"].notna()]
    placed = []
    for model_id, its_images in images.groupby("model_id"):
        map_S_sfm = sim3_between(poses_of(its_images, "map_cam"), poses_of(its_images, "sfm_cam"))
        its_points = points[points["model_id"] == model_id].copy()
        its_points[["x", "y", "z"]] = map_S_sfm.points(its_points[["x", "y", "z"]].to_numpy(float))
        placed.append(its_points)
    return pd.concat(placed or [points[:0]], ignore_index=True)


def refuse_unnamed_fields(table: pd.DataFrame, path: Path) -> None:
    """UserError where lines of a CSV have more fields than its first line has names: pandas takes the first ones for
    labels of rows, and each other one for that of the column before."""
    if not isinstance(table.index, pd.RangeIndex):
        raise UserError(
            "lines have more fields than the first line has names",
            where=path,
            found=f"names {', '.join(map(str, table.columns))}",
            do="name the last column, or take separators from the ends of lines",
        )
