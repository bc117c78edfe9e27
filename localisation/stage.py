"""Stage 4: build structure localisers from the training frames, and localise the others."""

import json
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.features.sift import Features
from groundwalk.geometry.poses import Array
from groundwalk.localisation.definition import LocaliseSettings
from groundwalk.localisation.inputs import read_inputs, training_of, with_found_focal
from groundwalk.localisation.localisers import LOCALISERS, FeatureKind, Localiser
from groundwalk.localisation.prepared import MIN_POINTS, Prepared, prepare
from groundwalk.localisation.record import blueprint, record
from groundwalk.localisation.results import QueryResult
from groundwalk.scoring.errors import position_error, rotation_error_deg, sure_enough
from groundwalk.scoring.scores import score
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import MapUnit
from groundwalk.store.cores import usable_cores
from groundwalk.store.hints import setting_of
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel, one_thread
from groundwalk.store.registry import PluginError
from groundwalk.store.schemas import schema
from groundwalk.store.tables import camera_of, pose_frame, poses_of

LocaliseRun = StageRun[LocaliseSettings]
_MIN_FRAMES = 5
_NO_LOCALISERS = setting_of("localise", "models = []")
_WRONG_M, _WRONG_DEG = 1.0, 5.0


@dataclass(frozen=True)
class LocaliserRun:
    """A localiser, its row of `models`, and what it says of each query (Q) at which cost (Q, 2), s: on the clock and of
    all cores."""

    localiser: Localiser
    model: dict[str, Any]
    results: list[QueryResult]
    cost_s: Array


def run(r: LocaliseRun) -> None:
    r.warn_of_scale()
    queries = r.dataset_frames()
    queries = queries[queries["split"].isin(r.settings.splits)].sort_values(["session_id", "t_ns"])
    queries = with_found_focal(queries.reset_index(drop=True), r.data.run(r.profile, r.scene.name))
    runs: dict[str, LocaliserRun] = {}
    faults = [*LOCALISERS.unusable(r.settings.models)]
    prepared: dict[FeatureKind, Prepared] = {}
    # Matrix products are small: on two threads they take more time of both.
    with one_thread():
        for name in (name for name in r.settings.models if name in LOCALISERS):
            kind = LOCALISERS[name].features
            try:
                with LOCALISERS.guard(name):
                    prepared[kind] = prepared.get(kind) or prepare_training(r, kind)
                    runs[name] = run_localiser(r, name, prepared[kind], queries)
            except PluginError as fault:
                faults.append(fault)
        r.leave_out(faults)
        if r.settings.models and not runs:
            raise faults[0]
        write_tables(r, queries, runs)
        with r.step("recording"), r.recording(blueprint(list(runs))) as stream:
            results = {name: each.results for name, each in runs.items()}
            points = {name: each.localiser.xyz for name, each in runs.items()}
            truth = r.read("align", "ground_truth")
            record(stream, queries, truth, points, results, lambda image: r.image_path(str(image)))


def prepare_training(r: LocaliseRun, kind: FeatureKind) -> Prepared:
    """The training frames with ground truth, their features, matches and points; UserError where they are too few."""
    inputs = read_inputs(r.data.run(r.profile, r.scene.name))
    rows = np.flatnonzero((inputs.frames["split"] == "train").to_numpy())
    if len(rows) < _MIN_FRAMES:
        raise UserError(
            f"scene {r.scene.name} has too few frames to build a map from",
            where=r.folder("align"),
            expected=f"{_MIN_FRAMES} frames of split train with ground truth",
            found=f"{len(rows)} of {int((r.dataset_frames()['split'] == 'train').sum())}",
            do="check the scene's split rules, and what align says about its ground truth; or leave structure "
            f"localisers out: {_NO_LOCALISERS}",
        )
    paths = [r.image_path(image) for image in inputs.frames["image"].iloc[rows]]

    def extracted(path: Path) -> Features:
        return kind.extract(read_grey_image(path), r.settings.max_features, r.settings.max_side)

    with r.step("features"):
        features = in_parallel(extracted, r.track(paths, "reading training frames", len(paths)))
        training = training_of(inputs, rows, list(features))
    with r.step("points"):
        prepared = prepare(r.scene.name, training, r.settings, kind, r.track)
    points = len(prepared.points.xyz)
    r.figure(f"{kind.id} points", points)
    r.say(f"{points} points of {kind.id} features, seen by {len(rows)} training frames")
    if points < MIN_POINTS:
        raise UserError(
            f"scene {r.scene.name} has too few points to localise by",
            expected=f"{MIN_POINTS} points that two training frames see",
            found=f"{points} by {len(rows)} frames",
            do=f"capture with more overlap and texture; or leave structure localisers out: {_NO_LOCALISERS}",
        )
    return prepared


