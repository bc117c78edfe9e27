"""A small place to localise in: a picture wall seen from many positions, artefacts made from it, and a regressor."""

import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.geometry.poses import make_pose, yaw_rotation
from groundwalk.store.files import sha256_of, write_json
from groundwalk.store.schemas import schema
from groundwalk.store.tables import CAMERA_COLUMNS, pose_frame, write_table
from tests.known import filled

WIDTH, HEIGHT, FOCAL = 64, 48, 50.0
SMALL = ["resize=40", "crop=32", "device=cpu", "threads=1", 'models=["PN"]', "regressors.PN.epochs=1"]


@pytest.fixture
def make_scene(tmp_path: Path) -> Callable[..., Path]:
    """Writes the finished import and align artefacts of a scene, and its images; returns the data folder."""

    def make(name: str = "Wall", train: int = 10, test: int = 4, seed: int = 0) -> Path:
        return write_scene(tmp_path / "data", name, train, test, seed)

    return make


def made_once(tmp_path_factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first of the test processes makes, and all of them read."""
    base = tmp_path_factory.getbasetemp()
    root = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, done = root / name, root / f"{name}.made"
    with (root / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not done.exists():
            make(folder)
            done.touch()
    return folder


@pytest.fixture(scope="session")
def trained_wall(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The data folder of scene Wall, profile tiny, with a PN that learnt for one epoch; only to be read."""
    from groundwalk.store import DataRoot, execute
    from groundwalk.training.definition import STAGE

    def make(folder: Path) -> None:
        execute(STAGE, "Wall", "tiny", DataRoot(write_scene(folder, "Wall", train=24, test=6, seed=0)), SMALL)

    return made_once(tmp_path_factory, "wall", make)


@pytest.fixture(scope="session")
def wall_bundle(trained_wall: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundle of that PN, as the command writes it; only to be read."""
    from typer.testing import CliRunner

    from groundwalk.export.__main__ import app
    from groundwalk.export.phone import quantisation

    def make(folder: Path) -> None:
        options = {"scene": "Wall", "profile": "tiny", "data": trained_wall, "format": "phone", "model": "PN"}
        arguments = [text for name, value in options.items() for text in (f"--{name}", str(value))]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(quantisation, "_TIMED_S", 0.3)  # of each of some ten networks
            done = CliRunner().invoke(app, [*arguments, "--out", str(folder)])
        assert done.exit_code == 0, done.exception or done.output

    return made_once(tmp_path_factory, "wall-bundle", make)


def wall_picture(position: np.ndarray, yaw_deg: float, seed: int) -> np.ndarray:
    """What a camera at `position` (m) sees of a textured wall 4 m ahead, turned by a yaw: BGR (H, W, 3)."""
    rng = np.random.default_rng(seed)
    wall = cv2.resize(rng.integers(0, 255, (12, 24, 3), dtype=np.uint8), (480, 240), interpolation=cv2.INTER_LINEAR)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cam_R_map = yaw_rotation(np.radians(yaw_deg)).T
    # Wall pixel (u, v) is the point (u / 40 - 6, v / 40 - 3, 4).
    wall_to_map = np.array([[1 / 40, 0, -6], [0, 1 / 40, -3], [0, 0, 4.0]])
    shift = np.array([[1, 0, -position[0] / 4], [0, 1, -position[1] / 4], [0, 0, 1 - position[2] / 4]])
    return cv2.warpPerspective(wall, K @ cam_R_map @ shift @ wall_to_map, (WIDTH, HEIGHT))


def write_scene(data: Path, name: str, train: int, test: int, seed: int) -> Path:
    """Write the finished import and align artefacts of a scene, and its images; returns `data`."""
    rng = np.random.default_rng(seed)
    sessions = np.repeat(["walk", "later"], [train, test])
    number = np.concatenate([np.arange(train), np.arange(test)])
    position = rng.uniform(-0.8, 0.8, (train + test, 3))
    yaw = rng.uniform(-15, 15, train + test)
    map_T_cam = make_pose(yaw_rotation(np.radians(yaw)), position)
    captures = data / "captures" / name
    captures.mkdir(parents=True)
    images = [f"{s}-{n}.png" for s, n in zip(sessions, number, strict=True)]
    for image, p, angle in zip(images, position, yaw, strict=True):
        cv2.imwrite(str(captures / image), wall_picture(p, angle, seed))
    hashes = [sha256_of(captures / image) for image in images]
    keys = pd.DataFrame(
        {
            "frame_id": [f"{s}/{n:06d}" for s, n in zip(sessions, number, strict=True)],
            "session_id": sessions,
            "t_ns": number * 1_000_000_000,
            "split": np.where(sessions == "walk", "train", "test"),
        }
    )
    camera = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    unknown = pose_frame("vio_cam", np.full((len(keys), 4, 4), np.nan))
    frames = filled("import", "frames", len(keys), **keys, **camera, **unknown, image=images, image_sha256=hashes)
    frames = frames.assign(gravity_x=0.0, gravity_y=1.0, gravity_z=0.0, sharpness=1.0)
    truth_T = map_T_cam.copy()
    truth_T[-1] = np.nan  # a frame that SfM didn't register
    known: dict[str, Any] = {"position_sd_m": 0.01, "rotation_sd_deg": 0.1, "component": 0}
    known |= {"scale_source": "vio", "vertical_source": "gravity", **frames[CAMERA_COLUMNS]}
    truth = filled("align", "ground_truth", len(keys), **keys, **pose_frame("map_cam", truth_T), **known)
    # Training that looked at a support frame would fail: its image can't be decoded.
    (captures / "damaged.png").write_text("not an image")
    damaged = {"image": "damaged.png", "image_sha256": sha256_of(captures / "damaged.png")}
    support = frames.iloc[[0]].assign(frame_id="walk/000900", t_ns=1, support=True, **damaged)
    _write(data, name, "import", "frames", pd.concat([frames, support]))
    _write(data, name, "align", "ground_truth", truth)
    return data


def _write(data: Path, scene: str, stage: str, table: str, frame: pd.DataFrame) -> None:
    folder = data / "runs" / "tiny" / scene / stage
    folder.mkdir(parents=True)
    write_table(folder / f"{table}.parquet", frame, schema(stage, table))
    write_json(folder / "manifest.json", {"outputs": {}, "simulated": True})
