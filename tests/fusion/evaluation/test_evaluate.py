"""Evaluation of tables: figures against a direct count, bad input, and the command line."""

import dataclasses
import hashlib
import json
from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from groundwalk.fusion import __main__ as commands
from groundwalk.fusion.__main__ import app
from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import Results, evaluate, report_lines
from groundwalk.fusion.evaluation.sweep import VALUES
from groundwalk.fusion.files.walks import Files, Inputs, evaluated
from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.methods.last_good import LastGood
from groundwalk.fusion.methods.localiser import Estimate
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError
from groundwalk.store.choices import MapUnit
from groundwalk.store.files import write_json
from groundwalk.store.registry import Source
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table
from tests.fusion.tables import Tables, tables
from tests.known import there

SEEDS = [1, 2, 3]
Spoil = Callable[..., Tables]
"""What makes three tables into three that are wrong."""


def run(frames: pd.DataFrame, truth: pd.DataFrame, predictions: pd.DataFrame, **settings: Any) -> Results:
    return evaluate([Inputs("Place", frames, truth, predictions)], FuseSettings(**settings))


def test_summary_counts_what_is_there() -> None:
    results = run(*tables(SEEDS, ("PN", "MS-T")), methods=["raw", "paper_rule", "last_good", "vio_oracle"])
    errors, summary = results.tables["errors"], results.tables["summary"]
    ours = errors[(errors["method"] == "paper_rule") & (errors["model"] == "PN")]
    of_rule = summary[(summary["method"] == "paper_rule") & (summary["model"] == "PN")]
    row: Any = of_rule.set_index(["subset", "scored"]).loc

    reliable = ours[ours["status"] == "reliable"]
    assert row["rp", "method"]["frames"] == len(reliable)
    assert row["rp", "method"]["frames_pct"] == pytest.approx(100 * len(reliable) / 120)
    assert row["rp", "method"]["position_median_m"] == pytest.approx(np.median(reliable["position_m"]))
    # A reliable pose is the prediction itself.
    assert row["rp", "raw"]["position_mean_m"] == pytest.approx(row["rp", "method"]["position_mean_m"])
    pooled = row["rp", "method"]["frames"] + row["opt", "method"]["frames"]
    assert row["rp+opt", "method"]["frames"] == pooled

    everything = row["all", "method"]
    answered = ours["live_position_m"].dropna()
    assert everything["frames"] == 120 and everything["answered"] == len(answered) < 120
    assert everything["position_mean_m"] == pytest.approx(answered.mean())
    high = (ours["live_position_m"] <= 0.25) & (ours["live_rotation_deg"] <= 2)
    assert everything["high_pct"] == pytest.approx(100 * high.sum() / 120)
    # Missing counts as infinitely wrong.
    filled = ours["live_position_m"].fillna(np.inf)
    assert everything["position_median_m"] == pytest.approx(np.median(filled))
    common = summary[(summary["subset"] == "common") & (summary["scored"] == "method")]
    assert (common["answered"] == common["frames"]).all() and len(set(common["frames"])) == 1


def held_out_tables() -> list[pd.DataFrame]:
    """Four sessions, of which two were held out of training."""
    parts = [t.copy() for t in tables([1, 2, 3, 4])]
    for table in parts:
        table.loc[table["session_id"].isin(["s1", "s2"]), "split"] = "val"
    return parts


