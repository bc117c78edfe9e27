from pathlib import Path

import pytest
import torch

from groundwalk.store import UserError
from groundwalk.training import weights
from groundwalk.training.build import Trained, load_trained, save_trained
from groundwalk.training.models.ms_transformer import MSTransformer
from groundwalk.training.models.posenet import PoseNet, ResNet34
from groundwalk.training.models.posenet_lite import PoseNetLite
from groundwalk.training.models.regressor import BackboneRegressor
from groundwalk.training.regressor_settings import LiteSettings, MSTransformerSettings, PoseNetSettings
from groundwalk.training.weights import load_first_weights


def of_torchvision() -> dict[str, torch.Tensor]:
    """ResNet-34's state dict as torchvision has it: with a classifier."""
    return {**ResNet34().state_dict(), "fc.weight": torch.zeros(1000, 512), "fc.bias": torch.zeros(1000)}


def fill(model: BackboneRegressor, weights: str, downloads: Path) -> str:
    return load_first_weights(model.backbone, model.backbone_url, weights, downloads)


def test_a_state_dict_of_torchvision_fills_the_backbone(tmp_path: Path) -> None:
    source = of_torchvision()
    torch.save(source, tmp_path / "resnet34.pth")
    model = PoseNet(PoseNetSettings())
    origin = fill(model, str(tmp_path / "resnet34.pth"), tmp_path)
    assert origin.startswith("file resnet34.pth, sha256 ")
    for name, tensor in model.backbone.state_dict().items():
        assert torch.equal(tensor, source[name]), name


def test_a_file_of_another_network_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "weights.pth"
    with pytest.raises(UserError, match="isn't there"):
        fill(PoseNet(PoseNetSettings()), str(path), tmp_path)
    path.write_text("nothing")
    with pytest.raises(UserError, match="can't be read"):
        fill(PoseNet(PoseNetSettings()), str(path), tmp_path)
    torch.save(of_torchvision(), path)
    with pytest.raises(UserError, match=r"another network[\s\S]*missing"):
        fill(MSTransformer(MSTransformerSettings(layers=1)), str(path), tmp_path)
    torch.save([1, 2], path)
    with pytest.raises(UserError, match="no state dict"):
        fill(PoseNet(PoseNetSettings()), str(path), tmp_path)


def test_weights_that_cannot_be_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(url: str, path: Path) -> None:
        raise OSError("no route")

    monkeypatch.setattr(weights, "_download", unreachable)
    model = PoseNet(PoseNetSettings())
    assert fill(model, "auto", tmp_path) == "scratch (ImageNet weights could not be fetched: no route)"
    with pytest.raises(UserError, match=r"no route[\s\S]*resnet34-b627a593\.pth"):
        fill(model, "imagenet", tmp_path)
    # Put there by hand, the file is used without a network.
    torch.save(of_torchvision(), tmp_path / "resnet34-b627a593.pth")
    assert fill(model, "auto", tmp_path).startswith("ImageNet, resnet34-b627a593.pth, sha256 ")


def test_a_weights_file_of_another_version_or_cut_short_says_so(tmp_path: Path) -> None:
    file = tmp_path / "PN-Lite.pt"
    settings = LiteSettings()
    trained = Trained(PoseNetLite(settings), ["Church"], 120, 120, None, 160, True)
    save_trained(file, "PN-Lite", settings, trained)
    assert load_trained(file).width == 160
    content = torch.load(file, weights_only=True)
    del content["state"]["whitening.axes"]
    torch.save(content, file)
    with pytest.raises(UserError, match="don't fit the model") as caught:
        load_trained(file)
    assert "whitening.axes" in str(caught.value) and "run the stage train again" in str(caught.value)
    file.write_bytes(file.read_bytes()[:1000])
    with pytest.raises(UserError, match="not a trained model"):
        load_trained(file)
