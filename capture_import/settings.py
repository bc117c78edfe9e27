"""Settings of the import stage."""

from typing import Literal

from pydantic import Field

from groundwalk.artefacts import Settings
from groundwalk.capture_import.capture import Limits


class ImportSettings(Settings):
    """Which frames are kept, and what counts as broken."""

    format: str = Field("auto", description="capture format, as `formats` lists it, or auto")
    sampling: Literal["rate", "motion", "all"] = Field("rate", description="how images are thinned out")
    rate_hz: float = Field(1.0, gt=0, le=240, description="sampling by rate: images a second")
    step_m: float = Field(0.5, gt=0, description="sampling by motion: metres between images")
    step_deg: float = Field(20.0, gt=0, description="sampling by motion: degrees between images")
    min_frames: int = Field(
        60, ge=0, description="a capture that would keep fewer frames is sampled more densely, to about so many"
    )
    support_step_m: float = Field(
        0.3, ge=0, description="images are added for SfM alone until neighbours are so many metres apart; 0: no matter"
    )
    support_step_deg: float = Field(
        15.0, ge=0, description="images are added for SfM alone until neighbours turn by so many degrees; 0: no matter"
    )
    support_share: float = Field(
        1.0, ge=0, description="most images added for SfM alone (support frames), per frame of the dataset; 0: none"
    )
    split_by: Literal["session", "time"] = Field(
        "session", description="session: by whole recordings where there are several; time: each in time"
    )
    images: Literal["reference", "copy", "link"] = Field(
        "reference", description="use images where the capture has them, or copy or hard-link them"
    )
    upright: bool = Field(
        False, description="turn images upright by gravity, a quarter turn at a time, with intrinsics and poses"
    )
    blur: bool = Field(False, description="make faces and licence plates unrecognisable where a detector finds them")
    max_pose_gap_s: float = Field(0.5, gt=0, description="poses are interpolated over no longer gap")
    blurred_below: float = Field(
        0.5, ge=0, lt=1, description="an image is too blurred below this share of its session's median sharpness"
    )
    split_jump_m: float = Field(0.5, gt=0, description="a session is split where VIO jumps farther")
    split_jump_deg: float = Field(15.0, gt=0, description="a session is split where VIO jumps by more")
    check_convention: bool = Field(
        True, description="hold poses and intrinsics against matched images, and stop where another convention fits"
    )
    reference_is_metric: bool = Field(
        False, description="reference poses whose file states no unit (COLMAP, nerfstudio) are in metres"
    )
    max_megapixels: float = Field(100.0, gt=0, description="a larger image is refused")

    @property
    def limits(self) -> Limits:
        return Limits(max_megapixels=self.max_megapixels)
