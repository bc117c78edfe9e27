"""Scores of poses over sets of test frames, straight from the errors of single frames.

Two ways of counting, always told apart: over the frames that the paper scores (its subsets), and over all test frames
with a missing pose counted as a failure.
"""

from dataclasses import asdict

import pandas as pd

from groundwalk.reports.inputs import SceneInputs, compared
from groundwalk.reports.published import PAPER_METHOD, RAW_METHOD
from groundwalk.scoring.errors import sure_enough
from groundwalk.scoring.scores import SUBSETS, Score, score
from groundwalk.store import UserError


def scene_scores(scene: SceneInputs) -> pd.DataFrame:
    """All scores of one scene's test frames, one row a model, method, subset and set.

    Columns: model, method, options, subset, over, share and coverage (percent), and Score's. `subset` is rp, opt or
    rp+opt (the paper's rule and, beside it, the raw regressor: over the same frames, `over` = "subset", and over all
    test frames, "all"); "all" (every method, poses in time, a missing pose fails); "common" (every method, on the
    frames that every causal method of this model answers in time). These two are over frames that all methods ran on:
    in sessions without VIO the raw regressor stands alone.

    Without the paper's rule there are no subsets, and the raw regressor over all test frames stands at rp+opt.
    UserError where there is no test frame with ground truth.
    """
    test = scene.errors[scene.errors["split"] == "test"]
    if test.empty:
        raise UserError(
            f"scene {scene.name} has no test frame with ground truth",
            expected="errors of test frames in fuse.errors",
            do="look at the align stage's table checks, and at the split in the scene's config",
        )
    models = test.groupby("model", sort=False)
    return pd.DataFrame([row for model, errors in models for row in _model_rows(str(model), errors, scene.offline)])


def _model_rows(model: str, errors: pd.DataFrame, offline: set[str]) -> list[dict[str, object]]:
    total = errors["frame_id"].nunique()
    rows: list[dict[str, object]] = []

    def add(method: str, options: str, subset: str, over: str, result: Score) -> None:
        share = 100 * result.frames / total
        coverage = 100 * result.answered / result.frames if result.frames else float("nan")
        keys = {"model": model, "method": method, "options": options, "subset": subset, "over": over}
        rows.append(keys | {"share": share, "coverage": coverage} | asdict(result))

    paper = errors[errors["method"] == PAPER_METHOD]
    raw_all = _scored(errors.drop_duplicates("frame_id"), "raw_")
    if paper.empty:
        add(RAW_METHOD, "", "rp+opt", "all", raw_all)
    else:
        for subset, statuses in SUBSETS.items():
            part = paper[paper["status"].isin(statuses)]
            add(RAW_METHOD, "", subset, "all", raw_all)
            add(RAW_METHOD, "", subset, "subset", _scored(part, "raw_"))
            add(PAPER_METHOD, str(paper["options"].iloc[0]), subset, "subset", _scored(part, ""))

    errors = compared(errors)
    unanswered = errors["live_position_m"].isna() | errors["live_rotation_deg"].isna()
    missed = set(errors.loc[unanswered & ~errors["method"].isin(offline), "frame_id"])
    for method, part in errors.groupby("method", sort=False):
        options = str(part["options"].iloc[0])
        add(str(method), options, "all", "all", _scored(part, "live_"))
        add(str(method), options, "common", "subset", _scored(part[~part["frame_id"].isin(missed)], "live_"))
    return rows


def by_walk(scene: SceneInputs) -> dict[tuple[str, str], Score]:
    """What each model alone scores over the test frames of each test walk, by (model, walk)."""
    errors = scene.errors[scene.errors["split"] == "test"].drop_duplicates(["model", "frame_id"])
    walks = errors["session_id"]
    return {
        (model, walk): _scored(errors[(errors["model"] == model) & (walks == walk)], "raw_")
        for model in scene.models
        for walk in sorted(set(walks))
    }


def _scored(errors: pd.DataFrame, prefix: str) -> Score:
    """The score of rows of fuse.errors, whose poses `prefix` says."""
    return score(errors[f"{prefix}position_m"], errors[f"{prefix}rotation_deg"], sure_enough(errors["quality"]))
