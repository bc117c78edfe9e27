"""A tiny room with textured walls, photographed on two walks, as import would leave it."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.store import DataRoot
from groundwalk.store.files import hash_files, sha256_of
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame, poses_of, write_table
from tests.known import put, table_of

SIZE_PX = (320, 240)
FOCAL_PX = 260.0
_TEXELS_PER_M = 120
# Odometry of a frame of its own, metric and upright.
_VIO_T_ROOM = make_pose(np.diag([-1.0, 1.0, -1.0]), [5.0, 0.0, 1.0])
# Walls of the room: a corner, and the two directions in which its texture runs (m).
_WALLS = [
    ((-2.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, 2.5, 0.0)),
    ((-2.0, 0.0, 3.0), (0.0, 0.0, -3.0), (0.0, 2.5, 0.0)),
    ((-2.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
]


@dataclass(frozen=True)
class Room:
    """A data folder with a finished import of the scene `room`, and the true room_T_cam (N, 4, 4) of its frames."""

    data: DataRoot
    frames: pd.DataFrame
    true_T_cam: Array

    def note_images(self) -> None:
        """Note the images as they are now in import's table, as if import had seen them so."""
        folder = self.data.run("tiny", "room", "import")
        frames = table_of(self.data, "room", "import", "frames")
        hashes = [sha256_of(self.data.captures("room") / image) for image in frames["image"]]
        put(self.data, "room", "import", "frames", frames.assign(image_sha256=hashes))
        manifest = {"key": "test", "simulated": False, "outputs": hash_files(folder, folder.glob("*.parquet"))}
        (folder / "manifest.json").write_text(json.dumps(manifest))

    def errors_m(self, images: pd.DataFrame) -> Array:
        """How far the positions (N, 3) of a model's frames are from the true ones, as it fits these best."""
        own = self.frames["frame_id"].isin(images["frame_id"])
        true, found = self.true_T_cam[own, :3, 3], poses_of(images, "sfm_cam")[:, :3, 3]
        return fit_sim3(true, found).points(found) - true


@pytest.fixture
def room(tmp_path: Path) -> Room:
    return make_room(tmp_path)


def make_room(folder: Path, per_walk: int = 7, same_place: bool = True) -> Room:
    """Both walks in one room, or the second one in a room of the same shape with other walls."""
    data = DataRoot(folder / "data")
    walks = {"one": _walk(per_walk, 1.5, 2.6), "two": _walk(per_walk, 1.2, 2.2)}
    tables = []
    for number, (session, poses) in enumerate(walks.items()):
        textures = _textures(0 if same_place else 10 * number)
        tables.append(_frames(data, session, poses, [_photograph(textures, pose) for pose in poses]))
    frames = pd.concat(tables, ignore_index=True)
    _write_import(data, frames, list(walks))
    room = Room(data, frames, np.concatenate(list(walks.values())))
    room.note_images()
    return room


def make_recording(folder: Path, count: int, height_m: float, distance_m: float, seed: int = 0) -> Array:
    """A walk in the room, or for another seed one of other walls, as a capture with VIO; its true room_T_cam."""
    textures, room_T_cam = _textures(seed), _walk(count, height_m, distance_m)
    rows: list[dict[str, Any]] = [{"groundwalk": "frames", "version": 1, "device": "phone", "clock": "boot"}]
    folder.mkdir(parents=True)
    camera = {"fx": FOCAL_PX, "fy": FOCAL_PX, "cx": SIZE_PX[0] / 2, "cy": SIZE_PX[1] / 2}
    for number, pose in enumerate(room_T_cam):
        cv2.imwrite(str(folder / f"{number}.png"), _photograph(textures, pose))
        row = {
            "t_ns": number * 1_000_000_000,
            "vio_T_cam": (_VIO_T_ROOM @ pose).ravel().tolist(),
            "image": f"{number}.png",
        }
        rows.append(row | {"width": SIZE_PX[0], "height": SIZE_PX[1]} | camera)
    (folder / "frames.jsonl").write_text("\n".join(map(json.dumps, rows)))
    return room_T_cam


