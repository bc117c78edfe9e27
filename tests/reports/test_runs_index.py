"""The page of all runs: each run's state and figures, whatever its report has come to."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from groundwalk.reports.definition import STAGE
from groundwalk.reports.runs_index import write_index
from groundwalk.store.files import read_json, write_json
from groundwalk.store.manifests import load_manifest
from groundwalk.store.settings import DataRoot
from groundwalk.store.stage import execute
from tests.reports.made_up_scenes import rows_of, write_stage


@pytest.mark.usefixtures("no_figures")
def test_each_run_stands_with_its_state_and_figures(make_run: Callable[..., DataRoot], tmp_path: Path) -> None:
    write_index(DataRoot(tmp_path))
    assert not (tmp_path / "runs").exists()
    data = make_run(Yard={"train": 12, "test": 8}, Lane={"train": 12, "test": 8}, Wood={"train": 12, "test": 8})
    execute(STAGE, "Yard", "tiny", data)
    for stage in ("align", "localise", "train", "fuse"):
        shutil.rmtree(data.run("tiny", "Lane", stage))
    (data.run("tiny", "Lane") / ".align.partial").mkdir()
    write_json(data.run("tiny", "Lane") / ".align.partial" / "stopped.json", {"what": "no <scale> & no vertical"})
    write_index(data)
    page = (data.root / "runs" / "index.html").read_text(encoding="utf-8")
    rows = {row[0]: row[1:] for row in rows_of(data.root / "runs", "runs", "index.html")}
    verdict = read_json(data.run("tiny", "Yard", "report") / "verdict.json")
    best = min(verdict["localisers"], key=lambda row: row["median_position"])
    assert rows["Yard, tiny"][0] == verdict["verdict"] and rows["Yard, tiny"][2] == str(verdict["headline"]["frames"])
    assert rows["Yard, tiny"][-1].startswith(f"{best['localiser']}: {best['median_position']:g} m")
    assert rows["Lane, tiny"][0] == "no verdict yet; stopped at align: no <scale> & no vertical"
    assert "no &lt;scale&gt; &amp; no vertical" in page and "<scale>" not in page
    assert rows["Wood, tiny"][0] == "no verdict yet; up to fuse"
    for file in ("page.html", "thumbnail.jpg"):
        assert f'"tiny/Yard/report/{file}"' in page and (data.root / "runs" / "tiny/Yard/report" / file).is_file()


def test_a_finished_group_has_the_verdicts_on_its_page(make_run: Callable[..., DataRoot]) -> None:
    data = make_run(group="both", Yard={"train": 12, "test": 8}, Lane={"train": 12, "test": 8})
    write_stage(data, "both", "report", {}, True)
    report = data.run("tiny", "both", "report")
    scene = {"name": "both", "members": ["Yard", "Lane"], "stages": ["train", "fuse", "report"]}
    write_json(report / "manifest.json", load_manifest(report) | {"scene": scene})
    write_index(data)
    states = {row[0]: row[1] for row in rows_of(data.root / "runs", "runs", "index.html")}
    assert states["both, tiny"] == "a group: its page has its scenes' verdicts"
    assert states["Yard, tiny"] == "no verdict yet; up to fuse"
