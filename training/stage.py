"""Stage 4: train the absolute pose regressors, and predict the pose of every frame."""

import json
import platform
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import torch

from groundwalk.artefacts import Stage, StageRun, UserError
from groundwalk.artefacts.child import Report, Task, in_children
from groundwalk.geometry.metrics import sure_enough
from groundwalk.training.build import Trained, build, save_trained, settings_of
from groundwalk.training.data import Frames, ImageCache
from groundwalk.training.evaluation import errors, mean_pose_errors
from groundwalk.training.inputs import (
    as_training_frames,
    check_trainable,
    focal_in_short_sides,
    read_frames,
    rows_with_truth,
    small_images,
    virtual_focal,
)
from groundwalk.training.loop import Run, save, take_best, train
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.predict import predict
from groundwalk.training.record import blueprint, record
from groundwalk.training.settings import ModelName, RegressorSettings, TrainSettings
from groundwalk.training.weights import load_first_weights

_FIRST = "first.pt"
_NARROW = 1.1
_TOO_LITTLE = "too little memory needs a smaller batch or crop"


def run(r: StageRun[TrainSettings]) -> None:
    settings = r.settings
    frames = read_frames(r)
    check_trainable(frames, r.folder("align", r.leaves[0]))
    torch.set_num_threads(settings.threads)
    device = choose_device(settings.device)
    focal = choose_camera(r, frames)
    with r.step("images"):
        cache = ImageCache.build(r.scratch / "images", small_images(r, frames, focal))
    data = as_training_frames(frames, cache, focal)
    report_mean_pose(r, frames, data)

    jobs = [prepare(r, name, data, frames, device) for name in models_of(r)]
    with r.step("train"):
        tasks = [Task(train_prepared, (job, settings.threads), job.settings.epochs) for job in jobs]
        in_children(f"training {', '.join(job.run.title for job in jobs)}", r.scratch / "log.txt", _TOO_LITTLE, tasks)
    predictions, history, cards = [], [], []
    for job in jobs:
        name = job.run.title
        card, curve, trained = finish(r, job, None if focal is None else focal * settings.resize)
        with r.step(f"predict {name}"):
            order = r.track(range(len(frames)), f"{name}: predicting")
            found = predict(trained.model, data, trained.scenes, trained.crop, device, order)
        card["inference_ms"] = float(found["inference_ms"].median())
        report_accuracy(r, name, frames, data, found)
        keys = frames[["scene", "frame_id", "session_id", "split", "t_ns"]]
        predictions.append(pd.concat([keys, found], axis=1).assign(model=name, covariance=None))
        history.append(curve)
        cards.append(card)

    all_predictions, all_history = (pd.concat(t, ignore_index=True) for t in (predictions, history))
    r.write("predictions", all_predictions)
    r.write("history", all_history)
    r.write("models", pd.DataFrame(cards))
    with r.step("recording"), r.recording(blueprint(r.leaves, [c["model"] for c in cards])) as stream:
        record(stream, frames, all_predictions, all_history, cache, settings.crop)


def models_of(r: StageRun[TrainSettings]) -> list[ModelName]:
    """The models that this run trains: of a group of scenes MS-T alone, as PN holds one scene."""
    models = [m for m in r.settings.models if m == "MS-T" or not r.scene.is_group]
    if not models:
        raise UserError(
            f"{r.scene.name} is a group of scenes, and PN holds one scene", found=list(r.settings.models), do="add MS-T"
        )
    return models


@dataclass(frozen=True)
class Job:
    """A model that is ready to be trained: its first weights lie in `run.folder`."""

    settings: RegressorSettings
    scenes: list[str]
    outdoor: bool
    training: Frames
    held_out: Frames
    run: Run
    origin: str

    def model(self) -> PoseRegressor:
        """The model with its first weights."""
        model = build(self.settings, len(self.scenes), self.outdoor)
        model.load_state_dict(torch.load(self.run.folder / _FIRST)["state"])
        return model


def prepare(
    r: StageRun[TrainSettings], name: ModelName, data: Frames, frames: pd.DataFrame, device: torch.device
) -> Job:
    """Fill and keep a model's first weights; a resumed run finds them, and where they came from, as they were."""
    settings = settings_of(name, r.settings)
    training, held_out = (data.select(rows_with_truth(frames, split)) for split in ("train", "val"))
    folder, outdoor = r.scratch / name, r.scene.environment == "outdoor"
    if not (folder / _FIRST).exists():
        torch.manual_seed(r.seed)
        model = build(settings, len(r.leaves), outdoor)
        origin = load_first_weights(model, settings.weights, r.data.root / "weights")
        model.frames.fit(training.poses(torch.device("cpu")), settings.normalise_position, settings.centre_rotation)
        save(folder / _FIRST, {"origin": origin, "state": model.state_dict()})
    origin = torch.load(folder / _FIRST)["origin"]
    r.say(f"{name}: backbone starts from {origin}")
    mixed_precision = choose_precision(settings.mixed_precision, device)
    run = Run(name, device, mixed_precision, r.settings.crop, r.seed, folder, r.settings.checkpoint_s)
    return Job(settings, r.leaves, outdoor, training, held_out, run, origin)


def train_prepared(report: Report, job: Job, threads: int) -> None:
    """`train` in a process of its own: two models on a thread each are done sooner than one after the other on two."""
    torch.set_num_threads(threads)
    train(report, job.model(), job.training, job.held_out, job.settings, job.run)


