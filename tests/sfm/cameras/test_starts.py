"""Focal lengths before mapping: what is stated stays where images don't tell, and gives way where they do."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import undistort
from groundwalk.sfm.cameras.starts import estimate_focal_lengths
from groundwalk.sfm.database import Workspace
from groundwalk.sfm.settings import SfmSettings

WIDTH, HEIGHT, FOCAL_PX = 480, 360, 420.0
BARREL = np.array([-0.15, 0.03, 0, 0, 0, 0, 0, 0])


def photograph_ground(folder: Path, relief_m: float) -> list[str]:
    """Twelve photos from 10 m above ground that is flat, or rises in steps, by a lens that isn't a phone's."""
    rng = np.random.default_rng(0)
    ground = np.zeros((1800, 1800), np.uint8)
    for size in (225, 450, 900):
        noise = rng.integers(0, 80, (size, size)).astype(np.uint8)
        ground += np.asarray(cv2.resize(noise, (1800, 1800), interpolation=cv2.INTER_CUBIC), np.uint8)
    steps = relief_m * rng.random((6, 6))
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1).reshape(-1, 2)
    ideal = undistort((pixels - [WIDTH / 2, HEIGHT / 2]) / FOCAL_PX, BARREL)
    names = []
    for number in range(12):
        x, y = 6 + 2.0 * (number % 4), 6.5 + 2.0 * (number // 4)
        turn = Rotation.from_euler("zxy", [180 * (number // 4 % 2), *rng.normal(0, 2, 2)], degrees=True)
        ray = turn.apply(np.column_stack([ideal, np.ones(len(ideal))]))
        depth = np.full(len(ray), 10.0)
        for _ in range(8):  # to where the ray meets the step below it
            at = np.array([x, y]) + ray[:, :2] / ray[:, 2:] * depth[:, None]
            cell = np.clip(at / 3, 0, 5).astype(int)
            depth = 10.0 - steps[cell[:, 1], cell[:, 0]]
        at = (100 * at).astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        shown = cv2.remap(ground, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        names.append(f"{number}.png")
        cv2.imwrite(str(folder / names[-1]), shown)
    return names


@pytest.mark.parametrize(("relief_m", "stated"), [(0.0, 1.0), (0.0, 1.04), (4.0, 1.3)])
def test_what_is_stated_stays_unless_images_deny_it(relief_m: float, stated: float, tmp_path: Path) -> None:
    """Flat ground from above fits any focal length, and with a phone's lens some other one better; relief tells it."""
    names = photograph_ground(tmp_path, relief_m)
    frame = {"session_id": "s", "width": WIDTH, "height": HEIGHT, "focal_sd": 0.05}
    frames = pd.DataFrame([frame] * len(names)).assign(fx=stated * FOCAL_PX, fy=stated * FOCAL_PX, cx=240.0, cy=180.0)
    work = Workspace(tmp_path, names, tmp_path / "scratch", {})
    found, k1_k2 = estimate_focal_lengths(lambda done, note="": None, frames, work, SfmSettings(), 0)
    assert k1_k2["s"] == pytest.approx(BARREL[:2], abs=0.05)
    if relief_m:
        assert found["s"] == pytest.approx(FOCAL_PX, rel=0.05)
    else:
        assert found["s"] == pytest.approx(stated * FOCAL_PX)
