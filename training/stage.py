"""Stage 5: train the absolute pose regressors, and predict the pose of every frame."""

import json
import platform
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import torch

from groundwalk.scoring.errors import sure_enough
from groundwalk.scoring.scores import median_error
from groundwalk.store import UserError, colours
from groundwalk.store.child import Report, Task, in_children
from groundwalk.store.hints import setting_of
from groundwalk.store.registry import PluginError
from groundwalk.store.schemas import schema
from groundwalk.training import inputs, processes
from groundwalk.training.build import Trained, save_trained
from groundwalk.training.data import Frames, ImageCache, View
from groundwalk.training.imported import imported_card, read_imported
from groundwalk.training.inputs import TrainRun, rows_with_truth
from groundwalk.training.loop import check_regressor, save, take_best, train
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.predict import answers, errors, mean_pose_errors, predict
from groundwalk.training.record import blueprint, record
from groundwalk.training.regressor_settings import RegressorSettings, weights_file
from groundwalk.training.regressors import REGRESSORS
from groundwalk.training.settings import TrainSettings
from groundwalk.training.sources import Run
from groundwalk.training.steps import WORDS, Precision

_FIRST = "first.pt"
_TOO_LITTLE = (
    f"too little memory needs a smaller {setting_of('train', 'crop')}, or batch in [train.regressors.<model>] there"
)


@dataclass(frozen=True)
class Result:
    """A regressor's model card, its predictions, and its learning curves, which are empty where it was imported."""

    card: dict[str, Any]
    predictions: pd.DataFrame
    history: pd.DataFrame


@dataclass(frozen=True)
class Job:
    """A model that is ready to be trained: its first weights lie in `run.folder`."""

    scenes: list[str]
    outdoor: bool
    training: Frames
    held_out: Frames
    run: Run
    origin: str

    def model(self) -> PoseRegressor:
        """The model with its first weights."""
        model = REGRESSORS.find(self.run.title).make(self.run.settings, len(self.scenes), self.outdoor)
        model.load_state_dict(torch.load(self.run.folder / _FIRST)["state"])
        return model


def run(r: TrainRun) -> None:
    r.warn_of_scale()
    frames = inputs.read_frames(r)
    torch.set_num_threads(r.settings.threads)
    device = choose_device(r.settings.device, r.settings.processes)
    imported = list(read_imported(r, frames))
    models = models_of(r)
    if models:
        inputs.check_trainable(frames, r.folder("align", r.leaves[0]))
    focal = inputs.virtual_focal(frames) if models and r.settings.undistort else None
    if focal is not None:
        r.figure("virtual focal length in shorter image sides", focal)
        inputs.warn_of_borders(r, frames, focal)
    with r.step("images"):
        sides = sorted({r.settings.resize, *(short_side(r.settings, model) for model in models)})
        caches = {
            s: ImageCache.build(r.scratch / f"images-{s}", inputs.small_images(r, frames, focal, s)) for s in sides
        }
        data = {side: inputs.as_training_frames(frames, cache, focal) for side, cache in caches.items()}
    report_mean_pose(r, frames, data[r.settings.resize])

    faults: list[PluginError] = []
    jobs = []
    for model in models:
        with left_out(model, faults):
            jobs.append(prepare(r, model, data[short_side(r.settings, model)], frames, device))
    results = []
    for job in train_all(r, jobs, faults):
        with left_out(job.run.title, faults):
            results.append(finish(r, job, data[short_side(r.settings, job.run.title)], frames, focal))
    for name, rows, origin in imported:
        report_accuracy(r, name, frames, data[r.settings.resize], rows)
        results.append(Result(imported_card(r, name, rows, origin), rows, pd.DataFrame()))
    faults = [*REGRESSORS.unusable(r.settings.models), *faults]
    r.leave_out(faults)
    if not results:
        raise faults[0]
    write_results(r, frames, data[r.settings.resize].cache, results)


