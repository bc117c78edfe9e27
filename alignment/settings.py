"""Settings of the align stage."""

from typing import Annotated

from pydantic import BeforeValidator, Field

from groundwalk.alignment.control.settings import ControlSettings, controls_of
from groundwalk.alignment.rulers.settings import Ruler, rulers_of
from groundwalk.store.settings import Settings


class AlignSettings(Settings):
    """What ground truth may rest on; docs/explanation/ground-truth.md says what isn't a setting, and why."""

    rulers: Annotated[list[Ruler], BeforeValidator(rulers_of)] = Field(
        default_factory=list, description="boards and known distances in the images; [[ruler]] in the scene's file"
    )
    controls: Annotated[list[ControlSettings], BeforeValidator(controls_of)] = Field(
        default_factory=list, description="surveyed points in the images; [[control]] in the scene's file"
    )
    max_ruler_size_error: float = Field(
        0.03,
        gt=0,
        description="a ruler fails if its size differs by more from that in the map, as a fraction: a print of another "
        "size; it may set the scale within this, or within the 95 % bounds of its difference from VIO's scale",
    )
    vio_link_m: float = Field(
        10.0, ge=0, description="longest VIO path by which SfM models without a common view are linked, metres"
    )
    max_focal_error: float = Field(
        0.03,
        gt=0,
        description="a session fails if its focal length by the images differs from the captured one by more, as a "
        "fraction",
    )
    max_session_scale_error: float = Field(
        0.03, gt=0, description="a session whose scale differs from the others' by more, as a fraction, fails"
    )
    max_session_tilt_deg: float = Field(
        2.0, gt=0, description="a session whose vertical differs from the others' by more, degrees, fails"
    )
    max_reference_error_m: float = Field(
        0.1,
        ge=0,
        description="largest distance between a frame and its reference pose, metres (where that is metric); 1 % of "
        "the reference's extent is added",
    )
    max_reference_error_deg: float = Field(
        3.0, gt=0, description="largest angle between a frame and its reference pose, degrees"
    )
    min_registered_fraction: float = Field(
        0.5, ge=0, le=1, description="the run fails if SfM registered a smaller fraction of its frames, or a session's"
    )
    min_consistent_fraction: float = Field(
        0.5, ge=0, le=1, description="the run fails if a smaller fraction of the registered frames passes the checks"
    )
