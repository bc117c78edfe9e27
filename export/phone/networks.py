"""A regressor's network as ONNX, and as Core ML where Apple's converter is installed."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.training.build import Trained

INPUT = "image"
OUTPUTS = ("position", "quaternion", "scene", "covariance")
PACKAGE = "network.mlpackage"
NOT_INSTALLED = "no Core ML network: coremltools isn't installed (pip install coremltools, then export again)"


class Exported(nn.Module):
    """A normalised image (1, 3, H, W) to position (m), unit xyzw quaternion of map_T_cam, scene index and, from a
    regressor that gives one, covariance."""

    def __init__(self, model: nn.Module, gives_covariance: bool) -> None:
        super().__init__()
        self.model = model
        self.gives_covariance = gives_covariance

    def forward(self, image_13HW: Tensor) -> tuple[Tensor, ...]:
        poses = self.model(image_13HW)
        answer = poses.position_B3, poses.quaternion_B4, poses.scene_B
        return (*answer, poses.covariance_B66) if self.gives_covariance else answer


def exported(trained: Trained, height: int, width: int) -> tuple[Exported, Tensor, list[str]]:
    """The module, an input of that size, and the names of its outputs."""
    image = torch.zeros(1, 3, height, width)
    with torch.no_grad():
        gives_covariance = trained.model(image).covariance_B66 is not None
    module = Exported(trained.model, gives_covariance).eval()
    return module, image, list(OUTPUTS[: 4 if gives_covariance else 3])


def write_onnx(trained: Trained, height: int, width: int, out: Path) -> None:
    """Write the network for one image; UserError where the exporter isn't installed."""
    module, image, outputs = exported(trained, height, width)
    try:
        with quiet():
            program = torch.onnx.export(
                module, (image,), dynamo=True, input_names=[INPUT], output_names=outputs, verbose=False
            )
    except ImportError as error:
        do = "pip install 'groundwalk[phone]', or onnx and onnxscript"
        raise UserError("exporting needs more packages", found=error, do=do) from None
    for node in program.model.graph:  # type: ignore[union-attr]
        node.metadata_props.clear()  # the exporter's call stacks: megabytes that no one reads
    program.save(out, external_data=False)  # type: ignore[union-attr]


@contextmanager
def quiet() -> Iterator[None]:
    """Without the converters' remarks on what they skip, which aren't for the user."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


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
