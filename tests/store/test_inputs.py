"""What a stage reads is held, verified and of one piece; what is damaged is made again without being asked to."""

import errno
import json
import os
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from groundwalk.store import DataRoot, Settings, Stage, StageRun, UserError, execute, files, inputs
from groundwalk.store.__main__ import link_folder
from groundwalk.store.cleaning import clean_scene
from groundwalk.store.files import hash_files, sha256_of
from groundwalk.store.locks import locked
from groundwalk.store.manifests import load_manifest
from groundwalk.store.outdated import is_up_to_date
from tests.known import filled, written


class ExampleSettings(Settings):
    text: str = "a"


Run = Callable[[StageRun[ExampleSettings]], None]


def stage(name: str, *needs: str, run: Run | None = None) -> Stage[ExampleSettings]:
    """A stage that writes two files of what it reads, its settings' text and its checkpoint."""

    def write(r: StageRun[ExampleSettings]) -> None:
        read = "".join((r.folder(need) / "weights" / "one.bin").read_text() for need in needs)
        (r.work / "weights").mkdir(exist_ok=True)
        for number in ("one", "two"):
            (r.work / "weights" / f"{number}.bin").write_text(f"{read}{name} {r.settings.text}\n")

    return Stage(name, 1, ExampleSettings, needs, run or write, "", reads_captures=not needs)


IMPORT, SFM, ALIGN = stage("import"), stage("sfm", "import"), stage("align", "import", "sfm")


def run(data: DataRoot, stage: Stage[ExampleSettings], *settings: str) -> Path:
    return execute(stage, "place", "own", data, list(settings))


def content(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*.bin")}


def test_an_input_is_not_replaced_while_it_is_read(data: DataRoot) -> None:
    folder = run(data, IMPORT)
    before = content(folder)

    def reading(r: StageRun[ExampleSettings]) -> None:
        with pytest.raises(UserError, match="under way"):
            run(data, IMPORT, "text=b")

    run(data, stage("sfm", "import", run=reading))
    assert content(folder) == before
    run(data, IMPORT, "text=b")
    assert content(folder) != before


def test_results_of_two_imports_never_mix(data: DataRoot) -> None:
    for each in (IMPORT, SFM, ALIGN):
        run(data, each)
    run(data, IMPORT, "text=b")
    advice = r"run --scene place --profile own --until sfm --data"
    with pytest.raises(UserError, match=rf"(?s)sfm of scene place is outdated: import .*{advice}"):
        run(data, ALIGN)
    run(data, SFM)
    run(data, ALIGN)
    run(data, IMPORT, "text=c")
    with pytest.raises(UserError, match="outdated"):
        run(data, stage("train", "align"))
    run(data, IMPORT, "text=b")  # as it was when the others read it
    run(data, stage("train", "align"))


def test_an_export_of_a_simulated_scene_is_simulated(data: DataRoot) -> None:
    note = data.captures("place") / "walk" / "export.json"
    for told, expected in {'{"simulated": false}': False, '{"simulated": true}': True, "[]": False}.items():
        note.write_text(told)
        assert load_manifest(run(data, IMPORT))["simulated"] is expected
    (note.parent / "SIMULATED.json").write_text("{}")  # a simulated scene's folder within another
    folder = run(data, IMPORT)
    assert load_manifest(folder)["simulated"] is True


def test_linked_recordings_are_said_not_to_be_followed(data: DataRoot, tmp_path: Path) -> None:
    (data.captures("place") / "walk").rename(tmp_path / "elsewhere")
    (data.captures("place") / "walk").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match=r"(?s)no captures.*links to folders.*doesn't follow: walk\n.*copy"):
        run(data, IMPORT)


def test_captures_that_change_during_import_are_refused(data: DataRoot) -> None:
    def change(r: StageRun[ExampleSettings]) -> None:
        (data.captures("place") / "walk" / "more.json").write_text("{}")

    with pytest.raises(UserError, match="captures changed"):
        run(data, stage("import", run=change))
    assert not data.run("own", "place", "import").exists()
    with locked(data.captures("place")), pytest.raises(UserError, match="under way"):
        run(data, IMPORT)


def import_images(r: StageRun[ExampleSettings]) -> None:
    """An import of the images in the captures."""
    names = [f"walk/{path.name}" for path in (r.captures / "walk").glob("*.jpg")]
    hashes = [sha256_of(r.captures / name) for name in names]
    r.write("frames", filled("import", "frames", len(names), frame_id=names, image=names, image_sha256=hashes))


