"""Settings of the compact map."""

from pydantic import Field

from groundwalk.artefacts.settings import Settings


class MapSettings(Settings):
    """How a compact map is built from training frames, and what its queries use."""

    max_features: int = Field(1024, ge=64, description="SIFT features kept per image, of the map and of queries")
    max_side: int = Field(640, ge=160, description="images are shrunk to this many pixels on the longer side")
    pairs_per_frame: int = Field(16, ge=1, description="training frames that each one is matched with, by overlap")
    max_points: int = Field(20_000, ge=100, description="points that the map keeps")
    dimensions: int = Field(64, ge=8, le=128, description="principal components kept of each descriptor, one byte each")
    calibration_every: int = Field(5, ge=2, description="every n-th training frame calibrates the map's answers")
