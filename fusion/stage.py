"""Stage fuse: every method on every model's predictions, their errors and figures."""

import pandas as pd

from groundwalk.artefacts import Stage, StageRun
from groundwalk.fusion.evaluate import FuseSettings, Inputs, evaluate, report_lines, stacked
from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.record import blueprint, record


def run(r: StageRun[FuseSettings]) -> None:
    inputs = [
        Inputs(
            leaf,
            r.dataset_frames(leaf),
            r.read("align", "ground_truth", scene=leaf),
            _predictions(r, leaf),
            _trained(r, leaf),
        )
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
    with r.step("recording"), r.recording(blueprint(results.fused, results.gates)) as stream:
        record(stream, results.fused, results.gates)
    for line in report_lines(results):
        r.say(line)


def _predictions(r: StageRun[FuseSettings], leaf: str) -> pd.DataFrame:
    """A scene's predictions: its own training's, but for models that a group around it has trained."""
    own = r.read("train", "predictions", scene=leaf)
    if not r.scene.is_group or "train" not in r.scene.stages:
        return own
    shared = r.read("train", "predictions")
    shared = shared[shared["scene"] == leaf]
    return stacked([shared, own[~own["model"].isin(shared["model"])]])


def _trained(r: StageRun[FuseSettings], leaf: str) -> frozenset[str]:
    """The models of a scene's predictions that were trained here, not imported."""
    group = r.scene.is_group and "train" in r.scene.stages
    cards = stacked([r.read("train", "models", scene=leaf), *([r.read("train", "models")] if group else [])])
    return frozenset(cards.loc[cards["file"] != "", "model"])


STAGE = Stage(
    name="fuse",
    version=9,
    settings=FuseSettings,
    needs=("import", "align", "train"),
    run=run,
    help="Fuse the regressors' predictions with odometry, and measure every method against the ground truth.",
    plugins=lambda settings: METHODS.versions(settings.methods),
)
