"""Campaigns: a plan of many scenes from a CSV, a workflow that Snakemake reads, and what became of each stage."""

import json
import platform
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk.campaign import PLAN, WORKFLOW, Job, State, plan, write_report, write_workflow
from groundwalk.campaign import app as campaign_app
from groundwalk.capture_import.__main__ import app as import_app
from groundwalk.store import DataRoot, UserError
from tests.capture_import.capture_writers import WRITERS, make_walk

ONE = "tiny/one"


def run_campaign(table: Path, data: Path, *options: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "groundwalk", "campaign", table, "--profile", "tiny", "--data", data, *options]
    return subprocess.run([*map(str, command)], capture_output=True, text=True)


def campaign_of(folder: Path, *lines: str) -> Path:
    """A CSV of scenes, beside a folder with one capture: `walks/one`."""
    WRITERS["frames_jsonl"].write(folder / "walks" / "one" / "walk", make_walk(20))
    table = folder / "scenes.csv"
    table.write_text("scene,captures,until\n" + "".join(f"{line}\n" for line in lines), encoding="utf-8")
    return table


def test_a_plan_has_the_stages_that_each_scene_needs_and_names_what_cannot_run(tmp_path: Path) -> None:
    lines = ("one,walks/one,align", "gone,walks/two,", "one,walks/one,align", "../x,,", "Church,,import")
    jobs, problems = plan(campaign_of(tmp_path, *lines), "tiny", DataRoot(tmp_path / "data"))
    needs = {job.id: job.needs for job in jobs}
    assert needs[f"{ONE}/sfm"] == [f"{ONE}/import"]
    assert needs[f"{ONE}/align"] == [f"{ONE}/import", f"{ONE}/sfm"]
    assert needs[f"{ONE}/report"] == [f"{ONE}/import", f"{ONE}/sfm", f"{ONE}/align"]
    assert needs["tiny/Church/import"] == ["tiny/Church/simulate"] and f"{ONE}/simulate" not in needs
    assert set(problems) == {"tiny/gone", "tiny/one (line 4)", "tiny/../x"}
    assert "isn't there" in problems["tiny/gone"] and "twice" in problems["tiny/one (line 4)"]


def test_a_scene_may_have_a_name_that_tables_take_for_nothing(tmp_path: Path) -> None:
    jobs, problems = plan(
        campaign_of(tmp_path, "None,walks/one,import", "NA,walks/one,import"), "tiny", DataRoot(tmp_path)
    )
    assert {job.scene for job in jobs} == {"None", "NA"} and not problems


def test_a_scene_has_one_folder_of_captures(tmp_path: Path) -> None:
    table = campaign_of(tmp_path, "one,walks/one,import")
    (tmp_path / "walks" / "two").mkdir()
    table.write_text("scene,captures,profile\none,walks/one,tiny\none,walks/two,demo\none,walks/one,standard\n")
    jobs, problems = plan(table, "tiny", DataRoot(tmp_path / "data"))
    assert {job.profile for job in jobs} == {"tiny", "standard"}
    assert "other captures above, walks/one" in problems["demo/one"]


@pytest.mark.parametrize("content", ["place\nChurch\n", "", "scene\n", "scene,note\nChurch,x\n", b"\xff\xfe"])
def test_what_is_no_table_of_scenes_is_refused(tmp_path: Path, content: str | bytes) -> None:
    table = tmp_path / "scenes.csv"
    table.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(UserError, match="table of scenes"):
        plan(table, "tiny", DataRoot(tmp_path / "data"))


def test_fields_without_a_name_are_refused(tmp_path: Path) -> None:
    (table := tmp_path / "scenes.csv").write_text("scene,profile\nChurch,demo,x\n")
    with pytest.raises(UserError, match="more fields than the first line has names"):
        plan(table, "tiny", DataRoot(tmp_path / "data"))


def test_a_refused_stage_is_reported_and_stops_no_other_scene(tmp_path: Path) -> None:
    pytest.importorskip("snakemake", reason="campaigns are run by Snakemake: pip install -e '.[campaign]'")
    (tmp_path / "walks" / "empty" / "walk").mkdir(parents=True)
    (tmp_path / "walks" / "empty" / "walk" / "frames.jsonl").write_text("{}\n")
    table = campaign_of(tmp_path, "bad,walks/empty,import", "one,walks/one,import")
    ended = run_campaign(table, tmp_path / "my data")
    assert ended.returncode == 1, ended.stdout + ended.stderr
    folder = tmp_path / "my data" / "campaigns" / "scenes"
    outcome = pd.read_parquet(folder / "campaign.parquet").set_index(["scene", "stage"])
    assert outcome["state"].to_dict() == {
        ("bad", "import"): "refused",
        ("bad", "report"): "waiting",
        ("one", "import"): "done",
        ("one", "report"): "done",
    }
    assert outcome["seconds"].max() > 0 and outcome["message"].str.contains("header").sum() == 1
    page = (folder / "campaign.html").read_text()
    assert page.index("refused</td>") < page.index("done</td>") and "1 refused" in page
    # The same command tries again what was refused, as the capture may be another one now, and nothing else.
    jobs, problems = plan(table, "tiny", DataRoot(tmp_path / "my data"))
    write_workflow(folder, jobs, problems, DataRoot(tmp_path / "my data"))
    assert not list(folder.rglob("*.refused"))
    done = {path.relative_to(folder / "done").as_posix() for path in (folder / "done").rglob("*") if path.is_file()}
    assert done == {f"{ONE}/import", f"{ONE}/report"}