def test_held_out_frames_say_which_method_is_ahead() -> None:
    frames, truth, predictions = held_out_tables()
    evaluated = partial(run, methods=["raw", "paper_rule", "drift_aware", "vio_oracle"])
    found = evaluated(frames, truth, predictions).tables["validation"]
    assert set(found["frames"]) == {80} and list(found.loc[found["ahead"], "method"]) != []
    assert found.groupby("model")["ahead"].sum().tolist() == [1]
    assert not set(found["method"]) & {"vio_oracle"}
    # Its figures are those of an evaluation of these frames.
    summary = evaluated(frames, truth, predictions, splits=["val"]).tables["summary"]
    summary = summary[(summary["subset"] == "all") & (summary["scored"] == "method")].set_index("method")
    for figure in ("coverage_pct", "position_mean_m", "rotation_mean_deg"):
        assert np.allclose(found[figure], summary.loc[found["method"], figure])
    # Where it has none, whatever the methods: two quick ones.
    evaluated = partial(run, methods=["raw", "paper_rule"])
    assert "validation" in evaluated(frames, truth, predictions).tables
    assert "validation" not in evaluated(frames, truth, predictions, splits=["test", "val"]).tables
    unseen = predictions[predictions["split"] == "test"]
    assert "validation" not in evaluated(frames, truth, unseen).tables
    # Frames without ground truth have a row of it, too: where most are so, nothing is ahead by the few others.
    few = truth.copy()
    is_known = ~((few["split"] == "val") & (few["frame_id"] != few["frame_id"].iloc[0]))
    for column in map(str, few):
        if column.startswith("map_cam_"):
            few[column] = few[column].where(is_known)
    assert "validation" not in evaluated(frames, few, predictions).tables


def test_held_out_frames_of_no_quality_hold_up_nothing() -> None:
    frames, truth, predictions = held_out_tables()
    quality = np.where(truth["split"] == "val", "none", "A")
    results = run(frames, truth.assign(quality=quality), predictions, methods=["raw", "paper_rule"])
    assert "validation" not in results.tables and len(results.tables["errors"]) == 160


def test_a_plugin_that_fails_on_held_out_frames_alone_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    class Picky(LastGood):
        def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
            if t_ns in held_out:
                raise ZeroDivisionError("no such place")
            return super()._fuse(t_ns, vio_T_cam, map_T_cam_predicted)

    parts = held_out_tables()
    held_out = set(parts[0].loc[parts[0]["split"] == "val", "t_ns"]) - set(parts[0].query("split == 'test'")["t_ns"])
    picky = dataclasses.replace(METHODS["last_good"], id="picky", make=Picky)
    source = Source("picky", "1", EntryPoint("picky", "picky:METHOD", METHODS.group))
    monkeypatch.setitem(METHODS._others.entries, "picky", picky)
    monkeypatch.setitem(METHODS._others.sources, "picky", source)
    results = run(*parts, methods=["raw", "picky"])
    assert [error.reason for error in results.left_out] == ["ZeroDivisionError: no such place"]
    for name in ("validation", "errors", "methods"):
        assert set(results.tables[name]["method"]) == {"raw"}, name
    assert results.tables["validation"]["ahead"].all()


def test_predictions_at_another_rate_than_a_method_checks_them_at_are_said() -> None:
    parts = tables([1, 2])
    methods = ["raw", "paper_rule", "last_good"]
    assert not any("aren't checked" in line for line in report_lines(run(*parts, methods=methods)))
    for table in parts:
        table["t_ns"] //= 5
    said = [line for line in report_lines(run(*parts, methods=methods)) if "aren't checked" in line]
    assert [line.split(": ")[1] for line in said] == ["paper_rule", "last_good"] and "interval_s" in said[0]
    at_5_hz = {"interval_s": 0.2, "interval_tolerance_s": 0.1}
    options = dict.fromkeys(methods[1:], at_5_hz)
    assert not any("aren't checked" in line for line in report_lines(run(*parts, methods=methods, options=options)))


def test_offline_methods_do_not_shrink_what_causal_ones_are_compared_on() -> None:
    frames, truth, predictions = tables(SEEDS)
    causal = ["raw", "drift_aware"]
    # Where odometry is lost these two answer with the prediction, the bound with nothing.
    both = run(frames, truth, predictions, methods=[*causal, "vio_oracle"]).tables["summary"].set_index("method")
    alone = run(frames, truth, predictions, methods=causal).tables["summary"].set_index("method")
    own = both[(both["subset"] == "all") & (both["scored"] == "method")]["answered"]
    assert own["vio_oracle"] < min(own["raw"], own["drift_aware"])
    pd.testing.assert_frame_equal(both.loc[causal], alone)


def test_poses_confirmed_later_are_not_live() -> None:
    ours = run(*tables(SEEDS), methods=["paper_rule"]).tables["poses"]
    late = ours[ours["status"] != ours["live_status"]]
    assert len(late) and set(late["status"]) == {"reliable"} and set(late["live_status"]) <= {"none", "aligning"}
    assert np.isfinite(poses_of(late, "map_cam")).all()