def choose_device(wanted: str, count: int) -> torch.device:
    """The device to train on; UserError where a GPU is asked for and there is none, or not one for each process."""
    if wanted == "cuda" and not torch.cuda.is_available():
        do = "set " + setting_of("train", 'device = "auto"')
        raise UserError("no CUDA device", found="device = cuda, which PyTorch doesn't see", do=do)
    device = torch.device("cuda" if wanted != "cpu" and torch.cuda.is_available() else "cpu")
    if device.type == "cuda" and count > max(1, torch.cuda.device_count()):
        found = f"{torch.cuda.device_count()} GPUs for {count} processes"
        do = "set a smaller number of " + setting_of("train", "processes")
        raise UserError("each process trains on a GPU of its own", found=found, do=do)
    return device


def choose_precision(
    wanted: Literal["auto", "fp32", "bf16"], settings: RegressorSettings, device: torch.device
) -> Precision:
    """The precision to train in; "auto": bfloat16 where the recipe allows it and the processor has units for its
    products."""
    if wanted != "auto":
        return wanted
    if device.type == "cuda":
        has_units = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        has_units = torch.cpu._is_amx_tile_supported() or torch.cpu._is_avx512_bf16_supported()
    return "bf16" if has_units and settings.training.bfloat16 else "fp32"


def models_of(r: TrainRun) -> list[str]:
    """The models that this run trains: of a group of scenes those that hold several."""
    usable = [m for m in r.settings.models if m in REGRESSORS]
    models = [m for m in usable if REGRESSORS[m].multi_scene or not r.scene.is_group]
    if usable and not models and not r.settings.predictions:
        one = " and ".join(usable)
        raise UserError(
            f"{r.scene.name} is a group of scenes, and {one} holds one scene",
            found=list(r.settings.models),
            expected=f"one of {', '.join(name for name, entry in REGRESSORS.items() if entry.multi_scene)}",
            do=f"add it to {setting_of('train', 'models')}",
        )
    return models


def short_side(settings: TrainSettings, model: str) -> int:
    """Pixels on the shorter side of the images that a model sees."""
    return REGRESSORS.find(model).whole_image_px or settings.resize


def view_of(settings: TrainSettings, model: str, training: Frames) -> View:
    """What the model sees of its images."""
    if REGRESSORS.find(model).whole_image_px is None:
        return View(settings.crop, settings.crop)
    upright = bool(np.isfinite(training.gravity_N3).any())
    # No image's border is left out of the commonest shape; of a longer image the ends are.
    shapes, counts = np.unique(training.cache.shapes[training.index_N], axis=0, return_counts=True)
    commonest = shapes[counts.argmax()]
    # One that isn't turned upright is cut out of every image, the smallest, too.
    window = commonest if upright else np.minimum(commonest, training.cache.shapes.min(axis=0))
    return View(int(window[0]), int(window[1]), upright)


@contextmanager
def left_out(model: str, faults: list[PluginError]) -> Iterator[None]:
    """What a plug-in does wrong within is put into `faults`, so that the models beside it go on."""
    try:
        with REGRESSORS.guard(model):
            yield
    except PluginError as fault:
        faults.append(fault)


def prepare(r: TrainRun, name: str, data: Frames, frames: pd.DataFrame, device: torch.device) -> Job:
    """Fill and keep a model's first weights; a resumed run finds them, and where they came from, as they were."""
    settings, regressor = r.settings.regressors[name], REGRESSORS.find(name)
    training, held_out = (data.select(rows_with_truth(frames, split)) for split in ("train", "val"))
    folder, outdoor = r.scratch / name, r.scene.environment == "outdoor"
    view, precision = view_of(r.settings, name, training), choose_precision(r.settings.precision, settings, device)
    if not (folder / _FIRST).exists():
        torch.manual_seed(r.seed)
        model = regressor.make(settings, len(r.leaves), outdoor)
        check_regressor(model, len(r.leaves), view, regressor.gives_covariance)
        named = weights_file(settings)
        given = settings.model_copy(update={"weights": str(r.data.root / named)}) if named else settings
        origin = model.initialise(training.poses(torch.device("cpu")), given, r.data.root / "weights")
        save(folder / _FIRST, {"origin": origin, "state": model.state_dict()})
    origin = torch.load(folder / _FIRST)["origin"]
    r.say(f"{name}: trains in {WORDS[precision]}; first weights: {origin}")
    run = Run(name, settings, device, precision, view, r.seed, folder, unit=r.map_unit(r.leaves[0]).symbol)
    return Job(r.leaves, outdoor, training, held_out, run, origin)


