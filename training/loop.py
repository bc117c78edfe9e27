"""The training loop, the same for every regressor, and whether one gives what it needs."""

import copy
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from groundwalk.store import UserError
from groundwalk.store.child import Report
from groundwalk.store.files import written_aside
from groundwalk.store.hints import setting_of
from groundwalk.training import processes
from groundwalk.training.data import Frames, View, normalised
from groundwalk.training.models.regressor import FrozenRegressor, PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.sources import FeatureSource, ImageSource, Run
from groundwalk.training.steps import GradientStep, gradient_step

CHECKPOINT = "checkpoint.pt"
_SCORED_EPOCHS = 5
_GROWTH = 10.0  # by how many times itself the first epoch's loss may grow
_CHECKED = 2  # images that a regressor is asked for before
_UNIT = 1e-3


def train(report: Report, model: PoseRegressor, training: Frames, held_out: Frames, run: Run) -> None:
    """Train `model` until the checkpoint in `run.folder` holds all its epochs; `take_best` reads it. Of several
    processes the first one tests and writes.

    The best epoch has the smallest `held_out_score`. UserError where the loss isn't finite or grows; the checkpoint is
    then the last one before.

    Everything random in an epoch comes from (seed, epoch), so a run that goes on from a checkpoint in `run.folder`
    ends, on a CPU, in the same weights to the bit as one that was never stopped.
    """
    model.to(run.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    settings = run.settings
    optimiser = make_optimiser(model, settings)
    history: list[dict[str, Any]] = []
    best: dict[str, Any] = {"score": math.inf, "epoch": 0, "weights": {}}
    if (run.folder / CHECKPOINT).exists():
        saved = torch.load(run.folder / CHECKPOINT, map_location=run.device)
        model.load_state_dict(saved["model"])
        optimiser.load_state_dict(saved["optimiser"])
        history, best = saved["history"], saved["best"]
    source: ImageSource | FeatureSource = ImageSource(model, training, held_out, run)
    if isinstance(model, FrozenRegressor):
        source = FeatureSource(report, model, training, held_out, run, resumed=bool(history))
    gradient = gradient_step(model, run.precision, run.device)

    report(len(history))
    saved_at = time.monotonic()
    for epoch in range(len(history), settings.epochs):
        started = time.monotonic()
        train_loss, rate = train_epoch(model, source, gradient, optimiser, epoch, run)
        if processes.rank():
            continue
        refuse_divergence(train_loss, rate, history, run)
        position_m, rotation_deg = source.errors()
        row = {
            "epoch": epoch + 1,
            "learning_rate": rate,
            "train_loss": train_loss,
            "val_position_m": float(np.median(position_m)),
            "val_rotation_deg": float(np.median(rotation_deg)),
            **model.curves(),
            "seconds": time.monotonic() - started,
        }
        history.append(row)
        score = held_out_score(history)
        # Scores of the first epochs are of fewer, so luck weighs more in them.
        if len(history) >= min(_SCORED_EPOCHS, settings.epochs) and score < best["score"]:
            weights = {name: tensor.clone() for name, tensor in model.state_dict().items()}
            best = {"score": score, "epoch": epoch + 1, "weights": weights}
        if epoch + 1 == settings.epochs or time.monotonic() - saved_at >= run.checkpoint_s:
            state = {"model": model.state_dict(), "optimiser": optimiser.state_dict()}
            save(run.folder / CHECKPOINT, {**state, "history": history, "best": best})
            saved_at = time.monotonic()
        position = row["val_position_m"]
        report(epoch + 1, f"{run.title} {position:.2f} {run.unit}, {row['val_rotation_deg']:.1f} deg")


def train_epoch(
    model: PoseRegressor,
    source: ImageSource | FeatureSource,
    gradient: GradientStep,
    optimiser: torch.optim.Optimizer,
    epoch: int,
    run: Run,
) -> tuple[float, float]:
    """One pass over the rows of `source`; returns the mean loss and the last step's learning rate."""
    settings = run.settings
    torch.manual_seed(run.seed * 100_003 + epoch + (processes.rank() << 40))  # dropout's, another one's own
    rng = np.random.default_rng([run.seed, epoch])
    model.train()
    batches = list(epoch_batches(source.scene_N, settings.batch, rng))
    losses, rate = [], 0.0
    for step, rows in enumerate(batches):
        rate = learning_rate(settings, epoch + step / len(batches))
        for group in optimiser.param_groups:
            group["lr"] = rate
        losses.append(gradient(*source.batch(rows, rng)))
        if settings.training.clip_gradient:
            torch.nn.utils.clip_grad_norm_(model.parameters(), settings.training.clip_gradient)
        optimiser.step()
    return processes.mean(torch.stack(losses).mean()).item(), rate


def refuse_divergence(train_loss: float, rate: float, history: list[dict[str, Any]], run: Run) -> None:
    """UserError where an epoch's mean loss isn't finite, or is far above that of the first epoch."""
    first = history[0]["train_loss"] if history else train_loss
    finite = math.isfinite(train_loss)
    if finite and train_loss <= first + _GROWTH * (1 + abs(first)):
        return
    checkpoint = run.folder / CHECKPOINT
    raise UserError(
        f"training {run.title} diverges: the loss {'grows' if finite else 'is not finite'}",
        where=f"last checkpoint before it: {checkpoint}" if checkpoint.exists() else None,
        found=f"{train_loss:.4g} in epoch {len(history) + 1} ({first:.4g} in the first), learning rate {rate:.2g}",
        do=f"lower {setting_of(f'train.regressors.{run.title}', 'learning_rate')}",
    )


def held_out_score(history: list[dict[str, Any]]) -> float:
    """How good the last epoch of a learning curve is, small is good: the product of the median position and rotation
    error over the held-out frames, as a geometric mean of the last few epochs.

    Held-out frames are few, and the smallest of many noisy products is one of luck.
    """
    recent = history[-_SCORED_EPOCHS:]
    return math.prod(row["val_position_m"] * row["val_rotation_deg"] for row in recent) ** (1 / len(recent))


def check_regressor(model: PoseRegressor, scenes: int, view: View, gives_covariance: bool) -> None:
    """Run a copy of the model, on a CPU, over two images of noise; ValueError or TypeError naming what isn't as it
    should be, before training and not hours later. The random numbers of PyTorch go on as if nothing had been drawn."""
    if not isinstance(model, PoseRegressor):
        raise TypeError(f"make returned a {type(model).__name__}, not a PoseRegressor")
    with torch.random.fork_rng(devices=[]):
        model = copy.deepcopy(model)
        image = normalised(torch.rand(_CHECKED, 3, view.height, view.width))
        with torch.no_grad():
            answer = model.eval()(image)
        _check_poses(answer, scenes, gives_covariance)
        position, quaternion = torch.randn(_CHECKED, 3), torch.nn.functional.normalize(torch.randn(_CHECKED, 4), dim=-1)
        truth = PoseBatch(position, quaternion, torch.zeros(_CHECKED, dtype=torch.long))
        loss = model.train().loss(image, truth)
    if not isinstance(loss, Tensor) or loss.shape != () or not loss.requires_grad:
        raise ValueError(f"loss returned {_described(loss)}, not a scalar with a gradient")


def _check_poses(answer: object, scenes: int, gives_covariance: bool) -> None:
    if not isinstance(answer, PoseBatch):
        raise TypeError(f"forward returned a {type(answer).__name__}, not a PoseBatch")
    shapes = {"position_B3": (_CHECKED, 3), "quaternion_B4": (_CHECKED, 4), "scene_B": (_CHECKED,)}
    if gives_covariance:
        shapes["covariance_B66"] = (_CHECKED, 6, 6)
    for name, shape in shapes.items():
        tensor = getattr(answer, name)
        if not isinstance(tensor, Tensor) or tensor.shape != shape:
            raise ValueError(f"forward's {name} is {_described(tensor)}, not {shape} for {_CHECKED} images")
    lengths = torch.linalg.vector_norm(answer.quaternion_B4.float(), dim=-1)
    if not bool(((lengths - 1).abs() < _UNIT).all()):
        raise ValueError(f"forward's quaternion_B4 have lengths {lengths.tolist()}, not 1")
    if not bool(((answer.scene_B >= 0) & (answer.scene_B < scenes)).all()):
        raise ValueError(f"forward's scene_B is {answer.scene_B.tolist()}, not from 0 to {scenes - 1}")


def _described(value: object) -> str:
    return f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def take_best(model: PoseRegressor, folder: Path) -> list[dict[str, Any]]:
    """Load the best epoch's weights from a finished checkpoint; returns the learning curves, a dict an epoch."""
    saved = torch.load(folder / CHECKPOINT, map_location="cpu")
    best = saved["best"]
    model.load_state_dict(best["weights"])
    return [{**row, "selected": row["epoch"] == best["epoch"]} for row in saved["history"]]


def make_optimiser(model: PoseRegressor, settings: RegressorSettings) -> torch.optim.Optimizer:
    """Adam or AdamW; the parameters that the model wants undecayed are left alone by the weight decay."""
    undecayed = model.undecayed()
    apart = {id(parameter) for parameter in undecayed}
    others = [parameter for parameter in model.parameters() if parameter.requires_grad and id(parameter) not in apart]
    recipe = settings.training
    groups: list[dict[str, Any]] = [{"params": others, "weight_decay": recipe.weight_decay}]
    if undecayed:
        groups.append({"params": undecayed, "weight_decay": 0.0})
    kind = torch.optim.AdamW if recipe.decoupled else torch.optim.Adam
    return kind(groups, lr=settings.learning_rate, eps=recipe.adam_eps, fused=True)


def learning_rate(settings: RegressorSettings, epochs: float) -> float:
    """The learning rate after so many epochs, a part of one included."""
    warmup, schedule = settings.training.warmup_epochs, settings.training.schedule
    if epochs < warmup:
        return settings.learning_rate * (epochs + 1e-2) / (warmup + 1e-2)
    if schedule == "thirds":
        return settings.learning_rate * 0.1 ** (3 * epochs // settings.epochs)
    if schedule == "cosine":
        return settings.learning_rate * 0.5 * (1 + math.cos(math.pi * (epochs - warmup) / (settings.epochs - warmup)))
    return settings.learning_rate


def epoch_batches(scene_N: NDArray[np.int64], batch: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Row numbers of an epoch's batches: every row once, and smaller scenes' rows again until all scenes have as
    many as the largest. Batches are of nearly equal size, since batch norm fails on a last one of a single image."""
    scenes = [np.flatnonzero(scene_N == scene) for scene in np.unique(scene_N)]
    largest = max(len(rows) for rows in scenes)
    drawn = [np.concatenate([rows, rng.choice(rows, largest - len(rows))]) for rows in scenes]
    order = rng.permutation(np.concatenate(drawn))
    yield from np.array_split(order, math.ceil(len(order) / batch))


def save(path: Path, content: dict[str, Any]) -> None:
    """Write a checkpoint so that a kill leaves the one before it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as partial:
        torch.save(content, partial)
