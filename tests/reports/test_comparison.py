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
from groundwalk.reports.comparison import ComparedRun, differences
from groundwalk.store.files import read_json, write_json
from groundwalk.store.manifests import output_hashes
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.tables import read_table, write_table
from tests.known import filled
from tests.reports.made_up_scenes import rows_of

FRAMES = 200
RNG = np.random.default_rng(0)
ERRORS = RNG.lognormal(0, 0.5, FRAMES)


def run_with(position: np.ndarray, model: str = "PN") -> ComparedRun:
    """A run of one walk, alone."""
    keys = {"scene": "S", "session_id": "w", "t_ns": np.arange(FRAMES), "frame_id": [f"w/{i}" for i in range(FRAMES)]}
    errors = pd.DataFrame(keys).assign(model=model, method="raw", options="", split="test", quality="A")
    errors = errors.assign(raw_position_m=position, raw_rotation_deg=np.where(np.isnan(position), np.nan, 1.0))
    return ComparedRun("r", {}, "m", filled("align", "ground_truth", 0), errors, filled("fuse", "validation", 0))


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
