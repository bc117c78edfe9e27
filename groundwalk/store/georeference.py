"""Where on earth a map is: `georeference.json` of the align stage, for who asked for it, and no table."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.geometry.control import similarity_jacobian
from groundwalk.geometry.earth import Origin, geodetic_of
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store.files import read_json, write_json

FILE = "georeference.json"
_ALTITUDE = {True: "as stated: phones' is above sea level", False: "as the survey states it"}


@dataclass(frozen=True, kw_only=True)
class Georeference:
    """East, north, up (metres) at `origin` from the map, `enu_S_map`, by `source` (`gps`, or a survey's name); its
    covariance (7, 7): rotation about east, north, up, translation at `middle` (3,) of the map, log scale (that of the
    map, where it has one); NaN for an up that nothing tells. `used` of `stated` positions fit with `rms_m` and
    `worst_m`, horizontally for GPS. `gives_scale`: the map has none of its own. `remarks` say what was left out."""

    source: str
    origin: Origin
    enu_S_map: Sim3
    covariance: Array
    middle: Array
    stated: int
    used: int
    rms_m: float
    worst_m: float
    gives_scale: bool
    remarks: list[str] = field(default_factory=list)

    @property
    def has_altitude(self) -> bool:
        return bool(np.isfinite(self.covariance[5, 5]))

    @property
    def sd(self) -> dict[str, float]:
        """Standard errors: of the heading and of the vertical, and, at the middle of the positions, of the place."""
        sd = np.sqrt(np.diag(self.covariance))
        tilt, yaw = np.degrees(max(sd[:2])), np.degrees(sd[2])
        named = zip(("yaw_deg", "tilt_deg", "east_m", "north_m", "up_m"), (yaw, tilt, *sd[3:6]), strict=True)
        return {name: float(value) for name, value in named}

    def places(self, xyz: Array) -> tuple[Array, Array, Array]:
        """East, north, up (N, 3), their standard errors (N, 3), and latitude, longitude, altitude (N, 3) of points of
        the map; what isn't known of the altitude is NaN."""
        enu = self.enu_S_map.points(xyz)
        jacobian, _ = similarity_jacobian(self.enu_S_map, xyz, self.middle)
        variance = np.einsum("nai,ij,naj->na", jacobian, np.nan_to_num(self.covariance), jacobian)
        geodetic = geodetic_of(self.origin, enu)
        if not self.has_altitude:
            enu[:, 2], variance[:, 2], geodetic[:, 2] = np.nan, np.nan, np.nan
        return enu, np.sqrt(variance), geodetic

    def describe(self) -> str:
        """In words, without the place."""
        sd = self.sd
        altitude = f"± {sd['up_m']:.2g} m in height" if self.has_altitude else "height unknown"
        scale = f"; it gives the scale, {self.enu_S_map.scale:.6g} m per unit of the map" if self.gives_scale else ""
        left = f"; left out: {', '.join(self.remarks)}" if self.remarks else ""
        return (
            f"georeference by {self.source}: {self.used} of {self.stated} positions, {self.rms_m:.2g} m RMS, worst "
            f"{self.worst_m:.2g} m; ± {max(sd['east_m'], sd['north_m']):.2g} m, {altitude}, heading ± "
            f"{sd['yaw_deg']:.2g}°{scale}{left}"
        )

    def write(self, path: Path) -> None:
        """As JSON, with null for what isn't known."""
        latitude, longitude, altitude = self.origin
        content = {
            "source": self.source,
            "origin": {"latitude_deg": latitude, "longitude_deg": longitude, "altitude_m": altitude},
            "altitude": _ALTITUDE[self.source == "gps"] if self.has_altitude else "unknown",
            "enu_T_map": make_pose(self.enu_S_map.rotation, self.enu_S_map.translation).tolist(),
            "scale": self.enu_S_map.scale,
            "gives_scale": self.gives_scale,
            "sd": {name: _or_none(value) for name, value in self.sd.items()},
            "covariance": [[_or_none(value) for value in row] for row in self.covariance.tolist()],
            "middle": self.middle.tolist(),
            **{name: getattr(self, name) for name in ("stated", "used", "rms_m", "worst_m", "remarks")},
        }
        write_json(path, content)


def read_georeference(folder: Path) -> Georeference | None:
    """Of a finished align stage's folder; None where it has none."""
    content: dict[str, Any] = read_json(folder / FILE)
    if "enu_T_map" not in content:
        return None
    enu_T_map = np.array(content["enu_T_map"], float)
    return Georeference(
        source=content["source"],
        origin=tuple(content["origin"][name] for name in ("latitude_deg", "longitude_deg", "altitude_m")),
        enu_S_map=Sim3(content["scale"], enu_T_map[:3, :3], enu_T_map[:3, 3]),
        covariance=np.array(content["covariance"], float),
        middle=np.array(content["middle"], float),
        gives_scale=content["gives_scale"],
        **{name: content[name] for name in ("stated", "used", "rms_m", "worst_m", "remarks")},
    )


def _or_none(value: float) -> float | None:
    return value if np.isfinite(value) else None
