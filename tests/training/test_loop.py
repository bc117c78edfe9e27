from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.training import loop
from groundwalk.training.data import Frames, ImageCache, View
from groundwalk.training.loop import epoch_batches, held_out_score, learning_rate, take_best, train
from groundwalk.training.models.posenet import PoseNet
from groundwalk.training.models.regressor import BackboneRegressor, FrozenRegressor, PoseRegressor
from groundwalk.training.poses import PoseBatch, exp_quaternion
from groundwalk.training.predict import mean_pose_errors, pose_errors
from groundwalk.training.regressor_settings import MSTransformerSettings, PoseNetSettings, Recipe
from groundwalk.training.sources import Run

CPU = torch.device("cpu")


class SmallRegressor(BackboneRegressor):
    """Few weights, but batch norm and dropout, whose state a resumed run must have too."""

    def __init__(self) -> None:
        super().__init__(PoseNetSettings(), 1, False)
        self.net = nn.Sequential(
            nn.Conv2d(3, 8, 5, 4), nn.BatchNorm2d(8), nn.ReLU(), nn.Flatten(), nn.Dropout(0.3), nn.LazyLinear(6)
        )
        self.net(torch.zeros(2, 3, 32, 32))

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        output = self.net(image_B3HW)
        scene = torch.zeros(len(output), dtype=torch.long)
        return self.frames.to_map(output[:, :3], exp_quaternion(output[:, 3:]), scene)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        found = self(image_B3HW)
        return self.loss_weights(
            (found.position_B3 - poses.position_B3).abs().mean(),
            (found.quaternion_B4 - poses.quaternion_B4).abs().mean(),
        )


def silent(done: int, note: str = "") -> None:
    """Progress that nobody watches."""


def random_frames(folder: Path, count: int) -> Frames:
    """Frames whose images are noise: nothing to learn but by heart."""
    rng = np.random.default_rng(0)
    folder.mkdir()
    np.save(folder / "shapes.npy", np.tile([36, 48], (count, 1)))
    rng.integers(0, 255, count * 36 * 48 * 3, dtype=np.uint8).tofile(folder / "pixels.u8")
    quaternion = rng.normal([0, 0, 0, 4], 1, (count, 4))
    quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
    K = np.tile(np.array([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]), (count, 1, 1))
    position = rng.uniform(-5, 5, (count, 3))
    gravity = np.tile([0.0, 1, 0], (count, 1))
    scene = np.zeros(count, np.int64)
    return Frames(ImageCache(folder), np.arange(count), K, position, quaternion, scene, gravity)


@pytest.mark.slow
def test_overfits_a_few_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    frames = random_frames(tmp_path / "images", 8)
    torch.manual_seed(0)
    monkeypatch.setattr(PoseNetSettings, "training", Recipe(schedule="cosine", turn_deg=(0, 0, 0)))
    chosen = PoseNetSettings(epochs=40, batch=8, learning_rate=1e-3, dropout=0.0)
    model = PoseNet(chosen)
    model.frames.fit(frames.poses(CPU), True, True)
    train(silent, model, frames, frames, Run("test", chosen, CPU, "fp32", View(32, 32), 0, tmp_path))
    history = take_best(model, tmp_path)
    assert history[-1]["train_loss"] < history[0]["train_loss"] - 2
    both = zip(pose_errors(model, frames, View(32, 32), CPU), mean_pose_errors(frames, frames), strict=True)
    position, rotation = (float(np.median(error) / np.median(of_mean)) for error, of_mean in both)
    assert position < 0.2 and rotation < 0.4


def check_resumed(
    monkeypatch: pytest.MonkeyPatch, folder: Path, frames: Frames, made: Callable[[], PoseRegressor], run: Run
) -> None:
    """A run that is killed in its third epoch and goes on ends in the weights and curves of one that wasn't."""

    def trained(name: str) -> tuple[dict[str, Tensor], list[dict[str, object]]]:
        torch.manual_seed(3)
        model = made()
        train(silent, model, frames, frames, replace(run, folder=folder / name, checkpoint_s=0))
        history = take_best(model, folder / name)
        return model.state_dict(), [{k: v for k, v in row.items() if k != "seconds"} for row in history]

    class Killed(Exception):
        pass

    def killed_at_3(history: list[dict[str, Any]]) -> float:
        if len(history) == 3:
            raise Killed
        return held_out_score(history)

    whole, whole_history = trained("whole")
    with monkeypatch.context() as patched:
        patched.setattr(loop, "held_out_score", killed_at_3)
        with pytest.raises(Killed):
            trained("killed")
    with monkeypatch.context() as patched:
        if isinstance(made(), FrozenRegressor):
            patched.setattr(Frames, "training_crops", None)  # features aren't computed again
        resumed, resumed_history = trained("killed")
    assert resumed_history == whole_history and resumed.keys() == whole.keys()
    for name, tensor in whole.items():
        assert torch.equal(tensor, resumed[name]), name


def test_a_resumed_run_ends_in_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = PoseNetSettings(epochs=5, batch=4, learning_rate=1e-2, recipe="few_images")
    run = Run("test", settings, CPU, "fp32", View(32, 32), 7, tmp_path)
    check_resumed(monkeypatch, tmp_path, random_frames(tmp_path / "images", 10), SmallRegressor, run)


def test_a_diverging_run_says_so(tmp_path: Path) -> None:
    frames = random_frames(tmp_path / "images", 4)
    settings = PoseNetSettings(epochs=20, batch=4, learning_rate=1e30)
    advice = r"lower \[train\.regressors\.test\] learning_rate in data/scenes/"
    with pytest.raises(UserError, match=rf"loss is not finite[\s\S]*{advice}"):
        train(silent, SmallRegressor(), frames, frames, Run("test", settings, CPU, "fp32", View(32, 32), 0, tmp_path))


def test_learning_rates() -> None:
    cosine = PoseNetSettings(epochs=10, learning_rate=1.0, recipe="few_images")  # warms up for 3 epochs
    rates = [learning_rate(cosine, e) for e in np.arange(0, 10, 0.25)]
    assert np.argmax(rates) == 12 and rates[12] == pytest.approx(1)
    assert np.all(np.diff(rates[:13]) > 0) and np.all(np.diff(rates[12:]) < 0) and rates[-1] < 0.01
    published = MSTransformerSettings(epochs=12, learning_rate=1.0)
    assert [learning_rate(published, e) for e in (3.9, 4, 8)] == pytest.approx([1, 0.1, 0.01])


def test_batches_hold_every_row_and_as_many_of_each_scene() -> None:
    scene_N = np.repeat([0, 1], [21, 8])
    batches = list(epoch_batches(scene_N, 8, np.random.default_rng(0)))
    rows = np.concatenate(batches)
    assert set(rows) == set(range(29))
    assert np.bincount(scene_N[rows]).tolist() == [21, 21]
    assert min(map(len, batches)) >= 7 and max(map(len, batches)) <= 8
