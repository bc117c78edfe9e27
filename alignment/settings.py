"""Settings of the align stage."""

from typing import Annotated

import numpy as np
from pydantic import BeforeValidator, Field

from groundwalk.alignment.rulers.settings import Ruler, rulers_of
from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, MAX_TURN_GAIN_ERROR
from groundwalk.consistency.scale import STEP_M, STEP_SCALE_SD
from groundwalk.consistency.windows import POSE_SD, WINDOW_M, PoseSd
from groundwalk.store.settings import Settings
from groundwalk.store.vio_drift_settings import VioDriftSettings


class QualitySettings(Settings):
    """Limits of a quality class."""

    max_position_sd_m: float = Field(gt=0, description="largest standard error of SfM's position in any axis, metres")
    max_rotation_sd_deg: float = Field(
        gt=0, description="largest standard error of SfM's rotation in any axis, degrees"
    )
    min_observations: int = Field(ge=0, description="fewest points of the SfM model seen in the frame")
    max_reprojection_deg: float = Field(gt=0, description="largest mean reprojection error, as an angle in degrees")


class AlignSettings(VioDriftSettings):
    """How ground truth is made; docs/explanation/ground-truth.md says why these defaults."""

    window_m: float = Field(WINDOW_M, gt=0, description="VIO path over which SfM and VIO are compared, metres")
    step_m: float = Field(
        STEP_M,
        gt=0,
        description="VIO path of the steps that determine the scale, metres; a walk shorter than eight steps has eight",
    )
    step_scale_sd: float = Field(
        STEP_SCALE_SD, gt=0, description="expected scale error (sd) of a step of one metre, as a fraction"
    )
    phone_scale_sd: float = Field(
        0.003, gt=0, description="expected scale error (sd) of one recording's VIO, as a fraction"
    )
    max_scale_sd: float = Field(
        0.02, gt=0, description="a metric scale with a larger standard error, as a fraction, is reported as uncertain"
    )
    max_vertical_sd_deg: float = Field(
        1.0, gt=0, description="a vertical with a larger standard error, degrees an axis, is reported as uncertain"
    )
    phone_tilt_sd_deg: float = Field(
        0.3, gt=0, description="expected gravity error (sd) of one recording, degrees an axis"
    )
    fit_position_sd_m: float = Field(
        POSE_SD.position_m, gt=0, description="weight of positions in fits of VIO to the map, as a sd in metres"
    )
    fit_rotation_sd_deg: float = Field(
        1.0, gt=0, description="weight of rotations in fits of VIO to the map, as a sd in degrees"
    )
    segment_jump_m: float = Field(
        0.5, gt=0, description="a session is aligned in parts before and after a VIO jump of this many metres or more"
    )
    segment_jump_deg: float = Field(
        5.0, gt=0, description="a session is aligned in parts before and after a VIO jump of this many degrees or more"
    )
    max_session_scale_error: float = Field(
        0.03, gt=0, description="a session whose scale differs from the others' by more, as a fraction, fails"
    )
    max_session_tilt_deg: float = Field(
        2.0, gt=0, description="a session whose vertical differs from the others' by more, degrees, fails"
    )
    min_motion_agreement: float = Field(
        0.5, ge=0, le=1, description="a session fails if VIO explains a smaller fraction of its relative poses in SfM"
    )
    max_focal_error: float = Field(
        0.03,
        gt=0,
        description="a session fails if its focal length by the images differs from the captured one by more, as a "
        "fraction",
    )
    max_turn_gain_error: float = Field(
        MAX_TURN_GAIN_ERROR,
        gt=0,
        description="a session fails if SfM turns more or less than VIO by more, as a fraction (a wrong focal length)",
    )
    max_aliased_fraction: float = Field(
        MAX_ALIASED_FRACTION,
        ge=0,
        description="a SfM model fails if a larger fraction of a session's frames lies at places far apart in VIO",
    )
    uncertain_step_m: float = Field(
        5.0,
        gt=0,
        description="VIO path, up to three times it, over which uncertain frames (class C) must match VIO, metres",
    )
    max_uncertain_deviation: float = Field(
        0.018,
        gt=0,
        description="uncertain frames (class C) whose motion differs from VIO's by more, as a fraction of the path, "
        "and by more than that of certain frames (class A or B, or twice the sd of their motion within this), get no "
        "ground truth",
    )
    vio_link_m: float = Field(
        10.0, ge=0, description="longest VIO path by which SfM models without a common view are linked, metres"
    )
    vio_link_m_per_sqrt_m: float = Field(
        0.03,
        gt=0,
        description="VIO's position drift (sd) between linked models, metres a square root of a metre of path",
    )
    vio_link_deg_per_sqrt_m: float = Field(
        0.6,
        gt=0,
        description="VIO's heading drift (sd) between linked models, degrees a square root of a metre of path",
    )
    max_reference_error_m: float = Field(
        0.1,
        ge=0,
        description="constant part of the largest distance between a frame and its reference pose, metres (where that "
        "is metric)",
    )
    max_reference_error_fraction: float = Field(
        0.01,
        ge=0,
        description="part of the largest distance between a frame and its reference pose that grows with the extent of "
        "the reference's camera positions, as a fraction of it",
    )
    max_reference_error_deg: float = Field(
        3.0, gt=0, description="largest angle between a frame and its reference pose, degrees"
    )
    max_depth_scale_error: float = Field(
        0.05,
        gt=0,
        description="a session fails if its depth sensor's median depth differs from the map's by more, as a fraction",
    )
    max_depth_spread: float = Field(
        0.05,
        gt=0,
        description="a session fails if sensor depth over map depth differs by more between near and far points",
    )
    min_registered_fraction: float = Field(
        0.5, ge=0, le=1, description="the run fails if SfM registered a smaller fraction of its frames, or a session's"
    )
    min_consistent_fraction: float = Field(
        0.5, ge=0, le=1, description="the run fails if a smaller fraction of the registered frames passes the checks"
    )
    common_keypoint_sd_px: float = Field(
        0.05,
        ge=0,
        description="error (sd) that all keypoints have in common, pixels an image axis; it turns all cameras alike",
    )
    rulers: Annotated[list[Ruler], BeforeValidator(rulers_of)] = Field(
        default_factory=list, description="boards and known distances in the images; [[ruler]] in the scene's file"
    )
    max_ruler_size_error: float = Field(
        0.03,
        gt=0,
        description="a ruler fails if its size differs by more from that in the map, as a fraction: a print of another "
        "size; it may set the scale within this, or within the 95 % bounds of its difference from VIO's scale",
    )
    ruler_max_sd: float = Field(
        0.01, gt=0, description="a ruler whose scale has a larger standard error, as a fraction, decides nothing"
    )
    ruler_min_angle_deg: float = Field(
        5.0, gt=0, description="a ruler whose views are less than this far apart, degrees, decides nothing"
    )
    quality_a: QualitySettings = Field(
        QualitySettings(
            max_position_sd_m=0.02, max_rotation_sd_deg=0.1, min_observations=100, max_reprojection_deg=0.15
        ),
        description="limits of quality class A",
    )
    quality_b: QualitySettings = Field(
        QualitySettings(max_position_sd_m=0.05, max_rotation_sd_deg=0.3, min_observations=50, max_reprojection_deg=0.3),
        description="limits of quality class B; frames beyond are C",
    )

    @property
    def fit_sd(self) -> PoseSd:
        """Weights of positions and rotations in fits of VIO to the map."""
        return PoseSd(self.fit_position_sd_m, float(np.radians(self.fit_rotation_sd_deg)))

    @property
    def vio_link_sd(self) -> PoseSd:
        """VIO's drift over a metre between linked models; it grows with the square root of the path."""
        return PoseSd(self.vio_link_m_per_sqrt_m, float(np.radians(self.vio_link_deg_per_sqrt_m)))
