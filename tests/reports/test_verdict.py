"""The verdict on a capture: what the page and verdict.json say after each stage, and of what was refused."""

import json
import shutil
from base64 import b64encode
from collections.abc import Callable
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

import groundwalk
from groundwalk.alignment.quality import CLASS_B, FrameEvidence, grade
from groundwalk.commands import closing_lines
from groundwalk.fusion.evaluation.summary import summarise
from groundwalk.geometry.poses import make_pose, yaw_rotation
from groundwalk.reports.definition import STAGE
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.verdict import FRAME_ADVICE, judge, state_of
from groundwalk.store.choices import NotRegistered
from groundwalk.store.files import read_json, write_json
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.stage import execute
from groundwalk.store.tables import dataset_frames, map_unit, pose_frame, poses_of, read_table, write_table
from tests.known import cells as values
from tests.known import note_outputs, rewrite, table_of
from tests.reports.made_up_scenes import MadeUpScene, page_of, rows_of

MakeRun = Callable[..., DataRoot]
pytestmark = pytest.mark.usefixtures("no_figures")
LATER = ("localise", "train", "fuse")


def judged(data: DataRoot, scene: str) -> tuple[str, dict]:
    """The page, and verdict.json."""
    folder = execute(STAGE, scene, "tiny", data)
    return page_of(folder), json.loads((folder / "verdict.json").read_text())


def test_the_page_grows_with_the_stages_that_are_finished(make_run: MakeRun) -> None:
    data = make_run(simulated=False, Yard={"train": 12, "test": 8, "localisers": ("Map",)})
    run, aside = data.run("tiny", "Yard"), data.root / "aside"
    shutil.move(run, aside)
    run.mkdir()
    sections = {"import": "verdict capture made", "align": "verdict capture ground-truth made",
                "train": "verdict capture ground-truth localisers made",
                "fuse": "verdict capture ground-truth localisers fusion all-checks made"}  # fmt: skip
    for name in ("import", "sfm", "align", "localise", "train", "fuse"):
        shutil.move(aside / name, run / name)
        if name in sections:
            page, verdict = judged(data, "Yard")
            assert [part.split('"')[0] for part in page.split('<section id="')[1:]] == sections[name].split()
            assert verdict["verdict"] == ("not judged yet" if name == "import" else "accepted")
    # What was made from another alignment than there is now takes no part.
    manifest = load_manifest(run / "fuse")
    write_json(run / "fuse" / "manifest.json", manifest | {"inputs": {"Yard/align": {"ground_truth.parquet": "other"}}})
    assert 'id="fusion"' not in judged(data, "Yard")[0]


def test_verdict_json_has_every_frame_as_the_ground_truth_has_it(make_run: MakeRun) -> None:
    data = make_run(simulated=False, Yard={"train": 30, "test": 20, "uncertain": 0.2})
    page, verdict = judged(data, "Yard")
    truth = table_of(data, "Yard", "align", "ground_truth").set_index("frame_id")
    frames = {frame["frame_id"]: frame for frame in verdict["frames"]}
    assert set(frames) == set(truth.index)
    for frame_id, row in truth.iterrows():
        assert (frames[frame_id]["quality"], frames[frame_id]["reason"]) == (row["quality"], row["reason"])
        assert frames[frame_id]["x"] == (
            None if np.isnan(row["map_cam_tx"]) else pytest.approx(row["map_cam_tx"], 1e-5)
        )
    counts = truth["quality"].value_counts()
    headline = verdict["headline"]
    assert [headline[f"class_{name}"] for name in ("A", "C", "none")] == [counts["A"], counts["C"], counts["none"]]
    assert headline["trusted_share"] == pytest.approx(counts["A"] / len(truth), rel=1e-4)
    assert verdict["captures"] == "real" and verdict["true_errors"] is None
    assert [row["distance_m"] for row in verdict["vio_error_by_distance"]] == [5.0, 10.0, 20.0, 50.0]
    shown = {row[0]: int(row[1]) for row in rows_of(data.run("tiny", "Yard", "report"), "quality-Yard")}
    assert shown == counts.to_dict()
    assert page.count("<circle ") == len(truth) and page.count('class="q-C"') == counts["C"]