def test_row_order_does_not_matter_and_is_counted() -> None:
    frames, truth, predictions = tables(SEEDS)
    shuffled = [t.sample(frac=1, random_state=0) for t in (frames, truth, predictions)]
    a, b = (run(*part, methods=["raw", "paper_rule", "window30"]) for part in ((frames, truth, predictions), shuffled))
    pd.testing.assert_frame_equal(a.tables["summary"], b.tables["summary"])
    assert a.counts["frames_out_of_order"] == 0 < b.counts["frames_out_of_order"]


def test_frames_that_cannot_be_scored_are_counted() -> None:
    frames, truth, predictions = tables([1])
    predictions.loc[3, "map_cam_tx"] = np.nan
    predictions.loc[4, [f"map_cam_q{a}" for a in "xyzw"]] = 0.0
    predictions.loc[5, "frame_id"] = "elsewhere/000001"
    truth.loc[7, [c for c in truth.columns if c.startswith("map_cam")]] = np.nan
    counts, plain = (run(*part, methods=["raw"]).counts for part in ((frames, truth, predictions), tables([1])))
    assert counts["predictions_not_finite"] == plain["predictions_not_finite"] + 2
    assert counts["predictions_of_unknown_frames"] == counts["frames_without_prediction"] == 1
    assert counts["frames_without_ground_truth"] == 1 and plain["frames_of_unstated_quality"] == 40


def test_levels_leave_out_ground_truth_of_class_c_and_count_it() -> None:
    frames, truth, predictions = tables([1, 2])
    quality = np.array(["A", "B", "C", "A"])[np.arange(len(truth)) % 4]
    results = run(frames, truth.assign(quality=quality), predictions, methods=["raw", "paper_rule"])
    assert results.counts["frames_too_uncertain_for_levels"] == 20
    assert results.counts["frames_of_unstated_quality"] == 0
    errors = results.tables["errors"]
    assert list(errors.loc[errors["method"] == "raw", "quality"]) == list(quality)
    rows: Any = results.tables["summary"].set_index(["method", "subset", "scored"]).loc
    rule = errors[errors["method"] == "paper_rule"]
    for subset, part, prefix in (("all", rule, "live_"), ("rp", rule[rule["status"] == "reliable"], "")):
        row, sure = rows[("paper_rule", subset, "method")], part[part["quality"] != "C"]
        high = (sure[f"{prefix}position_m"] <= 0.25) & (sure[f"{prefix}rotation_deg"] <= 2)
        assert row["high_pct"] == pytest.approx(100 * high.mean()) and row["too_uncertain"] == len(part) - len(sure) > 0
        assert row["position_mean_m"] == pytest.approx(part[f"{prefix}position_m"].mean())  # counts them
    swept = results.tables["sweep"]
    usual = swept[(swept["varied"] == "n") & (swept["n"] == 2) & (swept["subset"] == "all")].iloc[0]
    assert usual["medium_pct"] == rows[("paper_rule", "all", "method"), "medium_pct"]
    assert usual["too_uncertain"] == 20


def test_without_sure_ground_truth_levels_are_empty_and_that_is_said() -> None:
    frames, truth, predictions = tables([1])
    results = run(frames, truth.assign(quality="C"), predictions, methods=["raw", "paper_rule"])
    summary = results.tables["summary"]
    assert summary[["high_pct", "medium_pct", "low_pct"]].isna().all(axis=None)
    assert (summary["too_uncertain"] == summary["frames"]).all()
    assert summary.loc[summary["subset"] == "all", "position_mean_m"].notna().any()
    assert any("no accuracy level can be scored" in line for line in report_lines(results))


