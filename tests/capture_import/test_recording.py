"""What an import's recording shows, read back."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from rerun.chunk import RrdReader

from tests.capture_import.capture_writers import WRITERS, imported, make_walk


def rows_of(path: Path) -> dict[str, int]:
    """Rows by entity path."""
    rows: dict[str, int] = {}
    for chunk in RrdReader(path).stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.to_record_batch().num_rows
    return rows


def test_each_session_has_its_own_tree(tmp_path: Path) -> None:
    walk = make_walk(60, every=1)
    walk.vio_T_cam[30:, :3, 3] += [3.0, 0.0, 0.0]
    folder = tmp_path / "captures" / "place"
    WRITERS["3d_scanner_app"].write(folder / "walk", walk)
    (folder / "walk" / "frame_00010.jpg").write_bytes(b"")
    WRITERS["3d_scanner_app"].write(folder / "other", replace(make_walk(20, seed=1), has_image=np.ones(20, bool)))
    rows = rows_of(imported(tmp_path, "sampling='all'").folder / "recording.rrd")
    for session, poses, images in (("walk", 30, 29), ("walk.part2", 30, 30), ("other", 20, 20)):
        at = f"/{session}"
        assert rows[f"{at}/vio"] == rows[f"{at}/frames"] == 1
        # The curve of speed has a step fewer than there are poses, and a row for its name.
        assert rows[f"{at}/speed"] == poses and rows[f"{at}/sharpness"] == images + 1
        assert rows[f"/images/{session}"] == images
    assert rows["/walk/log/rejects"] == 1 and rows["/walk/rejects"] == 1
    assert rows["/walk/log/jumps"] == 1 and rows["/walk/jumps"] == 1
    assert not {"/other/jumps", "/other/rejects", "/walk.part2/log/rejects"} & rows.keys()


def test_a_reference_is_not_shown_as_odometry(tmp_path: Path) -> None:
    WRITERS["seven_scenes"].write(tmp_path / "captures" / "place" / "seq-01", make_walk(20, every=1))
    rows = rows_of(imported(tmp_path, "sampling='all'").folder / "recording.rrd")
    assert rows["/seq-01/reference"] == 1 and "/seq-01/vio" not in rows
    assert rows["/images/seq-01"] == 20
