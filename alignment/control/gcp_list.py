"""The GCP list of OpenDroneMap: surveyed points and where images show them, in one file.

Its first line says what coordinates these are, each further one `x y z x_px y_px image [name]`, with tabs or spaces
between; a point without a name is told by its coordinates. The middle of the top-left pixel is (0, 0).
https://docs.opendronemap.org/gcp/
"""

import re
from pathlib import Path

import numpy as np
import pandas as pd

from groundwalk.geometry.earth import geodetic_of_utm
from groundwalk.store import UserError
from groundwalk.store.text import encoding_of

_UTM = re.compile(
    r"EPSG:32(?P<code>[67])(?P<a>\d\d)|WGS ?84 */? *UTM *(?:zone)? *(?P<b>\d{1,2}) *(?P<side>[NS])|"
    r"(?=.*\+proj=utm)(?=.*\+zone=(?P<c>\d{1,2}))(?=.*(?:WGS84|GRS80))(?!.*units=(?!m\b))(?P<south>.*\+south)?.*",
    re.IGNORECASE,
)
_DEGREES = re.compile(r"EPSG:4326|WGS ?84|\+proj=(longlat|latlong)\b.*", re.IGNORECASE)
_EXPECTED = "a first line such as EPSG:4326, EPSG:32633 or WGS84 UTM 33N, then lines x y z x_px y_px image [name]"


def read_gcp_list(path: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The points, as a table of surveyed points has them, and what images show of them: `frame` (the image's file),
    `point`, `x_px`, `y_px`, the middle of the top-left pixel being (0.5, 0.5). UserError where a line isn't of it."""
    try:
        content = path.read_bytes()
        lines = content.decode(encoding_of(content)).splitlines()
    except (OSError, ValueError) as error:
        raise UserError("a GCP list can't be read", where=path, found=error, expected=_EXPECTED) from None
    numbered = [(n, line.strip()) for n, line in enumerate(lines, 1) if line.strip() and line.strip()[0] != "#"]
    rows, named = list[tuple[object, ...]](), dict[str, tuple[float, ...]]()
    for number, line in numbered[1:]:
        fields = [field.strip() for field in line.split("\t")] if "\t" in line else line.split()
        try:
            xyz, xy = tuple(map(float, fields[:3])), [float(field) + 0.5 for field in fields[3:5]]
            image, name = fields[5], " ".join(fields[6:7]) or "{:.10g} {:.10g} {:.10g}".format(*xyz)
            is_point = bool(np.isfinite([*xyz, *xy]).all())
        except (ValueError, IndexError):
            is_point = False
        if not is_point or named.setdefault(name, xyz) != xyz:
            what = "gives a point other coordinates than a line above" if is_point else "isn't a point with its height"
            raise UserError(f"a line {what}", where=f"{path}, line {number}", found=line, expected=_EXPECTED)
        rows.append((image, name, *xy))
    if not rows:
        raise UserError("a GCP list has no points", where=path, expected=_EXPECTED)
    survey = _placed(np.array(list(named.values())), numbered[0][1], path).assign(point=list(named))
    return survey, pd.DataFrame(rows, columns=["frame", "point", "x_px", "y_px"])


def _placed(xyz: np.ndarray, header: str, path: Path) -> pd.DataFrame:
    geodetic = xyz[:, [1, 0, 2]]
    if utm := _UTM.fullmatch(header):
        zone, south = (
            int(utm["a"] or utm["b"] or utm["c"]),
            "7" in (utm["code"] or "") or utm["south"] or utm["side"] in ("s", "S"),
        )
        geodetic[:, :2] = geodetic_of_utm(xyz[:, :2], zone, south=bool(south))
    elif header.lower() in ("metres", "meters"):
        return pd.DataFrame(xyz, columns=["x_m", "y_m", "z_m"])
    elif not _DEGREES.fullmatch(header):
        raise UserError(
            "a GCP list has coordinates that aren't known here",
            where=f"{path}, line 1",
            found=header,
            expected="EPSG:4326 (longitude, latitude), or WGS84 in a zone of UTM, such as EPSG:32633 or WGS84 UTM 33N",
            do="where they are metres, x to the east, y to the north, write metres into line 1; else convert them",
        )
    return pd.DataFrame(geodetic, columns=["latitude_deg", "longitude_deg", "altitude_m"])
