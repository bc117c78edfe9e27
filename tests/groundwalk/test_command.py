"""The command `groundwalk`: every command line of the packages, none of their libraries until one is run."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command
from typer.testing import CliRunner

from groundwalk import pipeline
from groundwalk.cli import all_commands, app
from groundwalk.pipeline import Step, _how_far, run_steps, steps
from groundwalk.simulation.existing import key_of
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store import DataRoot, UserError
from groundwalk.store.settings import STAGES, resolve_settings
from tests.groundwalk.made_up_run import MadeUpRun
from tests.known import wait_until, written

ROOT = Path(__file__).resolve().parents[2]
HEAVY = {"cv2", "numba", "numpy", "open3d", "pandas", "pyarrow", "pycolmap", "rerun", "scipy", "torch", "pydantic"}
PROGRAM = """
import sys
from groundwalk.cli import app
commands = {commands!r}
if any("run" in arguments for arguments in commands):
    from groundwalk import pipeline
    pipeline._run = lambda *step: None
for arguments in commands:
    try:
        app(arguments, prog_name="groundwalk")
    except SystemExit:
        pass
print("loaded:", *sys.modules)
"""


def scenes(data: Path) -> str:
    """What `groundwalk scenes` prints."""
    command = [sys.executable, "-m", "groundwalk", "scenes", "--data", str(data)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "COLUMNS": "200"})
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    return done.stdout


def loaded_by(*commands: list[str], **environment: str) -> tuple[str, set[str]]:
    """What commands print, and the modules that they load; they start no stage."""
    command = [sys.executable, "-c", PROGRAM.format(commands=commands)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    printed, _, modules = done.stdout.partition("loaded: ")
    assert modules, done.stderr
    return printed, {*modules.split()}


def options(command: Any) -> dict[str, Any]:
    return {name: (p.default, p.help) for p in command.params for name in getattr(p, "opts", [])}


@pytest.fixture(scope="module")
def packages() -> dict[str, Any]:
    """The applications of the packages' own command lines, by package."""
    paths = [path for path in ROOT.glob("*/__main__.py") if path.parent.name != "groundwalk"]
    assert len(paths) >= 9
    return {p.parent.name: get_command(import_module(f"groundwalk.{p.parent.name}.__main__").app) for p in paths}


def test_help_lists_every_command_and_loads_no_library() -> None:
    printed, libraries = loaded_by(["--help"])
    for command in all_commands():
        assert f" {command.name} " in printed and command.help in printed
    assert not libraries & (HEAVY - {"pydantic"})


def test_each_package_s_command_is_one_of_groundwalk_s(packages: dict[str, Any]) -> None:
    """The same command objects' options, under names that `groundwalk --help` lists."""
    modules = {(command.module, command.subcommand): command for command in all_commands()}
    of_stages = 0
    for package, application in packages.items():
        for name, command in getattr(application, "commands", {}).items():
            assert options(modules[f"{package}.__main__", name].load()) == options(command)
        if f"{package}.definition" in {module for module, _ in modules}:
            stage = modules[f"{package}.definition", None]
            assert options(stage.load()) == options(application)
            assert stage.load().help == application.help
            of_stages += 1
    assert of_stages == len(STAGES)
    assert [(c.name, c.stage().name) for c in all_commands() if c.is_stage] == [(stage, stage) for stage in STAGES]
    assert options(modules["simulation.__main__", None].load()) == options(packages["simulation"])