def test_covariances_that_predictions_bring_reach_the_walk_and_wrong_ones_are_counted() -> None:
    frames, truth, predictions = tables([1])
    stated: list[Any] = [np.eye(6).ravel().tolist() for _ in range(len(predictions))]
    stated[3], stated[4], stated[5] = None, (-np.eye(6)).ravel().tolist(), [1.0, 2.0]
    found = evaluated("Hall", frames, truth, predictions.assign(covariance=stated), ["test"])
    (walk,) = found.walks
    covariance = there(walk.predicted_covariance)
    known = np.isfinite(covariance).all(axis=(1, 2))
    assert list(np.flatnonzero(~known)) == [3, 4, 5] and np.array_equal(covariance[0], np.eye(6))
    assert found.prediction_counts["prediction_covariances_not_positive_definite"] == 2
    (plain,) = evaluated("Hall", frames, truth, predictions.assign(covariance=None), ["test"]).walks
    assert plain.predicted_covariance is None


def test_covariances_may_be_six_rows_and_what_is_no_matrix_is_counted(tmp_path: Path) -> None:
    frames, truth, predictions = tables([1])

    def of_file(**covariance: Any) -> Results:
        files = parquet_files(tmp_path, frames, truth, predictions.assign(**covariance))
        return evaluate([files.read("Place")], FuseSettings(methods=["drift_aware"]))

    matrix = np.diag([0.01] * 3 + [0.2] * 3)
    flat, rows = (of_file(covariance=[stated] * 40) for stated in (matrix.ravel().tolist(), matrix.tolist()))
    pd.testing.assert_frame_equal(rows.tables["poses"], flat.tables["poses"])
    without = of_file().tables["poses"]
    assert not without.equals(flat.tables["poses"])
    for stated in (json.dumps(matrix.ravel().tolist()), 0.2):
        found = of_file(covariance=stated)
        pd.testing.assert_frame_equal(found.tables["poses"], without)
        assert any("not positive definite: 40 (or not 6x6 numbers" in line for line in report_lines(found))


def test_only_predictions_without_a_pose_are_refusals() -> None:
    frames, truth, predictions = tables([1])
    predictions["map_cam_tx"] = predictions["map_cam_tx"].fillna(0.0)
    predictions.loc[[3, 4], "map_cam_tx"] = np.nan

    def counts(refusal: Any) -> tuple[int, int]:
        found = run(frames, truth, predictions.assign(refusal=refusal), methods=["raw"]).counts
        return found["predictions_refused"], found["predictions_not_finite"]

    missing = counts(None)[1]
    assert counts(None) == counts(False) == (0, missing) and missing >= 2
    assert counts("few_matches") == counts(True) == (missing, 0)
    assert counts(["few_matches" if row == 3 else None for row in range(40)]) == (1, missing - 1)


def test_a_pose_in_the_map_of_another_scene_is_a_failure() -> None:
    frames, truth, predictions = tables([1])
    predictions = predictions.assign(scene="Place", picked_scene=["Other", *["Place"] * 39])
    predictions.loc[0, list(truth.filter(like="map_cam_"))] = truth.filter(like="map_cam_").iloc[0]
    before = run(frames, truth, predictions.drop(columns="scene"), methods=["raw"])
    found = run(frames, truth, predictions, methods=["raw"])
    assert before.tables["errors"]["position_m"].iloc[0] < 1e-9 and found.tables["errors"]["position_m"].isna().iloc[0]
    assert found.counts["predictions_of_another_scene"] == 1
    assert found.counts["predictions_not_finite"] == before.counts["predictions_not_finite"]
    everything = run(frames, truth, predictions.assign(picked_scene="Other"), methods=["raw", "paper_rule"])
    assert everything.tables["errors"]["position_m"].isna().all()


def test_the_model_that_hardly_overlaps_is_named() -> None:
    frames, truth, predictions = tables([2], ("PN", "MS-T"))
    with pytest.raises(UserError, match="predictions of MS-T and frames hardly overlap"):
        run(frames, truth, predictions[:50], methods=["raw"])