def _frames(data: DataRoot, session: str, room_T_cam: Array, views: list[np.ndarray]) -> pd.DataFrame:
    """The frames table of a walk, a second apart, its pictures written."""
    images = [f"{session}/{row}.jpg" for row in range(len(views))]
    for image, view in zip(images, views, strict=True):
        path = data.captures("room") / image
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), view)
    table = pose_frame("vio_cam", _VIO_T_ROOM @ room_T_cam)
    table[["gravity_x", "gravity_y", "gravity_z"]] = -room_T_cam[:, 1, :3]
    table["frame_id"] = [f"{session}/{row:06d}" for row in range(len(views))]
    table["session_id"] = session
    table["image"] = images
    table["t_ns"] = np.arange(len(views)) * 1_000_000_000
    table[["fx", "fy", "cx", "cy"]] = np.array([FOCAL_PX, FOCAL_PX, SIZE_PX[0] / 2, SIZE_PX[1] / 2])
    table["split"] = "train"
    table["width"], table["height"] = SIZE_PX
    table["distortion"] = [[]] * len(table)
    return table


def _walk(count: int, height_m: float, distance_m: float) -> Array:
    along = np.linspace(-0.9, 1.0, count)
    centre = np.stack([along, np.full(count, height_m), distance_m + 0.2 * np.sin(3 * along)], axis=1)
    target = np.stack([along - 0.8, np.full(count, 0.9), np.zeros(count)], axis=1)
    forward = target - centre
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return make_pose(np.stack([right, np.cross(forward, right), forward], axis=2), centre)


def _textures(seed: int) -> list[np.ndarray]:
    """A texture for each wall."""
    lengths_m = [[float(np.linalg.norm(side)) for side in sides] for _, *sides in _WALLS]
    return [_texture(width_m, height_m, seed + i) for i, (width_m, height_m) in enumerate(lengths_m)]


def _texture(width_m: float, height_m: float, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    size = (int(width_m * _TEXELS_PER_M), int(height_m * _TEXELS_PER_M))
    layers = [
        weight * cv2.resize(rng.uniform(0, 1, (size[1] // cell + 1, size[0] // cell + 1)), size)
        for weight, cell in ((0.5, 6), (0.3, 14), (0.2, 40))
    ]
    return (255 * np.clip(1.6 * (np.sum(layers, axis=0) - 0.5) + 0.5, 0, 1)).astype(np.uint8)


def _photograph(textures: list[np.ndarray], room_T_cam: Array) -> np.ndarray:
    """The walls warped by their homographies; drawn large and shrunk, against aliasing."""
    zoom = 2
    image = np.zeros((zoom * SIZE_PX[1], zoom * SIZE_PX[0]), np.uint8)
    camera = np.array([[FOCAL_PX, 0, SIZE_PX[0] / 2], [0, FOCAL_PX, SIZE_PX[1] / 2], [0, 0, 1 / zoom]]) * zoom
    # OpenCV counts pixels from their centres, the camera from the corner of the first.
    camera[:2] -= 0.5 * camera[2]
    cam_T_room = inverse(room_T_cam)
    for texture, (corner, u, v) in zip(textures, _WALLS, strict=True):
        unit_u, unit_v = (np.array(axis) / np.linalg.norm(axis) / _TEXELS_PER_M for axis in (u, v))
        plane = np.stack([unit_u, unit_v, corner], axis=1)
        homography = camera @ (cam_T_room[:3, :3] @ plane + np.outer(cam_T_room[:3, 3], [0, 0, 1]))
        drawn = cv2.warpPerspective(texture, homography, image.shape[::-1], flags=cv2.INTER_LINEAR)
        image = np.where(drawn > 0, drawn, image)
    return cv2.resize(image, SIZE_PX, interpolation=cv2.INTER_AREA)


def _write_import(data: DataRoot, frames: pd.DataFrame, sessions: list[str]) -> None:
    folder = data.run("tiny", "room", "import")
    folder.mkdir(parents=True)
    _write(folder, "frames", frames)
    # The phone logs a pose a frame and nothing between them.
    _write(
        folder, "vio", frames[["session_id", "t_ns", *(c for c in frames.columns if c.startswith("vio_cam_"))]].copy()
    )
    _write(folder, "sessions", pd.DataFrame({"session_id": sessions, "recording": sessions}))
    _write(folder, "jumps", pd.DataFrame({"session_id": [], "t_ns": []}).astype({"session_id": str, "t_ns": "int64"}))


def _write(folder: Path, name: str, table: pd.DataFrame) -> None:
    """Columns that the test has no use for get a value of their type."""
    columns = schema("import", name)
    blank: dict[str, Any] = {"float64": 0.0, "int64": 0, "bool": False, "string": "", "list<float64>": None}
    for column in columns.columns:
        if column.name not in table:
            table[column.name] = next(iter(column.choices)) if column.choices else blank[column.dtype]
    write_table(folder / f"{name}.parquet", table, columns)