def with_images(data: DataRoot) -> Path:
    """Ten images, imported."""
    walk = data.captures("place") / "walk"
    for number in range(10):
        (walk / f"{number}.jpg").write_text(f"image {number}")
    run(data, stage("import", run=import_images))
    return walk


def swap(walk: Path) -> None:
    (walk / "0.jpg").rename(walk / "kept")
    (walk / "1.jpg").rename(walk / "0.jpg")
    (walk / "kept").rename(walk / "1.jpg")


def test_images_that_are_swapped_under_a_stage_give_no_artefact(data: DataRoot) -> None:
    """What it read of them is dropped, too: its checkpoints would be taken for those of the right ones."""
    walk = with_images(data)

    def swapping(r: StageRun[ExampleSettings]) -> None:
        (r.scratch / "features").write_text("of the images before")
        swap(walk)

    def reading(r: StageRun[ExampleSettings]) -> None:
        assert not (r.scratch / "features").exists()

    sfm = replace(stage("sfm", "import", run=swapping), reads_images=lambda settings: True)
    for _ in range(2):
        with pytest.raises(UserError, match="2 of 10 images aren't as import saw them"):
            run(data, sfm)
        assert not data.run("own", "place", "sfm").exists()
    swap(walk)
    run(data, replace(sfm, run=reading))


def replaced(path: Path) -> None:
    """Another content of the same size and time, in a file of its own."""
    status = path.stat()
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(bytes(255 - byte for byte in content))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))


