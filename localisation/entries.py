"""Groundwalk's own structure localisers: their records and settings."""

from dataclasses import replace

from pydantic import Field

from groundwalk.localisation.localisers import FeatureKind, LocaliserFile, LocaliserSettings, StructureLocaliser
from groundwalk.store import colours
from groundwalk.store.registry import Lazy


class MapSettings(LocaliserSettings):
    """What the compact map keeps."""

    max_points: int = Field(28_000, ge=100, description="points that the map keeps")


class HLocSettings(LocaliserSettings):
    """How HLoc answers."""

    retrieved: int = Field(20, ge=1, description="training images that a query is matched with")
    min_inliers: int = Field(12, ge=4, description="inliers below which an answer is refused")


XFEAT = FeatureKind(
    "XFeat",
    0.95,
    Lazy("groundwalk.localisation.learned:extract_xfeat"),
    Lazy("groundwalk.localisation.learned:match_xfeat"),
)

MAP = StructureLocaliser(
    id="Map",
    label="Map",
    meaning="compact map of the most useful points, with covariance and refusal",
    colour=colours.LOCALISERS["Map"],
    settings=MapSettings,
    build=Lazy("groundwalk.localisation.build:map_localiser"),
    file=LocaliserFile(
        ".gwm",
        Lazy("groundwalk.localisation.query:write_localiser"),
        Lazy("groundwalk.localisation.query:read_localiser"),
    ),
    by_default=True,
)
HLOC = StructureLocaliser(
    id="HLoc",
    label="HLoc",
    meaning="retrieval, matching with each retrieved image, and COLMAP's pose from their points",
    colour=colours.LOCALISERS["HLoc"],
    settings=HLocSettings,
    build=Lazy("groundwalk.localisation.hloc:HLocLocaliser"),
    file=None,
    by_default=True,
)
HLOC_XFEAT = replace(
    HLOC,
    id="HLoc-XFeat",
    label="HLoc (XFeat + LighterGlue)",
    meaning="HLoc on the features of a small network, with the extra `learned`",
    colour=colours.LOCALISERS["HLoc-XFeat"],
    features=XFEAT,
    by_default=False,
)