@pytest.mark.parametrize(
    ("scale_source", "unit"), [("none", MapUnit.SFM), ("reference, unit unknown", MapUnit.REFERENCE)]
)
def test_odometry_takes_no_part_in_a_map_without_metric_scale(scale_source: str, unit: MapUnit) -> None:
    frames, truth, predictions = tables([1])
    results = run(frames, truth.assign(scale_source=scale_source), predictions)
    lost = frames.assign(**{c: np.nan for c in frames.columns if c.startswith("vio_cam")})
    pd.testing.assert_frame_equal(results.tables["poses"], run(lost, truth, predictions).tables["poses"])
    assert set(results.tables["summary"]["map_unit"]) == {unit}
    lines = report_lines(results)
    warning = f"warning: Place: NO METRIC SCALE: positions are in {unit}, not in metres; odometry, in metres, "
    warning += "takes no part"
    errors = [line for line in lines if "mean error" in line and "no pose" not in line]
    assert warning in lines and errors and all(" map units, " in line for line in errors)
    metric = run(frames, truth.assign(scale_source="vio"), predictions)
    assert set(metric.tables["summary"]["map_unit"]) == {"metres"} and "METRIC" not in "".join(report_lines(metric))


@pytest.mark.parametrize("known", [0, 5])
def test_without_a_common_vertical_methods_that_need_it_have_no_odometry(known: int) -> None:
    frames, truth, predictions = tables([1])
    methods = ["drift_aware", "window30"]
    frames = frames.assign(gravity_x=0.0, gravity_y=1.0, gravity_z=0.0)
    usual = run(frames, truth, predictions, methods=methods)
    assert usual.counts["frames_without_common_vertical"] == 0
    frames.loc[frames.index[known:], ["gravity_x", "gravity_y", "gravity_z"]] = np.nan
    results = run(frames, truth, predictions, methods=methods)
    poses, as_usual = (r.tables["poses"].set_index("method") for r in (results, usual))
    pd.testing.assert_frame_equal(poses.loc[["window30"]], as_usual.loc[["window30"]])
    if known:  # a gap isn't a world of another kind
        pd.testing.assert_frame_equal(poses, as_usual)
        return
    alone = run(frames, truth, predictions, methods=["raw"]).tables["poses"]
    pose = [column for column in alone.columns if column.startswith("map_cam_")]
    np.testing.assert_allclose(poses.loc["drift_aware", pose], alone[pose], atol=1e-9)
    assert results.counts["frames_without_common_vertical"] == frames["vio_cam_tx"].notna().sum()
    assert any("may not have +y up" in line for line in report_lines(results))


def _without_vio(frames: pd.DataFrame, *sessions: str) -> pd.DataFrame:
    """The frames, those of some sessions without poses by odometry."""
    vio = [column for column in frames.columns if column.startswith("vio_cam_")]
    frames = frames.copy()
    frames.loc[frames["session_id"].isin(sessions), vio] = np.nan
    return frames


def test_without_odometry_nothing_is_fused_and_predictions_stand_alone() -> None:
    frames, truth, predictions = held_out_tables()
    results = run(_without_vio(frames, "s1", "s2", "s3", "s4"), truth, predictions)
    for name in ("poses", "errors", "summary", "intervals", "sessions", "methods"):
        assert set(results.tables[name]["method"]) == {"raw"}, name
    assert not {"sweep", "validation"} & set(results.tables)
    summary = results.tables["summary"].set_index(["subset", "scored"])
    assert summary["coverage_pct"].loc[[("all", "method")]].tolist() == [100]
    assert summary["frames_pct"].loc[[("common", "method")]].tolist() == [100]
    lines = report_lines(results)
    alone = "frames of walks without odometry: 80 (nothing is fused there; predictions stand alone)"
    assert [line for line in lines if "odometry" in line] == [alone]
    assert [line for line in lines if "mean error" in line] == [line for line in lines if " · raw: " in line]
    # Whatever methods were asked for: there is nothing that they could fuse.
    asked = run(_without_vio(frames, "s1", "s2", "s3", "s4"), truth, predictions, methods=["window30"])
    assert asked.tables["errors"].equals(results.tables["errors"])


