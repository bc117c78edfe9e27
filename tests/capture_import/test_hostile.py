"""Archives and logs that are made to harm: each its own folder, bounded in bytes, memory and names."""

import json
import shutil
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


@pytest.mark.parametrize("zipped", ["folder", "zip"])
def test_images_in_train_and_test_that_differ_in_metadata_alone_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], zipped: str
) -> None:
    root, comment = tmp_path / "captures" / "place", b"\xff\xfe\x00\x06here"
    WRITERS["frames_jsonl"].write(root / "train", make_walk(4))
    if zipped == "zip":
        zipped_walk(root / "test.zip", 4)
    else:
        WRITERS["frames_jsonl"].write(root / "test", make_walk(4))
    for image in (root / "train" / "images").iterdir():
        image.write_bytes(image.read_bytes()[:2] + comment + image.read_bytes()[2:])
    figures = imported(tmp_path, "sampling=all", "check_convention=false").figures
    count = figures["frames_test"]
    assert figures["test_images_also_in_train"] == count > 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"warning: {count} of {count} test images are also training images" in said


def test_a_zipped_export_of_a_simulated_scene_is_simulated(tmp_path: Path) -> None:
    root = tmp_path / "captures" / "place"
    zipped_walk(root / "walk.zip", 4)
    with zipfile.ZipFile(root / "walk.zip", "a") as archive:
        archive.writestr("export.json", '{"simulated": true}')
    assert load_manifest(imported(tmp_path, "check_convention=false").folder)["simulated"]


def test_archives_that_shrink_too_much_or_hold_too_much_together_are_refused(tmp_path: Path) -> None:
    bomb = tmp_path / "bomb.zip"
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as content, content.open("zeros", "w") as member:
        for _ in range(110):
            member.write(bytes(1 << 20))
    for name in ("a", "b"):
        with zipfile.ZipFile(tmp_path / f"{name}.zip", "w") as content:
            content.writestr("noise", bytes(700_000))
    small = Limits(max_archive_bytes=1 << 20)
    unpack(tmp_path / "a.zip", tmp_path / "unpacked" / "a", small)
    for archive, limits in ((bomb, Limits()), (tmp_path / "b.zip", small)):
        with pytest.raises(UserError, match="more bytes than the limit"):
            unpack(archive, tmp_path / "unpacked" / archive.stem, limits)


def test_an_archive_for_which_there_is_no_space_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    archive = tmp_path / "a.zip"
    with zipfile.ZipFile(archive, "w") as content:
        content.writestr("zeros", bytes(1 << 20))
    monkeypatch.setattr("shutil.disk_usage", lambda folder: type("Usage", (), {"free": 200 << 20}))
    with pytest.raises(UserError, match=r"(?s)too little free space.*257 MiB.*200 MiB free"):
        unpack(archive, tmp_path / "unpacked" / "a", Limits())


@pytest.mark.parametrize("method", [zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_STORED])
def test_damaged_members_are_a_sentence_in_every_compression(tmp_path: Path, method: int) -> None:
    archive = tmp_path / "walk.zip"
    with zipfile.ZipFile(archive, "w", method) as content:
        content.writestr("log.txt", "".join(f"{i * 7919 % 10007} " for i in range(3000)))
    whole = archive.read_bytes()
    refused = 0
    for at in range(37, min(len(whole), 4000), 61):
        for kind, damaged in (
            ("flipped", whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :]),
            ("cut", whole[:at]),
        ):
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
def test_a_session_of_a_long_name_is_imported(tmp_path: Path, name: str) -> None:
    root = tmp_path / "captures" / "place"
    for folder in (name, name[:-1] + "z"):
        WRITERS["frames_jsonl"].write(root / folder, make_walk(4))
    sessions = set(imported(tmp_path, "images=copy", "check_convention=false")["frames"]["session_id"])
    assert len(sessions) == 2 and max(len(session.encode()) for session in sessions) <= 120


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
def test_one_hostile_row_is_one_reject(tmp_path: Path, key: str, value: object, reason: str) -> None:
    log = tmp_path / "captures" / "place" / "walk" / "frames.jsonl"
    WRITERS["frames_jsonl"].write(log.parent, make_walk(20))
    rows = [json.loads(line) for line in log.read_text().splitlines()]
    rows[3][key] = value
    log.write_bytes("\n".join(map(json.dumps, rows)).encode().replace(b"NOT UTF-8", b"\xe9"))
    rejects = imported(tmp_path, "sampling=all", "check_convention=false")["rejects"]
    assert rejects.loc[rejects["source"].str.contains("jsonl"), "reason"].str.contains(reason).sum() == 1
