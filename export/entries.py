"""Records of groundwalk's own export formats."""

from dataclasses import replace
from functools import partial

from groundwalk.export.colmap import DISTORTION as OF_COLMAP
from groundwalk.export.colmap import write_colmap, write_hloc, write_kapture
from groundwalk.export.exporters import Exporter
from groundwalk.export.huggingface import write_huggingface
from groundwalk.export.nerfstudio import DISTORTION, write_nerfstudio, write_splat
from groundwalk.export.sequences import write_cambridge, write_euroc, write_seven_scenes, write_tum

COLMAP = Exporter(
    id="colmap",
    label="COLMAP",
    meaning="COLMAP's binary model beside images/",
    write=write_colmap,
    distortion_coefficients=OF_COLMAP,
    cameras="alike",
)
COLMAP_TEXT = replace(
    COLMAP,
    id="colmap-text",
    label="COLMAP, text",
    meaning="COLMAP's text model beside images/",
    write=partial(write_colmap, text=True),
)
TUM = Exporter(
    id="tum",
    label="TUM RGB-D",
    meaning="groundtruth.txt and rgb.txt for each session",
    write=write_tum,
    distortion_coefficients=None,
)
NERFSTUDIO = Exporter(
    id="nerfstudio",
    label="nerfstudio",
    meaning="transforms.json beside images/",
    write=write_nerfstudio,
    distortion_coefficients=len(DISTORTION),
)
SPLAT = Exporter(
    id="splat",
    label="Gaussian splatting",
    meaning="undistorted images with COLMAP's model, points.ply and transforms.json",
    write=write_splat,
    distortion_coefficients=0,
    cameras="pinhole",
)
SEVEN_SCENES = Exporter(
    id="7scenes",
    label="7-Scenes",
    meaning="a color image and a pose file for each frame",
    write=write_seven_scenes,
    distortion_coefficients=0,
)
CAMBRIDGE = Exporter(
    id="cambridge",
    label="Cambridge Landmarks",
    meaning="dataset_train.txt and dataset_test.txt beside the images",
    write=write_cambridge,
    distortion_coefficients=0,
)
EUROC = Exporter(
    id="euroc",
    label="EuRoC",
    meaning="mav0/cam0 with undistorted images and ground truth for each session",
    write=write_euroc,
    distortion_coefficients=0,
    cameras="pinhole",
)
HLOC = Exporter(
    id="hloc",
    label="hloc",
    meaning="a reference model and lists of queries for hloc's scripts",
    write=write_hloc,
    distortion_coefficients=OF_COLMAP,
    cameras="alike",
)
KAPTURE = Exporter(
    id="kapture",
    label="kapture",
    meaning="kapture 1.1, one of the frames for mapping and one of the queries",
    write=write_kapture,
    distortion_coefficients=OF_COLMAP,
    cameras="alike",
)
HUGGINGFACE = Exporter(
    id="huggingface",
    label="Hugging Face",
    meaning="Parquet with images, a dataset card and Croissant metadata",
    write=write_huggingface,
    distortion_coefficients=None,
)
