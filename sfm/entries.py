"""Records of groundwalk's own mappers and retrieval."""

from groundwalk.sfm.extensions import MapperEntry, RetrievalEntry
from groundwalk.store.registry import Lazy

INCREMENTAL = MapperEntry(
    id="incremental",
    label="incremental",
    meaning="COLMAP's incremental mapping",
    run=Lazy("groundwalk.sfm.mapping.mappers:incremental"),
)
GLOBAL = MapperEntry(
    id="global",
    label="global",
    meaning="COLMAP's global mapping",
    run=Lazy("groundwalk.sfm.mapping.mappers:global_"),
)
HIERARCHICAL = MapperEntry(
    id="hierarchical",
    label="hierarchical",
    meaning="COLMAP's hierarchical mapping",
    run=Lazy("groundwalk.sfm.mapping.mappers:hierarchical"),
)
FROM_VIO = MapperEntry(
    id="vio",
    label="from VIO",
    meaning="points triangulated from VIO's poses, then adjusted",
    run=Lazy("groundwalk.sfm.mapping.mappers:from_vio"),
)
VLAD = RetrievalEntry(
    id="vlad",
    label="VLAD",
    meaning="VLAD over words learned from the scene",
    describe=Lazy("groundwalk.sfm.pairs.retrieval:vlad"),
)
PCA_VLAD = RetrievalEntry(
    id="pca-vlad",
    label="PCA-VLAD",
    meaning="VLAD over the features' principal components",
    describe=Lazy("groundwalk.sfm.pairs.retrieval:pca_vlad"),
)