@pytest.mark.parametrize(
    ("line", "cursor", "expected"),
    [
        ("groundwalk s", 1, ["scenes", "simulate", "sfm"]),
        ("groundwalk align --fo", 2, ["--force"]),
    ],
)
def test_completion_knows_commands_and_options(line: str, cursor: int, expected: list[str]) -> None:
    asked = {"_GROUNDWALK_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(cursor)}
    printed, libraries = loaded_by([], **asked)
    assert printed.split() == expected
    assert not libraries & (HEAVY - {"numpy", "scipy", "pydantic"})


def test_what_only_touches_files_loads_no_stage_s_library(make_run: Callable[..., MadeUpRun]) -> None:
    """`run` of a finished scene, too, whose stages are all compared with what there is."""
    data = ["--data", str(make_run("import", "sfm", "align", "localise", "train", "fuse").data.root)]
    scene = ["--scene", "place", "--profile", "tiny"]
    _, libraries = loaded_by(["scenes", *data], ["run", *data, *scene], *([stage, "--help"] for stage in STAGES))
    assert not libraries & (HEAVY - {"numpy", "scipy", "pydantic"} | {"scipy.spatial", "scipy.optimize"})


@pytest.mark.parametrize(
    ("command", "status", "said"),
    [
        (["sfm"], 2, "error: no scene was named"),
        (["view", "--scene", "place"], 2, "there is no recording to view"),
        (["algin"], 2, "Did you mean 'align'"),
        (["--version"], 0, "groundwalk 0."),
        ([], 2, "Usage: groundwalk [OPTIONS]"),
    ],
)
def test_errors_are_those_of_the_packages(
    command: list[str], status: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        app(command, prog_name="groundwalk")
    assert ended.value.code == status and said in "".join(capsys.readouterr())


def test_scenes_names_a_broken_file_beside_the_others_and_outdated_stages(tmp_path: Path) -> None:
    written(tmp_path / "scenes" / "Broken.toml", "x = \n")
    written(tmp_path / "scenes" / "Loop.toml", 'members = ["Loop"]\n')
    read = {"import": {}, "sfm": {"Own/import": {"t": "old"}}, "align": {"Own/sfm": {"t": "now"}}}
    for stage, inputs in read.items():
        manifest = {"outputs": {"t": "now"}, "simulated": False, "scene": {"name": "Own"}, "inputs": inputs}
        written(tmp_path / "runs" / "tiny" / "Own" / stage / "manifest.json", json.dumps(manifest))
    (tmp_path / "captures" / "Own").mkdir(parents=True)
    printed = scenes(tmp_path)
    lines = {line.split()[0]: line for line in printed.splitlines() if line}
    assert "see below (1)" in lines["Broken"] and "none, can be simulated" in lines["Church"]
    assert re.search(r"\(1\) a settings file can't be read\n.*Broken\.toml", printed)
    assert "(2) the group of scenes Loop is a member of itself" in printed
    assert "tiny: import, sfm (outdated), align (outdated)" in lines["Own"]


def test_scenes_names_those_whose_captures_are_gone(tmp_path: Path) -> None:
    data = DataRoot(tmp_path)
    for scene in ("Moved", "Unmounted"):
        written(data.run("tiny", scene, "import") / "manifest.json", "{}")
    data.captures("Unmounted").parent.mkdir()
    data.captures("Unmounted").symlink_to("/mnt/nothing")
    printed = scenes(tmp_path)
    assert re.search("Moved +none +tiny: import", printed)
    assert re.search("Unmounted +a link to /mnt/nothing, which isn't there +tiny: import", printed)


def test_scenes_shows_what_strangers_wrote_as_text(tmp_path: Path) -> None:
    evil = "[/x] \x1b[2J [bold]\u202e"
    written(tmp_path / "profiles" / "evil.toml", f"description = {json.dumps(evil)}")
    written(tmp_path / "scenes" / "evil.toml", f'members = ["{"[" * 9000}"]')
    with_captures(DataRoot(tmp_path), "place", json.dumps({"profile": evil}))
    with_captures(DataRoot(tmp_path), "large", json.dumps({"profile": "x" * (5 << 20)}))
    written(tmp_path / "runs" / f"{evil.replace('/', '')}" / "place" / "import" / "manifest.json", "{}")
    printed = scenes(tmp_path)
    said = " ".join(printed.split())
    shown = r"[/x] \x1b[2J [bold]\u202e"
    for text in (f"evil {shown}", f"simulated, profile {shown}", f"{shown.replace('/', '')}: import"):
        assert text in said
    assert "\x1b" not in printed and len(printed) < 20_000


def with_captures(data: DataRoot, scene: str, marker: str | None = None) -> None:
    written(data.captures(scene) / "0.jpg", "")
    if marker:
        written(data.captures(scene) / "SIMULATED.json", marker)


def test_a_scene_takes_all_stages_and_is_simulated_where_it_may_be(tmp_path: Path) -> None:
    data = DataRoot(tmp_path)
    assert steps(data, "tiny", "Library") == [Step(stage, "Library") for stage in STAGES]
    assert steps(data, "tiny", "Church")[:2] == [Step("simulate", "Church"), Step("import", "Church")]
    assert [s.command for s in steps(data, "tiny", "Church", "sfm")] == ["simulate", "import", "sfm", "report"]
    with_captures(data, "Church", '{"profile": "tiny"}')
    assert steps(data, "tiny", "Church")[0].command == "simulate"
    assert steps(data, "demo", "Church")[0].command == "import"
    with_captures(data, "Square")
    assert steps(data, "tiny", "Square")[0].command == "import"
    with pytest.raises(UserError, match=r"no stage 'mapping'[\s\S]*import, sfm"):
        steps(data, "tiny", "Church", "mapping")
    with pytest.raises(UserError, match="no profile 'large'"):
        steps(data, "large", "Church")


def test_captures_simulated_for_another_profile_are_named_before_the_first_stage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    data = DataRoot(tmp_path)
    with_captures(data, "Church", '{"profile": "tiny"}')
    monkeypatch.setattr(pipeline, "is_up_to_date", lambda *_: True)
    run_steps(steps(data, "demo", "Church", "import"), "demo", data)
    told, *others = capfd.readouterr().err.splitlines()
    assert "simulated for profile tiny" in told
    assert f"groundwalk simulate --scene Church --profile demo --data {tmp_path}" in told
    assert all("up to date" in line for line in others)
    key = key_of("Church", resolve_settings(SimulateSettings, "simulate", data, "demo", "Church"), 0)[0]
    marker = {"profile": "tiny", "key": key, "sessions": {}}
    (data.captures("Church") / "0.jpg").unlink()
    (data.captures("Church") / "SIMULATED.json").write_text(json.dumps(marker))
    run_steps(steps(data, "demo", "Church", "import"), "demo", data)
    assert "simulated for" not in capfd.readouterr().err, "the same images whatever the profile is called"


def test_a_group_s_scenes_come_before_it(tmp_path: Path) -> None:
    written(tmp_path / "scenes" / "two.toml", 'members = ["a", "b"]\nstages = ["train", "fuse"]\n')
    written(tmp_path / "scenes" / "more.toml", 'members = ["two", "b"]\nstages = ["fuse"]\n')
    data = DataRoot(tmp_path)
    expected = [Step(stage, scene) for scene in "ab" for stage in STAGES]
    expected += [Step("train", "two"), Step("fuse", "two"), Step("fuse", "more")]
    assert steps(data, "tiny", "more") == expected
    until_align = [Step(s, scene) for scene in "ab" for s in ("import", "sfm", "align", "report")]
    assert steps(data, "tiny", "two", "align") == until_align


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "scene place has no captures.*correct the scene's name: .*groundwalk scenes"),
        ("[align]\nmax_speed = 3", r"'max_speed'.*\[align\] of \S+place\.toml"),
        ("[fuse]\noptions.window30.frames = 3", r"'frames'.*window30.*\[fuse\] of \S+place\.toml"),
        ("[fuse]\nmethods = ['windw30']", r"no fusion method 'windw30'.*\[fuse\] of \S+place\.toml"),
        ("[train]\npredictions = 'mine.parquet'", r"can't be read.*mine\.parquet"),
    ],
)
def test_settings_of_all_stages_and_captures_are_checked_before_the_first_runs(
    tmp_path: Path, text: str, message: str
) -> None:
    data = DataRoot(tmp_path)
    written(tmp_path / "scenes" / "place.toml", text)
    written(tmp_path / "scenes" / "two.toml", 'members = ["other", "place"]\n')
    for scene in ("other", "place") if text else ("other",):
        with_captures(data, scene)
    with pytest.raises(UserError, match=f"(?s){message}"):
        run_steps(steps(data, "tiny", "two"), "tiny", data)
    assert not (tmp_path / "runs").exists()


