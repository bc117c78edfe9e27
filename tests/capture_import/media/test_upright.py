"""Turning upright keeps every point of the world on its pixel."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.capture_import.media.upright import first_row
from groundwalk.geometry.poses import inverse, make_pose, transform
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.tables import poses_of
from tests.capture_import.capture_writers import HEIGHT, WIDTH, image, make_walk, write_frames_jsonl, write_scanner_app
from tests.known import rows


@pytest.mark.parametrize("quarters", [0, 1, 3])
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
        assert row.first_row == ["top", "right", "bottom", "left"][quarters]
        if quarters:
            written = decode_rgb((folder / row.image.removeprefix("import:")).read_bytes(), 1000)
            expected = np.rot90(image(index)[:, :, ::-1], -quarters)
            assert np.abs(written.astype(int) - expected).mean() < 20


@pytest.mark.parametrize(
    ("size", "stated", "quarters", "side"),
    [
        ((1920, 1440), None, 0, "top"),
        ((1440, 1920), None, 0, "right"),  # an app turned it clockwise
        ((1440, 1920), None, 1, "right"),  # import turned it
        ((1920, 1440), None, 1, "bottom"),  # both did
        ((1440, 1440), None, 1, "right"),
        ((1440, 1920), "left", 0, "left"),
        ((1440, 1920), "left", 2, "right"),
        ((1920, 1440), "bottom", 3, "right"),
    ],
)
def test_the_first_row_is_where_turns_put_it(
    size: tuple[int, int], stated: str | None, quarters: int, side: str
) -> None:
    assert first_row(*size, stated, quarters) == side


def test_what_a_capture_states_of_its_shutter_is_in_frames_and_an_absurd_readout_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "captures" / "place" / "walk"
    write_frames_jsonl(folder, make_walk(8))
    log = folder / "frames.jsonl"
    as_written = log.read_text()

    def stated(**members: object) -> None:
        log.write_text(as_written.replace("{", json.dumps(members)[:-1] + ", ", 1))

    for settings, side in (([], "bottom"), (["first_row='left'"], "left"), (["upright=true"], "bottom")):
        stated(first_row="bottom", readout_s=0.0187)
        frames = pd.read_parquet(execute(STAGE, "place", "tiny", DataRoot(tmp_path), settings) / "frames.parquet")
        assert set(frames["first_row"]) == {side} and set(frames["stated_readout_s"]) == {0.0187}
    stated(first_row="down")
    with pytest.raises(UserError, match="first_row"):
        execute(STAGE, "place", "tiny", DataRoot(tmp_path))
    for wrong in (18.7, -0.01, True, "20 ms"):
        stated(readout_s=wrong)
        with pytest.raises(UserError, match="readout_s, seconds, 0 to 0"):
            execute(STAGE, "place", "tiny", DataRoot(tmp_path))