@pytest.mark.parametrize("end", ["kill -9 $$", "echo 'error: mapping: its process died (SIGKILL)'; exit 2"])
def test_a_job_that_is_killed_is_run_again_with_more_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str
) -> None:
    """The job itself, or a process that it started."""
    pytest.importorskip("snakemake", reason="campaigns are run by Snakemake: pip install -e '.[campaign]'")
    python = tmp_path / "python"  # killed twice, as by a system without memory
    python.write_text(f'#!/bin/sh\ncd "${{0%/*}}"; echo >> times; [ $(wc -l < times) = 3 ] || {{ {end}; }}\n')
    python.chmod(0o755)
    folder = tmp_path / "campaign"
    with monkeypatch.context() as patched:
        patched.setattr(sys, "executable", str(python))
        write_workflow(folder, [Job("one", "tiny", "import")], {}, DataRoot(tmp_path / "data"))
    command = [sys.executable, "-m", "snakemake", "--snakefile", folder / WORKFLOW, "--directory", folder]
    ended = subprocess.run([*map(str, command), "--cores", "1"], capture_output=True, text=True)
    said = ended.stdout + ended.stderr
    assert ended.returncode == 0 and (folder / "done" / ONE / "import").exists(), said
    assert list(dict.fromkeys(re.findall(r"mem_mb=\d+", said))) == ["mem_mb=4096", "mem_mb=8192", "mem_mb=12288"]


def test_a_worker_with_another_version_of_groundwalk_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = DataRoot(tmp_path / "data")
    write_workflow(tmp_path, [Job("one", "tiny", "import")], {}, data)
    (expected,) = set(re.findall(r"groundwalk [\d.]+, import version \d+", (tmp_path / WORKFLOW).read_text()))
    monkeypatch.setenv("GROUNDWALK_EXPECTED_VERSION", other := "groundwalk 0.0.9, import version 1")
    with pytest.raises(UserError, match="another version of groundwalk") as refused:
        CliRunner().invoke(import_app, ["--scene", "one", "--data", str(data.root)], catch_exceptions=False)
    details = refused.value.details
    assert (details["expected"], details["found"]) == (other, expected) and platform.node() in str(details["where"])


def test_scenes_side_by_side_share_the_cores_of_this_machine_alone(tmp_path: Path) -> None:
    jobs = [Job(f"scene{number}", "tiny", command) for number in range(3) for command in ("import", "sfm")]
    jobs.append(Job("alone", "demo", "sfm"))

    def threads(**how: Any) -> dict[str, int]:
        write_workflow(tmp_path, jobs, {}, DataRoot(tmp_path / "data"), **how)
        return {kind: of["threads"] for kind, of in json.loads((tmp_path / PLAN).read_text())["resources"].items()}

    assert threads(cores=6) == {"tiny/import": 1, "tiny/sfm": 2, "demo/sfm": 6}
    assert threads(cores=2) == {"tiny/import": 1, "tiny/sfm": 1, "demo/sfm": 2}
    assert threads(cores=6, is_local=False) == {"tiny/import": 1, "tiny/sfm": 6, "demo/sfm": 6}


def test_flags_of_what_is_outdated_go_and_resources_are_those_of_finished_runs(tmp_path: Path) -> None:
    data, folder = DataRoot(tmp_path / "data"), tmp_path / "campaign"
    jobs = [Job("one", "tiny", "import"), Job("one", "tiny", "sfm", [f"{ONE}/import"])]
    flag = folder / "done" / f"{ONE}/import"
    flag.parent.mkdir(parents=True)
    flag.touch()
    made = data.run("tiny", "other", "sfm")
    made.mkdir(parents=True)
    (made / "manifest.json").write_text(json.dumps({"peak_memory_mib": 3000, "total_seconds": 600}))
    slower = data.run("paper", "other", "sfm")  # another profile's, which says nothing of this one
    slower.mkdir(parents=True)
    (slower / "manifest.json").write_text(json.dumps({"peak_memory_mib": 30000, "total_seconds": 60000}))
    write_workflow(folder, jobs, {}, data)
    assert not flag.exists()
    resources = json.loads((folder / PLAN).read_text())["resources"]
    assert resources["tiny/sfm"]["mem_mb"] == 5012 and resources["tiny/sfm"]["runtime"] == 20
    assert resources["tiny/import"]["mem_mb"] == 4096
    assert (write_report(folder, data)["state"] == State.WAITING).all()


def test_a_campaign_is_of_one_table_though_others_have_its_name(tmp_path: Path) -> None:
    """Its state was shown as the other's, and the other's plan took its place."""
    data, mine, other = tmp_path / "data", tmp_path / "mine" / "scenes.csv", tmp_path / "other" / "scenes.csv"
    for table in (mine, other):
        table.parent.mkdir()
        table.write_text("scene\nChurch\n")
    folder = data / "campaigns" / "scenes"
    write_workflow(folder, [Job("Church", "tiny", "import")], {}, DataRoot(data), table=mine)
    for options in (["--status"], []):
        with pytest.raises(UserError, match=r"another table[\s\S]*mine[\s\S]*another name"):
            CliRunner().invoke(campaign_app, [str(other), "--data", str(data), *options], catch_exceptions=False)
    mine.rename(tmp_path / "scenes.csv")  # one that was moved is still the same campaign
    for table in (tmp_path / "scenes.csv", other):
        said = CliRunner().invoke(campaign_app, [str(table), "--data", str(data), "--status"], catch_exceptions=False)
        assert "1 waiting" in said.output
