"""What an import's recording shows, read back."""

from pathlib import Path

from rerun.chunk import RrdReader

from tests.capture_import.capture_writers import WRITERS, imported, make_walk


def rows_of(path: Path) -> dict[str, int]:
    """Rows by entity path."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.to_record_batch().num_rows
    return rows


def test_each_session_has_its_own_tree_and_a_reference_is_not_shown_as_odometry(tmp_path: Path, place: Path) -> None:
    walk = make_walk(60, every=1)
    walk.vio_T_cam[30:, :3, 3] += [3.0, 0.0, 0.0]
    WRITERS["3d_scanner_app"].write(place / "walk", walk)
    (place / "walk" / "frame_00010.jpg").write_bytes(b"")
    WRITERS["3d_scanner_app"].write(place / "other", make_walk(20, every=1, seed=1))
    WRITERS["seven_scenes"].write(place / "seq-01", make_walk(20, every=1))
    rows = rows_of(imported(tmp_path, "sampling='all'").folder / "recording.rrd")
    for session, poses, images in (("walk", 30, 29), ("walk.part2", 30, 30), ("other", 20, 20)):
        at = f"/{session}"
        assert rows[f"{at}/vio"] == rows[f"{at}/frames"] == 1
        # The curve of speed has a step fewer than there are poses, and a row for its name.
        assert rows[f"{at}/speed"] == poses and rows[f"{at}/sharpness"] == images + 1
        assert rows[f"/images/{session}"] == images
    assert rows["/walk/log/rejects"] == 1 and rows["/walk/rejects"] == 1
    assert rows["/walk/log/jumps"] == 1 and rows["/walk/jumps"] == 1
    assert rows["/seq-01/reference"] == 1 and rows["/images/seq-01"] == 20
    assert not {"/other/jumps", "/other/rejects", "/walk.part2/log/rejects", "/seq-01/vio"} & rows.keys()