def test_uncertain_scale_or_too_few_sure_frames_leave_it_undecided(make_run: MakeRun) -> None:
    data = make_run(Yard={"train": 12, "test": 8, "uncertain": 0.7}, Lane={"train": 12, "test": 8})
    assert judged(data, "Yard")[1]["verdict"] == "undecided"
    checks = table_of(data, "Lane", "align", "checks")
    scale = checks.iloc[[-1]].assign(check="map_scale", reason="scale: 2.8 % (limit 2 %)", advice="a longer walk")
    scale["session_id"], of_walk = "", scale.assign(check="session_scale", session_id="walk_0")
    rewrite(data, "Lane", "align", "checks", pd.concat([checks, scale, of_walk]))
    _, verdict = judged(data, "Lane")
    assert verdict["verdict"] == "undecided" and "scale: 2.8 % (limit 2 %)" in verdict["why"]
    problem = {"what": "check map_scale undecided", "count": 10, "why": scale["reason"].iloc[0], "do": "a longer walk"}
    assert problem in verdict["problems"]
    assert problem | {"what": "check session_scale undecided, walk_0"} in verdict["problems"]


@pytest.mark.parametrize(
    "evidence", [CLASS_B._replace(**{name: worse}) for name, worse in zip(CLASS_B._fields, (1, 9, 9, 9), strict=True)]
)
def test_whatever_keeps_a_frame_from_being_sure_comes_with_what_to_do(
    make_run: MakeRun, evidence: FrameEvidence
) -> None:
    data = make_run(Yard={"train": 12, "test": 8, "uncertain": 0.7})
    truth = table_of(data, "Yard", "align", "ground_truth")
    uncertain = truth["quality"] == "C"
    assert uncertain.any()
    rewrite(data, "Yard", "align", "ground_truth", truth.assign(reason=np.where(uncertain, grade(evidence).reason, "")))
    problems = judged(data, "Yard")[1]["problems"]
    assert [problem["do"] != "" for problem in problems if problem["what"] == "class C"] == [True]
    assert [p["why"] for p in problems if p["what"] == "recording walk_3 left out"] == [
        "a video can't be read: 0 bytes"
    ]
    of_align = (
        "pose in SfM inconsistent with VIO",
        "poses in SfM and reference inconsistent",
        "class C: the map has no metric scale",
    )
    assert all(any(words in reason for words in FRAME_ADVICE) for reason in (*NotRegistered, *of_align))


def test_of_a_map_of_images_alone_no_sigma_is_said(make_run: MakeRun) -> None:
    data = make_run(Yard={"train": 12, "test": 8})
    sessions = table_of(data, "Yard", "import", "sessions").assign(pose_source="none")
    rewrite(data, "Yard", "import", "sessions", sessions)
    rewrite(data, "Yard", "align", "residuals", table_of(data, "Yard", "align", "residuals").iloc[:0])
    truth = table_of(data, "Yard", "align", "ground_truth").assign(scale_source="none")
    rewrite(data, "Yard", "align", "ground_truth", truth)
    for name in LATER:
        shutil.rmtree(data.run("tiny", "Yard", name))
    page, verdict = judged(data, "Yard")
    assert verdict["verdict"] == "undecided" and ": 39 of 40 are in the map" in verdict["why"]
    assert {frame["position_sd"] for frame in verdict["frames"]} == {None}
    assert "look-alike places may be one in it" in page


def test_without_metric_scale_the_walk_is_as_long_as_in_the_map() -> None:
    """VIO's metres aren't of the map's unit."""
    tables = MadeUpScene("Yard", 0, train=12, test=8, uncertain=0.49, scale_source="none").tables()
    truth = tables["align"]["ground_truth"].copy()
    truth[["map_cam_tx", "map_cam_ty", "map_cam_tz"]] *= 3
    made = SimpleNamespace(
        frames=dataset_frames(tables["import"]["frames"]), ground_truth=truth, unit=map_unit(truth), stages={"align"},
        stopped={}, is_images_alone=False, true_T_cam=None, rejects=tables["import"]["rejects"],
        residuals=tables["align"]["residuals"], align_sessions=tables["align"]["sessions"],
        align_checks=tables["align"]["checks"],
    )  # fmt: skip
    verdict = judge(cast(SceneInputs, made))
    walk = poses_of(truth[truth["session_id"] == "walk_1"], "map_cam")[:, :3, 3]
    of_walk = verdict.frames[verdict.frames["session_id"] == "walk_1"]
    assert of_walk["travelled"].max() == pytest.approx(np.linalg.norm(np.diff(walk, axis=0), axis=1).sum())


