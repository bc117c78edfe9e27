"""Advice names what works where it's given: the command with its data folder, the file of a scene."""

import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundwalk.cli import app
from groundwalk.pipeline import Step
from groundwalk.store import DataRoot
from groundwalk.store.checkout import CHECKOUT
from groundwalk.store.hints import (
    link_command,
    run_command,
    view_command,
)


def test_advice_about_another_data_folder_works_as_it_is_printed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, asked = DataRoot(tmp_path / "my data"), []

    def note(commands: list[Step], profile: str, root: DataRoot) -> None:
        asked.append((commands[-1], profile, root.root))

    monkeypatch.setattr("groundwalk.commands.run_steps", note)
    (tmp_path / "captures").mkdir()
    for command in (
        run_command(data.run("tiny", "place", "report")),
        link_command(data.captures("place"), "tiny").replace("<your folder>", shlex.quote(str(tmp_path / "captures"))),
    ):
        _, _, arguments = command.partition("groundwalk ")
        done = CliRunner().invoke(app, shlex.split(arguments))
        assert done.exit_code == 0, done.output
        assert asked.pop() == (Step("report", "place"), "tiny", data.root)
    _, _, arguments = view_command(data.run("tiny", "place")).partition("groundwalk ")
    with pytest.raises(Exception, match=f"where: +{data.run('tiny', 'place')}"):
        CliRunner().invoke(app, shlex.split(arguments), catch_exceptions=False)


def test_make_is_advised_only_where_it_is_and_about_its_own_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert CHECKOUT is not None
    monkeypatch.chdir(CHECKOUT)
    assert run_command(DataRoot(Path("data")).run("tiny", "Bar", "sfm")) == "make scene=Bar profile=tiny sfm"
    assert run_command(DataRoot(Path("other")).run("tiny", "Bar", "sfm")).endswith(f"--data {CHECKOUT / 'other'}")
    monkeypatch.chdir(tmp_path)
    assert run_command(DataRoot(Path("data")).run("tiny", "Bar", "sfm")).endswith(
        "groundwalk run --scene Bar --profile tiny --until sfm"
    )
    assert run_command(Path("/copied/import")) == "run the stage import where this run comes from, and copy it again"
