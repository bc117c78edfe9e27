"""The stage's settings."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from groundwalk.geometry.shutter import MAX_READOUT_S
from groundwalk.sfm.plugins import MAPPERS
from groundwalk.store import Settings

MapperName = Annotated[str, AfterValidator(MAPPERS.known)]
LensSource = Literal["auto", "stated"]
RefineCameras = Literal["auto", "never"]


class SfmSettings(Settings):
    """[sfm]"""

    max_image_size: int = Field(1120, ge=64, description="longest side of images for features, px; larger ones shrink")
    max_features: int = Field(2048, gt=0, description="features per image")
    few_frames: int = Field(
        40, ge=0, description="scenes of up to so many frames get 3 times the features, from images 1.5 times as large"
    )
    sequence_pairs: int = Field(
        5, ge=1, description="next frames of its recording that a frame is matched to, besides those 8, 16 and 32 later"
    )
    vio_pairs: int = Field(
        10, ge=0, description="frames of its session, of most view overlap by VIO, that a frame is matched to"
    )
    vio_max_distance_m: float = Field(
        8.0, gt=0, description="frames of a session farther apart in VIO aren't matched, metres"
    )
    retrieval_pairs: int = Field(
        10,
        ge=0,
        description="frames of other sessions, of most similar images, that a frame is matched to, and of its own "
        "recording where that has no VIO; half as many that match a third frame in common",
    )
    mapper: MapperName = Field("incremental", description="incremental or global")
    retry: bool = Field(True, description="try other pairs and more features where frames are missing or wrong")
    lens: LensSource = Field(
        "auto", description="distortion k1, k2: auto estimates it from the images; stated takes what the capture states"
    )
    readout_s: float | None = Field(
        None,
        ge=-MAX_READOUT_S,
        le=MAX_READOUT_S,
        description="rolling shutter, first to last row in seconds; null estimates it, from what the capture states",
    )
    refine_cameras: RefineCameras = Field(
        "auto",
        description="auto estimates lens, readout and focal lengths; never uses the stated, or else typical, ones",
    )