def test_what_is_needed_is_said_as_a_count() -> None:
    """49.8 % isn't "50 %, but 50 % are needed"."""
    checks = pd.DataFrame({"check": [], "status": [], "reason": []})
    state, why = state_of(checks, pd.Series(["A"] * 100 + ["C"] * 101))
    assert state == "undecided" and why.endswith("but: 101 of 201 are needed")
    checks = pd.DataFrame({"check": ["map_scale"], "status": ["undecided"], "reason": ["the scale is unknown"]})
    assert state_of(checks, pd.Series(["C"]))[1].endswith("but: 1 of 1 are needed; the scale is unknown")


def test_a_refused_capture_says_why_and_what_to_do(make_run: MakeRun) -> None:
    data = make_run(simulated=False, Yard={"train": 12, "test": 8})
    run = data.run("tiny", "Yard")
    for name in ("align", *LATER):
        shutil.rmtree(run / name)
    (run / ".align.partial").mkdir()
    why = {"what": "the SfM model fails its consistency checks: <b>aliasing</b>", "do": "record & retry 100 %"}
    write_json(run / ".align.partial" / "stopped.json", why | {"found": "\nfirst attempt\nsecond attempt"})
    (run / ".align.partial" / "checks.png").write_bytes(b"a picture")
    page, verdict = judged(data, "Yard")
    assert verdict["verdict"] == "refused" and verdict["why"] == why["what"] + " (first attempt; second attempt)"
    first_screen = page[: page.index('<section id="capture">')]
    assert f"data:image/png;base64,{b64encode(b'a picture').decode()}" in first_screen
    assert {frame["quality"] for frame in verdict["frames"]} == {"none"}
    assert "&lt;b&gt;aliasing" in page and "<b>aliasing" not in page and "record &amp; retry 100 %" in page


def test_hostile_names_stay_text(make_run: MakeRun) -> None:
    data = make_run(simulated=False, Yard={"train": 12, "test": 8})
    evil = "</script><script>alert(1)</script>&_%"
    rewrite(data, "Yard", "align", "ground_truth", table_of(data, "Yard", "align", "ground_truth").assign(reason=evil))
    rewrite(data, "Yard", "import", "sessions", table_of(data, "Yard", "import", "sessions").assign(device=evil))
    page, _ = judged(data, "Yard")
    assert evil not in page and page.count("<script") == 2 and "alert(1)" in page


def test_a_simulated_scene_has_stated_beside_true(make_run: MakeRun) -> None:
    data = make_run(simulated=True, Yard={"train": 30, "test": 20})
    truth = table_of(data, "Yard", "align", "ground_truth")
    map_T_cam = poses_of(truth, "map_cam")
    rng = np.random.default_rng(0)
    off = np.tile(np.eye(4), (len(truth), 1, 1))
    off[:, :3, 3] = rng.normal(0, 0.02, (len(truth), 3))
    true_T_map = make_pose(yaw_rotation(0.7), np.array([3.0, 0.5, -2.0]))
    covariance = np.diag([1e-6] * 3 + [0.02**2] * 3).ravel()
    stated = truth.assign(covariance=values(None if np.isnan(p[0, 0]) else covariance for p in map_T_cam))
    rewrite(data, "Yard", "align", "ground_truth", stated)
    keys = truth[["session_id", "t_ns"]]
    poses = pd.concat([keys, pose_frame("map_cam", true_T_map @ off @ map_T_cam)], axis=1)
    poses = poses.dropna(subset=["map_cam_tx"])
    of = schema("simulate", "true_poses")
    write_table(data.captures("Yard") / "true_poses.parquet", poses[of.column_names], of)
    page, verdict = judged(data, "Yard")
    errors = verdict["true_errors"]
    expected = np.median(np.linalg.norm(off[:, :3, 3], axis=1))
    assert errors["position"] == pytest.approx(expected, rel=0.1) and errors["position_stated"] == pytest.approx(0.02)
    assert 88 < errors["position_within"] <= 100 and errors["scale"] < 0.1 and errors["vertical_deg"] < 0.1
    assert "Stated against true" in page and "ground truth from the truth (m)" in page
    # Without a vertical its axes mean nothing, which only heading and origin are fitted of.
    rewrite(data, "Yard", "align", "ground_truth", stated.assign(vertical_source="none"))
    align = data.run("tiny", "Yard", "align")
    note_outputs(align, figures=load_manifest(align)["figures"] | {"vertical_sd_deg": None})
    page, verdict = judged(data, "Yard")
    assert verdict["true_errors"] is None and "Stated against true" not in page


