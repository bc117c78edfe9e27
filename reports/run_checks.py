"""Is this run what its numbers are taken for? Checks on the artefacts that the tables are made from."""

from collections.abc import Iterator
from typing import NamedTuple

import pandas as pd

from groundwalk.reports.grids import OURS
from groundwalk.reports.inputs import LEAK_S, MAX_NEAR_COPIES, SceneInputs
from groundwalk.store.choices import MapUnit

AGREES, DISAGREES, CAUTION = "agrees", "disagrees", "caution"
WRONG_M, WRONG_DEG = 1.0, 5.0


class Finding(NamedTuple):
    """One thing that was checked: where, what it should be by the rule, what is printed, and the status."""

    check: str
    table: str
    scene: str
    subset: str
    column: str
    expected: str
    printed: str
    status: str
    because: str


def as_table(findings: list[Finding]) -> pd.DataFrame:
    """Findings as rows of report.checks."""
    return pd.DataFrame(findings, columns=list(Finding._fields)).assign(source=OURS)


def run_findings(scene: SceneInputs) -> Iterator[Finding]:
    """What was found of one scene's ground truth, split and errors."""
    truth = scene.ground_truth
    known = set(truth.loc[(truth["split"] == "test") & truth["map_cam_tx"].notna(), "frame_id"])
    test = scene.errors[scene.errors["split"] == "test"]
    alone = set(truth.loc[truth["session_id"].isin(scene.unfused_sessions), "frame_id"])
    for (model, method), errors in test.groupby(["model", "method"], sort=False):
        scored = set(errors["frame_id"])
        expected = known if method in scene.raw_methods else known - alone
        yield Finding(
            *("all_scored", "fuse.errors", scene.name, "all", f"{model} {method}"),
            *(f"{len(expected)} frames", f"{len(expected & scored)} of them, {len(scored - expected)} others"),
            AGREES if scored == expected else DISAGREES,
            "each test frame with ground truth has one row for each method, answered or not; of a method that fuses, "
            "each in sessions where it can",
        )
    yield from _localiser_findings(scene)
    uses_vio = int(truth["gt_uses_vio"].sum())
    yield Finding(
        *("ground_truth_without_vio", "align.ground_truth", scene.name, "all", "gt_uses_vio"),
        *("0 frames", f"{uses_vio} frames", CAUTION if uses_vio else AGREES),
        "ground truth that leans on VIO flatters methods that use VIO",
    )
    leak, near = scene.leak_s, scene.near_copies
    if near is not None and leak is None:
        apart = f"no times; {near:.0%} of test images show nearly what a training image shows"
    else:
        apart = "in different walks" if leak is None else f"{leak:.1f} s apart in one walk"
    is_apart = (leak is None or leak >= LEAK_S) and (near or 0) <= MAX_NEAR_COPIES
    yield Finding(
        *("no_leak", "import.frames", scene.name, "all", "split"),
        *(f"{LEAK_S:g} s apart or more", apart, AGREES if is_apart else CAUTION),
        "a test frame next to a training frame shows nearly the same picture",
    )


def _localiser_findings(scene: SceneInputs) -> Iterator[Finding]:
    """Whether structure localisers refused what they couldn't localise, where metres say that."""
    if scene.unit is not MapUnit.METRE:
        return
    test = scene.errors[(scene.errors["split"] == "test") & scene.errors["method"].isin(scene.raw_methods)]
    for model in scene.localisers["model"]:
        errors = test[test["model"] == model].drop_duplicates("frame_id")
        wrong = int(((errors["raw_position_m"] > WRONG_M) | (errors["raw_rotation_deg"] > WRONG_DEG)).sum())
        yield Finding(
            *("no_wrong_answer", "localise.predictions", scene.name, "all", f"{model} pose"),
            *("0 frames", f"{wrong} of {len(errors)} frames", CAUTION if wrong else AGREES),
            f"a structure localiser refuses rather than be off by more than {WRONG_M:g} m or {WRONG_DEG:g} degrees",
        )
