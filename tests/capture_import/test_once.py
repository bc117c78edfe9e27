"""Images are decoded once: the checks and the recording take what the scan has put aside."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader

from groundwalk.capture_import import recording
from groundwalk.capture_import.capture import Limits, RawFrame
from groundwalk.capture_import.checks import views
from groundwalk.capture_import.checks.clock import CLOCK_LONG_SIDE, dense_part
from groundwalk.capture_import.checks.convention import CONVENTION_LONG_SIDE, parallax_pairs
from groundwalk.capture_import.checks.scan import ImageScan, scan_images
from groundwalk.capture_import.checks.views import Views
from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.media.images import decode_gray
from groundwalk.capture_import.media.spool import Spool, thumbnail_path
from groundwalk.capture_import.media.thumbnails import MAX_THUMBNAILS, spread, thumbnail_of
from groundwalk.store import DataRoot, execute
from groundwalk.store.manifests import load_manifest
from tests.capture_import.capture_writers import Walk, make_walk, write_scanner_app, write_stray_scanner


def frames_of(folder: Path) -> list[RawFrame]:
    (found,) = find_recordings(folder, folder.parent, Limits())
    return [frame for frame in found.read(Limits()).frames if frame.image is not None]


@pytest.mark.parametrize("write", [write_scanner_app, write_stray_scanner])
def test_what_the_checks_want_is_put_aside(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path, Walk], object]
) -> None:
    write(tmp_path / "place" / "walk", make_walk(60, every=1))
    frames = frames_of(tmp_path / "place")
    kept = Views([tmp_path], Limits())
    assert len([look for look in kept.scan(frames) if isinstance(look, ImageScan)]) == 60
    missed: list[RawFrame] = []
    again = views.load_gray

    def counted(frames: Sequence[RawFrame], *options: Any) -> object:
        missed.extend(frames)
        return again(frames, *options)

    monkeypatch.setattr(views, "load_gray", counted)
    wanted = sorted({i for pair in parallax_pairs(frames) for i in pair})
    assert len(wanted) > 4
    seen = list(kept.load([frames[i] for i in wanted], CONVENTION_LONG_SIDE))
    assert not missed
    # What is loaded without having been put aside is the same.
    fresh = list(Views([tmp_path], Limits()).load([frames[i] for i in wanted], CONVENTION_LONG_SIDE))
    assert len(missed) == len(wanted)
    for (frame, gray), (other, decoded) in zip(seen, fresh, strict=True):
        assert frame is other
        np.testing.assert_array_equal(gray, decoded)
    missed.clear()
    stretch = dense_part(frames)
    assert len(list(kept.load(stretch, CLOCK_LONG_SIDE))) == len(stretch) >= 20
    assert not missed
    # Others are decoded again, in between.
    assert [frame.number for frame, _ in kept.load(frames, CLOCK_LONG_SIDE)] == [frame.number for frame in frames]
    assert len(missed) == len(frames) - len(stretch) > 0


def test_thumbnails_are_made_from_the_one_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scanner_app(tmp_path / "captures" / "place" / "walk", make_walk(200, every=1))
    monkeypatch.setattr(recording, "thumbnail_of", lambda path: pytest.fail(f"{path} is decoded again"))
    artefact = execute(STAGE, "place", "tiny", DataRoot(tmp_path), ["min_frames=0", "rate_hz=4"])
    batches = [c.to_record_batch() for c in RrdReader(artefact / "recording.rrd").stream() if is_image(c.entity_path)]
    shown = sum(batch.num_rows for batch in batches if any("blob" in name for name in batch.schema.names))
    assert shown == load_manifest(artefact)["figures"]["frames"] == 81


def is_image(path: object) -> bool:
    return str(path).endswith("/camera/image")


def test_a_thumbnail_shows_its_image(tmp_path: Path) -> None:
    folder = tmp_path / "place" / "walk"
    write_scanner_app(folder, make_walk(30, every=1))
    frames = frames_of(tmp_path / "place")
    spool = Spool(tmp_path / "spool", frames, STAGE.settings(sampling="all"))
    for place, look in enumerate(scan_images(frames, [tmp_path], Limits(), spool.in_colour)):
        assert isinstance(look, ImageScan)
        spool.add(place, look)
    spool.flush()
    for i, frame in enumerate(frames):
        ready = decode_gray(thumbnail_path(tmp_path / "spool", frame.number).read_bytes(), 1000).astype(int)
        direct = decode_gray(thumbnail_of(folder / f"frame_{i:05d}.jpg"), 1000)
        assert np.abs(ready - direct).mean() < 3


def test_as_many_are_shown_as_a_recording_holds() -> None:
    for count in (0, 1, MAX_THUMBNAILS, MAX_THUMBNAILS + 1, 10 * MAX_THUMBNAILS):
        shown = spread(range(count))
        assert min(count, MAX_THUMBNAILS // 2) <= len(shown) <= MAX_THUMBNAILS
