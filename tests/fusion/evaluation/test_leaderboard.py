"""The leaderboard: cases from folders, its figures beside the stage's, who is ahead, and its files."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from benchmarks.leaderboard import ahead, app, cases_in, leaderboard, ratios, scores
from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import ahead_of, evaluate
from groundwalk.fusion.files.walks import Inputs
from groundwalk.store import UserError
from tests.fusion.tables import Tables, tables

NAMES = ("frames", "ground_truth", "predictions")


def laid(folder: Path, place: str, seeds: Iterable[int], models: tuple[str, ...] = ("PN",)) -> Tables:
    (folder / place).mkdir(parents=True)
    parts = tables(list(seeds), models)
    for name, table in zip(NAMES, parts, strict=True):
        table.to_parquet(folder / place / f"{name}.parquet", index=False)
    return parts


def test_figures_are_the_stages(tmp_path: Path) -> None:
    parts = laid(tmp_path, "walks/Place", [1, 2])
    (tmp_path / "about.txt").write_text("made up, seed 1\n")
    cases, sources = cases_in(tmp_path)
    assert [(c.group, c.scene, c.model, len(c.walks)) for c in cases] == [("walks", "Place", "PN", 2)]
    assert "1 scenes" in sources[0] and sources[1] == "made up, seed 1"
    rows = scores(cases, ["last_good"]).set_index("method")
    results = evaluate([Inputs("Place", *parts)], FuseSettings(methods=["raw", "paper_rule", "last_good"]))
    summary = results.tables["summary"]
    summary = summary[(summary["subset"] == "all") & (summary["scored"] == "method")].set_index("method")
    assert list(rows.index) == ["raw", "paper_rule", "last_good"]
    for figure in ("frames", "coverage_pct", "position_mean_m", "rotation_mean_deg", "high_pct", "low_pct"):
        assert np.allclose(rows[figure], summary.loc[rows.index, figure]), figure
    assert (rows["position_median_m"] <= rows["position_p95_m"]).all()
    assert rows["position_within_pct"].isna().all()


def test_scenes_without_odometry_take_no_part_and_are_named(tmp_path: Path) -> None:
    laid(tmp_path, "walks/Place", [1, 2])
    frames, *_ = laid(tmp_path, "walks/Photos", [3])
    vio = [column for column in frames.columns if column.startswith("vio_cam_")]
    frames.assign(**dict.fromkeys(vio, np.nan)).to_parquet(tmp_path / "walks/Photos/frames.parquet", index=False)
    cases, sources = cases_in(tmp_path)
    assert [case.scene for case in cases] == ["Place"]
    assert sources[1] == "without odometry, where nothing is fused: Photos"


def made_up(rows: list[tuple[Any, ...]]) -> pd.DataFrame:
    columns = ["method", "causal", "coverage_pct", "position_mean_m", "rotation_mean_deg"]
    rest = dict.fromkeys(["high_pct", "medium_pct", "low_pct"], 1.0)
    rest |= dict.fromkeys(["position_within_pct", "rotation_within_pct"], 95.0)
    return pd.DataFrame(rows, columns=columns).assign(group="g", scene="s", model="m", **rest)


def test_ahead_is_the_causal_method_of_least_error_and_missing_answers_are_failures() -> None:
    rows = made_up(
        [("raw", True, 100.0, 4.0, 4.0), ("paper_rule", True, 100.0, 2.0, 2.0), ("vio_oracle", False, 100.0, 0.1, 0.1)]
    )
    assert ahead(rows)["ahead"].tolist() == ["paper_rule"]
    assert ratios(rows).set_index("method").loc["vio_oracle (offline)", "position /rule"] == pytest.approx(0.05)
    rows.loc[1, "coverage_pct"] = 40.0
    assert ahead(rows)["ahead"].tolist() == ["raw"]
    rows.loc[0, ["position_mean_m", "rotation_mean_deg"]] = np.nan
    assert ahead_of(rows[rows["causal"]]) == "paper_rule"


def test_the_command_writes_table_figures_and_plot(tmp_path: Path) -> None:
    laid(tmp_path / "in", "walks/Place", [1])
    command = [f"{tmp_path}/in", f"--data={tmp_path}", "--methods=smoother"]
    for _ in range(2):  # new, and in place of an earlier one
        found = CliRunner().invoke(app, [*command, f"--out={tmp_path}/out"])
        assert found.exit_code == 0, found.output
    text = (tmp_path / "out" / "fusion.md").read_text()
    assert "## walks: 1 scenes, 1 cases, 1 walks" in text and "smoother (offline)" in text and "revision" in text
    rows = pd.read_csv(tmp_path / "out" / "fusion.csv")
    assert {"raw", "smoother"} <= set(rows["method"]) and rows["revision"].notna().all()


def test_what_no_leaderboard_wrote_is_kept_and_said_before_the_methods_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    laid(tmp_path / "in", "walks/Place", [1])
    monkeypatch.setattr("benchmarks.leaderboard.scores", None)
    for name in ("fusion.md", "fusion.csv"):
        mine = tmp_path / name.replace(".", "-") / name
        mine.parent.mkdir()
        mine.write_text("mine")
        with pytest.raises(UserError, match="a file that no leaderboard wrote"):
            leaderboard([tmp_path / "in"], tmp_path, mine.parent)
        with pytest.raises(UserError, match="nothing can be written there"):
            leaderboard([tmp_path / "in"], tmp_path, mine)
        assert mine.read_text() == "mine"


def test_an_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no predictions in the folder"):
        cases_in(tmp_path)
