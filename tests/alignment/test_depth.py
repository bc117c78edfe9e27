"""Depth against the map: cameras over a floor, whose depth at each pixel is known, and SfM's model of that floor."""

from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.checks.results import with_status
from groundwalk.alignment.components import NO_SCALE, Component, MapScale, PlacedComponent, Vertical
from groundwalk.alignment.depth import agreement_table, check_depth, read_depth, sample_frames
from groundwalk.consistency.decisions import Status
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, inverse, make_pose, transform
from groundwalk.store import UserError
from groundwalk.store.files import sha256_of
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame, write_table
from tests.known import cells

COUNT, SIZE, SHAPE = 12, (640, 480), (96, 128)
K = np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]])
EXACT = {0: 0.0}
GAUGE = Sim3(0.4, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -7.0, 1.0]))


def cameras() -> Array:
    """Looking down at the floor y = 0 from 1 to 3.5 m, a little tilted."""
    rng = np.random.default_rng(0)
    down = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    tilt = Rotation.from_rotvec(rng.normal(0, 0.15, (COUNT, 3))).as_matrix()
    xyz = np.column_stack([rng.uniform(-0.2, 0.2, COUNT), 1 + 0.25 * np.arange(COUNT), rng.uniform(-0.2, 0.2, COUNT)])
    return make_pose(tilt @ down, xyz)


def floor_depth(map_T_cam: Array) -> Array:
    """Depth (H, W) along the camera's z at which each pixel of the depth image sees y = 0."""
    v, u = np.meshgrid(
        (np.arange(SHAPE[0]) + 0.5) * SIZE[1] / SHAPE[0],
        (np.arange(SHAPE[1]) + 0.5) * SIZE[0] / SHAPE[1],
        indexing="ij",
    )
    rays = np.stack([(u - 320) / 500, (v - 240) / 500, np.ones_like(u)], axis=-1) @ map_T_cam[:3, :3].T
    return -map_T_cam[1, 3] / rays[..., 1]


Placed = tuple[pd.DataFrame, pd.DataFrame, PlacedComponent]
"""Frames, SfM's images and one placed model."""


@pytest.fixture
def scene(tmp_path: Path) -> Placed:
    """With the depth images and the model in `tmp_path`."""
    map_T_cam = cameras()
    sfm_T_cam = GAUGE.poses(map_T_cam)
    points = np.random.default_rng(1).uniform([-0.5, 0, -0.4], [0.5, 0, 0.4], (150, 3))
    model = pycolmap.Reconstruction()
    tracks: list[list[pycolmap.TrackElement]] = [[] for _ in points]
    frames = []
    for i in range(COUNT):
        cam = transform(inverse(map_T_cam[i]), points)
        xy = cam[:, :2] / cam[:, 2:] * 500 + [320, 240]
        seen = np.flatnonzero(((xy > 0) & (xy < SIZE)).all(axis=1))
        camera = pycolmap.Camera(camera_id=i + 1, model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"walk/{i:06d}.jpg", keypoints=xy[seen], camera_id=i + 1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(sfm_T_cam[i])[:3]))
        for number, point in enumerate(seen):
            tracks[point].append(pycolmap.TrackElement(i + 1, number))
        cv2.imwrite(str(tmp_path / f"depth{i}.png"), np.round(1000 * floor_depth(map_T_cam[i])).astype(np.uint16))
        cv2.imwrite(str(tmp_path / f"conf{i}.png"), np.full(SHAPE, 255, np.uint8))
        frames.append({"frame_id": f"walk/{i:06d}", "session_id": "walk", "width": 640, "height": 480})
    for xyz, track in zip(GAUGE.points(points), tracks, strict=True):
        model.add_point3D(xyz, pycolmap.Track(track))
    (tmp_path / "model").mkdir()
    model.write_binary(tmp_path / "model")
    table = pd.DataFrame(frames).assign(fx=500.0, fy=500.0, cx=320.0, cy=240.0, distortion=cells([[]] * COUNT))
    table["depth"] = [f"depth{i}.png" for i in range(COUNT)]
    table["depth_sha256"] = [sha256_of(tmp_path / name) for name in table["depth"]]
    table["depth_confidence"] = [f"conf{i}.png" for i in range(COUNT)]
    component = Component(
        index=0,
        model_id="m",
        segments=[],
        scale=MapScale(0.0, 0.0, {}),
        vertical=Vertical(np.zeros(3), 0.0, {}),
        vio_scale=NO_SCALE,
    )
    placed = PlacedComponent(component, GAUGE.inverse())
    return table, pose_frame("sfm_cam", sfm_T_cam), placed


