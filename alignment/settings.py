"""Settings of the align stage."""

from typing import Annotated, ClassVar

from pydantic import BeforeValidator, Field

from groundwalk.alignment.rulers.settings import Ruler, rulers_of
from groundwalk.alignment.uncertainty import QualityLimits
from groundwalk.artefacts import Settings
from groundwalk.artefacts.vio_drift_settings import VioDriftSettings
from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, MAX_TURN_GAIN_ERROR
from groundwalk.consistency.scale import STEP_M, STEP_SCALE_SD
from groundwalk.consistency.windows import POSE_SD, WINDOW_M


class QualitySettings(Settings):
    """What a frame must keep for a quality class."""

    position_sd_m: float = Field(gt=0, description="one sigma of SfM's position, least certain axis")
    rotation_sd_deg: float = Field(gt=0, description="one sigma of SfM's rotation, least certain axis")
    observations: int = Field(ge=0, description="points of the model seen in the frame, at least")
    reprojection_deg: float = Field(gt=0, description="mean reprojection error as an angle")

    def limits(self) -> QualityLimits:
        return QualityLimits(self.position_sd_m, self.rotation_sd_deg, self.observations, self.reprojection_deg)


class AlignSettings(VioDriftSettings):
    """How ground truth is made; docs/explanation/ground-truth.md says why these defaults."""

    renamed: ClassVar[dict[str, str]] = {"vio_drift_deg_per_root_m": "vio_drift_deg_per_sqrt_m"}

    window_m: float = Field(WINDOW_M, gt=0, description="VIO path over which SfM and VIO are compared, metres")
    step_m: float = Field(
        STEP_M, gt=0, description="VIO path of the steps that give the scale, metres; an eighth of a shorter walk"
    )
    step_scale_sd: float = Field(STEP_SCALE_SD, gt=0, description="expected scale error of a step of a metre, share")
    phone_scale_sd: float = Field(0.003, gt=0, description="expected scale error of one recording's VIO, share")
    max_scale_sd: float = Field(
        0.02, gt=0, description="a metric scale with a larger standard error, as a share, is called uncertain"
    )
    max_vertical_sd_deg: float = Field(
        1.0, gt=0, description="a vertical with a larger standard error, degrees an axis, is called uncertain"
    )
    phone_tilt_sd_deg: float = Field(0.3, gt=0, description="expected gravity error of one recording, degrees an axis")
    position_sd_m: float = Field(
        POSE_SD.position_m, gt=0, description="position's weight in fits of VIO to the map, metres"
    )
    rotation_sd_deg: float = Field(1.0, gt=0, description="rotation's weight in the same fits, degrees")
    segment_jump_m: float = Field(0.5, gt=0, description="a session is aligned apart before and after such a VIO jump")
    segment_jump_deg: float = Field(5.0, gt=0, description="the same for a jump in rotation, degrees")
    session_scale_limit: float = Field(0.03, gt=0, description="gate: a session's scale may differ by this share")
    session_tilt_limit_deg: float = Field(2.0, gt=0, description="gate: a session's vertical may differ by this")
    motion_agreeing: float = Field(
        0.5, ge=0, le=1, description="gate: share of a session's steps that must be alike in SfM and VIO"
    )
    focal_limit: float = Field(
        0.03,
        gt=0,
        description="gate: the images may say that a session's focal length is off by this share",
    )
    turn_gain_limit: float = Field(
        MAX_TURN_GAIN_ERROR,
        gt=0,
        description="gate: SfM may turn by this share more or less than VIO; a wrong focal length does so",
    )
    folded_limit: float = Field(
        MAX_ALIASED_FRACTION,
        ge=0,
        description="gate: share of a session's frames that may lie where far ones do, by VIO",
    )
    unsure_step_m: float = Field(
        5.0,
        gt=0,
        description="gate: frames that SfM isn't sure of (class C) must move as VIO does over this path",
    )
    unsure_share: float = Field(0.018, gt=0, description="... and up to three times that, to this share of it")
    bridge_m: float = Field(10.0, ge=0, description="models that no view ties are joined by VIO over this path at most")
    bridge_m_per_sqrt_m: float = Field(
        0.03, gt=0, description="what VIO drifts by there, one sigma: metres over the root of a metre walked"
    )
    bridge_deg_per_sqrt_m: float = Field(0.6, gt=0, description="the same in heading, degrees")
    reference_limit_m: float = Field(
        0.1,
        ge=0,
        description="gate: a frame may be this far from its reference pose (where that is metric), metres, ...",
    )
    reference_limit_share: float = Field(
        0.01, ge=0, description="... and this share of the extent of the reference's camera positions"
    )
    reference_limit_deg: float = Field(3.0, gt=0, description="gate: the same in rotation, degrees")
    depth_scale_limit: float = Field(
        0.05, gt=0, description="gate: a depth sensor's median depth may differ from the map's by this share"
    )
    depth_spread_limit: float = Field(
        0.05, gt=0, description="gate: the same share may differ by this between near and far points"
    )
    least_registered: float = Field(0.5, ge=0, le=1, description="share of frames that SfM must register")
    least_agreeing: float = Field(0.5, ge=0, le=1, description="share of registered frames that must pass the gate")
    common_px: float = Field(
        0.05, ge=0, description="what all keypoints are off by in common, one sigma per image axis; turns all cameras"
    )
    rulers: Annotated[list[Ruler], BeforeValidator(rulers_of)] = Field(
        default_factory=list, description="boards and known distances in the images; [[ruler]] in the scene's file"
    )
    ruler_size_limit: float = Field(
        0.03,
        gt=0,
        description="a ruler further from VIO's scale, as a share, doesn't set the scale: a print of another size?",
    )
    ruler_max_sd: float = Field(
        0.01, gt=0, description="a ruler's scale must be surer than this share, one sigma, to judge"
    )
    ruler_min_angle_deg: float = Field(
        5.0, gt=0, description="views of a ruler must be this far apart to judge, degrees"
    )
    quality_a: QualitySettings = QualitySettings(
        position_sd_m=0.02, rotation_sd_deg=0.1, observations=100, reprojection_deg=0.15
    )
    quality_b: QualitySettings = QualitySettings(
        position_sd_m=0.05, rotation_sd_deg=0.3, observations=50, reprojection_deg=0.3
    )
