"""Archives and logs that are made to harm: each its own folder, bounded in bytes, memory and names."""

import json
import shutil
import stat
import tempfile
import zipfile
from pathlib import Path

import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.media.archive import unpack
from groundwalk.capture_import.parsing import json_of, lines_of
from groundwalk.store import UserError
from groundwalk.store.manifests import load_manifest
from tests.capture_import.capture_writers import WRITERS, imported, make_walk


def zipped_walk(archive: Path, frames: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        WRITERS["frames_jsonl"].write(Path(folder), make_walk(frames))
        written = shutil.make_archive(f"{folder}-zipped", "zip", folder)
    archive.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(written, archive)


@pytest.mark.parametrize(("one", "other"), [("x/y.zip", "x-y.zip"), ("x/y.zip", "x/y.r3d"), ("x/é.zip", "x/è.zip")])
def test_each_archive_has_a_folder_of_its_own(tmp_path: Path, one: str, other: str) -> None:
    root = tmp_path / "place"
    zipped_walk(root / one, 4)
    zipped_walk(root / other, 6)
    found = find_recordings(root, tmp_path / "unpacked", Limits())
    assert sorted(len(recording.read(Limits()).frames) for recording in found) == [4, 6]
    again = find_recordings(root, tmp_path / "unpacked", Limits())
    assert [recording.path for recording in again] == [recording.path for recording in found]


@pytest.mark.parametrize("is_zipped", [False, True])
def test_images_in_train_and_test_that_differ_in_metadata_alone_are_named(
    tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str], is_zipped: bool
) -> None:
    WRITERS["frames_jsonl"].write(place / "train", make_walk(4))
    if is_zipped:
        zipped_walk(place / "test.zip", 4)
    else:
        WRITERS["frames_jsonl"].write(place / "test", make_walk(4))
    for image in (place / "train" / "images").iterdir():
        image.write_bytes(image.read_bytes()[:2] + b"\xff\xfe\x00\x06here" + image.read_bytes()[2:])
    figures = imported(tmp_path, "sampling=all", "check_convention=false").figures
    count = figures["frames_test"]
    assert figures["test_images_also_in_train"] == count > 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"warning: {count} of {count} test images are also training images" in said
    assert "warning: train is test again: 2 of its 2 frames have the same image" in said


def test_a_zipped_export_of_a_simulated_scene_is_simulated(tmp_path: Path, place: Path) -> None:
    zipped_walk(place / "walk.zip", 4)
    with zipfile.ZipFile(place / "walk.zip", "a") as archive:
        archive.writestr("export.json", '{"simulated": true}')
    assert load_manifest(imported(tmp_path, "check_convention=false").folder)["simulated"]


def zipped(archive: Path, *members: tuple[str | zipfile.ZipInfo, bytes]) -> Path:
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as content:
        for name, data in members:
            content.writestr(name, data)
    return archive


@pytest.mark.parametrize("name", ["../evil.txt", "/evil.txt", "a/../../evil.txt", "..\\evil.txt", "C:\\evil.txt"])
def test_archives_cannot_write_outside(tmp_path: Path, name: str) -> None:
    archive = zipped(tmp_path / "walk.zip", (name, b"x"))
    with pytest.raises(UserError, match="refused"):
        unpack(archive, tmp_path / "deep" / "er" / "target", Limits())
    assert not list(tmp_path.rglob("evil*"))


