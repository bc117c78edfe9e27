"""What ALIKED and LightGlue need: their model files, and a COLMAP that was built to run networks."""

from pathlib import Path
from typing import Any

import pycolmap

from groundwalk.artefacts import UserError
from groundwalk.artefacts.hints import setting_of
from groundwalk.sfm.settings import SfmSettings

_DO = "install a pycolmap that was built with ONNX (COLMAP's ONNX_ENABLED), or set {setting}"
_SIFT, _NEAREST = (setting_of("sfm", setting) for setting in ('features = "sift"', 'sift_matcher = "nearest"'))


def model_files(settings: SfmSettings) -> dict[str, str]:
    """The settings that name the model files which these settings need, and the files."""
    if settings.features == "aliked":
        names: tuple[str, ...] = ("aliked_model", "aliked_lightglue_model")
    elif settings.sift_matcher == "lightglue":
        names = ("sift_lightglue_model",)
    else:
        names = ()
    return {name: getattr(settings, name) for name in names}


def require_model_files(settings: SfmSettings) -> None:
    """UserError where a model file that the settings need isn't there. COLMAP would download it; nothing here does."""
    for name, file in model_files(settings).items():
        if not Path(file).is_file():
            raise UserError(
                f"the model file that {name} names is missing",
                where=Path(file).absolute(),
                expected="the ONNX file that COLMAP publishes with its releases",
                found="no such file",
                do=f"put it there, name it in {setting_of('sfm', name)}, or set {_without(settings)}",
            )


def options_of_network(options: Any, name: str) -> Any:
    """A network's options among COLMAP's; UserError where COLMAP has none, as it was built without ONNX."""
    if not hasattr(options, name):
        raise UserError(
            "this pycolmap can't run networks",
            where=pycolmap.__file__,
            expected="COLMAP built with ONNX",
            found=f"its {type(options).__name__} has no {name}",
            do=_DO.format(setting=f"{_SIFT} and {_NEAREST}"),
        )
    return getattr(options, name)


def cannot_run(settings: SfmSettings, error: Exception) -> UserError:
    """The error for the user where COLMAP raised `error` as the networks were tried."""
    return UserError(
        "this pycolmap can't run the networks that the settings ask for",
        where=", ".join(model_files(settings).values()),
        expected="COLMAP built with ONNX, and the model files that COLMAP publishes with its releases",
        found=error,
        do=_DO.format(setting=_without(settings)),
    )


def _without(settings: SfmSettings) -> str:
    return _SIFT if settings.features == "aliked" else _NEAREST