def run_localiser(r: LocaliseRun, name: str, prepared: Prepared, queries: pd.DataFrame) -> LocaliserRun:
    """A localiser, built, and what it says of each query."""
    entry, settings = LOCALISERS[name], r.settings.localisers[name]
    path = None if entry.file is None else r.work / f"{name.lower()}{entry.file.suffix}"
    with r.step(f"build {name}"):
        began = time.process_time()
        if entry.file is None or path is None:
            localiser: Localiser = entry.build(prepared, settings, r.track)
        else:
            if not path.exists():
                entry.file.write(path, entry.build(prepared, settings, r.track))
            localiser = entry.file.read(path)
        build_s = time.process_time() - began
    results, cost_s = ask_all(r, name, localiser, queries)
    medians = np.median(1000 * cost_s, axis=0).tolist() if len(cost_s) else [None, None]
    shared = {key: getattr(r.settings, key) for key in ("max_features", "max_side")}
    model = {
        "model": name,
        "label": entry.label,
        "meaning": entry.meaning,
        "file": "" if path is None else path.name,
        "bytes": sum(localiser.bytes_by_part().values()) if path is None else path.stat().st_size,
        "points": len(localiser.xyz),
        "train_frames": len(prepared.training.views),
        "seed": r.seed,
        "config": json.dumps(shared | settings.model_dump(mode="json"), sort_keys=True),
        "device": f"{platform.machine()} CPU, {usable_cores()} threads",
        "inference_ms": medians[0],
        "cpu_ms": medians[1],
        "build_cpu_seconds": build_s,
    }
    report_accuracy(r, name, queries, results)
    return LocaliserRun(localiser, model, results, cost_s)


def ask_all(r: LocaliseRun, name: str, localiser: Localiser, queries: pd.DataFrame) -> tuple[list[QueryResult], Array]:
    """What a localiser says of each query, and what that cost (Q, 2), s: on the clock and of all cores."""
    gravity = queries[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan)
    results: list[QueryResult] = []
    costs: list[tuple[float, float]] = []
    with r.step(f"localise {name}"):
        for row in r.track(range(len(queries)), f"{name}: localising", len(queries)):
            down = gravity[row] if np.isfinite(gravity[row]).all() else None
            image, camera = read_grey_image(r.image_path(queries["image"].iloc[row])), camera_of(queries.iloc[row])
            wall, cpu = time.perf_counter(), time.process_time()
            results.append(localiser.localise(image, camera, down, seed=r.seed))
            costs.append((time.perf_counter() - wall, time.process_time() - cpu))
    return results, np.array(costs).reshape(-1, 2)