def finish(
    r: StageRun[TrainSettings], job: Job, focal_px: float | None
) -> tuple[dict[str, Any], pd.DataFrame, Trained]:
    """A trained model's card (without inference_ms), its learning curves, and itself with its weights file written."""
    name, settings, run = job.run.title, job.settings, job.run
    model = job.model()
    curve = pd.DataFrame(take_best(model, run.folder))
    model.to(run.device)
    trained = Trained(model, r.leaves, r.settings.resize, run.crop, focal_px)
    save_trained(r.work / "weights" / f"{name}.pt", name, settings, trained)
    curve.insert(0, "model", name)
    curve.insert(1, "scenes", pd.Series([r.leaves] * len(curve)))
    card: dict[str, Any] = {
        "model": name,
        "scenes": r.leaves,
        "file": f"weights/{name}.pt",
        "parameters": model.parameter_count(),
        "bytes": model.bytes(),
        "layers": model.layers(),
        "weights": job.origin,
        "resize_px": r.settings.resize,
        "crop_px": r.settings.crop,
        "focal_px": focal_px,
        "train_frames": len(job.training),
        "val_frames": len(job.held_out),
        "epochs": settings.epochs,
        "best_epoch": int(curve.loc[curve["kept"], "epoch"].iloc[0]),
        "seed": run.seed,
        "config": json.dumps(settings.model_dump(mode="json"), sort_keys=True),
        "reduced": r.settings.reduced,
        "device": describe(run),
        "train_seconds": float(curve["seconds"].sum()),
    }
    return card, curve, trained


def choose_camera(r: StageRun[TrainSettings], frames: pd.DataFrame) -> float | None:
    """The virtual pinhole's focal length in shorter sides, None for images as captured; says what it can't fill."""
    if not r.settings.undistort:
        return None
    focal = virtual_focal(frames)
    r.figure("virtual focal length in shorter image sides", focal)
    narrow = int((focal_in_short_sides(frames) > _NARROW * focal).sum())
    if narrow:
        r.say(
            f"{narrow} of {len(frames)} images have focal lengths over {_NARROW:g} times the virtual camera's, so they "
            "don't fill its image: their borders are repeated"
        )
    return focal


def report_mean_pose(r: StageRun[TrainSettings], frames: pd.DataFrame, data: Frames) -> None:
    """Keep, as figures, how well the mean training pose of each scene does: what a regressor has to beat."""
    for scene in r.leaves:
        here = (frames["scene"] == scene).to_numpy()
        training, tested = (data.select(rows_with_truth(frames[here], s) + np.argmax(here)) for s in ("train", "test"))
        if len(tested):
            keep_figures(r, f"mean-pose {scene}", *mean_pose_errors(training, tested))


def report_accuracy(
    r: StageRun[TrainSettings], name: str, frames: pd.DataFrame, data: Frames, found: pd.DataFrame
) -> None:
    """Keep, as figures, the model's errors on each scene's test frames, and say them."""
    position = found[[f"map_cam_t{a}" for a in "xyz"]].to_numpy()
    quaternion = found[[f"map_cam_q{a}" for a in "xyzw"]].to_numpy()
    for scene in r.leaves:
        rows = np.intersect1d(rows_with_truth(frames, "test"), np.flatnonzero(frames["scene"] == scene))
        if len(rows):
            keep_figures(r, f"{name} {scene}", *errors(position[rows], quaternion[rows], data.select(rows)))
            unsure = int((~sure_enough(frames["quality"].iloc[rows])).sum())
            if unsure:
                r.say(f"{scene}: the ground truth of {unsure} of these {len(rows)} test frames is of class C")


def keep_figures(r: StageRun[TrainSettings], title: str, position_m: np.ndarray, rotation_deg: np.ndarray) -> None:
    medians = float(np.median(position_m)), float(np.median(rotation_deg))
    r.figure(f"{title} test median position_m", medians[0])
    r.figure(f"{title} test median rotation_deg", medians[1])
    r.say(f"{title}: median {medians[0]:.2f} m, {medians[1]:.1f} deg over {len(position_m)} test frames")


def choose_device(wanted: str) -> torch.device:
    """The device to train on; UserError where a GPU is asked for and there is none."""
    if wanted == "cuda" and not torch.cuda.is_available():
        raise UserError(
            "no CUDA device", expected="device = auto or cpu", found="device = cuda, which PyTorch doesn't see"
        )
    return torch.device("cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu")


def choose_precision(wanted: str, device: torch.device) -> bool:
    """Whether to train in bfloat16: with `auto` where there are instructions for it, as emulation is slower."""
    if wanted != "auto":
        return wanted == "bf16"
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()


def describe(run: Run) -> str:
    """The device in words, with the precision."""
    if run.device.type == "cuda":
        machine = torch.cuda.get_device_name()
    else:
        machine = f"{platform.machine()} CPU, {torch.get_num_threads()} threads"
    return f"{machine}, trained in {'bfloat16' if run.mixed_precision else 'float32'}"


STAGE = Stage(
    name="train",
    version=4,
    settings=TrainSettings,
    needs=("import", "align"),
    run=run,
    help="Train the absolute pose regressors PN and MS-T, and predict the pose of every frame. A group of scenes "
    "shares one MS-T.",
)
