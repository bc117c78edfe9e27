"""The stage's settings."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from groundwalk.geometry.shutter import MAX_READOUT_S
from groundwalk.sfm.extensions import MAPPERS, RETRIEVALS
from groundwalk.store.vio_drift_settings import VioDriftSettings

MapperName = Annotated[str, AfterValidator(MAPPERS.known)]
RefineCameras = Literal["auto", "never"]
LensSource = Literal["auto", "stated"]
RetrievalName = Annotated[str, AfterValidator(RETRIEVALS.known)]


class SfmSettings(VioDriftSettings):
    """[sfm]"""

    max_image_size: int = Field(1120, ge=64, description="longest side of images for features, px; larger ones shrink")
    max_features: int = Field(2048, gt=0, description="features per image")
    min_contrast: float = Field(
        0.02, gt=0, lt=1, description="SIFT: contrast that a feature needs (OpenCV's contrastThreshold)"
    )
    sequence_pairs: int = Field(5, ge=1, description="next frames of its recording that a frame is matched to")
    vio_pairs: int = Field(
        10, ge=0, description="frames of its session, of most view overlap by VIO, that a frame is matched to"
    )
    vio_max_distance_m: float = Field(
        8.0, gt=0, description="frames of a session farther apart in VIO aren't matched, metres"
    )
    vio_max_angle_deg: float = Field(
        60.0, gt=0, le=180, description="frames of a session whose viewing directions differ by more aren't matched"
    )
    vio_gravity_deg: float = Field(
        5.0, gt=0, description="a pair whose gravity differs by more between its frames is inconsistent, degrees"
    )
    vio_direction_deg: float = Field(
        15.0, gt=0, description="error of a pair's direction of motion by its images, degrees; VIO's drift adds to it"
    )
    retrieval_pairs: int = Field(
        10,
        ge=0,
        description="frames of other sessions, of most similar images, that a frame is matched to; and of its own "
        "recording where that has no VIO",
    )
    retrieval: RetrievalName = Field(
        "vlad", description="what describes images to find similar ones (docs/explanation/sfm.md)"
    )
    retrieval_words: int = Field(64, ge=2, description="visual words of retrieval, learned from the scene")
    transitive_pairs: int = Field(5, ge=0, description="pairs a frame gains where both match a third one; 0: none")
    min_inliers: int = Field(15, ge=8, description="verified matches that a pair needs")
    floor_features: bool = Field(
        True,
        description="match the floor as seen from above (bird's-eye view) where neighbours have few verified matches",
    )
    mapper: MapperName = Field("incremental", description="incremental, global, hierarchical, or vio: starts from VIO")
    min_component_frames: int = Field(
        10, ge=3, description="frames, in no larger model, that a model beside the largest needs to be selected"
    )
    held_out_fraction: float = Field(
        0.05, ge=0, le=0.5, description="fraction of tracks left out of mapping, to check the model with"
    )
    retry: bool = Field(True, description="try other pairs, features and mappers where frames are missing or wrong")
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
    min_registered_fraction: float = Field(
        0.5, ge=0, le=1, description="fraction of frames that the models must register; fewer is an error"
    )
    target_registered_fraction: float = Field(
        0.9, ge=0, le=1, description="fraction of frames to register; with fewer, more pairs are tried"
    )
    min_consistent_fraction: float = Field(
        0.8, ge=0, le=1, description="fraction of registered frames whose motion must be consistent with VIO's"
    )
    covariance_max_images: int = Field(
        2500, ge=0, description="larger models get no covariances, and their frames class C (memory: 36 n² numbers)"
    )
    threads: int = Field(-1, ge=-1, description="threads for features; -1: all cores. Mapping has one, to repeat")
