"""Photos alone against cameras that were measured by laser, beside stock COLMAP.

`python -m benchmarks.measured_cameras` (`make bench-measured scenes=<folder>`): `--scenes` has `<scene>/images/` and
`<scene>/gt_dense_cameras/`, as those of Strecha et al., "On benchmarking camera calibration and multi-view stereo for
high resolution imagery", CVPR 2008 (github.com/openMVG/SfM_quality_evaluation). Writes
docs/results/measured-cameras.md. Scenes that are done in `--work` aren't run again.
"""

import shutil
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import pycolmap
import typer
from scipy.stats import chi2

from benchmarks.groundtruth_inputs import PROFILE, run_stage
from benchmarks.results import circumstances, kept, markdown_table, write_page
from benchmarks.stock import largest_model, stock_cost, stock_poses
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, make_pose, rotation_angle
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.tables import poses_of, table_of

app = new_app(__doc__ or "")

_OFF = ("in the model", "positions off: RMS, largest", "rotations off, median", "focal length off")
_BOUNDS = "ours: positions inside their 95 % bounds"
_HEADING = ("scene", "across", *(f"ours: {name}" for name in _OFF), _BOUNDS, *(f"COLMAP: {name}" for name in _OFF))


def _cameras(scene: Path) -> tuple[list[str], Array, Array]:
    """The images' names, true_T_cam (N, 4, 4) in metres and focal lengths (N,) in px of a scene's measured cameras."""
    files = sorted((scene / "gt_dense_cameras").glob("*.camera"))
    numbers = np.array([file.read_text().split() for file in files], float)
    true_T_cam = make_pose(numbers[:, 12:21].reshape(-1, 3, 3), numbers[:, 21:24])
    return [file.stem for file in files], true_T_cam, numbers[:, 0]


def _off(sfm_T_cam: Array, focal_px: Array, is_placed: np.ndarray, true_T_cam: Array, true_px: Array) -> list[str]:
    """Of the frames that are placed, after a similarity fit of positions: how far they and the focal length are off."""
    found, true = sfm_T_cam[is_placed], true_T_cam[is_placed]
    placed = fit_sim3(true[:, :3, 3], found[:, :3, 3]).poses(found)
    off_mm = 1000 * np.linalg.norm(placed[:, :3, 3] - true[:, :3, 3], axis=1)
    turn_deg = np.degrees(rotation_angle(np.swapaxes(placed[:, :3, :3], 1, 2) @ true[:, :3, :3]))
    return [
        f"{is_placed.sum()} of {len(true_T_cam)}",
        f"{np.sqrt(np.mean(off_mm**2)):.3g}, {off_mm.max():.3g} mm",
        f"{np.median(turn_deg):.2g}°",
        f"{100 * (np.median(focal_px[is_placed] / true_px[is_placed]) - 1):+.2f} %",
    ]


def _inside(sfm_T_cam: Array, covariance: list[Array], true_T_cam: Array) -> str:
    """How many positions have the measured ones, fitted to them, inside their 95 % bounds."""
    true_xyz, xyz = true_T_cam[:, :3, 3], sfm_T_cam[:, :3, 3]
    off = fit_sim3(true_xyz, xyz).inverse().points(true_xyz) - xyz
    of_positions = np.reshape(covariance, (-1, 6, 6))[:, 3:, 3:]
    squared = np.einsum("ni,nij,nj->n", off, np.linalg.inv(of_positions), off)
    return f"{np.count_nonzero(squared < chi2.ppf(0.95, 3))} of {len(xyz)}"


def _row(scene: Path, work: Path) -> list[str]:
    root, (names, true_T_cam, true_px) = DataRoot(work), _cameras(scene)
    if not root.captures(scene.name).exists():
        root.captures(scene.name).mkdir(parents=True)
        for name in names:
            shutil.copy(scene / "images" / name, root.captures(scene.name))
    run_stage("capture_import", scene.name, root)
    run_stage("sfm", scene.name, root)
    run = root.run(PROFILE, scene.name)
    frames, images = table_of(run, "import", "frames"), table_of(run, "sfm", "images")
    order = [names.index(Path(image).name) for image in frames["image"]]
    true = true_T_cam[order], true_px[order]
    largest = (images["model_id"] == images["model_id"].mode()[0]).to_numpy(bool)
    sfm_T_cam = poses_of(images, "sfm_cam")
    ours = _off(sfm_T_cam, images["fx"].to_numpy(float), largest, *true)
    ours.append(_inside(sfm_T_cam[largest], list(images["covariance"][largest]), true[0][largest]))
    stock = work / "stock" / scene.name
    stock_cost(scene.name, PROFILE, root, stock)
    cameras = pycolmap.Reconstruction(largest_model(stock) or stock).cameras.values()
    focal_px = np.full(len(frames), np.mean([camera.mean_focal_length() for camera in cameras]))
    stock_T_cam, model_N = stock_poses(stock, len(frames))
    extent_m = np.linalg.norm(np.ptp(true_T_cam[:, :3, 3], axis=0))
    return [scene.name, f"{extent_m:.3g} m", *ours, *_off(stock_T_cam, focal_px, model_N == 0, *true)]


@app.command()
def main(
    scenes: Annotated[Path, typer.Option(help="Folder of scenes with measured cameras.")],
    work: Annotated[Path, typer.Option(help="Where it works.")] = Path("build/measured"),
    out: Annotated[Path, typer.Option(help="Where the page is written.")] = Path("docs/results"),
) -> None:
    """Maps of photos alone, against cameras measured by laser."""
    rows = [kept(work / f"{scene.name}.json", partial(_row, scene, work)) for scene in sorted(scenes.iterdir())]
    text = (
        "Written by `python -m benchmarks.measured_cameras`, not to be edited. Real photos without EXIF, whose cameras "
        "were measured by laser (Strecha et al., CVPR 2008): poses, focal length, principal point and lens are found "
        f"from the images, profile {PROFILE}; positions after a similarity fit to the measured ones. COLMAP: its "
        "incremental mapper on as many features, with an OPENCV camera that starts at the same focal length. "
        "Bounds are those of table `sfm.images`; page and verdict of photos alone state none."
    )
    table = markdown_table([_HEADING, *rows])
    write_page(out, "measured-cameras", ["# Photos against measured cameras", text, circumstances(), table])


if __name__ == "__main__":
    app()
