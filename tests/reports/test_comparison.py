"""Comparing runs: what was done differently, and which figures differ by more than noise."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk import commands
from groundwalk.reports.comparison import ComparedRun, differences, missing, why_no_positions
from groundwalk.store.choices import MapUnit
from groundwalk.store.errors import UserError
from groundwalk.store.files import read_json, write_json
from groundwalk.store.manifests import output_hashes
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.tables import pose_frame, read_table, write_table
from tests.known import filled
from tests.reports.made_up_scenes import page_of, rows_of

FRAMES = 200
RNG = np.random.default_rng(0)
ERRORS = RNG.lognormal(0, 0.5, FRAMES)


def run_with(position: np.ndarray, model: str = "PN") -> ComparedRun:
    """A run of one walk, alone."""
    keys = {"scene": "S", "session_id": "w", "t_ns": np.arange(FRAMES), "frame_id": [f"w/{i}" for i in range(FRAMES)]}
    errors = pd.DataFrame(keys).assign(model=model, method="raw", options="", split="test", quality="A")
    errors = errors.assign(raw_position_m=position, raw_rotation_deg=np.where(np.isnan(position), np.nan, 1.0))
    return ComparedRun(
        "r", {}, MapUnit.METRE, filled("align", "ground_truth", 0), errors, filled("fuse", "validation", 0)
    )


@pytest.mark.parametrize(
    ("position", "clear"),
    [
        (ERRORS * RNG.lognormal(0, 0.05, FRAMES), set()),
        (1.2 * ERRORS, {"median position"}),
        (0.8 * ERRORS, {"median position"}),
        (np.where(np.arange(FRAMES) % 4 < 3, ERRORS, np.nan), {"coverage (%)", "median position"}),
        (
            np.where(np.arange(FRAMES) % 4 < 1, ERRORS, np.nan),
            {"coverage (%)", "median position", "median rotation (°)"},
        ),
    ],
)
def test_only_what_is_beyond_noise_differs(position: np.ndarray, clear: set[str]) -> None:
    found = {d.figure: d for d in differences(run_with(ERRORS), run_with(position))}
    assert {name for name, d in found.items() if d.is_clear} == clear
    median = found["median position"]
    assert median.before == pytest.approx(np.median(ERRORS)) and median.frames == FRAMES
    worse = np.nanmean(np.nan_to_num(position, nan=99)) > ERRORS.mean()
    assert all(found[name].is_worse == worse and found[name].is_worse_by(5) == worse for name in clear)
    assert not any(d.is_worse_by(5) for name, d in found.items() if name not in clear)
    assert not median.is_worse_by(25) or not np.isfinite(median.after) or median.percent > 25


def test_runs_without_common_frames_or_with_too_few_say_so() -> None:
    first = run_with(ERRORS)
    assert differences(first, run_with(ERRORS, model="other")) == []
    few = replace(first, errors=first.errors.head(12))
    assert all(np.isnan(d.low) and not d.is_clear and not d.is_worse_by(5) for d in differences(first, few))


def test_what_only_one_of_the_runs_has_is_counted() -> None:
    both = pd.concat([run_with(ERRORS).errors, run_with(ERRORS, model="other").errors])
    first = replace(run_with(ERRORS), name="first", errors=both)
    assert missing(first, first) == []
    lost, more = missing(first, run_with(ERRORS)), missing(run_with(ERRORS), first)
    assert [str(m) for m in lost] == ["missing: r: other, alone: 200 of the 200 frames of first"] and more == []
    few = replace(first, name="few", errors=both[both["t_ns"] < 50])
    assert [(m.run, m.has, m.frames, m.of) for m in missing(first, few)] == [("few", "first", 150, 200)] * 2
    assert missing(few, first) == []


def test_positions_are_compared_in_one_unit_only() -> None:
    truth = filled("align", "ground_truth", 3, frame_id=["a", "b", "c"], session_id="w", t_ns=np.arange(3))
    truth = truth.assign(**pose_frame("map_cam", np.tile(np.eye(4), (3, 1, 1))), position_sd_m=0.1)
    metric = replace(run_with(ERRORS), ground_truth=truth)
    sfm = replace(run_with(0.1 * ERRORS), name="other", unit=MapUnit.SFM, ground_truth=truth)
    reference = replace(sfm, unit=MapUnit.REFERENCE)
    for first, other in ((metric, sfm), (sfm, metric), (sfm, reference)):
        assert why_no_positions(first, other).startswith("positions aren't compared: ")
        figures = {(d.subject, d.figure.partition(" (")[0]) for d in differences(first, other)}
        rotations = {("ground truth", "sigma, rotation"), ("PN, alone", "median rotation")}
        assert figures == rotations | {("ground truth", "frames with one"), ("PN, alone", "coverage")}
    # SfM's unit is another in each map.
    moved = replace(sfm, ground_truth=truth.assign(map_cam_tx=2.0))
    assert "another in each map" in why_no_positions(sfm, moved)
    for run in (metric, sfm, reference):
        assert why_no_positions(run, run) == "" and len(differences(run, run)) == 6
    # Groups of scenes have no ground truth of their own.
    group = replace(run_with(ERRORS), unit=MapUnit.SFM)
    assert "another in each map" in why_no_positions(group, group)


def test_the_command_fails_on_what_is_missing_and_says_what(make_run: Callable[..., DataRoot], tmp_path: Path) -> None:
    data = make_run(Yard={"train": 12, "test": 10})

    def other(name: str, change: Callable[[pd.DataFrame], pd.DataFrame]) -> Path:
        run = tmp_path / "runs" / name / "Yard"
        shutil.copytree(data.run("tiny", "Yard"), run)
        for stage, table in (("align", "ground_truth"), ("fuse", "errors")):
            file, of = run / stage / f"{table}.parquet", schema(stage, table)
            write_table(file, change(read_table(file, of)), of)
            manifest = read_json(run / stage / "manifest.json") | {"outputs": output_hashes(run / stage)}
            write_json(run / stage / "manifest.json", manifest)
        return run

    def compare(first: object, second: object) -> tuple[int, str, str]:
        words = ["compare", first, second, "--profile", "tiny", "--data", data.root, "--out", tmp_path / "c.html"]
        done = CliRunner().invoke(commands.app, [*map(str, words), "--fail-if-worse", "5%"])
        if isinstance(done.exception, UserError):
            raise done.exception
        return done.exit_code, done.stdout, page_of(tmp_path, "c.html")

    without_model = other("model", lambda t: t[t["model"] != "MS-T"] if "model" in t else t)
    status, printed, page = compare("Yard", without_model)
    assert status == 1 and ": MS-T, alone: 19 of the 19 frames of " in printed
    assert rows_of(tmp_path, "missing", "c.html")[0][1:] == ["MS-T, alone", "Yard, tiny", "19", "19"]
    assert "all figures are over the others" in page
    status, printed, _ = compare(without_model, "Yard")  # which has more
    assert status == 0
    assert "missing: Yard: MS-T, alone: 19 of the 19 frames of Yard, tiny" in printed

    status, printed, _ = compare("Yard", other("walk", lambda t: t[t["session_id"] != "walk_4"]))
    assert status == 1 and "PN, alone: 10 of the 19 frames" in printed and "ground truth: 10 of the " in printed

    without_scale = other("scale", lambda t: t.assign(scale_source="none") if "scale_source" in t else t)
    status, printed, page = compare("Yard", without_scale)
    assert status == 1 and "median position" not in page and "median rotation" in page
    assert "positions aren't compared" in printed and "Positions aren&#39;t compared" in page
    assert compare(without_scale, "Yard")[0] == 0

    # As of a group of scenes, which has no ground truth of its own.
    groups = [other(name, lambda t: t) for name in ("group", "again")]
    summary = filled("fuse", "summary", 1, map_unit=MapUnit.SFM)
    write_table(groups[0] / "fuse" / "summary.parquet", summary, schema("fuse", "summary"))
    manifest = read_json(groups[0] / "fuse" / "manifest.json") | {"outputs": output_hashes(groups[0] / "fuse")}
    write_json(groups[0] / "fuse" / "manifest.json", manifest)
    for run in groups:
        shutil.rmtree(run / "align")
    status, printed, page = compare(groups[1], groups[0])
    assert status == 1 and "positions aren't compared" in printed and "median position" not in page

    stopped = other("stopped", lambda t: t)
    shutil.rmtree(stopped / "fuse")
    status, printed, _ = compare("Yard", stopped)
    assert status == 1 and "PN, alone: 19 of the 19 frames of Yard, tiny" in printed
    with pytest.raises(UserError, match="no frame in common"):
        compare("Yard", other("captures", lambda t: t.assign(frame_id="x" + t["frame_id"])))


def test_a_limit_that_no_figure_could_be_beyond_is_refused() -> None:
    done = CliRunner().invoke(commands.app, ["compare", "Yard", "Barn", "--fail-if-worse", "nan"])
    assert isinstance(done.exception, UserError) and "no percentage" in str(done.exception)


def test_the_command_writes_a_page_and_fails_where_it_is_asked_to(
    make_run: Callable[..., DataRoot], tmp_path: Path
) -> None:
    data = make_run(Yard={"train": 30, "test": 60})
    other = tmp_path / "runs" / "tiny" / "Yard & <more>"
    shutil.copytree(data.run("tiny", "Yard"), other)
    of = schema("fuse", "errors")
    errors = read_table(other / "fuse" / "errors.parquet", of)
    errors.loc[errors["model"] == "PN", ["raw_position_m", "live_position_m"]] *= 1.5
    write_table(other / "fuse" / "errors.parquet", errors, of)
    manifest = read_json(other / "fuse" / "manifest.json") | {"outputs": output_hashes(other / "fuse")}
    write_json(other / "fuse" / "manifest.json", manifest | {"seed": 7, "settings": {"options": {"window": 30}}})

    def compare(*options: object) -> tuple[int, str]:
        words = ["compare", "Yard", other, "--profile", "tiny", "--data", data.root, "--out", tmp_path / "c.html"]
        done = CliRunner().invoke(commands.app, [str(word) for word in (*words, *options)])
        assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
        return done.exit_code, done.stdout

    status, printed = compare("--fail-if-worse", "5%")
    assert status == 1 and "worse: " in printed and "PN, alone: median position" in printed
    assert compare()[0] == 0 and compare("--fail-if-worse", "60%")[0] == 0
    figures = {tuple(row[1:3]): row for row in rows_of(tmp_path, "figures", "c.html")}
    assert figures["PN, alone", "median position (m)"][3] == "worse"
    assert figures["PN, alone", "median position (m)"][7] == "+50.0"
    assert figures["MS-T, alone", "median position (m)"][3] == "the same"
    assert figures["ground truth", "sigma, position (m)"][3] == "the same"
    settings = {tuple(row[:2]): row[2:] for row in rows_of(tmp_path, "settings", "c.html")}
    assert settings.items() >= {("fuse", "seed"): ["0", "7"], ("fuse", "options.window"): ["–", "30"]}.items()
    page = (tmp_path / "c.html").read_text(encoding="utf-8")
    assert "<more>" not in page and "The captures differ" not in page
    manifest = read_json(other / "import" / "manifest.json") | {"inputs": {"captures": {"sha256": "of others"}}}
    write_json(other / "import" / "manifest.json", manifest)
    compare()
    assert "The captures differ" in (tmp_path / "c.html").read_text(encoding="utf-8")
