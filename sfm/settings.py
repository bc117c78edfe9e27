"""The stage's settings."""

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field

from groundwalk.artefacts.vio_drift_settings import VioDriftSettings
from groundwalk.sfm.extensions import MAPPERS, RETRIEVALS

MapperName = Annotated[str, AfterValidator(MAPPERS.known)]
FeatureName = Literal["sift", "aliked"]
RefineCameras = Literal["auto", "never"]
LensSource = Literal["auto", "stated"]
RetrievalName = Annotated[str, AfterValidator(RETRIEVALS.known)]
SiftMatcherName = Literal["nearest", "lightglue"]


class SfmSettings(VioDriftSettings):
    """[sfm]"""

    renamed: ClassVar[dict[str, str]] = {"vio_drift_deg_per_root_m": "vio_drift_deg_per_sqrt_m"}

    max_image_size: int = Field(1600, ge=64, description="images are shrunk to this longest side for features, px")
    max_features: int = Field(2048, gt=0, description="features kept per image")
    first_octave: int = Field(
        0, ge=-1, le=2, description="SIFT: -1 doubles the image first: more features, 2 to 4 times slower"
    )
    features: FeatureName = Field("sift", description="sift, or aliked: a network's, matched by LightGlue")
    sift_matcher: SiftMatcherName = Field("nearest", description="SIFT: nearest descriptors, or lightglue: a network")
    aliked_model: str = Field("data/weights/aliked-n16rot.onnx", description="COLMAP's ONNX file of ALIKED")
    aliked_lightglue_model: str = Field(
        "data/weights/aliked-lightglue.onnx", description="COLMAP's ONNX file of LightGlue for ALIKED"
    )
    sift_lightglue_model: str = Field(
        "data/weights/sift-lightglue.onnx", description="COLMAP's ONNX file of LightGlue for SIFT"
    )
    sequence_pairs: int = Field(
        5, ge=1, description="following frames of the same recording that a frame is matched to"
    )
    vio_pairs: int = Field(10, ge=0, description="frames of the same session with the most view overlap by VIO")
    vio_max_distance_m: float = Field(
        8.0, gt=0, description="farther apart in VIO two frames of a session aren't matched"
    )
    vio_max_angle_deg: float = Field(60.0, gt=0, le=180, description="nor if their views turn apart by more than this")
    vio_gravity_deg: float = Field(5.0, gt=0, description="gravity may differ by this in two frames, degrees")
    vio_direction_deg: float = Field(
        15.0, gt=0, description="what two images leave open of the direction of motion, degrees"
    )
    retrieval_pairs: int = Field(10, ge=0, description="frames of other sessions that look most alike")
    retrieval: RetrievalName = Field("vlad", description="what `look alike` means: vlad or pca-vlad (docs/sfm.md)")
    retrieval_words: int = Field(64, ge=2, description="visual words, learned from the scene, behind `look alike`")
    transitive_pairs: int = Field(5, ge=0, description="pairs a frame gains where both match a third one; 0: none")
    min_inliers: int = Field(15, ge=8, description="verified matches that a pair needs")
    mapper: MapperName = Field("incremental", description="incremental, global, hierarchical, or vio: starts from VIO")
    component_frames: int = Field(
        10, ge=3, description="frames that a model beside the largest needs so that it's kept as a component"
    )
    held_out: float = Field(0.05, ge=0, le=0.5, description="share of tracks that is left out, to check the model with")
    retries: bool = Field(True, description="try other pairs, features and mappers where frames are missing or wrong")
    lens: LensSource = Field(
        "auto", description="distortion k1, k2: auto estimates it from the images; stated takes what the capture states"
    )
    readout_s: float | None = Field(
        None, ge=-0.1, le=0.1, description="rolling shutter, first to last row in seconds; null estimates it"
    )
    refine_cameras: RefineCameras = Field(
        "auto",
        description="auto estimates lens, readout and focal lengths; never keeps the stated, or else typical, ones",
    )
    focal_limit: float = Field(
        0.03, gt=0, lt=0.5, description="a session's focal lengths are called wrong where images say so by this share"
    )
    min_registered: float = Field(0.5, ge=0, le=1, description="share of frames that the models must have")
    wanted_registered: float = Field(
        0.9, ge=0, le=1, description="share of frames below which more pairs are tried, and the best attempt is taken"
    )
    min_agreeing: float = Field(0.8, ge=0, le=1, description="share of these that must move as VIO does")
    covariance_max_images: int = Field(
        2500, ge=0, description="larger models get no covariances (memory: 36 n² numbers)"
    )
    threads: int = Field(-1, ge=-1, description="threads for features; -1: all cores. Mapping has one, to repeat")
