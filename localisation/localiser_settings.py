"""Settings of the features and matches that all structure localisers share, and of each of groundwalk's own."""

from pydantic import Field

from groundwalk.store.settings import Settings


class StructureSettings(Settings):
    """How training frames and queries are turned into features."""

    max_features: int = Field(1024, ge=64, description="SIFT features kept per image, of training frames and queries")
    max_side: int = Field(640, ge=160, description="images are shrunk to this many pixels on the longer side")


class LocaliserSettings(Settings):
    """Base of a structure localiser's settings."""


class MapSettings(LocaliserSettings):
    """What the compact map keeps."""

    max_points: int = Field(28_000, ge=100, description="points that the map keeps")


class HLocSettings(LocaliserSettings):
    """How HLoc answers."""

    retrieved: int = Field(20, ge=1, description="training images that a query is matched with")
    min_inliers: int = Field(12, ge=4, description="inliers below which an answer is refused")
