"""Turning upright keeps every point of the world on its pixel."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from capture_writers import HEIGHT, WIDTH, image, make_walk, write_scanner_app
from known import rows

from groundwalk.artefacts import DataRoot, execute
from groundwalk.artefacts.tables import poses_of
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.capture_import.stage import STAGE
from groundwalk.geometry.poses import inverse, make_pose, transform


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_points_stay_on_their_pixels(tmp_path: Path, quarters: int) -> None:
    """A phone held turned by quarters counter-clockwise must come out upright."""
    c, s = np.cos(quarters * np.pi / 2).round(), np.sin(quarters * np.pi / 2).round()
    held = make_pose([[c, -s, 0], [s, c, 0], [0, 0, 1]], [0, 0, 0])
    walk = make_walk(24)
    walk = replace(walk, vio_T_cam=walk.vio_T_cam @ held)
    write_scanner_app(tmp_path / "captures" / "place" / "walk", walk)
    folder = execute(STAGE, "place", "tiny", DataRoot(tmp_path), ["upright=true"])
    frames = pd.read_parquet(folder / "frames.parquet")
    assert (frames["gravity_y"] > 0.9).all()
    vio = poses_of(pd.read_parquet(folder / "vio.parquet"), "vio_cam")
    for row, vio_T_cam in zip(rows(frames), poses_of(frames, "vio_cam"), strict=True):
        index = int(row.frame_id[-6:])
        np.testing.assert_allclose(vio[index], vio_T_cam, atol=1e-9)
        points = transform(walk.vio_T_cam[index], np.random.default_rng(index).uniform([-1, -1, 2], [1, 1, 5], (20, 3)))
        before, after = transform(inverse(walk.vio_T_cam[index]), points), transform(inverse(vio_T_cam), points)
        fx, fy, cx, cy = walk.camera[index]
        u, v = fx * before[:, 0] / before[:, 2] + cx, fy * before[:, 1] / before[:, 2] + cy
        width, height = WIDTH, HEIGHT
        for _ in range(quarters):
            u, v, width, height = height - v, u, height, width
        np.testing.assert_allclose(row.fx * after[:, 0] / after[:, 2] + row.cx, u, atol=1e-6)
        np.testing.assert_allclose(row.fy * after[:, 1] / after[:, 2] + row.cy, v, atol=1e-6)
        assert (row.width, row.height) == (width, height)
        if quarters:
            written = decode_rgb((folder / row.image.removeprefix("import:")).read_bytes(), 1000)
            expected = np.rot90(image(index)[:, :, ::-1], -quarters)
            assert np.abs(written.astype(int) - expected).mean() < 20