def test_archives_beyond_the_limits_are_refused_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links; too many files; more bytes than archives of this size hold, or than all may hold together, or than are
    free."""
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    linked = zipped(tmp_path / "linked.zip", (link, b"/etc/passwd"))
    many = zipped(tmp_path / "many.zip", *((str(i), b"") for i in range(20)))
    bomb = zipped(tmp_path / "bomb.zip", ("zeros", bytes(110 << 20)))
    one, other = (zipped(tmp_path / f"{name}.zip", ("noise", bytes(700_000))) for name in ("one", "other"))
    small = Limits(max_archive_files=10, max_archive_bytes=1 << 20)
    unpack(one, tmp_path / "unpacked" / "one", small)
    for archive, limits, found in (
        (linked, small, "no file or folder"),
        (many, small, "more than 10 files"),
        (other, small, "more bytes than the limit"),
        (bomb, Limits(), "more bytes than the limit"),
    ):
        with pytest.raises(UserError, match=found):
            unpack(archive, tmp_path / "unpacked" / archive.stem, limits)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 200 << 20}))
    with pytest.raises(UserError, match=r"(?s)too little free space.*257 MiB.*200 MiB free"):
        unpack(other, tmp_path / "unpacked" / "other", Limits())
    assert [path.name for path in (tmp_path / "unpacked").iterdir() if path.suffix != ".partial"] == ["one"]


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_STORED])
def test_damaged_members_are_a_sentence_in_every_compression(tmp_path: Path, method: int) -> None:
    archive = tmp_path / "walk.zip"
    with zipfile.ZipFile(archive, "w", method) as content:
        content.writestr("log.txt", "".join(f"{i * 7919 % 10007} " for i in range(3000)))
    whole = archive.read_bytes()
    refused = 0
    for at in range(37, min(len(whole), 4000), 61):
        flipped = whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]
        for kind, damaged in (("flipped", flipped), ("cut", whole[:at])):
            archive.write_bytes(damaged)
            try:
                unpack(archive, tmp_path / f"{kind}{at}" / "walk", Limits())
            except UserError as error:
                assert len(str(error)) < 1000
                refused += 1
    assert refused > 3


def test_a_json_file_is_refused_before_it_takes_the_memory(tmp_path: Path) -> None:
    log = tmp_path / "log.json"
    for part, count in (("[]", 8 << 20), ("{}", 3 << 20), ('{"a":""}', 2 << 20)):
        log.write_text('{"pose_data": [' + f"{part}," * count + "[]]}")
        with pytest.raises(UserError, match=r"would take about \d+ MiB of memory, more than the limit of 512 MiB"):
            json_of(log, Limits())


def test_logs_are_read_line_by_line_within_limits(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.write_text("﻿# head\n\nfirst\r\nsecond\n" + "noise\n" * 1000 + "last", encoding="utf-8")
    kept = lines_of(log, Limits(max_rows=3), lambda line: line != "noise")
    assert kept == [("log.txt line 3", "first"), ("log.txt line 4", "second"), ("log.txt line 1005", "last")]
    for limits, found in (
        (Limits(max_rows=99), "99 rows"),
        (Limits(max_parsed_bytes=2000), "rows"),
        (Limits(max_text_bytes=9), "bytes"),
    ):
        with pytest.raises(UserError, match=found):
            lines_of(log, limits)
    log.write_text("1 " * 600_000)
    with pytest.raises(UserError, match="line 1 is longer"):
        lines_of(log, Limits())
    with pytest.raises(UserError, match="can't be read"):
        lines_of(tmp_path / "none", Limits())


@pytest.mark.parametrize("name", ["x" * 250, "漢" * 80], ids=["ascii", "three bytes"])
def test_a_session_of_a_long_name_is_imported(tmp_path: Path, place: Path, name: str) -> None:
    for folder in (name, name[:-1] + "z"):
        WRITERS["frames_jsonl"].write(place / folder, make_walk(4))
    sessions = set(imported(tmp_path, "images=copy", "check_convention=false")["frames"]["session_id"])
    assert len(sessions) == 2 and max(len(session.encode()) for session in sessions) <= 120


def test_no_session_is_called_as_all_of_them_together(tmp_path: Path, place: Path) -> None:
    WRITERS["frames_jsonl"].write(place / "all", make_walk(4))
    assert set(imported(tmp_path, "check_convention=false")["frames"]["session_id"]) == {"all_"}


@pytest.mark.parametrize(
    ("key", "value", "reason"),
    [
        ("image", "images/\ud800.jpg", "lone surrogate"),
        ("image", "/etc/hostname", "leads out of the recording"),
        ("t_ns", 2**63 - 1, "nanoseconds"),
        ("t_ns", 1 - 2**63, "nanoseconds"),
        ("note", "NOT UTF-8", "row isn't UTF-8 text"),
    ],
)
def test_one_hostile_row_is_one_reject(tmp_path: Path, place: Path, key: str, value: object, reason: str) -> None:
    log = place / "walk" / "frames.jsonl"
    WRITERS["frames_jsonl"].write(log.parent, make_walk(20))
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    rows[3][key] = value
    log.write_bytes("\n".join(map(json.dumps, rows)).encode().replace(b"NOT UTF-8", b"\xe9"))
    rejects = imported(tmp_path, "sampling=all", "check_convention=false")["rejects"]
    assert rejects.loc[rejects["source"].str.contains("jsonl"), "reason"].str.contains(reason).sum() == 1