def train_all(r: TrainRun, jobs: list[Job], faults: list[PluginError]) -> list[Job]:
    """Train the models, each in processes of its own: two on a thread each are done sooner than one after the other on
    two. Returns those that were trained."""
    if not jobs:
        return []
    with r.step("train"):
        title, count = f"training {', '.join(job.run.title for job in jobs)}", r.settings.processes
        with tempfile.TemporaryDirectory() as meetings:
            tasks = [
                Task(_train, (job, r.settings.threads, part), 0 if part.rank else job.run.settings.epochs)
                for job in jobs
                for part in (processes.Part(rank, count, Path(meetings, job.run.title)) for rank in range(count))
            ]
            ended = in_children(title, r.scratch / "log.txt", _TOO_LITTLE, tasks)[::count]
    faults += [fault for fault in ended if fault is not None]
    return [job for job, fault in zip(jobs, ended, strict=True) if fault is None]


def _train(report: Report, job: Job, threads: int, part: processes.Part) -> PluginError | None:
    """`train` in another process, of which the first one reports; returns what a plug-in did wrong, which ends all
    where several share a batch."""
    torch.set_num_threads(threads)
    faults: list[PluginError] = []
    with left_out(job.run.title, faults), processes.joined(part, job.run.device) as device:
        run = replace(job.run, device=device)
        train(report if not part.rank else _no_report, job.model(), job.training, job.held_out, run)
    if faults and part.count > 1:
        raise faults[0]
    return faults[0] if faults else None


def _no_report(done: int, note: str = "") -> None:
    """Progress of a process beside the first one."""


def finish(r: TrainRun, job: Job, data: Frames, frames: pd.DataFrame, focal: float | None) -> Result:
    """Write a trained model's weights file, and predict every frame with it."""
    name, run, view, regressor = job.run.title, job.run, job.run.view, REGRESSORS.find(job.run.title)
    model = job.model()
    curve = pd.DataFrame(take_best(model, run.folder))
    curve.insert(0, "model", name)
    curve.insert(1, "scenes", pd.Series([r.leaves] * len(curve)))
    model.to(run.device)
    if regressor.gives_covariance:
        calibrate(model, job.held_out, run)
    side = short_side(r.settings, name)
    focal_px = None if focal is None else focal * side
    trained = Trained(model, r.leaves, side, view.height, focal_px, view.width, view.upright)
    save_trained(r.work / "weights" / f"{name}.pt", name, run.settings, trained)

    with r.step(f"predict {name}"):
        order = r.track(range(len(frames)), f"{name}: predicting")
        estimates = predict(model, data, trained.scenes, view, run.device, order)
    predictions = pd.concat([frames[["scene", "frame_id", "session_id", "split", "t_ns"]], estimates], axis=1)
    predictions["model"] = name
    report_accuracy(r, name, frames, data, predictions)
    machine = f"{platform.machine()} CPU, {torch.get_num_threads()} threads"
    if run.device.type == "cuda":
        machine = torch.cuda.get_device_name()
    shared = f" by {r.settings.processes} processes" if r.settings.processes > 1 else ""
    card = {
        "model": name,
        "label": regressor.label,
        "scenes": r.leaves,
        "file": f"weights/{name}.pt",
        "parameters": model.parameter_count(),
        "bytes": model.bytes(),
        "layers": model.layers(),
        "weights": job.origin,
        "resize_px": side,
        "crop_px": view.height,
        "width_px": view.width,
        "upright": view.upright,
        "focal_px": focal_px,
        "train_frames": len(job.training),
        "val_frames": len(job.held_out),
        "epochs": run.settings.epochs,
        "best_epoch": int(curve.loc[curve["selected"], "epoch"].iloc[0]),
        "seed": run.seed,
        "config": json.dumps(run.settings.model_dump(mode="json"), sort_keys=True),
        "reduced": reduced(r.settings, run.settings) if regressor.in_paper else None,
        "device": f"{machine}, trained in {WORDS[run.precision]}{shared}",
        "inference_ms": float(estimates["inference_ms"].median()),
        "train_seconds": float(curve["seconds"].sum()),
    }
    return Result(card, predictions, curve)


