"""Surveyed points and where images show them, by their files and by tags that are detected."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.control.gcp_list import read_gcp_list
from groundwalk.alignment.rulers.detection import Grey, markers_in, rows_named, rows_read_off
from groundwalk.alignment.settings import ControlSettings
from groundwalk.geometry.cameras import CENTRE_OF_FIRST_PIXEL
from groundwalk.geometry.earth import Origin, enu_of
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel
from groundwalk.store.tables import refuse_unnamed_fields
from groundwalk.store.text import encoding_of

_LOCAL, _WGS84 = ["x_m", "y_m", "z_m"], ["latitude_deg", "longitude_deg", "altitude_m"]
_TAG_POINT = re.compile(r"(\d+)(?:\.([0-3]))?")


@dataclass(frozen=True)
class ControlPoints:
    """K surveyed points: names, coordinates (K, 3) and their standard errors (K,), metres; M observations of them, by
    row of the frames table, point, and pixel (M, 2). `remarks`: what is wrong with a point's observations, by
    its index. `origin`: where on earth (0, 0, 0) is, of coordinates that are true east, north, up; None of others."""

    settings: ControlSettings
    names: list[str]
    xyz_m: Array
    sd_m: Array
    row: NDArray[np.int64]
    point: NDArray[np.int64]
    xy_px: Array
    remarks: dict[int, str]
    origin: Origin | None = None


def find_points(
    settings: ControlSettings, frames: pd.DataFrame, folder: Path, image_path: Callable[[str], Path]
) -> ControlPoints:
    """The points of a survey in the images of import's table `frames`; its files lie in `folder`.

    Raises UserError for files that aren't such tables, a point listed twice, a pixel outside of its image, and names of
    frames or points that there aren't.
    """
    in_list = None
    if settings.in_one_file:
        survey, in_list = read_gcp_list(folder / settings.points)
    else:
        survey = _read(folder / settings.points, ["point"], _LOCAL, _WGS84)
    _refuse_repeated(survey, ["point"], folder / settings.points)
    sd_m = survey["sd_m"].fillna(settings.sd_m) if "sd_m" in survey else pd.Series(settings.sd_m, survey.index)
    if not (sd_m > 0).all():
        raise UserError("a surveyed point's sd_m isn't above 0", where=folder / settings.points, found=sd_m.min())
    xyz_m, origin = _coordinates(survey, settings, folder / settings.points)
    names = survey["point"].tolist()
    seen, remarks = list[tuple[int, int, float, float]](), dict[int, str]()
    if in_list is not None:
        seen += _of_list(in_list, names, frames, folder / settings.points, remarks)
    if settings.images:
        seen += _of_file(folder / settings.images, names, frames)
    if settings.dictionary is not None:
        points = (_TAG_POINT.fullmatch(name.replace(",", ".")) for name in names)
        wanted = {index: (int(m[1]), m[2]) for index, m in enumerate(points) if m}
        for tag in {tag for tag, corner in wanted.values() if corner not in (None, "0")}:
            if (tag, None) in wanted.values() and (tag, "0") not in wanted.values():
                raise UserError(
                    f"tag {tag} has its middle and corners, but no corner {tag}.0: did a spreadsheet make {tag} of it?",
                    where=folder / settings.points,
                    do="store the column of names as text; or leave the middle out",
                )
        paths = [image_path(image) for image in frames["image"]]
        found = list(_tags(settings.dictionary, paths))
        for index, (tag, corner) in wanted.items():
            at = [(row, xy[tag]) for row, xy in enumerate(found) if tag in xy]
            if twice := [row for row, xy in at if len(xy) > 1]:
                frame_id = frames["frame_id"].iloc[twice[0]]
                remarks[index] = (
                    f"tag {tag} is there twice in {len(twice)} images, such as {frame_id}: give one another id"
                )
            seen += [(row, index, *_tag_point(xy[0], corner)) for row, xy in at if len(xy) == 1]
    table = np.array(seen, dtype=float).reshape(-1, 4)
    row, point = table[:, :2].T.astype(np.int64)
    sd = np.asarray(sd_m, dtype=float)
    return ControlPoints(settings, names, xyz_m, sd, row, point, table[:, 2:], remarks, origin)


def _coordinates(survey: pd.DataFrame, settings: ControlSettings, path: Path) -> tuple[Array, Origin | None]:
    """Metres (K, 3), those of latitudes and longitudes about their middle, and where on earth (0, 0, 0) is."""
    if set(_LOCAL) <= set(survey):
        return survey[_LOCAL].to_numpy(float), settings.origin
    geodetic = survey[_WGS84].to_numpy(float)
    if (np.abs(geodetic[:, :2]) > [90, 180]).any() or settings.up != "z" or settings.origin is not None:
        raise UserError(
            "these aren't latitudes and longitudes of points on earth",
            where=path,
            expected='latitude_deg within 90, longitude_deg within 180; a [[control]] with up = "z", without origin',
            do="check the order of the columns, or give local coordinates x_m, y_m, z_m",
        )
    latitude, longitude, altitude = np.median(geodetic, axis=0).tolist()
    return enu_of((latitude, longitude, altitude), geodetic), (latitude, longitude, altitude)


def _of_file(path: Path, names: list[str], frames: pd.DataFrame) -> list[tuple[int, int, float, float]]:
    """Row of the frames table, point, and pixel of each line of a file."""
    table = _read(path, ["frame", "point"], ["x_px", "y_px"])
    _refuse_repeated(table, ["frame", "point"], path)
    point = pd.Index(names).get_indexer(pd.Index(table["point"]))
    if (point < 0).any():
        raise UserError(
            f"{(point < 0).sum()} lines are of points that aren't surveyed",
            where=path,
            found=table["point"].iloc[int(np.argmin(point))],
            expected=f"a surveyed point, such as {names[0]}",
            do="correct the names",
        )
    row, xy = rows_read_off(table, frames, path), table[["x_px", "y_px"]].to_numpy(float)
    return list(zip(row.tolist(), point.tolist(), *xy.T.tolist(), strict=True))


def _of_list(
    table: pd.DataFrame, names: list[str], frames: pd.DataFrame, path: Path, remarks: dict[int, str]
) -> list[tuple[int, int, float, float]]:
    """As `_of_file`, of a GCP list, which may name images that aren't used: `remarks` then say so by point."""
    there = rows_named(table["frame"], frames) >= 0
    point = pd.Index(names).get_indexer(pd.Index(table["point"]))
    for index, lost in table[~there].groupby(point[~there]):
        remarks[int(str(index))] = f"{len(lost)} of its images aren't among the frames, such as {lost['frame'].iloc[0]}"
    used = table[there] if there.any() else table
    row, xy = rows_read_off(used, frames, path), used[["x_px", "y_px"]].to_numpy(float)
    return list(zip(row.tolist(), point[there].tolist(), *xy.T.tolist(), strict=True))


