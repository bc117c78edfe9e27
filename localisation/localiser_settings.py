"""Settings of the features and matches that all structure localisers share, and of each of groundwalk's own."""

from pydantic import Field

from groundwalk.store.settings import Settings


class StructureSettings(Settings):
    """How training frames and queries are turned into features, and training frames matched."""

    max_features: int = Field(1024, ge=64, description="SIFT features kept per image, of training frames and queries")
    max_side: int = Field(640, ge=160, description="images are shrunk to this many pixels on the longer side")
    pairs_per_frame: int = Field(16, ge=1, description="training frames that each one is matched with, by overlap")


class LocaliserSettings(Settings):
    """Base of a structure localiser's settings."""


class MapSettings(LocaliserSettings):
    """What the compact map keeps."""

    max_points: int = Field(28_000, ge=100, description="points that the map keeps")
    dimensions: int = Field(40, ge=8, le=128, description="principal components kept of each descriptor, one byte each")
    calibration_every: int = Field(5, ge=2, description="every n-th training frame calibrates the map's answers")


class HLocSettings(LocaliserSettings):
    """How HLoc answers."""

    retrieved: int = Field(20, ge=1, description="training images that a query is matched with")
    min_inliers: int = Field(12, ge=4, description="inliers below which an answer is refused")
