"""A scene whose pictures show two blotchy boards, with the tables of import, sfm and align."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store.files import sha256_of, write_json
from groundwalk.store.schemas import stage_tables
from groundwalk.store.settings import DataRoot
from groundwalk.store.tables import pose_frame, write_table
from tests.known import filled, put, table_of

COUNT, WIDTH, HEIGHT, FOCAL = 18, 320, 240, 300.0
TEST, VAL = np.arange(COUNT) % 5 == 2, np.arange(COUNT) == 8
CAMERA = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": 160.0, "cy": 120.0}


@dataclass(frozen=True)
class Boards:
    """Scene `Boards` of profile tiny: frame i is `walk/<i>`, its picture captures/<i>.png, its true pose
    map_T_cam[i] (N, 4, 4)."""

    data: DataRoot
    map_T_cam: Array

    def image(self, row: int) -> Path:
        return self.data.captures("Boards") / f"{row}.png"

    def note_images(self) -> None:
        """Note the images as they are now in import's table, as if import had seen them so."""
        frames = table_of(self.data, "Boards", "import", "frames")
        hashes = [sha256_of(self.data.captures("Boards") / image) for image in frames["image"]]
        put(self.data, "Boards", "import", "frames", frames.assign(image_sha256=hashes))

    def table(self, name: str) -> pd.DataFrame:
        return pd.read_parquet(self.data.run("tiny", "Boards", "localise") / f"{name}.parquet")

    def map_bytes(self) -> bytes:
        return (self.data.run("tiny", "Boards", "localise") / "map.gwm").read_bytes()


@pytest.fixture
def make_boards(tmp_path: Path) -> Callable[..., Boards]:
    return lambda frames=COUNT: _boards(tmp_path / "data", frames)


@pytest.fixture(scope="session")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Boards:
    """A scene that no test changes."""
    return _boards(tmp_path_factory.mktemp("boards"), COUNT)


def _boards(root: Path, frames: int) -> Boards:
    rng = np.random.default_rng(0)
    pictures = [board(rng) for _ in "ab"]
    position = [np.linspace(-0.6, 0.6, COUNT), 0.1 * rng.standard_normal(COUNT), 3 + 0.1 * rng.standard_normal(COUNT)]
    poses = make_pose(np.tile(np.diag([1.0, -1.0, -1.0]), (COUNT, 1, 1)), np.stack(position, 1))[:frames]
    made = Boards(DataRoot(root), poses)
    made.data.captures("Boards").mkdir(parents=True)
    for row, pose in enumerate(poses):
        cv2.imwrite(str(made.image(row)), picture(pictures, pose))
    split = np.where(TEST, "test", np.where(VAL, "val", "train"))[:frames].tolist()
    ids = [f"walk/{row:06d}" for row in range(frames)]
    keys = {"frame_id": ids, "session_id": "walk", "t_ns": list(range(frames)), "split": split}
    down = {"gravity_x": 0.0, "gravity_y": 1.0, "gravity_z": 0.0}
    images = [f"{row}.png" for row in range(frames)]
    known = {name: CAMERA[name] for name in ("fx", "fy", "cx", "cy")}
    truth = filled(
        "align", "ground_truth", frames, **keys, **pose_frame("map_cam", poses), **known, quality="A", component=0
    )
    tables = {
        "import": {"frames": filled("import", "frames", frames, **keys, image=images, **CAMERA, **down)},
        "sfm": {"images": filled("sfm", "images", frames, frame_id=ids, **pose_frame("sfm_cam", poses))},
        "align": {"ground_truth": truth},
    }
    for stage, of_stage in tables.items():
        folder = made.data.run("tiny", "Boards", stage)
        folder.mkdir(parents=True)
        for table in stage_tables(stage):
            rows = of_stage.get(table.name, filled(stage, table.name, 0))
            write_table(folder / f"{table.name}.parquet", rows, table)
        about = {"stage": stage, "profile": "tiny", "scene": {"name": "Boards"}, "inputs": {}, "outputs": {}}
        write_json(folder / "manifest.json", about | {"key": "", "simulated": True})
    made.note_images()
    return made


def board(rng: np.random.Generator) -> np.ndarray:
    return cv2.resize(rng.integers(0, 255, (50, 70), np.uint8), (700, 500), interpolation=cv2.INTER_CUBIC)


def picture(boards: list[np.ndarray], pose: Array) -> np.ndarray:
    """What a pinhole sees of boards at z = 0 and, left of it, at z = -0.7."""
    shown: np.ndarray = np.full((HEIGHT, WIDTH), 128, np.uint8)
    for image, z, x in ((boards[1], -0.7, -2.0), (boards[0], 0.0, -0.7)):
        to_cam = pose[:3, :3].T
        # Board pixels are 5 mm.
        plane = np.array([[0.005, 0, x], [0, -0.005, 1.25], [0, 0, 0.0]]) - np.outer([0, 0, 1], [0, 0, -z])
        plane = to_cam @ (plane - np.outer(pose[:3, 3], [0, 0, 1]))
        # OpenCV's pixel centres are whole numbers.
        k = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
        shown = cv2.warpPerspective(image, k @ plane, (WIDTH, HEIGHT), shown, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return shown


def other_board_picture(pose: Array) -> np.ndarray:
    """The same view of another place."""
    rng = np.random.default_rng(99)
    return picture([board(rng) for _ in "ab"], pose)
