"""Settings of the simulator, section [simulate]."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator
from pydantic_core import PydanticCustomError

from groundwalk.store import Settings
from groundwalk.store.choices import Appearance

Drawn = Literal["drawn"]
# "drawn": lens, readout time and focus as measured on phones, another one for each scene and seed.
_PHONE: float | Drawn = "drawn"


def _between(low: float, high: float) -> BeforeValidator:
    def check(value: Any) -> Any:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if value == "drawn" or (is_number and low <= value <= high):
            return value
        raise PydanticCustomError("number_or_drawn", f'should be a number from {low} to {high}, or "drawn"')

    return BeforeValidator(check)


class SimulateSettings(Settings):
    """How much is simulated and how finely."""

    width: int = Field(640, ge=64, description="image width, pixels")
    height: int = Field(480, ge=48, description="image height, pixels")
    rate_hz: float = Field(10.0, gt=0, le=60, description="poses a second")
    image_hz: float = Field(1.0, gt=0, description="images a second; every k-th pose has one")
    train_frames: int = Field(1500, gt=0, description="training images, before frame_fraction")
    test_frames: int = Field(600, gt=0, description="test images, before frame_fraction")
    frame_fraction: float = Field(
        0.18, gt=0, le=1, description="fraction of train_frames and test_frames that is simulated"
    )
    train_sessions: int = Field(
        3, ge=1, description="training walks; more where one would be longer than max_session_s"
    )
    test_sessions: int = Field(2, ge=1, description="test walks; more where one would be longer than max_session_s")
    max_session_s: float = Field(400.0, gt=0, description="longer walks are split into more sessions")
    texel_m: float = Field(0.012, gt=0, description="texel of near surfaces, metres")
    supersampling: int = Field(2, ge=1, le=4, description="n x n rays a pixel where surfaces meet")
    lens_k1: Annotated[float | Drawn, _between(-0.5, 0.5)] = Field(
        _PHONE,
        description='radial distortion k1, as OpenCV\'s; "drawn": 0.05 to 0.12 where k3 is 0, by scene and seed',
    )
    lens_k2: Annotated[float | Drawn, _between(-1, 1)] = Field(
        _PHONE,
        description='radial distortion k2; "drawn": -0.20 to -0.05 where k3 is 0, by scene and seed',
    )
    lens_k3: Annotated[float | Drawn, _between(-1, 1)] = Field(
        _PHONE,
        description='radial distortion k3; "drawn": 0 to 0.5 by scene and seed, with k1 and k2 that make up for it; 0 '
        "where k1 or k2 is a number",
    )
    readout_s: Annotated[float | Drawn, _between(0, 0.05)] = Field(
        _PHONE, description='rolling shutter: first to last row, seconds; "drawn": 0.010 to 0.030, by scene and seed'
    )
    time_offset_s: float = Field(
        0.0, ge=-0.1, le=0.1, description="logged time of an image minus that of its middle row, seconds"
    )
    focus_breathing: Annotated[float | Drawn, _between(0, 0.02)] = Field(
        _PHONE, description='largest error of the logged focal length, as a fraction; "drawn": 0 to 0.003, by session'
    )
    appearances: tuple[Appearance, ...] = Field(
        (Appearance.SAME,),
        min_length=1,
        description="what the test walks see, beside the training walks, each walk once in each: same; other_hour: sun "
        "elsewhere; evening: low warm sun, artificial light, noise; other_month: overcast, other foliage and ground, a "
        "fifth of the movable objects moved, removed or new",
    )
    jpeg_quality: int = Field(90, ge=50, le=100, description="JPEG quality")

    @field_validator("appearances")
    @classmethod
    def _refuse_twice(cls, appearances: tuple[Appearance, ...]) -> tuple[Appearance, ...]:
        if len(set(appearances)) < len(appearances):
            raise PydanticCustomError("twice", "should name each appearance once")
        return appearances
