"""The Makefile, with a stand-in for Python: what a user gives is never a command, and make deletes nothing."""

import os
import shutil
import signal
import subprocess
from pathlib import Path

import pytest

from groundwalk.store.settings import STAGES
from tests.known import wait_until

ROOT = Path(__file__).resolve().parents[2]
# Notes its arguments, and finishes as a run does: puts a manifest in place. With HOLD it waits then, as a stage that
# still writes its last line does.
PYTHON = """#!/bin/bash
printf '%s\\0' "$@" >> arguments
if [ "$3" = run ]; then
  mkdir -p data/runs
  echo '{}' > data/runs/manifest.json
  if [ -n "${HOLD:-}" ]; then sleep 30; fi
fi
"""
HOSTILE = [
    "x`touch f`",
    "$$(touch f)",
    "$(shell touch f)",
    '"; touch f; "',
    "'; touch f; '",
    "x\n\ttouch f",
    "x&touch${IFS}f",
    "a b ",
    "../x",
    "#a,b)é",
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    if not shutil.which("make"):
        pytest.skip("make isn't installed")
    shutil.copy(ROOT / "Makefile", tmp_path)
    shutil.copytree(ROOT / "shipped", tmp_path / "shipped")
    for name in ("pyproject.toml", "constraints.txt", "hashes.txt"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / ".venv" / "bin").mkdir(parents=True)
    (tmp_path / ".venv" / ".installed").touch()
    python = tmp_path / ".venv" / "bin" / "python"
    python.write_text(PYTHON)
    python.chmod(0o755)
    walk = tmp_path / "data" / "captures" / "place" / "walk"
    walk.mkdir(parents=True)
    (walk / "frame.json").write_text("{}")
    return tmp_path


def make(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["make", *arguments], cwd=folder, capture_output=True, text=True, env={**os.environ, **environment}
    )


def arguments_of(folder: Path) -> list[str]:
    """All arguments that the stand-in for Python got, one after the other."""
    return (folder / "arguments").read_text().split("\0")[:-1]


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("goal", ["import", "all", "simulate", "clean", "bench-phone"])
def test_names_reach_python_as_they_are(folder: Path, name: str, goal: str) -> None:
    for variables in (["scene"], ["profile", "captures"]):
        done = make(folder, "scene=place", *(f"{variable}={name}" for variable in variables), goal)
        assert done.returncode == 0, done.stderr
        given = arguments_of(folder)
        for variable in variables:
            if variable != "captures" or goal in ("import", "all"):
                assert given[given.index(f"--{variable}") + 1] == name
        (folder / "arguments").unlink()
    assert not (folder / "f").exists()


def test_stages_are_those_of_the_pipeline(folder: Path) -> None:
    for stage in STAGES:
        make(folder, "scene=Church", "profile=tiny", stage)
        run = ["-m", "groundwalk", "run", "--scene", "Church", "--profile", "tiny", "--until", stage]
        assert arguments_of(folder) == run
        (folder / "arguments").unlink()
    make(folder, "scene=Church", "captures=walks", "all")
    assert arguments_of(folder)[3:] == [
        *("--scene", "Church", "--profile", "demo", "--captures", "walks", "--until", STAGES[-1])
    ]


def test_a_stage_needs_a_scene(folder: Path) -> None:
    for goal in (*STAGES, "all", "simulate", "view", "clean"):
        done = make(folder, goal)
        assert done.returncode == 2 and "name a scene" in done.stderr


@pytest.mark.parametrize("name", HOSTILE)
def test_other_values_and_folders_are_no_commands(folder: Path, name: str) -> None:
    if "/" not in name:
        (folder / "data" / "captures" / name).mkdir()
    assert make(folder, "help").returncode == 0
    for goal, variable in (("bench-real", "captures"), ("bench-phone", "roots")):
        assert make(folder, f"{variable}={name}", goal).returncode == 0
        assert arguments_of(folder)[-1] == name
    for goal, variable in (("view", "web"), ("bench-real", "stability")):
        assert make(folder, "scene=place", f"{variable}={name}", goal).returncode == 0
    assert not (folder / "f").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_finished_manifest_survives_a_signal(folder: Path, number: signal.Signals) -> None:
    manifest = folder / "data/runs/manifest.json"
    process = subprocess.Popen(
        ["make", "scene=place", "profile=tiny", "import"],
        cwd=folder,
        env={**os.environ, "HOLD": "1"},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Whoever runs the tests in the background may ignore it, and children inherit that.
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    wait_until(lambda: manifest.is_file() and manifest.read_text() != "", 20)
    os.killpg(process.pid, number)
    _, said = process.communicate(timeout=20)
    assert process.returncode != 0
    assert manifest.is_file(), said
