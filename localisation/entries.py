"""Records of groundwalk's own structure localisers."""

from groundwalk.artefacts.registry import Lazy
from groundwalk.localisation.localiser_settings import HLocSettings, MapSettings
from groundwalk.localisation.localisers import LocaliserFile, StructureLocaliser

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
)
