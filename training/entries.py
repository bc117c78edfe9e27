"""Records of groundwalk's own regressors."""

from groundwalk.store import colours
from groundwalk.store.registry import Lazy
from groundwalk.training.regressor_settings import LiteSettings, MSTransformerSettings, PoseNetSettings
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