def test_page_tables_terminal_summary_and_errors_agree_on_who_has_a_pose(
    make_run: MakeRun, capsys: pytest.CaptureFixture[str]
) -> None:
    data = make_run(Yard={"train": 30, "test": 20, "localisers": ("Map",)})
    errors = table_of(data, "Yard", "fuse", "errors")
    errors = errors[errors["split"] == "test"].reset_index(drop=True)
    rewrite(data, "Yard", "fuse", "errors", errors)
    rewrite(data, "Yard", "fuse", "summary", summarise(errors).assign(map_unit="metres"))
    folder = execute(STAGE, "Yard", "tiny", data)
    said = capsys.readouterr().err
    cells = read_table(folder / "cells.parquet", schema("report", "cells"))
    table4 = (folder / "tables" / "table4.md").read_text()
    headline = {row[0]: row for row in rows_of(folder, "headline-Yard")}
    run = groundwalk.open("Yard", profile="tiny", data=data.root)
    summary = run.summary()
    for model in ("PN", "MS-T", "Map"):
        for method, name in (("raw", f"{model}, alone"), ("paper_rule", f"{model}+VIO")):
            rows = run.errors[(run.errors["model"] == model) & (run.errors["method"] == method)]
            answered, frames = int(rows["live_position_m"].notna().sum()), len(rows)
            coverage, median = 100 * answered / frames, rows["live_position_m"].fillna(np.inf).median()
            of_method = cells[(cells["model"] == model) & (cells["method"] == method) & (cells["row"] == "all")]
            value = of_method[of_method["table"] == "IV"].set_index(["statistic", "quantity"])["value"]
            assert value["coverage", "frames"] == pytest.approx(coverage)
            assert value["median", "translation"] == pytest.approx(median)
            assert headline[name][1] == f"{median:.2f}" if median > 0.1 else f"{median:.3f}"
            assert headline[name][4] == f"{coverage:.1f}"
            assert headline[name][5] == {"raw": "1.60 to infinite", "paper_rule": "1.20 to 1.95"}[method]
            label = model if method == "raw" else name
            assert f"| Yard | {label} | {coverage:.1f} |" in table4
            assert f"Yard: {name}: median {headline[name][1]} m" in said and f"{coverage:.1f} % have a pose" in said
            assert f"{method}, {model}" in summary
            line = next(line for line in summary.splitlines() if line.startswith(f"{method}, {model} "))
            assert f"median {headline[name][1]} m" in line and f"{answered} of {frames} test frames have a pose" in line
    closing = list(closing_lines(read_json(folder / "verdict.json")))
    subjects = ["ground truth", "VIO", "best structure localiser", "best regressor"]
    assert [line.split(":")[0] for line in closing] == subjects
    assert f"Map, alone: median {float(headline['Map, alone'][1]):g} m" in closing[2]
    best = min(("PN+VIO", "MS-T+VIO"), key=lambda name: float(headline[name][1]))
    model = best.removesuffix("+VIO")
    alone = headline[f"{model}, alone"][1]
    assert f"{best}: median {float(headline[best][1]):g} m" in closing[3] and closing[3].endswith(
        f"alone {float(alone):g} m"
    )
    # What the paper's rule scores isn't called what it answers.
    assert "answers" not in (folder / "tables" / "table2.md").read_text()


def test_headlines_say_what_stands_by_them(make_run: MakeRun) -> None:
    for simulated, kind in ((True, "Simulated"), (False, "Measured")):
        data = make_run(simulated=simulated, Yard={"train": 12, "test": 8})
        page, _ = judged(data, "Yard")
        caption = page[page.index('id="headline-Yard"') :].split("</figcaption>")[0]
        assert f"{kind}, over 15 test frames with ground truth of 16" in caption
        assert "own sigma there is 0.0050 m" in caption and "15 of these queries took part" in caption