def reduced(settings: TrainSettings, regressor: RegressorSettings) -> str:
    """What is smaller than in the paper, whose values are the defaults; "" for nothing."""
    smaller = []
    for mine, names in ((settings, ["crop"]), (regressor, ["epochs", "layers"])):
        for name in (name for name in names if name in type(mine).model_fields):
            here, paper = getattr(mine, name), type(mine).model_fields[name].default
            smaller += [f"{name} {here} instead of {paper}"] if here < paper else []
    return ", ".join(smaller)


def calibrate(model: PoseRegressor, held_out: Frames, run: Run) -> None:
    """Let the model scale its covariances by its errors on the held-out frames."""
    estimates = answers(model, held_out, run.view, run.device)
    quaternion_N4 = held_out.camera_poses(estimates, run.view)[1]
    as_tensor = torch.tensor(quaternion_N4, dtype=torch.float32, device=run.device)
    model.calibrate(estimates._replace(quaternion_B4=as_tensor), held_out.poses(run.device))


def report_mean_pose(r: TrainRun, frames: pd.DataFrame, data: Frames) -> None:
    """Keep, as figures, how well the mean training pose of each scene does: what a regressor has to beat."""
    for scene in r.leaves:
        here = (frames["scene"] == scene).to_numpy()
        training, tested = (data.select(rows_with_truth(frames[here], s) + np.argmax(here)) for s in ("train", "test"))
        if len(training) and len(tested):
            keep_figures(r, "mean-pose", scene, *mean_pose_errors(training, tested))


def report_accuracy(r: TrainRun, name: str, frames: pd.DataFrame, data: Frames, predictions: pd.DataFrame) -> None:
    """Keep, as figures, the model's errors on each scene's test frames, and say them; a frame without a pose, or that
    was taken for another scene's, is infinitely wrong."""
    keys = ["scene", "frame_id"]
    in_its_map = predictions[predictions["picked_scene"] == predictions["scene"]]
    matched = frames[keys].merge(in_its_map, on=keys, how="left")
    position = matched[[f"map_cam_t{a}" for a in "xyz"]].to_numpy(float)
    quaternion = matched[[f"map_cam_q{a}" for a in "xyzw"]].to_numpy(float)
    for scene in r.leaves:
        rows = np.intersect1d(rows_with_truth(frames, "test"), np.flatnonzero(frames["scene"] == scene))
        if len(rows):
            keep_figures(r, name, scene, *errors(position[rows], quaternion[rows], data.select(rows)))
            uncertain = int((~sure_enough(frames["quality"].iloc[rows])).sum())
            if uncertain:
                r.say(f"{scene}: the ground truth of {uncertain} of these {len(rows)} test frames is of class C")


def keep_figures(r: TrainRun, name: str, scene: str, position: np.ndarray, rotation_deg: np.ndarray) -> None:
    title, unit = f"{name} {scene}", r.map_unit(scene).symbol
    medians = median_error(position), median_error(rotation_deg)
    total, answered = len(position), int(np.isfinite(position).sum())
    for what, median in zip(("position_m", "rotation_deg"), medians, strict=True):
        r.figure(f"{title} test median {what}", median if np.isfinite(median) else None)
    text = f"median {medians[0]:.2f} {unit}, {medians[1]:.1f} deg"
    if answered == total:
        r.say(f"{title}: {text} over {total} test frames")
        return
    text = text if np.isfinite(medians).all() else "no median, as half or more have no pose"
    r.say(f"{title}: {text}; {answered} of {total} test frames have a pose in this map")


def write_results(r: TrainRun, frames: pd.DataFrame, cache: ImageCache, results: list[Result]) -> None:
    predictions = pd.concat([result.predictions for result in results], ignore_index=True)
    curves = [result.history for result in results if len(result.history)]
    columns = schema("train", "history").column_names
    history = pd.concat(curves, ignore_index=True) if curves else pd.DataFrame(columns=columns)
    r.write("predictions", predictions[schema("train", "predictions").column_names])
    r.write("history", history.reindex(columns=columns))
    r.write("models", pd.DataFrame([result.card for result in results]))
    names = [result.card["model"] for result in results]
    shades = colours.localiser_colours(names) | {name: REGRESSORS[name].colour for name in names if name in REGRESSORS}
    with r.step("recording"), r.recording(blueprint(r.leaves, names)) as stream:
        record(stream, frames, predictions, cache, r.settings.crop, shades)
