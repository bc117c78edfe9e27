"""`groundwalk judge`: its exit status, what it leaves where, and captures that it can't judge."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from groundwalk import commands
from groundwalk.pipeline import Reported, Step
from groundwalk.store.errors import UserError
from groundwalk.store.files import partial_folder
from groundwalk.store.settings import DataRoot
from tests.known import written


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return written(tmp_path / "my walk & more" / "frame_00000.json", "{}").parent


def stopped(steps: list[Step], profile: str, data: DataRoot) -> None:
    raise SystemExit(143)


def judge(*arguments: object) -> int:
    done = CliRunner().invoke(commands.app, ["judge", *map(str, arguments)])
    if isinstance(done.exception, UserError):
        raise done.exception
    return done.exit_code


@pytest.mark.parametrize(("verdict", "status"), [("accepted", 0), ("undecided", 3), ("refused", 4)])
def test_the_exit_status_is_the_verdict(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: str, status: int
) -> None:
    asked: list[Step] = []

    def run_steps(steps: list[Step], profile: str, data: DataRoot) -> None:
        asked.extend(steps)
        report = data.run(profile, steps[0].scene, "report")
        written(report / "verdict.json", json.dumps({"verdict": verdict, "why": "because"}))
        written(report / "page.html", "a page")
        if verdict == "refused":
            raise Reported(2)

    monkeypatch.setattr(commands, "run_steps", run_steps)
    out = tmp_path / "out"
    assert judge(capture, "--out", out) == status
    assert [step.command for step in asked] == ["import", "sfm", "align", "report"]
    assert json.loads((out / "verdict.json").read_text())["verdict"] == verdict
    assert (out / "page.html").read_text() == "a page"
    link = out / "data" / "captures" / asked[0].scene
    assert link.is_symlink() and link.resolve() == capture
    assert [path.name for path in capture.iterdir()] == ["frame_00000.json"]


def test_a_capture_may_have_a_longer_name_than_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "run_steps", stopped)
    walk = written(tmp_path / ("a walk " * 20) / "frame_00000.json", "{}").parent
    assert judge(walk, "--out", tmp_path / "out") == 143


def test_a_single_file_is_judged_in_a_folder_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    video, roots = tmp_path / "my walk.mp4", list[DataRoot]()
    (tmp_path / "another.mp4").write_bytes(b"another")

    def run_steps(steps: list[Step], profile: str, data: DataRoot) -> None:
        roots.append(data)
        raise SystemExit(143)

    monkeypatch.setattr(commands, "run_steps", run_steps)
    for content in (b"first", b"second"):
        video.unlink(missing_ok=True)
        video.write_bytes(content)
        assert judge(video, "--out", tmp_path / "out") == 143
        (copy,) = roots[-1].captures("my-walk").iterdir()
        assert (copy.name, copy.read_bytes()) == ("my walk.mp4", content) and video.read_bytes() == content


def test_a_folder_that_is_another_captures_is_refused_and_nothing_is_touched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Captures of one name share a folder unless --out names one."""

    monkeypatch.setattr(commands, "run_steps", stopped)
    for n, (first, then) in enumerate(
        [
            ("walk", "walk/walk.mp4"),
            ("walk", "walk.zip"),
            ("walk.mov", "walk.mp4"),
            ("walk", "b/walk"),
            ("b", "walk.mp4"),
        ]
    ):
        base = tmp_path / str(n)
        for name in ("walk/walk.mp4", "walk/log.csv", "walk.zip", "walk.mov", "walk.mp4", "b/walk/walk.mp4"):
            written(base / name, name)
        monkeypatch.chdir(base)
        out = () if first != "b" else ("--out", base / "out")
        for _ in range(2):
            assert judge(base / first, *out) == 143
        before = {path: path.read_text() for path in base.rglob("*") if path.is_file()}
        with pytest.raises(UserError, match=r"the output folder is of another capture(.|\n)*with --out"):
            judge(base / then, *out)
        assert {path: path.read_text() for path in base.rglob("*") if path.is_file()} == before
        assert judge(base / then, "--out", base / "another") == 143
        assert judge(base / first, *out) == 143


def test_a_file_that_lies_in_the_captures_of_the_output_folder_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(commands, "run_steps", stopped)
    mine = written(tmp_path / "data" / "captures" / "walk" / "walk.mp4", "mine")
    assert judge(mine, "--out", tmp_path) == 143
    with pytest.raises(UserError, match="another capture"):
        judge(written(tmp_path / "walk.mp4", "other"), "--out", tmp_path)
    assert mine.read_text() == "mine"


def test_an_empty_folder_and_none_are_said_in_a_sentence(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    with pytest.raises(UserError, match="the folder is empty"):
        judge(tmp_path / "empty", "--out", out)
    assert "the folder is empty" in (out / "page.html").read_text() and not (out / "data").exists()
    assert json.loads((out / "verdict.json").read_text())["verdict"] == "unreadable"
    with pytest.raises(UserError, match="there is no such capture"):
        judge(tmp_path / "nowhere")


def test_what_import_refuses_has_a_page_that_says_what_is_missing(
    capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    why = {"what": "no <capture>", "found": "\n 3 files\n a folder", "do": "copy it again"}

    def run_steps(steps: list[Step], profile: str, data: DataRoot) -> None:
        written(partial_folder(data.run(profile, steps[0].scene, "import")) / "stopped.json", json.dumps(why))
        raise SystemExit(2)

    monkeypatch.setattr(commands, "run_steps", run_steps)
    out = tmp_path / "out"
    assert judge(capture, "--out", out) == 2
    page, verdict = (out / "page.html").read_text(), json.loads((out / "verdict.json").read_text())
    assert (
        "Unreadable.</strong> no &lt;capture&gt;." in page and "<capture>" not in page and "my walk &amp; more" in page
    )
    assert (verdict["verdict"], verdict["why"]) == ("unreadable", why["what"])
    assert verdict["problems"][0]["why"] == "no <capture> (found: 3 files; a folder)"
