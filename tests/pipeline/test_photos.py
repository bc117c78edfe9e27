"""Photos of a facade by ten cameras, as tourists leave them on the web: from photos to a map."""

from pathlib import Path

import numpy as np
import pandas as pd
import PIL.ExifTags
import PIL.Image
import pytest

from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, rotation_angle
from groundwalk.simulation.camera import Exposure, expose
from groundwalk.simulation.materials import plaster
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.place import Light
from groundwalk.simulation.render import Renderer, Sky
from groundwalk.simulation.scenes import parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.parts import Facade
from groundwalk.simulation.view import RadialDistortion, View
from groundwalk.store.tables import poses_of
from tests.pipeline.test_pipeline import run
from tests.simulation.test_render import looking

# Of each camera: width, height, focal length by EXIF (mm of 35 mm film), what it really is of that, k1, k2.
CAMERAS = [
    (1200, 900, 26, 1.02, 0.06, -0.10),
    (1024, 768, 28, 0.98, 0.02, -0.05),
    (900, 1200, 24, 1.01, 0.08, -0.12),
    (1280, 960, 35, 1.00, -0.06, 0.02),
    (1600, 1200, 27, 1.03, 0.05, -0.08),
    (1152, 768, 50, 1.00, -0.03, 0.0),
    (1280, 720, 26, 0.97, 0.04, -0.06),
    (800, 600, 33, 1.01, -0.10, 0.03),
    (960, 1280, 25, 0.99, 0.07, -0.11),
    (1400, 1050, 29, 1.02, 0.03, -0.04),
]


def photograph(folder: Path) -> Array:
    """Ten photos of a row of houses, each by another model from another place; the true world_T_cam (10, 4, 4)."""
    b = Builder("Facade", (40, 40), 12, Light(0.66, (-0.45, 0.8, 0.35), 0.52), 0)
    b.floor("ground", (-20, -6), (20, 20), 0, parts.GRANITE)
    facades = [Facade(plaster((120, 178, 216)), 3, shop=True), Facade(parts.BRICK_RED, 3), Facade(parts.SANDSTONE, 3)]
    parts.row_of_houses(b, "row", (-10, -5), (10, -5), facades, [7, 6, 7])
    renderer, rng = Renderer(build_mesh(b.place, 0.012, 0)), np.random.default_rng(0)
    folder.mkdir(parents=True)
    poses = []
    for n, (width, height, film_mm, factor, k1, k2) in enumerate(CAMERAS):
        x = -7 + 1.5 * n + rng.uniform(-0.4, 0.4)
        at = (x, rng.uniform(1.4, 1.9), rng.uniform(6, 9) + (film_mm - 28) * 0.15)
        pose = looking(at, (0.4 * x, 3.4, -5.0)).world_T_cam
        focal_px = factor * film_mm * np.hypot(width, height) / np.hypot(36, 24)
        view = View(pose, focal_px, focal_px, width / 2, height / 2, width, height, RadialDistortion(k1, k2))
        blue, green, red = rng.uniform(0.85, 1.15, 3)
        exposure = Exposure(0.002, (blue, green, red), 1.5)
        shown = expose(renderer.render(view, Sky(n)), view, np.zeros(3), np.zeros(3), exposure, rng)
        exif, base = PIL.Image.Exif(), PIL.ExifTags.Base
        exif[base.Make], exif[base.Model] = "Maker", f"Camera {n}"
        exif.get_ifd(PIL.ExifTags.IFD.Exif)[base.FocalLengthIn35mmFilm] = film_mm
        PIL.Image.fromarray(shown[..., ::-1]).save(folder / f"{n}.jpg", quality=90, exif=exif)
        poses.append(pose)
    return np.array(poses)


@pytest.mark.slow
def test_a_facade_by_ten_cameras_is_one_right_map(tmp_path: Path) -> None:
    true_T_cam = photograph(tmp_path / "captures" / "Facade" / "photos")
    said = {stage: run(stage, "Facade", tmp_path) for stage in ("import", "sfm", "align")}
    assert "10 photos without poses, by 10 cameras" in said["import"] and "focal length by EXIF of 10" in said["import"]
    assert "EXIF states" not in said["sfm"] and "NO METRIC SCALE" in said["align"]
    folder = tmp_path / "runs" / "tiny" / "Facade"
    frames, truth = (pd.read_parquet(folder / f"{table}.parquet") for table in ("import/frames", "align/ground_truth"))
    assert set(truth["quality"]) == {"C"} and truth["frame_id"].tolist() == frames["frame_id"].tolist()
    true_T_cam = true_T_cam[[int(Path(image).stem) for image in frames["image"]]]
    map_T_cam = poses_of(truth, "map_cam")
    found_T_cam = fit_sim3(true_T_cam[:, :3, 3], map_T_cam[:, :3, 3]).poses(map_T_cam)
    # Along 13 m, 10 to 14 m from the houses.
    assert np.linalg.norm(found_T_cam[:, :3, 3] - true_T_cam[:, :3, 3], axis=1).max() < 0.1
    turned = rotation_angle(np.swapaxes(found_T_cam[:, :3, :3], 1, 2) @ true_T_cam[:, :3, :3])
    assert np.degrees(turned).max() < 0.6
