"""Settings of the simulator, section [simulate]."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator
from pydantic_core import PydanticCustomError

from groundwalk.store import Settings

Drawn = Literal["drawn"]
JPEG_QUALITY = 90
MAX_SESSION_S = 400.0  # longer walks are split into more sessions


def _between(low: float, high: float) -> BeforeValidator:
    def check(value: Any) -> Any:
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if value == "drawn" or (is_number and low <= value <= high):
            return value
        raise PydanticCustomError("number_or_drawn", f'should be a number from {low} to {high}, or "drawn"')

    return BeforeValidator(check)


class SimulateSettings(Settings):
    """How much is simulated and how finely. "drawn": as measured on phones, another one for each scene and seed."""

    width: int = Field(640, ge=64, multiple_of=4, description="image width, pixels; images are 4:3")
    rate_hz: float = Field(10.0, gt=0, le=60, description="poses a second")
    image_hz: float = Field(1.0, gt=0, description="images a second; every k-th pose has one")
    train_frames: int = Field(1500, gt=0, description="training images, before frame_fraction")
    test_frames: int = Field(600, gt=0, description="test images, before frame_fraction")
    frame_fraction: float = Field(
        0.18, gt=0, le=1, description="fraction of train_frames and test_frames that is simulated"
    )
    train_sessions: int = Field(3, ge=1, description="training walks; more where one would take over 400 s")
    test_sessions: int = Field(2, ge=1, description="test walks; more where one would take over 400 s")
    texel_m: float = Field(0.012, gt=0, description="texel of near surfaces, metres")
    supersampling: int = Field(2, ge=1, le=4, description="n x n rays a pixel where surfaces meet")
    lens: tuple[float, float, float] | Drawn = Field(
        "drawn", description='radial distortion k1, k2, k3 as OpenCV\'s, from -1 to 1; "drawn": by scene and seed'
    )
    readout_s: Annotated[float | Drawn, _between(0, 0.05)] = Field(
        "drawn", description='rolling shutter: first to last row, seconds; "drawn": 0.010 to 0.030, by scene and seed'
    )
    time_offset_s: float = Field(
        0.0, ge=-0.1, le=0.1, description="logged time of an image minus that of its middle row, seconds"
    )
    focus_breathing: Annotated[float | Drawn, _between(0, 0.02)] = Field(
        "drawn", description='largest error of the logged focal length, as a fraction; "drawn": 0 to 0.003, by session'
    )

    @property
    def height(self) -> int:
        return 3 * self.width // 4

    @property
    def images(self) -> dict[str, int]:
        """Images that are simulated, of all training walks and of all test walks."""
        frames = {"train": self.train_frames, "test": self.test_frames}
        return {kind: max(2, round(self.frame_fraction * count)) for kind, count in frames.items()}

    @field_validator("lens")
    @classmethod
    def _refuse_impossible(cls, lens: tuple[float, float, float] | Drawn) -> tuple[float, float, float] | Drawn:
        if lens != "drawn" and not all(-1 <= k <= 1 for k in lens):
            raise PydanticCustomError("lens", 'should be three numbers from -1 to 1, or "drawn"')
        return lens
