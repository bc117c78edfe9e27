"""Small simulated captures whose geometry hardly tells the focal length: one ring round an object, without VIO
and with a guess for a camera; a hall whose walls are far away; a straight corridor."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.gates_captures import CORRIDOR, Capture, write_capture
from groundwalk.geometry.poses import inverse
from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas, Material
from groundwalk.simulation.place import Light, Route, SceneryPlan
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table, write_table

RING, HALL = "Ring", "Hall"
KINDS = (RING, HALL, CORRIDOR)
_RADIUS_M, _ROOM_M, _HALL_M = 1.5, 7.0, 36.0
_GUESS_SD = 0.01  # of a focal length that isn't logged, as a fraction


def write_weak_capture(folder: Path, kind: str, seed: int) -> None:
    """Render a walk of a kind into `folder`, which must not be there, with its true poses beside it."""
    plans = {RING: _ring, HALL: _hall}
    write_capture(folder, Capture(kind, seed, 1), plans[kind](seed) if kind in plans else None)
    if kind == RING:
        _without_vio(folder, np.random.default_rng([seed, 11]))


def _ring(seed: int) -> SceneryPlan:
    """A tall box of prints in the middle of a plain room."""
    b = Builder(RING, (_ROOM_M, _ROOM_M), 3.0, Light(0.9), seed, 0.6)
    _room(b, _ROOM_M / 2, 3.0, materials.plaster((190, 196, 200), 0.3))
    b.box("object", (0, 0), (0.7, 1.7, 0.7), _printed, texel=0.5)
    angle = np.arange(8) * np.pi / 4
    points = [(_RADIUS_M * np.cos(a), -_RADIUS_M * np.sin(a), 90) for a in angle]
    return SceneryPlan(b.place, Route(points, 0.5, 0.1, 3, -6, far_glances=0.0))


def _hall(seed: int) -> SceneryPlan:
    """A few metres straight on in a hall, looking to a side."""
    b = Builder(HALL, (_HALL_M, _HALL_M), 9.0, Light(0.9), seed, 0.6)
    _room(b, _HALL_M / 2, 9.0, _printed)
    points = [(0.3, 3, 50), (0.3, 0.0, 50), (0.3, -3, 50), (-0.3, -3, 50), (-0.3, 0.0, 50), (-0.3, 3, 50)]
    return SceneryPlan(b.place, Route(points, 0.25, 0.2, 8, 4, far_glances=0.0))


def _room(b: Builder, x: float, height_m: float, paint: Material) -> None:
    corners = [(-x, -x), (x, -x), (x, x), (-x, x)]
    for k, name in enumerate(("north", "east", "south", "west")):
        b.wall(name, corners[k], corners[(k + 1) % 4], 0, height_m, paint, texel=2.0)
    b.floor("floor", (-x, -x), (x, x), 0, materials.plain((120, 126, 130)), texel=2.0)
    b.ceiling("ceiling", (-x, -x), (x, x), height_m, materials.plain((200, 204, 206)))


def _printed(c: Canvas) -> None:
    materials.plaster((170, 186, 196), 0.6)(c)
    size_m = max(0.22, c.height_m / 10)
    for _ in range(round(1.5 * c.width_m * c.height_m / size_m**2)):
        x, y = c.rng.uniform(0, max(c.width_m - size_m, 0.01)), c.rng.uniform(0, max(c.height_m - size_m, 0.01))
        (details.poster if c.rng.random() < 0.5 else details.notice)(c, x, y, size_m * c.rng.uniform(0.4, 1), size_m)


def _without_vio(folder: Path, rng: np.random.Generator) -> None:
    """Turn the app's walk into images beside a COLMAP model of the true poses, whose camera is a guess: one focal
    length, the centre of the image."""
    walk = folder / "walk-1"
    pictures = sorted(walk.glob("*.jpg"))
    of_picture = np.array([int(path.stem.removeprefix("frame_")) for path in pictures])
    for name in ("true_poses", "true_cameras"):
        path, kind = folder / f"{name}.parquet", schema("simulate", name)
        true = read_table(path, kind).iloc[of_picture].reset_index(drop=True)
        write_table(path, true.assign(t_ns=np.arange(len(true)) * 1_000_000_000), kind)
    focal_px = float(np.exp(rng.normal(0, _GUESS_SD)) * true["fx"].median())
    true = read_table(folder / "true_poses.parquet", schema("simulate", "true_poses"))
    cam_T_map = inverse(poses_of(true, "map_cam"))
    xyzw = Rotation.from_matrix(cam_T_map[:, :3, :3]).as_quat()
    for path in walk.glob("*.json"):
        path.unlink()
    (walk / "images").mkdir()
    (walk / "sparse" / "0").mkdir(parents=True)
    lines = []
    for number, (path, (x, y, z, w), at) in enumerate(zip(pictures, xyzw, cam_T_map[:, :3, 3], strict=True), 1):
        path.rename(walk / "images" / path.name)
        lines += [" ".join(map(str, (number, w, x, y, z, *at, 1, path.name))), ""]
    camera = f"1 PINHOLE 320 240 {focal_px} {focal_px} 160 120\n"
    for name, text in (("cameras", camera), ("images", "\n".join(lines) + "\n"), ("points3D", "")):
        (walk / "sparse" / "0" / f"{name}.txt").write_text(text, encoding="utf-8")
