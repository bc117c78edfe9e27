"""A regressor's network as Core ML, where Apple's converter is installed."""

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from groundwalk.export.phone.networks import INPUT, exported, quiet
from groundwalk.training.build import Trained

PACKAGE = "network.mlpackage"
NOT_INSTALLED = "no Core ML network: coremltools isn't installed (pip install coremltools, then export again)"


def write_coreml(trained: Trained, height: int, width: int, folder: Path) -> str:
    """Write the network as an ML program in half precision; "", or why there is none."""
    try:
        import coremltools
    except ImportError:
        return NOT_INSTALLED
    module, image, outputs = exported(trained, height, width)
    try:
        with quiet():
            program = torch.export.export(module, (image,)).run_decompositions(_PLAIN)
        converted: Any = coremltools.convert(
            program,
            inputs=[coremltools.TensorType(INPUT, image.shape)],
            outputs=[coremltools.TensorType(name) for name in outputs],
            minimum_deployment_target=coremltools.target.iOS16,
            compute_precision=coremltools.precision.FLOAT16,
        )
        converted.save(str(folder / PACKAGE))
    except Exception as error:  # the converter raises whatever an operation of a plug-in's network leads to
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        return f"no Core ML network: coremltools {coremltools.__version__} can't convert it ({reason})"
    return ""


def _sinc(x: Tensor) -> Tensor:
    scaled = torch.pi * x
    small = scaled.abs() < 1e-4
    return torch.where(small, 1 - scaled * scaled / 6, torch.sin(scaled) / torch.where(small, 1.0, scaled))


def _cross(a: Tensor, b: Tensor, *, dim: int = -1) -> Tensor:
    a0, a1, a2, b0, b1, b2 = (x.select(dim, i) for x in (a, b) for i in range(3))
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], dim)


# What the converter doesn't know, in operations that it does.
_PLAIN: Any = {torch.ops.aten.sinc.default: _sinc, torch.ops.aten.linalg_cross.default: _cross}
