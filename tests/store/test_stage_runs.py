"""A stage run is atomic, resumable, and repeated only when something that it depends on changed."""

import json
import multiprocessing
import os
import re
import signal
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from groundwalk.geometry.poses import make_pose
from groundwalk.store import DataRoot, Settings, Stage, StageRun, UserError, execute
from groundwalk.store import stage as stage_module
from groundwalk.store.files import STOPPED, partial_folder
from groundwalk.store.hints import setting_of
from groundwalk.store.manifests import load_manifest
from groundwalk.store.tables import pose_frame
from tests.store.places import place


class ExampleSettings(Settings):
    rows: int = 3
    offset: float = 0.0


def reach(moment: str) -> None:
    """Called where the process of a test may be killed."""


def run_example(r: StageRun[ExampleSettings]) -> None:
    safe = r.scratch / "counted"
    with r.step("count"):
        for i in r.track(range(r.settings.rows), "counting"):
            if i >= len(safe.read_text() if safe.exists() else ""):
                with safe.open("a") as file:
                    file.write("x")
                reach(f"row {i}")
    r.figure("rows counted here", r.settings.rows)
    frame = pd.DataFrame({"session_id": ["s"] * r.settings.rows, "t_ns": range(r.settings.rows)})
    positions = [[r.settings.offset + i, 0, 0] for i in range(r.settings.rows)]
    poses = make_pose([[1, 0, 0], [0, 1, 0], [0, 0, 1]], positions)
    r.write("true_poses", frame.join(pose_frame("map_cam", poses)))
    reach("table written")


# It stands in for any, and writes the one table that no real stage owns.
STAGE = Stage("simulate", 1, ExampleSettings, (), run_example, "An example.", reads_captures=True)


def killed_at(moment: str, root: Path) -> None:
    """Runs the stage, and kills its process at a moment."""

    def die(reached: str) -> None:
        if reached == moment:
            os.kill(os.getpid(), signal.SIGKILL)

    def write_json(*arguments: Any) -> None:
        write(*arguments)
        die("manifest written")

    def rename_to(self: Path, target: Path) -> Path:
        moved = rename(self, target)
        die(f"rename to {target.name}")
        return moved

    write, rename = stage_module.write_json, Path.rename
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage_module, "write_json", write_json)
        patch.setattr(Path, "rename", rename_to)
        patch.setattr(f"{__name__}.reach", die)
        execute(STAGE, "place", "own", DataRoot(root), ["offset=1"])


def table_bytes(folder: Path) -> bytes:
    return (folder / "true_poses.parquet").read_bytes()


def test_second_run_does_nothing_and_a_change_runs_again(data: DataRoot, capsys: pytest.CaptureFixture[str]) -> None:
    folder = execute(STAGE, "place", "own", data)
    first = load_manifest(folder)
    assert first["figures"] == {"rows counted here": 3}
    assert set(first["outputs"]) == {"true_poses.parquet"}
    assert first["simulated"] is False
    assert not (folder / "scratch").exists()

    # Settings that were refused meanwhile, and then taken back.
    (stopped := partial_folder(folder) / STOPPED).parent.mkdir()
    stopped.write_text('{"what": "no model"}')
    execute(STAGE, "place", "own", data)
    assert "up to date" in capsys.readouterr().err and not stopped.exists()
    assert load_manifest(folder) == first

    execute(STAGE, "place", "own", data, ["rows=4"])
    assert load_manifest(folder)["key"] != first["key"]
    (data.captures("place") / "walk" / "frame.json").write_text("{ }")
    before = load_manifest(folder)["key"]
    execute(STAGE, "place", "own", data, ["rows=4"])
    assert load_manifest(folder)["key"] != before
    # The simulator's truth is no input of any stage.
    for name in ("true_poses", "true_cameras"):
        (data.captures("place") / f"{name}.parquet").write_text("truth")
    before = load_manifest(folder)["key"]
    execute(STAGE, "place", "own", data, ["rows=4"])
    assert load_manifest(folder)["key"] == before


@pytest.mark.parametrize(
    "moment", ["row 2", "table written", "manifest written", "rename to .simulate.old", "rename to simulate"]
)
def test_killed_run_leaves_nothing_half_and_goes_on(data: DataRoot, tmp_path: Path, moment: str) -> None:
    untouched = place(tmp_path / "reference")
    expected = table_bytes(execute(STAGE, "place", "own", untouched, ["offset=1"]))
    folder = execute(STAGE, "place", "own", data)
    old = table_bytes(folder)

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=killed_at, args=(moment, data.root))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    if (folder / "manifest.json").exists():
        assert table_bytes(folder) in (old, expected)
        assert json.loads((folder / "manifest.json").read_text())["outputs"]

    execute(STAGE, "place", "own", data, ["offset=1"])
    assert table_bytes(folder) == expected
    hidden = [p.name for p in folder.parent.iterdir() if p.name.startswith(".") and not p.name.endswith(".lock")]
    assert hidden == []


def test_a_failing_stage_keeps_the_old_artefact(data: DataRoot) -> None:
    folder = execute(STAGE, "place", "own", data)
    before = table_bytes(folder)

    def fail(r: StageRun[ExampleSettings]) -> None:
        raise UserError("no luck")

    with pytest.raises(UserError, match="no luck"):
        execute(Stage("simulate", 2, ExampleSettings, (), fail, "", reads_captures=True), "place", "own", data)
    assert table_bytes(folder) == before


def test_missing_inputs_are_named_and_leave_no_folder(data: DataRoot) -> None:
    with pytest.raises(UserError, match="run --scene elsewhere --profile own --captures <your folder> --data "):
        execute(STAGE, "elsewhere", "own", data)
    needs_sfm = Stage("align", 1, ExampleSettings, ("sfm",), run_example, "")
    with pytest.raises(UserError, match="stage sfm of scene place hasn't been run"):
        execute(needs_sfm, "place", "own", data)
    with pytest.raises(UserError, match="group of scenes"):
        execute(STAGE, "outdoor", "own", data)
    assert not (data.root / "runs").exists()


def test_two_runs_of_a_stage_keep_apart(data: DataRoot) -> None:
    def run_inside(r: StageRun[ExampleSettings]) -> None:
        with pytest.raises(UserError, match="under way"):
            execute(STAGE, "place", "own", data)
        run_example(r)

    execute(Stage("simulate", 1, ExampleSettings, (), run_inside, "", reads_captures=True), "place", "own", data)


def test_a_setting_goes_where_an_error_says(data: DataRoot, capsys: pytest.CaptureFixture[str]) -> None:
    """The scene is named, in what a stage says as in what it raises."""

    def refuse_many(r: StageRun[ExampleSettings]) -> None:
        r.say(f"limit 2 ({setting_of('simulate', 'rows')})")
        if r.settings.rows > 2:
            raise UserError("too many rows", do=f"set {setting_of('simulate', 'rows = 2')}")
        run_example(r)

    stage = Stage("simulate", 1, ExampleSettings, (), refuse_many, "An example.", reads_captures=True)
    with pytest.raises(UserError, match="too many rows") as caught:
        execute(stage, "place", "own", data)
    assert f"limit 2 ([simulate] rows in {data.root}/scenes/place.toml)" in capsys.readouterr().err
    ((section, setting, file),) = re.findall(r"set (\[.*\]) (.*) in (.*)$", str(caught.value))
    (data.root / "scenes").mkdir()
    Path(file).write_text(f"{section}\n{setting}")
    execute(stage, "place", "own", data)