def test_of_walks_with_and_without_odometry_methods_fuse_the_ones_and_compare_on_the_same_frames() -> None:
    frames, truth, predictions = tables([1, 2, 3])
    results = run(_without_vio(frames, "s2"), truth, predictions)
    errors = results.tables["errors"]
    fused = errors[errors["method"] != "raw"]
    assert set(fused["session_id"]) == {"s1", "s3"} and set(fused["method"]) == set(FuseSettings().methods) - {"raw"}
    assert set(errors.loc[errors["method"] == "raw", "session_id"]) == {"s1", "s2", "s3"}
    # Each walk is fused as if the other one weren't there.
    without = run(*(table[table["session_id"] != "s2"] for table in (frames, truth, predictions)))
    alone = without.tables["errors"].query("method != 'raw'").reset_index(drop=True)
    pd.testing.assert_frame_equal(fused.reset_index(drop=True), alone)
    common = results.tables["summary"].query("subset == 'common' and scored == 'method'")
    assert len(set(common["frames"])) == 1 and (common["frames"] <= 80).all()
    assert results.counts["frames_of_walks_without_odometry"] == 40


def test_frames_without_odometry_are_counted() -> None:
    frames, truth, predictions = tables([1])
    plain = run(frames, truth, predictions, methods=["raw"]).counts["frames_without_odometry"]
    frames.loc[20:23, [c for c in frames.columns if c.startswith("vio_cam")]] = np.nan
    results = run(frames, truth, predictions, methods=["raw", "paper_rule", "drift_aware"])
    assert results.counts["frames_without_odometry"] > plain
    poses = results.tables["poses"].set_index(["method", "frame_id"])
    lost = [f"s1/{i:06d}" for i in range(20, 24)]
    assert (poses.loc["paper_rule"].loc[lost, "live_status"] == "none").all()
    predicted = predictions.set_index("frame_id").loc[lost, "map_cam_tx"].notna()
    assert ((poses.loc["drift_aware"].loc[lost, "live_status"] == "predicted") == predicted).all()


def w_first(*which: int) -> Spoil:
    """Spoils tables by writing the scalar part of quaternions first."""

    def spoil(frames: pd.DataFrame, truth: pd.DataFrame, predictions: pd.DataFrame) -> Tables:
        made = (frames, truth, predictions)
        for number in which:
            prefix = "vio_cam" if number == 0 else "map_cam"
            q = [f"{prefix}_q{a}" for a in "xyzw"]
            made[number][q] = made[number][[q[3], *q[:3]]].to_numpy()
        return made

    return spoil


def euler_degrees(frames: pd.DataFrame, truth: pd.DataFrame, predictions: pd.DataFrame) -> Tables:
    degrees = Rotation.from_matrix(poses_of(predictions, "map_cam")[:, :3, :3]).as_euler("xyz", degrees=True)
    columns = dict(zip(["map_cam_qx", "map_cam_qy", "map_cam_qz"], degrees.T, strict=True))
    return frames, truth, predictions.assign(map_cam_qw=0.0, **columns)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f, t, p: (f, t, p.drop(columns="map_cam_qw")), "lack columns"),
        (lambda f, t, p: (f, t, pd.concat([p, p.iloc[:1]])), "rows twice"),
        (lambda f, t, p: (pd.concat([f, f.iloc[:1]]), t, p), "rows twice"),
        (lambda f, t, p: (f.assign(t_ns=f["t_ns"].where(f.index != 1, f["t_ns"].iloc[0])), t, p), "rows twice"),
        (lambda f, t, p: (f, t, p.assign(session_id=p["session_id"].where(p.index != 5, "b"))), "another session_id"),
        (lambda f, t, p: (f, t, p.iloc[:10]), "hardly overlap"),
        (lambda f, t, p: (f, t.assign(t_ns=t["t_ns"] + 1), p), "another t_ns"),
        (lambda f, t, p: (f.assign(vio_cam_tx="left"), t, p), "another type"),
        (lambda f, t, p: (f, t, p.assign(frame_id=range(len(p)))), "another type"),
        (w_first(0), "frames of Place: quaternions look like w"),
        (w_first(1), "ground truth of Place: quaternions look like w"),
        (w_first(2), "predictions of Place: quaternions look like w"),
        (w_first(0, 1, 2), "frames and ground truth of Place: quaternions look like w"),
        (lambda f, t, p: (f.assign(t_ns=f["t_ns"] * 1e-9), t, p), "another type"),
        (lambda f, t, p: (f.assign(gravity_x=0.0, gravity_y="down", gravity_z=0.0), t, p), "another type"),
        (lambda f, t, p: (f, t.assign(quality="good"), p), "unknown quality"),
        (lambda f, t, p: (f.assign(session_id=f["session_id"].where(f.index != 3)), t, p), "empty values"),
        (lambda f, t, p: (f, t, p.assign(frame_id=p["frame_id"].where(p.index != 3))), "empty values"),
        (lambda f, t, p: (f, t.assign(frame_id="x" + t["frame_id"]), p), "no frame has ground truth"),
        (lambda f, t, p: (f, t.assign(map_cam_tx=np.nan), p), "no evaluated frame has ground truth"),
        (lambda f, t, p: (f, t.assign(quality="none"), p), "no evaluated frame has ground truth"),
        (lambda f, t, p: (f, t, p.iloc[:0]), "no rows"),
        (euler_degrees, "rotations are no quaternions"),
        (lambda f, t, p: (f, t, p.assign(map_cam_tx=np.nan)), "none of 40 rows has a finite pose"),
        (lambda f, t, p: (f.iloc[:0], t, p), "no rows"),
    ],
)
def test_input_that_cannot_be_evaluated_is_refused(spoil: Spoil, message: str) -> None:
    with pytest.raises(UserError, match=message):
        run(*spoil(*tables([2])))