def _tags(dictionary: str, paths: list[Path]) -> Iterator[dict[int, list[Array]]]:
    """Each image's tags: the corners (4, 2) of each one that has an id, by id."""

    def tags_in(path: Path) -> dict[int, list[Array]]:
        image: Grey = read_grey_image(path)
        by_id: dict[int, list[Array]] = {}
        for tag, xy in markers_in(dictionary, image):
            by_id.setdefault(tag, []).append(xy + CENTRE_OF_FIRST_PIXEL)
        return by_id

    return in_parallel(tags_in, paths)


def _tag_point(xy: Array, corner: str | None) -> tuple[float, float]:
    """A corner of a tag, or the middle, which is where its diagonals cross."""
    if corner:
        return float(xy[int(corner), 0]), float(xy[int(corner), 1])
    a, b = xy[2] - xy[0], xy[3] - xy[1]
    along, _ = np.linalg.solve(np.column_stack([a, -b]), xy[1] - xy[0])
    x, y = xy[0] + along * a
    return float(x), float(y)


def _read(path: Path, names: list[str], *choices: list[str]) -> pd.DataFrame:
    """A CSV file with names as text, and the first choice of finite numbers that it has; also as spreadsheets and total
    stations write it: with semicolons or tabs, decimal commas, in UTF-16."""
    expected = f"CSV with columns {' or '.join(', '.join([*names, *numbers]) for numbers in choices)}"
    try:
        content = path.read_bytes()
        text = content.decode(encoding_of(content)).lstrip("\r\n")
        between = max(",;\t", key=text.partition("\n")[0].count)
        decimal = "," if between != "," and re.search(r"\d,\d", text) else "."
        table = pd.read_csv(
            StringIO(text), sep=between, dtype=str, skipinitialspace=True, keep_default_na=False, skip_blank_lines=False
        ).fillna("")  # not before: a point may be called NA
        refuse_unnamed_fields(table, path)
    except (OSError, ValueError) as error:
        raise UserError("a file of control points can't be read", where=path, found=error, expected=expected) from None
    table = table[(table != "").any(axis=1)].copy()  # labels still count the file's lines
    numbers = next((numbers for numbers in choices if set(numbers) <= set(table)), choices[0])
    if missing := [name for name in [*names, *numbers] if name not in table]:
        found = ", ".join(map(str, table.columns))
        raise UserError(f"column {missing[0]} is missing", where=path, found=found, expected=expected)
    is_whole = (table[names] != "").all(axis=1)
    for name in [*numbers, *({"sd_m"} & set(table))]:
        may_be_missing = (name not in numbers) & table[name].isin(["", "NA"])
        table[name] = pd.to_numeric(table[name].str.replace(decimal, "."), errors="coerce")
        is_whole &= np.isfinite(table[name]) | may_be_missing
    if not is_whole.all():
        line = int(is_whole.index.to_numpy()[is_whole.argmin()]) + 2
        raise UserError("a line isn't names and finite numbers", where=f"{path}, line {line}", expected=expected)
    if table.empty:
        raise UserError("a file of control points has no lines", where=path, expected=expected)
    return table.reset_index(drop=True)


def _refuse_repeated(table: pd.DataFrame, columns: list[str], path: Path) -> None:
    repeated = table[table.duplicated(columns)]
    if len(repeated):
        found = " ".join(repeated.iloc[0][columns])
        raise UserError(
            f"{' and '.join(columns)} are listed twice", where=path, found=found, do="keep one of the lines"
        )