def report_accuracy(r: LocaliseRun, name: str, queries: pd.DataFrame, results: Sequence[QueryResult]) -> None:
    """Keep, as figures, how many test frames were answered and how well; a refused frame is infinitely wrong."""
    truth = r.read("align", "ground_truth").set_index("frame_id").reindex(queries["frame_id"])
    true = poses_of(truth, "map_cam")
    tested = np.flatnonzero((queries["split"] == "test").to_numpy() & np.isfinite(true).all(axis=(1, 2)))
    if not len(tested):
        return
    position, rotation = errors_of([results[row] for row in tested.tolist()], true[tested])
    sure = sure_enough(truth["quality"].to_numpy(object)[tested])
    given, unit, measured = np.isfinite(position), r.map_unit(), score(position, rotation, sure)
    median = measured.median_m
    r.figure(f"{name} test frames", len(tested))
    r.figure(f"{name} test refused", int((~given).sum()))
    r.figure(f"{name} test median position_m", median if np.isfinite(median) else None)
    length = f"{100 * median:.2g} cm" if unit is MapUnit.METRE else f"{median:.2g} {unit.symbol}"
    median_text = f"median {length}" if np.isfinite(median) else "no median, as half or more are refused"
    refused = f"{int((~given).sum())} of {len(tested)} test frames refused"
    if unit is not MapUnit.METRE or not measured.certain:  # levels are in metres, and of what ground truth can tell
        r.say(f"{name}: {median_text}; {refused}")
        return
    wrong = int((given & ((position > _WRONG_M) | (rotation > _WRONG_DEG))).sum())
    r.figure(f"{name} test wrong", wrong)
    r.figure(f"{name} test within 0.25 m and 2 deg, %", measured.high)
    left_out = len(tested) - measured.certain
    r.figure(f"{name} test frames of quality class C", left_out)
    of_frames = f" of {measured.certain} ({left_out} of quality class C left out)" if left_out else ""
    r.say(
        f"{name}: {median_text}, {measured.high:.1f} % within 0.25 m and 2 deg{of_frames}; {refused}, "
        f"{wrong} off by more than {_WRONG_M:g} m or {_WRONG_DEG:g} deg"
    )


def errors_of(results: Sequence[QueryResult], truth: Array) -> tuple[Array, Array]:
    """Position errors, m, and rotation errors, deg, of results for frames with true poses (N, 4, 4); infinite where
    refused."""
    position, rotation = np.full(len(results), np.inf), np.full(len(results), np.inf)
    for row, result in enumerate(results):
        if result.map_T_cam is not None:
            position[row] = position_error(result.map_T_cam, truth[row])
            rotation[row] = rotation_error_deg(result.map_T_cam, truth[row])
    return position, rotation


def write_tables(r: LocaliseRun, queries: pd.DataFrame, runs: dict[str, LocaliserRun]) -> None:
    """The stage's tables, of any number of localisers."""
    tables: dict[str, list[pd.DataFrame]] = {"predictions": [], "models": [], "storage": []}
    none = np.full((4, 4), np.nan)
    for name, run in runs.items():
        poses = np.array([none if a.map_T_cam is None else a.map_T_cam for a in run.results]).reshape(-1, 4, 4)
        said = {
            "covariance": [None if a.covariance is None else a.covariance.ravel().tolist() for a in run.results],
            "inference_ms": 1000 * run.cost_s[:, 0],
            "cpu_ms": 1000 * run.cost_s[:, 1],
            "inliers": [a.inliers for a in run.results],
            "candidates": [a.candidates for a in run.results],
            "refusal": [a.refusal for a in run.results],
            "reason": [a.reason or None for a in run.results],
        }
        keys = queries[["frame_id", "session_id", "split", "t_ns"]]
        of_model = {"model": name, "scene": r.scene.name, "picked_scene": r.scene.name}
        columns = [keys, pose_frame("map_cam", poses), pd.DataFrame(said)]
        tables["predictions"].append(pd.concat(columns, axis=1).assign(**of_model))
        tables["models"].append(pd.DataFrame([run.model]))
        storage = run.localiser.bytes_by_part()
        parts, sizes = list(storage), list(storage.values())
        tables["storage"].append(pd.DataFrame({"model": name, "part": parts, "bytes": sizes}))
    for table, of_models in tables.items():
        names, rows = schema("localise", table).column_names, [each for each in of_models if len(each)]
        r.write(table, pd.concat(rows, ignore_index=True)[names] if rows else pd.DataFrame(columns=names))
