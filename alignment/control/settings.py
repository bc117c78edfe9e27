"""Settings of control points: the `[[control]]` tables of a scene's file."""

from typing import Any, Literal

from pydantic import Field, model_validator

from groundwalk.alignment.rulers.settings import Dictionary, named
from groundwalk.store import Settings
from groundwalk.store.settings import validated


class ControlSettings(Settings):
    """Surveyed points, and where images show them: pixels in a file, tags that are detected, or both."""

    name: str = Field("control", description="name of the survey in tables and messages")
    points: str = Field(
        min_length=1,
        description="CSV file with columns point, x_m, y_m, z_m and, where they differ, sd_m; relative to the data "
        "folder",
    )
    images: str = Field(
        "", description="CSV file with columns frame, point, x_px, y_px; relative to the data folder; empty: tags alone"
    )
    dictionary: Dictionary | None = Field(
        None,
        description="OpenCV's name of a dictionary of tags: a point named 17 is the middle of tag 17, 17.0 to 17.3 are "
        "its corners, clockwise from its top left",
    )
    sd_m: float = Field(0.005, gt=0, description="standard error of a surveyed coordinate, metres")
    pixel_sd: float = Field(1.0, gt=0, description="standard error of a pixel coordinate of `images`, at least")
    up: Literal["z", "y", "unknown"] = Field(
        "z", description="the survey's axis that points up: z of east, north, up; unknown: of no use for the tilt"
    )
    origin: tuple[float, float, float] | None = Field(
        None,
        description="latitude, longitude (degrees) and altitude (metres) in WGS84 of (0, 0, 0), where the survey's "
        "axes are true east, north, up: places the map on earth; points in latitude_deg, longitude_deg and altitude_m "
        "need none",
    )
    max_error_m: float = Field(
        0.05, gt=0, description="the check fails where held-out points are further off, RMS, or one of them is, metres"
    )

    @model_validator(mode="after")
    def _consistent(self) -> "ControlSettings":
        if not self.images and self.dictionary is None:
            raise ValueError("nothing says where images show the points: name `images`, `dictionary` or both")
        if self.origin is not None and (abs(self.origin[0]) > 90 or abs(self.origin[1]) > 180 or self.up != "z"):
            raise ValueError('an origin is latitude, longitude and altitude of axes east, north, up (up = "z")')
        return self


def controls_of(tables: Any) -> list[ControlSettings]:
    """The `[[control]]` tables as settings; UserError says which one is wrong and how."""
    return named(tables, "surveys", "control", lambda table, where: validated(ControlSettings, table, where))
