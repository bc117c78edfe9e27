"""Is this run what its numbers are taken for? Checks on the artefacts that the tables are made from."""

from collections.abc import Iterator

import pandas as pd

from groundwalk.reports.grids import OURS
from groundwalk.reports.inputs import LEAK_S, MAX_NEAR_COPIES, SceneInputs
from groundwalk.store.choices import MapUnit

AGREES, DISAGREES, CAUTION = "agrees", "disagrees", "caution"
WRONG_M, WRONG_DEG = 1.0, 5.0
_COLUMNS = ["check", "table", "column", "expected", "printed", "status", "because"]


def run_findings(scene: SceneInputs) -> pd.DataFrame:
    """What was found of one scene's ground truth, split and errors, as rows of report.checks: where, what it should be
    by the rule, what is printed, and the status."""
    return pd.DataFrame(_findings(scene), columns=_COLUMNS).assign(scene=scene.name, subset="all", source=OURS)


def _findings(scene: SceneInputs) -> Iterator[tuple[str, ...]]:
    truth = scene.ground_truth
    known = set(truth.loc[(truth["split"] == "test") & truth["map_cam_tx"].notna(), "frame_id"])
    test = scene.errors[scene.errors["split"] == "test"]
    alone = set(truth.loc[truth["session_id"].isin(scene.unfused_sessions), "frame_id"])
    for (model, method), errors in test.groupby(["model", "method"], sort=False):
        scored = set(errors["frame_id"])
        expected = known if method in scene.raw_methods else known - alone
        yield (
            *("all_scored", "fuse.errors", f"{model} {method}", f"{len(expected)} frames"),
            f"{len(expected & scored)} of them, {len(scored - expected)} others",
            AGREES if scored == expected else DISAGREES,
            "each test frame with ground truth has one row for each method, answered or not; of a method that fuses, "
            "each in sessions where it can",
        )
    if scene.unit is MapUnit.METRE:
        yield from _wrong_answers(scene, test[test["method"].isin(scene.raw_methods)])
    uses_vio = int(truth["gt_uses_vio"].sum())
    yield (
        *("ground_truth_without_vio", "align.ground_truth", "gt_uses_vio", "0 frames", f"{uses_vio} frames"),
        CAUTION if uses_vio else AGREES,
        "ground truth that leans on VIO flatters methods that use VIO",
    )
    leak, near = scene.leak_s, scene.near_copies
    if near is not None and leak is None:
        apart = f"no times; {near:.0%} of test images show nearly what a training image shows"
    else:
        apart = "in different walks" if leak is None else f"{leak:.1f} s apart in one walk"
    is_apart = (leak is None or leak >= LEAK_S) and (near or 0) <= MAX_NEAR_COPIES
    yield (
        *("no_leak", "import.frames", "split", f"{LEAK_S:g} s apart or more", apart),
        AGREES if is_apart else CAUTION,
        "a test frame next to a training frame shows nearly the same picture",
    )


def _wrong_answers(scene: SceneInputs, test: pd.DataFrame) -> Iterator[tuple[str, ...]]:
    """Whether structure localisers refused what they couldn't localise, by errors of test frames in metres."""
    for model in scene.localisers["model"]:
        errors = test[test["model"] == model].drop_duplicates("frame_id")
        wrong = int(((errors["raw_position_m"] > WRONG_M) | (errors["raw_rotation_deg"] > WRONG_DEG)).sum())
        yield (
            *("no_wrong_answer", "localise.predictions", f"{model} pose"),
            *("0 frames", f"{wrong} of {len(errors)} frames", CAUTION if wrong else AGREES),
            f"a structure localiser refuses rather than be off by more than {WRONG_M:g} m or {WRONG_DEG:g} degrees",
        )