def test_what_puts_the_figures_in_doubt_is_said_before_them() -> None:
    frames, truth, predictions = tables([1])
    finite = int(predictions["map_cam_tx"].notna().sum())

    def evaluated(changed: pd.DataFrame) -> Results:
        return run(frames, truth, changed, methods=["raw", "paper_rule"])

    def warnings(results: Results) -> list[str]:
        lines = report_lines(results)
        first_figure = next(i for i, line in enumerate(lines) if "mean error" in line)
        assert not any(line.startswith("warning") for line in lines[first_figure:])
        return lines[:first_figure]

    plain = evaluated(predictions)
    assert warnings(plain) == [f"warning: {40 - finite} predictions are not finite and count as missing"]
    far = predictions.assign(map_cam_tx=predictions["map_cam_tx"] + 5000)
    assert f"warning: {finite} predictions lie farther from the ground truth" in warnings(evaluated(far))[-1]
    some = predictions.copy()
    some.loc[some["map_cam_tx"].notna().to_numpy().nonzero()[0][:10], "map_cam_tz"] += 5000
    assert "warning: 10 predictions lie farther" in warnings(evaluated(some))[-1]
    # Of a quaternion that is too long the direction is taken.
    longer = evaluated(predictions.assign(**{f"map_cam_q{a}": 2 * predictions[f"map_cam_q{a}"] for a in "xyzw"}))
    assert f"warning: {finite} predictions have quaternions" in warnings(longer)[0]
    pd.testing.assert_frame_equal(longer.tables["summary"], plain.tables["summary"])


def test_quaternions_of_other_lengths_are_counted_and_taken_for_their_direction() -> None:
    frames, truth, predictions = tables([1])
    plain = run(frames, truth, predictions, methods=["raw", "paper_rule"])
    longer = predictions.copy()
    longer[[f"map_cam_q{a}" for a in "xyzw"]] *= 3.0
    results = run(frames, truth, longer, methods=["raw", "paper_rule"])
    predicted = int(predictions["map_cam_tx"].notna().sum())
    assert results.counts["prediction_quaternions_not_of_unit_length"] == predicted
    assert plain.counts["prediction_quaternions_not_of_unit_length"] == 0
    pd.testing.assert_frame_equal(results.tables["summary"], plain.tables["summary"])


def test_what_was_run_is_listed_with_its_options() -> None:
    found = run(*tables([1]), methods=["paper_rule", "vio_oracle"], options={"paper_rule": {"n": 3}}).tables
    methods = found["methods"].set_index("method")
    assert methods["causal"].to_dict() == {"paper_rule": True, "vio_oracle": False}
    options = methods["options"]["paper_rule"]
    assert '"n": 3' in options and set(found["poses"].query("method == 'paper_rule'")["options"]) == {options}
    with pytest.raises(UserError, match="gama"):
        run(*tables([1]), options={"paper_rule": {"gama": 3}})
    with pytest.raises(UserError, match="no fusion method"):
        run(*tables([1]), methods=["magic"])


