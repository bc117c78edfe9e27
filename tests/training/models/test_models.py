import pytest
import torch
from torch import nn

from groundwalk.store import UserError
from groundwalk.training.models.efficientnet import EfficientNetB0
from groundwalk.training.models.ms_transformer import MSTransformer
from groundwalk.training.models.posenet import ResNet34
from groundwalk.training.models.regressor import BackboneRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressors import REGRESSORS


def some_poses(count: int, scenes: int = 1) -> PoseBatch:
    generator = torch.Generator().manual_seed(1)
    quaternion = nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    return PoseBatch(5 * torch.randn(count, 3, generator=generator), quaternion, torch.arange(count) % scenes)


def images(count: int, side: int = 32) -> torch.Tensor:
    return torch.randn(count, 3, side, side, generator=torch.Generator().manual_seed(2))


def made(name: str, scenes: int = 1) -> BackboneRegressor:
    """A regressor with little dropout, MS-T with a layer a transformer."""
    torch.manual_seed(0)
    entry = REGRESSORS[name]
    more = {"layers": 1} if name == "MS-T" else {}
    model = entry.make(entry.settings(**{"dropout": 0.05, **more}), scenes, True)
    assert isinstance(model, BackboneRegressor)
    return model


@pytest.mark.parametrize(("name", "mib"), [("PN", 85.3), ("MS-T", 70.9)])
def test_sizes_are_those_published(name: str, mib: float) -> None:
    entry = REGRESSORS[name]
    assert entry.make(entry.settings(), 1, True).bytes() / 2**20 == pytest.approx(mib, abs=0.05)


@pytest.mark.parametrize(
    ("backbone", "parameters", "tensors", "shapes"),
    [
        (
            ResNet34(),
            21_284_672,
            216,
            {
                "conv1.weight": (64, 3, 7, 7),
                "layer1.2.bn2.running_var": (64,),
                "layer2.0.downsample.0.weight": (128, 64, 1, 1),
                "layer4.2.conv2.weight": (512, 512, 3, 3),
            },
        ),
        (
            EfficientNetB0(),
            5_288_548,
            360,
            {
                "features.0.0.weight": (32, 3, 3, 3),
                "features.1.0.block.1.fc1.weight": (8, 32, 1, 1),
                "features.2.0.block.2.fc2.bias": (96,),
                "features.3.1.block.1.0.weight": (240, 1, 5, 5),
                "features.7.0.block.3.0.weight": (320, 1152, 1, 1),
                "features.8.1.running_mean": (1280,),
                "classifier.1.weight": (1000, 1280),
            },
        ),
    ],
)
def test_backbones_have_the_layout_of_torchvision(
    backbone: nn.Module, parameters: int, tensors: int, shapes: dict[str, tuple[int, ...]]
) -> None:
    state = backbone.state_dict()
    assert sum(p.numel() for p in backbone.parameters()) == parameters
    assert len(state) == tensors
    assert {name: tuple(state[name].shape) for name in shapes} == shapes
    assert all(m.eps == 1e-5 for m in backbone.modules() if isinstance(m, nn.BatchNorm2d))


@pytest.mark.parametrize("name", ["PN", "MS-T"])
def test_training_reaches_every_part_and_evaluation_is_deterministic(name: str) -> None:
    model = made(name, 2 if name == "MS-T" else 1).train()
    model.loss(images(6), some_poses(6, model.scenes)).backward()
    unused = ("backbone.features.6", "backbone.features.7", "backbone.features.8", "backbone.classifier")
    for part, parameter in model.named_parameters():
        if part.startswith(unused):
            assert parameter.grad is None, part
        elif parameter.requires_grad:
            assert parameter.grad is not None, part
            assert torch.isfinite(parameter.grad).all(), part
    model.eval()
    first, second = model(images(4)), model(images(4))
    assert all(torch.equal(a, b) for a, b in zip(first[:3], second[:3], strict=True))
    assert torch.allclose(first.quaternion_B4.norm(dim=-1), torch.ones(4), atol=1e-5)
    assert (first.quaternion_B4[:, 3] >= 0).all()


@pytest.mark.parametrize("name", ["PN", "MS-T"])
def test_both_signs_of_a_quaternion_are_the_same_rotation(name: str) -> None:
    model, poses = made(name).eval(), some_poses(6)
    other = poses._replace(quaternion_B4=-poses.quaternion_B4)
    assert torch.allclose(model.loss(images(6), poses), model.loss(images(6), other))


def test_scene_is_the_true_one_in_training_and_the_likeliest_in_testing(monkeypatch: pytest.MonkeyPatch) -> None:
    model = made("MS-T", 2)
    assert isinstance(model, MSTransformer)
    position_BSC, rotation_BSC = torch.randn(3, 2, 256), torch.randn(3, 2, 256)
    logits_BS = torch.tensor([[0.0, 1], [2, 0], [0, 3]])
    monkeypatch.setattr(model, "_decode", lambda _: (position_BSC, rotation_BSC, logits_BS))
    rows, likeliest = torch.arange(3), torch.tensor([1, 0, 1])
    picked = model(images(3))
    assert torch.equal(picked.scene_B, likeliest)
    assert torch.allclose(picked.position_B3, model.position_head(position_BSC[rows, likeliest]), atol=1e-5)

    # A true pose that equals what the true scene's vectors give has no pose error: what is left is the classifier's.
    true = 1 - likeliest
    position = model.position_head(position_BSC[rows, true])
    quaternion = nn.functional.normalize(model.rotation_head(rotation_BSC[rows, true]), dim=-1)
    loss = model.loss(images(3), PoseBatch(position, quaternion, true))
    weights = model.loss_weights.sx + model.loss_weights.sq
    assert float((loss - weights).detach()) == pytest.approx(
        float(-logits_BS.log_softmax(dim=1)[rows, true].mean()), abs=1e-3
    )


def test_a_crop_beyond_the_embedded_cells_is_refused() -> None:
    model = made("MS-T")
    assert isinstance(model, MSTransformer)
    assert model._place(torch.zeros(1, 1, 50, 50)).shape == (2500, 256)
    with pytest.raises(UserError, match=r"(?s)400 px a side at most.*56 x 56 cells.*crop"):
        model._place(torch.zeros(1, 1, 56, 56))


def test_frames_of_the_network_are_undone() -> None:
    model = made("PN")
    poses = some_poses(20)
    model.frames.fit(poses, normalise_position=True, centre_rotation=True)
    position, quaternion = model.frames.from_map(poses)
    assert torch.allclose(position.mean(0), torch.zeros(3), atol=1e-5)
    assert float(position.square().mean()) == pytest.approx(1, abs=1e-3)
    back = model.frames.to_map(position, quaternion, poses.scene_B)
    assert torch.allclose(back.position_B3, poses.position_B3, atol=1e-5)
    dots = (back.quaternion_B4 * poses.quaternion_B4).sum(-1).abs()
    assert torch.allclose(dots, torch.ones(20), atol=1e-5)
