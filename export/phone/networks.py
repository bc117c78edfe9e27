"""A regressor's network as ONNX."""

import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.training.build import Trained

INPUT = "image"
OUTPUTS = ("position", "quaternion", "scene", "covariance")


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