def samples_of(scene: Placed, tmp_path: Path, scale: float = 1.0) -> pd.DataFrame:
    frames, images, placed = scene
    to_map = placed.map_S_sfm
    wrong = PlacedComponent(placed.component, Sim3(scale * to_map.scale, to_map.rotation, to_map.translation))
    used = np.ones(len(frames), dtype=bool)
    return sample_frames(frames, images, used, [wrong], lambda _: tmp_path / "model", lambda entry: tmp_path / entry)


@pytest.mark.parametrize("scale", [1.0, 1.1])
def test_the_ratio_is_that_of_the_scales(scene: Placed, tmp_path: Path, scale: float) -> None:
    samples = samples_of(scene, tmp_path, scale)
    assert len(samples) > 300 and set(samples["confidence"]) == {2}
    # Millimetres are rounded: half of one at a metre.
    np.testing.assert_allclose(samples["sensor_m"] / samples["map_m"], 1 / scale, atol=1.5e-3)
    table = agreement_table(samples, seed=0)
    write_table(tmp_path / "depth_agreement.parquet", table, schema("align", "depth_agreement"))
    whole = table[(table["near_m"] == 0) & (table["far_m"] == 5.0) & (table["confidence"] == 2)].iloc[0]
    assert whole["median_ratio"] == pytest.approx(1 / scale, abs=5e-4) and whole["median_ratio_se"] < 1e-3
    bins = table[table["confidence"].isna() & ((table["near_m"] > 0) | (table["far_m"] != 5.0))]
    assert bins["samples"].sum() == len(samples) and len(bins) > 2
    checks, (line,) = check_depth(table, EXACT)
    (of_scale,) = [c for c in checks if c.name == "session_depth_scale"]
    assert of_scale.status == ("passed" if scale == 1.0 else "failed") and of_scale.sd == whole["median_ratio_se"]
    assert ("9.09% less" in line) == (scale == 1.1)
    # Beside a scale that isn't known to so much, that decides nothing.
    assert check_depth(table, {0: 0.04})[0][0].status == "undecided"


def test_an_error_that_grows_with_distance_is_named(scene: Placed, tmp_path: Path) -> None:
    samples = samples_of(scene, tmp_path)
    samples["sensor_m"] *= 1 + 0.06 * (samples["map_m"] - 2)
    checks, _ = check_depth(agreement_table(samples, seed=0), EXACT)
    (failed,) = with_status(checks, Status.FAILED)
    assert failed.name == "session_depth_by_distance" and "differs with distance" in failed.reason


def test_too_little_depth_judges_nothing(scene: Placed, tmp_path: Path) -> None:
    frames, images, placed = scene
    frames.loc[2:, "depth"] = None
    samples = samples_of((frames, images, placed), tmp_path, 1.3)
    (result,), (line,) = check_depth(agreement_table(samples, seed=0), EXACT)
    assert (result.name, result.subject.session_id, result.status) == ("session_depth_scale", "walk", "undecided")
    assert "too little depth" in line and result.value is None and result.advice.startswith("more frames with depth")
    frames["depth"] = [f"depth{i}.png" for i in range(COUNT)]
    (decided, *_), _ = check_depth(agreement_table(samples_of((frames, images, placed), tmp_path, 1.3), seed=0), EXACT)
    assert decided.status == "failed"
    frames["depth"] = None
    assert not len(agreement_table(samples_of((frames, images, placed), tmp_path), seed=0))


@pytest.mark.parametrize("levels", [(0, 1, 2), (0, 127, 255)])
def test_both_ways_of_writing_confidence_mean_the_same(tmp_path: Path, levels: tuple[int, int, int]) -> None:
    cv2.imwrite(str(tmp_path / "d.png"), np.full((1, 3), 1250, np.uint16))
    cv2.imwrite(str(tmp_path / "c.png"), np.array([levels], np.uint8))
    metres, confidence = read_depth(tmp_path / "d.png", tmp_path / "c.png", sha256_of(tmp_path / "d.png"))
    assert confidence.tolist() == [[0, 1, 2]] and (metres == 1.25).all()


def test_confidence_that_is_gone_since_import_is_not_taken_for_unknown(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "d.png"), np.full((1, 3), 1250, np.uint16))
    with pytest.raises(UserError, match=r"confidence(.|\n)*c.png"):
        read_depth(tmp_path / "d.png", tmp_path / "c.png", sha256_of(tmp_path / "d.png"))


def test_depth_that_import_has_not_seen_is_refused(scene: Placed, tmp_path: Path) -> None:
    (tmp_path / "depth3.png").write_bytes((tmp_path / "depth4.png").read_bytes())
    with pytest.raises(UserError, match=r"isn't as import saw it(.|\n)*depth3.png"):
        samples_of(scene, tmp_path)
