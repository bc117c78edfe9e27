"""Settings of the import stage."""

from typing import Literal

from pydantic import Field

from groundwalk.capture_import.capture import Limits
from groundwalk.store import Settings


class ImportSettings(Settings):
    """Which images become frames, and what counts as broken."""

    format: str = Field("auto", description="capture format, as `formats` lists it, or auto")
    sampling: Literal["rate", "all"] = Field("rate", description="which images become frames: by rate, or all")
    rate_hz: float = Field(1.0, gt=0, le=240, description="sampling by rate: images a second")
    min_frames: int = Field(
        60,
        ge=0,
        description="a capture with fewer frames by the settings above is sampled more densely, to about this many",
    )
    max_support_fraction: float = Field(
        1.0, ge=0, description="most support frames (images for SfM alone), as a fraction of the frames of the dataset"
    )
    split_by: Literal["session", "time"] = Field(
        "session",
        description="split for testing by whole recordings where there are several, or each recording in time",
    )
    images: Literal["reference", "copy"] = Field(
        "reference", description="use images where the capture has them, or copy them"
    )
    first_row: Literal["auto", "top", "right", "bottom", "left"] = Field(
        "auto",
        description="side of the images, as captured, that the sensor reads out first (rolling shutter); auto: what "
        "the capture states, or else top, and right of images higher than wide",
    )
    blur: bool = Field(False, description="make faces that a detector finds unrecognisable")
    face_model: str = Field(
        "",
        description="blur: YuNet's ONNX file, relative to the data folder, which finds faces far better than OpenCV's "
        "own detectors (docs/how-to/blur-faces.md); empty: those",
    )
    blur_boxes: str = Field(
        "",
        description="a table (CSV, relative to the data folder) of what to blur, as import writes it to blurred.csv: "
        "images that it lists are blurred there and nowhere else",
    )
    gps: bool = Field(
        False,
        description="keep the positions on earth that photos and logs state, so that align can tell where on earth the "
        "map is; otherwise they aren't read",
    )
    min_relative_sharpness: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="an image less sharp than this fraction of its session's median sharpness is rejected as blurred",
    )
    check_convention: bool = Field(
        True, description="compare poses and intrinsics with matched images, and stop where another convention fits"
    )
    reference_is_metric: bool = Field(
        False, description="the unit of reference poses whose file states none (COLMAP, nerfstudio) is the metre"
    )
    max_megapixels: float = Field(100.0, gt=0, description="largest image that is read, megapixels")

    @property
    def limits(self) -> Limits:
        return Limits(max_megapixels=self.max_megapixels)
