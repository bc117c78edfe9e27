"""Stage fuse: every method on every model's predictions, their errors and figures."""

from functools import partial

import pandas as pd

from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import evaluate, report_lines
from groundwalk.fusion.evaluation.fuse import stacked
from groundwalk.fusion.files.walks import Inputs
from groundwalk.fusion.recording import blueprint, record
from groundwalk.store import StageRun, UserError
from groundwalk.store.hints import setting_of


def run(r: StageRun[FuseSettings]) -> None:
    frames = {leaf: r.dataset_frames(leaf) for leaf in r.leaves}
    inputs = [
        Inputs(leaf, frames[leaf], r.read("align", "ground_truth", leaf), _predictions(r, leaf), _made_here(r, leaf))
        for leaf in r.leaves
    ]
    with r.step("fuse"):
        results = evaluate(inputs, r.settings)
    for name, table in results.tables.items():
        r.write(name, table)
    for name, count in results.counts.items():
        r.figure(name, count)
    for error in results.left_out:
        r.figure(f"left out: {error.what}", f"{error.details['where']}: {error.reason}")
    files = {leaf: frames[leaf]["image"].map(partial(r.image_path, scene=leaf)) for leaf in r.leaves}
    with r.step("recording"), r.recording(blueprint(results.fused, results.gates)) as stream:
        record(stream, results.fused, results.gates, {leaf: frames[leaf].assign(file=files[leaf]) for leaf in r.leaves})
    for line in report_lines(results):
        r.say(line)


def _predictions(r: StageRun[FuseSettings], leaf: str) -> pd.DataFrame:
    """A scene's predictions: its own training's, but for models that a group around it has trained, and its structure
    localisers'. UserError where two of them have one name."""
    parts = [r.read("train", "predictions", scene=leaf)]
    if r.scene.is_group and "train" in r.scene.stages:
        shared = r.read("train", "predictions")
        shared = shared[shared["scene"] == leaf]
        parts = [shared, parts[0][~parts[0]["model"].isin(shared["model"])]]
    localised = r.read("localise", "predictions", scene=leaf)
    trained = {str(model) for part in parts for model in part["model"]}
    if twice := trained.intersection(localised["model"]):
        raise UserError(
            f"scene {leaf}: a regressor and a structure localiser are called {min(twice)!r}",
            do="give the regressor's predictions another name, or leave the localiser out of "
            f"{setting_of('localise', 'models')}",
        )
    return stacked([*parts, localised])


def _made_here(r: StageRun[FuseSettings], leaf: str) -> frozenset[str]:
    """The models of a scene's predictions that were trained or built here, not imported."""
    group = r.scene.is_group and "train" in r.scene.stages
    cards = stacked([r.read("train", "models", scene=leaf), *([r.read("train", "models")] if group else [])])
    built = r.read("localise", "models", scene=leaf)["model"]
    return frozenset(cards.loc[cards["file"] != "", "model"]) | frozenset(built)
