"""Records of groundwalk's own structure localisers."""

from dataclasses import replace

from groundwalk.localisation.feature_kinds import XFEAT
from groundwalk.localisation.localiser_settings import HLocSettings, MapSettings
from groundwalk.localisation.localisers import LocaliserFile, StructureLocaliser
from groundwalk.store import colours
from groundwalk.store.registry import Lazy

MAP = StructureLocaliser(
    id="Map",
    label="Map",
    meaning="compact map of the most useful points, with covariance and refusal",
    colour=colours.LOCALISERS["Map"],
    settings=MapSettings,
    build=Lazy("groundwalk.localisation.build:map_localiser"),
    gives_covariance=True,
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
    gives_covariance=False,
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
