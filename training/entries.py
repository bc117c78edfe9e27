"""Records of groundwalk's own regressors."""

from groundwalk.store import colours
from groundwalk.store.registry import Lazy
from groundwalk.training.regressor_settings import (
    ADPoseNetSettings,
    LiteSettings,
    MapNetSettings,
    MSTransformerSettings,
    PoseNetSettings,
)
from groundwalk.training.regressors import Regressor

PN = Regressor(
    id="PN",
    label="PN",
    meaning="PoseNet on ResNet-34 with log-quaternions",
    colour=colours.LOCALISERS["PN"],
    settings=PoseNetSettings,
    make=Lazy("groundwalk.training.models.posenet:PoseNet"),
    multi_scene=False,
    gives_covariance=False,
    in_paper=True,
)
MAPNET = Regressor(
    id="MapNet",
    label="MapNet",
    meaning="PN that also learns the motion between frames",
    colour=colours.LOCALISERS["MapNet"],
    settings=MapNetSettings,
    make=Lazy("groundwalk.training.models.mapnet:MapNet"),
    multi_scene=False,
    gives_covariance=False,
)
BAYESIAN_PN = Regressor(
    id="PN-Bayesian",
    label="Bayesian PN",
    meaning="PN with dropout at test time",
    colour=colours.LOCALISERS["PN-Bayesian"],
    settings=PoseNetSettings,
    make=Lazy("groundwalk.training.models.bayesian_posenet:BayesianPoseNet"),
    multi_scene=False,
    gives_covariance=True,
)
AD_POSENET = Regressor(
    id="AD-PoseNet",
    label="AD-PoseNet",
    meaning="PN with parts of the image hidden in training and testing",
    colour=colours.LOCALISERS["AD-PoseNet"],
    settings=ADPoseNetSettings,
    make=Lazy("groundwalk.training.models.ad_posenet:ADPoseNet"),
    multi_scene=False,
    gives_covariance=True,
)
COORDINET = Regressor(
    id="CoordiNet",
    label="CoordiNet",
    meaning="PN with coordinate channels and learned uncertainty",
    colour=colours.LOCALISERS["CoordiNet"],
    settings=PoseNetSettings,
    make=Lazy("groundwalk.training.models.coordinet:CoordiNet"),
    multi_scene=False,
    gives_covariance=True,
)
MS_T = Regressor(
    id="MS-T",
    label="MS-T",
    meaning="multi-scene transformer on EfficientNet-B0",
    colour=colours.LOCALISERS["MS-T"],
    settings=MSTransformerSettings,
    make=Lazy("groundwalk.training.models.ms_transformer:MSTransformer"),
    multi_scene=True,
    gives_covariance=False,
    in_paper=True,
)
PN_LITE = Regressor(
    id="PN-Lite",
    label="PN-Lite",
    meaning="mixture of poses on frozen features of EfficientNet-Lite0",
    colour=colours.LOCALISERS["PN-Lite"],
    settings=LiteSettings,
    make=Lazy("groundwalk.training.models.posenet_lite:PoseNetLite"),
    whole_image_px=120,
    multi_scene=False,
    gives_covariance=True,
)
