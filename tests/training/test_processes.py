"""Training by two processes that share each batch, beside the same training by one."""

import os
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from torch import Tensor, nn

from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.child import Report, Task, in_children
from groundwalk.training import processes
from groundwalk.training.data import Frames, View, jittered
from groundwalk.training.definition import STAGE
from groundwalk.training.loop import CHECKPOINT, train
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.processes import Part, joined
from groundwalk.training.regressor_settings import PoseNetSettings
from groundwalk.training.sources import Run
from tests.training.test_loop import CPU, SmallRegressor, random_frames, silent


def run_of(folder: Path, epochs: int) -> Run:
    """Batches of 5 images, of which two processes have 3 and 2."""
    settings = PoseNetSettings(epochs=epochs, batch=6, learning_rate=1e-3, jitter=(0.2, 0.2, 0.2, 0.1))
    return Run("test", settings, CPU, "fp32", View(32, 32), 7, folder, checkpoint_s=0)


def made() -> PoseRegressor:
    torch.manual_seed(3)
    model = SmallRegressor()
    # Each process drops others; and what batch norm takes out again has rounding errors for a gradient.
    for module in model.net:
        if isinstance(module, nn.Dropout):
            module.p = 0.0
    model.net[0].register_parameter("bias", None)
    return model


def part_of_training(report: Report, frames: Frames, run: Run, part: Part) -> None:
    torch.set_num_threads(1)
    with joined(part, run.device):
        train(silent, made(), frames, frames, run)


def trained(frames: Frames, run: Run, count: int) -> dict[str, Tensor]:
    """The weights after a training by so many processes."""
    run.folder.mkdir(exist_ok=True)
    parts = [Part(rank, count, run.folder / f"meeting{run.settings.epochs}") for rank in range(count)]
    if count == 1:
        part_of_training(silent, frames, run, parts[0])
    else:
        tasks = [Task(part_of_training, (frames, run, part), 0) for part in parts]
        in_children("training", run.folder / "log.txt", "look", tasks)
    return dict(torch.load(run.folder / CHECKPOINT)["model"])


def same_to_rounding(found: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, rtol=1e-4, atol=1e-5, msg=lambda text: f"{name}: {text}")  # noqa: B023


def test_random_numbers_of_a_frame_do_not_depend_on_who_draws_them(tmp_path: Path) -> None:
    frames = random_frames(tmp_path / "images", 5)
    for turn_deg in (None, (8.0, 3.0, 4.0)):
        rng = [np.random.default_rng(1) for _ in range(3)]
        whole, poses = frames.training_crops(View(32, 32), turn_deg, rng[0], CPU)
        whole = jittered(whole, (0.2, 0.2, 0.2, 0.1), rng[0])
        for rank in range(2):
            part = slice(rank, None, 2)
            mine, its_poses = frames.training_crops(View(32, 32), turn_deg, rng[rank + 1], CPU, part)
            mine = jittered(mine, (0.2, 0.2, 0.2, 0.1), rng[rank + 1], 5, part)
            assert torch.equal(mine, whole[part])
            assert torch.equal(its_poses.position_B3, poses.position_B3[part])
            assert torch.equal(its_poses.quaternion_B4, poses.quaternion_B4[part])


def test_two_processes_train_as_one_does_and_either_goes_on_from_the_others_checkpoint(tmp_path: Path) -> None:
    frames = random_frames(tmp_path / "images", 10)
    for epochs, count in ((3, 2), (4, 1), (5, 2)):
        found = trained(frames, run_of(tmp_path / "two", epochs), count)
        same_to_rounding(found, trained(frames, run_of(tmp_path / f"one-{epochs}", epochs), 1))
    curves = [torch.load(tmp_path / name / CHECKPOINT)["history"] for name in ("two", "one-5")]
    for two, one in zip(*curves, strict=True):
        assert two["train_loss"] == pytest.approx(one["train_loss"], rel=1e-5)


def fails(report: Report, part: Part, how: str) -> None:
    with joined(part, CPU):
        if part.rank and how == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if part.rank:
            raise UserError("the second one can't go on")
        processes.mean(torch.zeros(1))


@pytest.mark.parametrize(("how", "message"), [("dies", r"its process died \(SIGKILL\)"), ("raises", "can't go on")])
def test_one_that_fails_ends_all_with_its_own_message(tmp_path: Path, how: str, message: str) -> None:
    tasks = [Task(fails, (Part(rank, 2, tmp_path / "meeting"), how), 0) for rank in range(2)]
    with pytest.raises(UserError, match=message):
        in_children("training", tmp_path / "log.txt", "look", tasks)


def test_batches_that_cannot_be_shared_are_refused(tmp_path: Path) -> None:
    for count, batch in ((3, 16), (4, 4)):
        settings = [f"processes={count}", f"regressors.PN.batch={batch}", "regressors.MS-T.batch=12"]
        with pytest.raises(UserError, match=rf"{count} processes can't share .* {batch} images[\s\S]*divides"):
            execute(STAGE, "Wall", "tiny", DataRoot(tmp_path), settings)


@pytest.mark.slow
def test_the_stage_trains_the_papers_regressors_by_two_processes(make_scene: Callable[..., Path]) -> None:
    data = DataRoot(make_scene())
    settings = ["resize=40", "crop=32", "device=cpu", "precision=fp32"]
    for name in ("PN", "MS-T"):
        more = {"epochs": 2, "batch": 4, "dropout": 0, "weights": "scratch", "learning_rate": 1e-4}
        settings += [f"regressors.{name}.{key}={value}" for key, value in more.items()]
    losses, positions = [], []
    for count in (1, 2):
        folder = execute(STAGE, "Wall", "tiny", data, [*settings, f"processes={count}"], force=True)
        losses.append(pd.read_parquet(folder / "history.parquet")["train_loss"].to_numpy())
        predictions = pd.read_parquet(folder / "predictions.parquet")
        positions.append(predictions[[f"map_cam_t{axis}" for axis in "xyz"]].to_numpy())
    # Adam makes a step of rounding errors where a weight's gradient is no larger.
    assert losses[1] == pytest.approx(losses[0], rel=1e-3) and positions[1] == pytest.approx(positions[0], abs=0.02)
    # What it makes doesn't depend on their number: it is up to date for any.
    written = (folder / "manifest.json").read_text()
    execute(STAGE, "Wall", "tiny", data, [*settings, "processes=1"])
    assert (folder / "manifest.json").read_text() == written