def test_captures_that_nothing_was_written_to_are_not_read_again(
    data: DataRoot, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = data.captures("place") / "walk" / "frame.json"
    folder = run(data, IMPORT)
    assert "captures_state" not in load_manifest(folder)  # so young that it may be written again without a trace
    monkeypatch.setattr(files, "_SETTLED_NS", -(10**9))
    run(data, IMPORT, "text=b")
    read = list[Path]()

    def hashed(folder: Path, paths: Iterable[Path]) -> dict[str, str]:
        known = [*paths]
        read.extend(known)
        return hash_files(folder, known)

    monkeypatch.setattr(inputs, "hash_files", hashed)
    assert is_up_to_date(IMPORT, "place", "own", data) is False and not read  # by its settings alone
    run(data, IMPORT)
    read.clear()
    assert is_up_to_date(IMPORT, "place", "own", data) and not read
    os.utime(frame)
    assert is_up_to_date(IMPORT, "place", "own", data) and frame in read
    replaced(frame)
    assert not is_up_to_date(IMPORT, "place", "own", data)
    run(data, IMPORT)
    (frame.parent / "more.json").write_text("{}")
    assert not is_up_to_date(IMPORT, "place", "own", data)


@pytest.mark.parametrize("file", ["captures/place/walk/frame.json", "runs/own/place/import/weights/one.bin", "named"])
def test_whatever_a_stage_reads_is_the_same_at_its_end(data: DataRoot, file: str) -> None:
    (data.root / "named").write_text("weights")
    run(data, IMPORT)
    old = time.time() - 60
    for path in (data.root / file, *(data.root / "runs").rglob("*.bin")):
        os.utime(path, (old, old))
    reads = {"reads_captures": True} if file.startswith("captures") else {"files": lambda settings: ("named",)}
    with pytest.raises(UserError, match=r"changed while stage sfm|isn't as its stage wrote it"):
        run(data, replace(stage("sfm", "import", run=lambda r: replaced(data.root / file)), **reads))
    assert not data.run("own", "place", "sfm").exists()


def test_captures_stay_while_any_stage_reads(data: DataRoot, tmp_path: Path) -> None:
    """Of whatever profile: they are one scene's, and each profile's to simulate, to remove and to link."""
    simulated = {"profile": "other", "sessions": {"walk": {"poses": 1, "images": 1}}}
    (data.captures("place") / "SIMULATED.json").write_text(json.dumps(simulated))
    for each in (IMPORT, SFM):
        run(data, each)

    def reading(r: StageRun[ExampleSettings]) -> None:
        with pytest.raises(UserError, match="under way"):
            clean_scene(data, "demo", "place")
        with pytest.raises(UserError, match="under way"):
            link_folder(data, "place", other)

    (other := tmp_path / "other").mkdir()
    run(data, stage("align", "sfm", run=reading))
    assert clean_scene(data, "demo", "place").removed == [data.captures("place")]


def test_captures_in_which_results_would_lie_and_those_of_a_group_are_refused(data: DataRoot, tmp_path: Path) -> None:
    written(data.root / "scenes" / "two.toml", 'members = ["place", "other"]')
    (walk := tmp_path / "walk").mkdir()
    for scene, folder, why in (("two", walk, "two is a group"), ("mine", tmp_path, "results would be written into")):
        with pytest.raises(UserError, match=why):
            link_folder(data, scene, folder)
        assert not data.captures(scene).is_symlink()
    link_folder(hidden := DataRoot(walk / ".results"), "mine", walk)
    assert hidden.captures("mine").resolve() == walk


def flip(path: Path) -> None:
    damaged = bytearray(path.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    path.write_bytes(damaged)


DAMAGES: dict[str, Callable[[Path], object]] = {
    "one bit": lambda folder: flip(folder / "weights" / "two.bin"),
    "cut": lambda folder: os.truncate(folder / "weights" / "two.bin", 1),
    "zeroed": lambda folder: (folder / "weights" / "two.bin").write_bytes(b"\0" * 9),
    "gone": lambda folder: (folder / "weights" / "two.bin").unlink(),
    **{
        f"manifest {text[:9]}": lambda folder, text=text: (folder / "manifest.json").write_text(text)  # type: ignore[misc]
        for text in ("", "null", "[]", '{"outputs": 3, "simulated": true}', '{"outputs": {"x": 1}}', "[" * 9999)
    },
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_artefact_is_refused_as_input_and_made_again(data: DataRoot, damage: str) -> None:
    folder = run(data, IMPORT)
    whole = content(folder)
    DAMAGES[damage](folder)
    with pytest.raises(UserError, match=r"isn't as its stage wrote it|manifest of artefact import is damaged") as told:
        run(data, SFM)
    assert len(str(told.value).splitlines()) < 8
    run(data, IMPORT)
    assert content(folder) == whole
    run(data, SFM)


def test_a_recording_that_is_gone_is_made_again(data: DataRoot) -> None:
    def record(r: StageRun[ExampleSettings]) -> None:
        (r.work / "recording.rrd").write_text("a view")

    folder = run(data, stage("import", run=record))
    (folder / "recording.rrd").unlink()
    run(data, stage("import", run=record))
    assert (folder / "recording.rrd").is_file()


def resumable(kill: bool) -> Stage[ExampleSettings]:
    """A stage with a checkpoint that has to hold a number; it is killed right after writing it."""

    def count(r: StageRun[ExampleSettings]) -> None:
        checkpoint = r.scratch / "checkpoint.json"
        if not checkpoint.exists():
            checkpoint.write_text("41")
        if kill:
            raise KeyboardInterrupt
        (r.work / "answer.bin").write_text(str(json.loads(checkpoint.read_text()) + 1))

    return stage("import", run=count)


@pytest.mark.parametrize("damage", ["", "\0\0", "[]", "4\x001"])
def test_a_damaged_checkpoint_is_dropped_with_a_line(
    data: DataRoot, damage: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(data, resumable(kill=True))
    (data.run("own", "place", ".import.partial") / "scratch" / "checkpoint.json").write_text(damage)
    folder = run(data, resumable(kill=False))
    assert (folder / "answer.bin").read_text() == "42"
    said = capsys.readouterr().err
    assert said.count("the checkpoints are damaged") == 1 and "Traceback" not in said
    assert load_manifest(folder)["resumed"] is False


def test_an_error_of_the_user_or_the_machine_keeps_the_checkpoints(data: DataRoot) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(data, resumable(kill=True))
    checkpoint = data.run("own", "place", ".import.partial") / "scratch" / "checkpoint.json"
    errors = [UserError("the capture is wrong"), MemoryError()]
    errors += [OSError(number, os.strerror(number), "/x") for number in (errno.ENOSPC, errno.EROFS, errno.EMFILE)]
    for error in errors:

        def fail(r: StageRun[ExampleSettings], error: Exception = error) -> None:
            raise error

        with pytest.raises(UserError):
            run(data, stage("import", run=fail))
        assert checkpoint.read_text() == "41"
