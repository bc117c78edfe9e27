"""A trained regressor as ONNX, for phones and other runtimes."""

from pathlib import Path

import torch
from torch import Tensor, nn

from groundwalk.artefacts import UserError
from groundwalk.training.build import Trained, load_trained
from groundwalk.training.data import normalised


class Exported(nn.Module):
    """An RGB image in 0..1 to position (m), unit xyzw quaternion and scene index, the normalisation included."""

    def __init__(self, model: nn.Module) -> None:
        super().__init__()
        self.model = model

    def forward(self, image_13HW: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        poses = self.model(normalised(image_13HW))
        return poses.position_B3, poses.quaternion_B4, poses.scene_B


def export_onnx(weights: Path, out: Path) -> Trained:
    """Write the model of a weights file as ONNX for one image of its crop size.

    Input `image` (1, 3, crop, crop), RGB in 0..1; outputs `position` (1, 3), `quaternion` (1, 4) of map_T_cam and
    `scene` (1,). The image is the middle of the one that `Trained` describes, which is returned. UserError where the
    weights can't be read or the exporter isn't installed.
    """
    trained = load_trained(weights)
    image = torch.zeros(1, 3, trained.crop, trained.crop)
    try:
        program = torch.onnx.export(
            Exported(trained.model).eval(),
            (image,),
            dynamo=True,
            input_names=["image"],
            output_names=["position", "quaternion", "scene"],
            verbose=False,
        )
    except ImportError as error:
        raise UserError("exporting needs more packages", found=error, do="pip install onnx onnxscript") from None
    out.parent.mkdir(parents=True, exist_ok=True)
    program.save(out)  # type: ignore[union-attr]
    return trained
