"""What each check estimates, in which unit, and what to do where it failed or is undecided."""

from dataclasses import dataclass

from groundwalk.store.choices import CheckName, CheckUnit, FailureCause
from groundwalk.store.hints import ANY_SCENE, setting_of

_EXCLUDE_SESSION = "take the session out of the captures' folder"
_MEASURED_PRINT = (
    f"correct its size in [[ruler]] of data/scenes/{ANY_SCENE}.toml; or, where it is right, let it set the scale: "
    f"use_for_scale = true there, and if it still doesn't, raise {setting_of('align', 'max_ruler_size_error')}"
)
ADVICE_BY_CAUSE = {
    FailureCause.MIRRORED_IMAGES: f"write the images as the camera sees them, not mirrored; or {_EXCLUDE_SESSION}",
    FailureCause.MISMATCHED_IMAGES: f"give each image the time and pose that it was taken at; or {_EXCLUDE_SESSION}",
}


@dataclass(frozen=True)
class CheckDefinition:
    """What a check estimates; the value must be at most the limit, or at least (`limit_is_minimum`). `remedy`: what to
    do where it failed; `evidence`: what would decide it."""

    estimate: str
    unit: CheckUnit = CheckUnit.FRACTION
    remedy: str = ""
    evidence: str = ""
    limit_is_minimum: bool = False


DEFINITIONS = {
    CheckName.REGISTERED: CheckDefinition(
        "registered frames",
        remedy=f"capture with more overlap between images, or lower {setting_of('align', 'min_registered_fraction')}",
        limit_is_minimum=True,
    ),
    CheckName.SESSION_REGISTERED: CheckDefinition(
        "registered frames",
        remedy=f"{_EXCLUDE_SESSION}, or lower {setting_of('align', 'min_registered_fraction')}",
        limit_is_minimum=True,
    ),
    CheckName.COMPONENT_SCALE: CheckDefinition(
        "metric scale of the SfM model",
        remedy="capture it again: with odometry a longer walk, without it more images between this place and the rest",
    ),
    CheckName.MAP_SCALE: CheckDefinition(
        "standard error of the metric scale",
        evidence="a ruler in view (docs/how-to/ruler.md); with odometry a longer or a second walk, without it a survey",
    ),
    CheckName.MAP_VERTICAL: CheckDefinition(
        "standard error of the vertical",
        CheckUnit.DEGREES,
        evidence="a further session whose poses are in a gravity-aligned world",
    ),
    CheckName.REFERENCE_SCALE: CheckDefinition(
        "standard error of the metric scale by the reference poses",
        evidence="more frames with reference poses, and their unit (metre: "
        f"{setting_of('import', 'reference_is_metric = true')})",
    ),
    CheckName.REFERENCE_VERTICAL: CheckDefinition(
        "standard error of the vertical by the reference poses",
        CheckUnit.DEGREES,
        evidence="more frames with reference poses",
    ),
    CheckName.SESSION_FOCAL_LENGTH: CheckDefinition(
        "focal length estimated from the images against the captured one",
        remedy="correct the captured focal length, image by image where it changes; or, where it's constant and only a "
        f"guess, raise {setting_of('align', 'max_focal_error')}: SfM used the estimated one",
        evidence="a walk that also turns and goes sideways",
    ),
    CheckName.SESSION_MOTION: CheckDefinition(
        "steps that VIO explains", remedy=_EXCLUDE_SESSION, evidence="a longer walk with turns", limit_is_minimum=True
    ),
    CheckName.SESSION_TURNS: CheckDefinition(
        "turns in SfM against VIO's",
        remedy=f"correct the captured focal length, or {_EXCLUDE_SESSION}",
        evidence="a walk with more turns",
    ),
    CheckName.SESSION_ALIASING: CheckDefinition(
        "frames at places that are far apart in VIO",
        remedy=f"capture again with distinctive views of each place, or {_EXCLUDE_SESSION}",
    ),
    CheckName.SESSION_SCALE: CheckDefinition(
        "the session's scale against the others'",
        remedy=f"{_EXCLUDE_SESSION}, or raise {setting_of('align', 'max_session_scale_error')}",
        evidence="a longer walk in this session",
    ),
    CheckName.SESSION_VERTICAL: CheckDefinition(
        "the session's vertical against the others'",
        CheckUnit.DEGREES,
        remedy=f"{_EXCLUDE_SESSION}, or raise {setting_of('align', 'max_session_tilt_deg')}",
        evidence="a longer walk in this session, or a further session",
    ),
    CheckName.RULER_SCALE: CheckDefinition(
        "the map's scale against the ruler",
        remedy=f"measure the print: {_MEASURED_PRINT}",
        evidence="views of the whole ruler from several directions, a longer walk, by which VIO's scale is better "
        f"known, or the print's measured size ({_MEASURED_PRINT})",
    ),
    CheckName.CONTROL_POINTS: CheckDefinition(
        "held-out control points against the map, RMS",
        CheckUnit.METRES,
        remedy="correct the survey's files, or measure the points again (docs/how-to/control-points.md); or, where the "
        "survey is right, capture more views of these places, and let a ruler set the scale",
        evidence="six points or more, each seen by three frames or more from different directions",
    ),
    CheckName.WINDOW_POSITION: CheckDefinition(
        "largest distance between SfM and VIO in a window",
        CheckUnit.METRES,
        remedy="capture again with more overlap there",
        evidence="more images there",
    ),
    CheckName.WINDOW_ROTATION: CheckDefinition(
        "largest angle between SfM and VIO in a window",
        CheckUnit.DEGREES,
        remedy="capture again with more overlap there",
        evidence="more images there",
    ),
    CheckName.SESSION_REFERENCE: CheckDefinition(
        "frames away from their reference poses",
        remedy=f"correct the data set's poses or intrinsics, {_EXCLUDE_SESSION}, or raise "
        f"{setting_of('align', 'max_reference_error_m')} or max_reference_error_deg",
    ),
    CheckName.SESSION_DEPTH_SCALE: CheckDefinition(
        "the depth sensor's depth against the map's",
        remedy="measure a length in the scene with a ruler, to see whether map or sensor is wrong",
        evidence="more frames with depth, nearer to the surfaces in view, or a longer walk",
    ),
    CheckName.SESSION_DEPTH_BY_DISTANCE: CheckDefinition(
        "the depth sensor's depth against the map's, between near and far points",
        remedy="check the captured focal length and lens",
        evidence="more frames with depth",
    ),
    CheckName.COMPONENT_LINK: CheckDefinition(
        "VIO path between the SfM models",
        CheckUnit.METRES,
        remedy=f"capture images between the two places, or raise {setting_of('align', 'vio_link_m')}",
    ),
}