def parquet_files(folder: Path, *made: pd.DataFrame) -> Files:
    """The three tables as files."""
    files = Files(*(folder / f"{name}.parquet" for name in ("frames", "truth", "predictions")))
    for table, path in zip(made, (files.frames, files.ground_truth, files.predictions), strict=True):
        table.to_parquet(path)
    return files


def write(files: Files, out: Path, force: bool = False) -> None:
    commands.evaluate(**vars(files), out=out, scene="Place", set_=['methods=["raw"]'], force=force)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:2000]), "can't be read"),
        (lambda path: path.write_text("frame_id,session_id\n"), "can't be read"),
        (lambda path: (path.unlink(), path.mkdir()), "a folder"),
        (Path.unlink, "no such table"),
    ],
)
def test_files_that_are_no_tables_are_refused_and_nothing_is_left(
    tmp_path: Path, spoil: Callable[[Path], object], message: str
) -> None:
    files = parquet_files(tmp_path, *tables([1]))
    spoil(files.predictions)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match=message):
        write(files, tmp_path / "out")
    assert sorted(tmp_path.rglob("*")) == before


def test_results_appear_whole_and_replace_nothing_but_results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = parquet_files(tmp_path, *tables([1]))
    out = tmp_path / "out"
    for folder, message in (
        (tmp_path, "other files"),
        (files.frames, "other files"),
        (files.frames / "out", "can't be made"),
    ):
        with pytest.raises(UserError, match=message):
            write(files, folder)
    others = [tmp_path / f".out.{suffix}" for suffix in ("partial", "old")]
    for foreign in others:
        foreign.mkdir()
        (foreign / "mine.txt").write_text("mine")
    write(files, out)
    assert all((foreign / "mine.txt").read_text() == "mine" for foreign in others)
    note = json.loads((out / "evaluation.json").read_text())
    assert note["counts"]["frames"] == 40 and note["settings"]["methods"] == ["raw"]
    assert note["inputs"]["frames"]["sha256"] == hashlib.sha256(files.frames.read_bytes()).hexdigest()
    with pytest.raises(UserError, match="holds earlier results"):
        write(files, out)
    note["files"].append("stale.parquet")  # as of a version that wrote another table
    (out / "stale.parquet").touch()
    write_json(out / "evaluation.json", note)

    def fail(*args: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("groundwalk.fusion.__main__.record", fail)
        with pytest.raises(UserError, match="can't be written"):
            write(files, out, force=True)
    assert (out / "stale.parquet").exists() and len(list(tmp_path.iterdir())) == 6
    (out / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match=r"(?s)holds other files than earlier results.*mine.txt"):
        write(files, out, force=True)
    (out / "mine.txt").unlink()
    write(files, out, force=True)
    assert all((foreign / "mine.txt").read_text() == "mine" for foreign in others)
    assert not (out / "stale.parquet").exists()


def test_texts_may_be_dictionaries_and_ids_an_index(tmp_path: Path) -> None:
    made = [t.astype({"frame_id": "category", "session_id": "category"}).set_index("frame_id") for t in tables([1])]
    write(parquet_files(tmp_path, *made), tmp_path / "out")
    assert len(read_table(tmp_path / "out" / "errors.parquet", schema("fuse", "errors"))) == 40


def test_command_line(tmp_path: Path) -> None:
    files = parquet_files(tmp_path, *(table.drop(columns="split") for table in tables([1, 2])))
    arguments = [f"--{name.replace('_', '-')}={path}" for name, path in vars(files).items()]
    done = CliRunner().invoke(app, ["evaluate", *arguments, f"--out={tmp_path / 'out'}"])
    assert done.exit_code == 0, done.output
    for table in ("poses", "errors", "signals", "summary", "intervals", "sessions", "methods"):
        assert len(read_table(tmp_path / "out" / f"{table}.parquet", schema("fuse", table)))
    swept = read_table(tmp_path / "out" / "sweep.parquet", schema("fuse", "sweep"))
    assert set(swept["varied"]) == set(VALUES) and set(swept["subset"]) == {"rp+opt", "all"}
    for picture in ("recording.rrd", "sweep.svg"):
        assert (tmp_path / "out" / picture).stat().st_size > 10_000