def test_a_seed_that_no_library_takes_is_refused(tmp_path: Path) -> None:
    for command in ("sfm", "train", "simulate"):
        for seed in (-1, 2**31):
            done = CliRunner().invoke(app, [command, "--scene=Church", f"--data={tmp_path}", f"--seed={seed}"])
            assert done.exit_code == 2 and "Invalid value for '--seed'" in done.output


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run", "--scene=A", "--scene", "B"], "--scene was given twice"),
        (["run", "--scene=A", "--captures="], "the path 'captures' is empty"),
        (["judge", ""], "the path 'folder' is empty"),
    ],
)
def test_what_would_be_obeyed_in_part_or_in_the_current_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match=said):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert not list(tmp_path.iterdir())


def test_the_home_folder_is_found_where_shells_leave_it_to_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with_captures(DataRoot(tmp_path / "mine"), "place")
    assert re.search("place +real", CliRunner().invoke(app, ["scenes", "--data=~/mine"]).output)
    with pytest.raises(UserError, match="no such capture"):
        CliRunner().invoke(app, ["judge", "~nobody-here/walk"], catch_exceptions=False)


def test_the_first_step_that_fails_ends_a_run(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = DataRoot(tmp_path)
    with pytest.raises(SystemExit) as ended:
        run_steps([Step("sfm", "Church"), Step("align", "Church")], "tiny", data)
    assert ended.value.code == 2 and capfd.readouterr().err.count("stage import of scene Church hasn't been run") == 1


def test_the_time_left_is_that_of_all_stages_by_how_quick_those_before_were() -> None:
    usual = {Step(name, "Church"): 60.0 for name in ("simulate", *STAGES)}
    first, second, *_ = usual
    assert _how_far(second, usual, {first: 120.0}) == "stage 1 of 7 · about 14 min left"
    assert _how_far(first, {**usual, second: None}, {}) == "captures first"


def test_a_signal_ends_a_run_with_its_stage(tmp_path: Path) -> None:
    """Where only the command itself gets it, as from a job scheduler."""
    number = signal.SIGTERM
    command = [sys.executable, "-m", "groundwalk", "run", "--scene", "Church", "--profile", "tiny"]
    process = subprocess.Popen(
        [*command, "--data", str(tmp_path)],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # Whoever runs the tests in the background may ignore it, and children inherit that.
        preexec_fn=lambda: signal.signal(number, signal.SIG_DFL),
    )
    wait_until((tmp_path / "captures" / ".Church.partial" / "key.json").is_file)
    process.send_signal(number)
    _, said = process.communicate(timeout=30)
    assert process.returncode == 128 + number
    assert said.count("the same command resumes") == 1 and "Traceback" not in said

    def is_gone() -> bool:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, 0)
            return False
        return True

    wait_until(is_gone, 30)  # once its helpers have seen that it ended
    assert not (tmp_path / "captures" / "Church").exists()


