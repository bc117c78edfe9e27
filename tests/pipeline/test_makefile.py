"""The Makefile, with a stand-in for Python: names are never commands, and nothing that is finished is deleted."""

import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
# Notes its arguments, and does what a stage does: puts a manifest in place. With HOLD it waits then, as a stage does
# that is still writing its last line; with FAIL it fails.
PYTHON = """#!/bin/bash
printf '%s\\0' "$@" >> arguments
while [ $# -gt 0 ]; do
  case $1 in --scene) scene=$2;; --profile) profile=$2;; groundwalk.capture_import) stage=import;; esac
  shift
done
if [ -n "${stage:-}" ]; then
  mkdir -p "data/runs/$profile/$scene/$stage"
  echo '{}' > "data/runs/$profile/$scene/$stage/manifest.json"
  if [ -n "${HOLD:-}" ]; then sleep 30; fi
  if [ -n "${FAIL:-}" ]; then exit 1; fi
fi
"""
HOSTILE = [
    "x`touch f`",
    "$$(touch f)",
    "$(touch f)",
    "$(shell touch f)",
    "${shell touch f}",
    '"; touch f; "',
    "'; touch f; '",
    "x; touch f",
    "x\ntouch f",
    "x\n\ttouch f",
    "x&touch${IFS}f",
    "a b",
    "x ",
    "../x",
    "#x",
    "a,b)",
    "é",
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    if not shutil.which("make"):
        pytest.skip("make isn't installed")
    shutil.copy(ROOT / "Makefile", tmp_path)
    shutil.copytree(ROOT / "data" / "scenes", tmp_path / "data" / "scenes")
    shutil.copytree(ROOT / "data" / "profiles", tmp_path / "data" / "profiles")
    for name in ("pyproject.toml", "constraints.txt"):
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
def test_a_hostile_name_is_refused_before_any_shell_sees_it(folder: Path, name: str) -> None:
    for variables in ([f"scene={name}"], ["scene=place", f"profile={name}"]):
        for goal in ("import", "clean", "help", "bench"):
            done = make(folder, *variables, goal)
            assert done.returncode == 2 and "name has only letters" in done.stderr, (variables, goal, done)
    assert not (folder / "f").exists() and not (folder / "arguments").exists()


def test_an_empty_profile_and_a_group_with_a_hostile_member_are_refused(folder: Path) -> None:
    assert "the profile is empty" in make(folder, "scene=place", "profile=", "clean").stderr
    (folder / "data" / "scenes" / "two.toml").write_text('members = ["Church", "`touch f`"]\n')
    assert "a member's name has only letters" in make(folder, "scene=two", "all").stderr
    assert not (folder / "f").exists() and not (folder / "arguments").exists()


@pytest.mark.parametrize("name", HOSTILE)
def test_a_captures_folder_may_have_any_name(folder: Path, name: str) -> None:
    done = make(folder, "scene=own", f"captures={name}", "import")
    assert done.returncode == 0, done.stderr
    assert arguments_of(folder)[:6] == ["-m", "groundwalk.artefacts", "link-captures", "--scene", "own", "--folder"]
    assert arguments_of(folder)[6] == name
    assert not (folder / "f").exists()


@pytest.mark.parametrize("name", HOSTILE)
def test_other_values_and_folders_are_no_commands(folder: Path, name: str) -> None:
    if "/" not in name:
        (folder / "data" / "captures" / name).mkdir()
    done = make(folder, "help")
    assert done.returncode == 0 and "place" in done.stdout
    for goal, variable in (("fuzz-import", "seconds"), ("bench-import", "nerfstudio"), ("view", "web")):
        make(folder, "scene=place", f"{variable}={name}", goal)
    assert not (folder / "f").exists()
    assert name in arguments_of(folder)


def test_a_second_make_does_nothing_and_other_captures_are_looked_at(folder: Path) -> None:
    variables = ("scene=own", "captures=elsewhere", "import")
    (folder / "elsewhere").mkdir()
    (folder / "other").mkdir()
    (folder / "data" / "captures" / "own").symlink_to(folder / "elsewhere")
    assert make(folder, *variables).returncode == 0
    (folder / "arguments").unlink()
    assert make(folder, *variables).returncode == 0
    assert not (folder / "arguments").exists()
    make(folder, "scene=own", "captures=other", "import")
    assert "link-captures" in arguments_of(folder) and "groundwalk.capture_import" in arguments_of(folder)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_finished_manifest_survives_a_signal(folder: Path, number: signal.Signals) -> None:
    manifest = folder / "data/runs/tiny/place/import/manifest.json"
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
    deadline = time.monotonic() + 20
    while not (manifest.is_file() and manifest.read_text()):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, number)
    _, said = process.communicate(timeout=20)
    assert process.returncode != 0
    assert manifest.is_file(), said


def test_a_finished_manifest_survives_a_failed_recipe(folder: Path) -> None:
    assert make(folder, "scene=place", "profile=tiny", "import", FAIL="1").returncode == 2
    assert (folder / "data/runs/tiny/place/import/manifest.json").is_file()


def test_every_stage_s_manifest_is_precious(folder: Path) -> None:
    database = make(folder, "-pn", "scene=Church", "profile=tiny", "all").stdout
    precious = next(line for line in database.splitlines() if line.startswith(".PRECIOUS:")).split()[1:]
    recipes = make(folder, "-n", "scene=Church", "profile=tiny", "all").stdout
    assert recipes.count(".venv/bin/python -m") == 8
    stages = ("import", "sfm", "align", "localise", "train", "fuse", "report")
    expected = {f"data/runs/tiny/Church/{stage}/manifest.json" for stage in stages}
    assert set(precious) == expected | {"data/captures/Church/SIMULATED.json"}