def test_no_code_of_the_current_folder_runs(tmp_path: Path) -> None:
    """As the installed script, `run` starts helpers and the stages' commands, whose Python would look there first."""
    with_captures(DataRoot(tmp_path / "data"), "place")
    for name in ("groundwalk/__init__", "groundwalk/__main__", "cv2", "socket", "multiprocessing"):
        written(tmp_path / f"{name}.py", "import os; os.write(2, b'a stranger\\'s code')")
    script = written(tmp_path / "bin" / "groundwalk", "from groundwalk.cli import app\napp()\n")
    command = [sys.executable, str(script), "run", "--scene=place", "--profile=tiny", "--until=import"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and "stranger" not in done.stderr
    assert "import · place · tiny\nerror: no capture in a known format" in done.stderr
    (tmp_path / ".numba_config.yaml").write_text("cache_dir: cache")
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and "settings of numba" in done.stderr


@pytest.mark.parametrize(
    ("before", "said"),
    [
        ("mkdir gone && cd gone && rmdir ../gone", "the current folder has been removed"),
        ("export OMP_NUM_THREADS=abc", "OMP_NUM_THREADS is no number of threads"),
    ],
)
def test_where_no_library_could_work_is_named(tmp_path: Path, before: str, said: str) -> None:
    command = f"{before} && {sys.executable} -m groundwalk scenes"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and done.stderr.startswith(f"error: {said}")


def test_stages_that_are_not_up_to_date_are_run(
    make_run: Callable[..., MadeUpRun], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make_run("import", "sfm")
    monkeypatch.setattr("groundwalk.pipeline.stage_of", made.stage)
    ran: list[str] = []
    monkeypatch.setattr("groundwalk.pipeline._run", lambda step, profile, data: ran.append(step.command))

    def run_all() -> list[str]:
        ran.clear()
        run_steps([Step(stage, "place") for stage in ("import", "sfm", "align")], "tiny", made.data)
        return ran

    assert run_all() == ["align"] and "sfm · place · tiny: up to date" in capsys.readouterr().err
    (made.folder / "sfm" / "images.parquet").write_bytes(b"damaged")
    assert run_all() == ["sfm", "align"]
    (made.data.captures("place") / "new.png").write_bytes(b"one more")
    assert run_all() == ["import", "sfm", "align"]
