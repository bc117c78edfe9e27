"""Photos and video alone: the images of real captures without their poses, against the phone's own poses.

`python -m benchmarks.images_alone` (`make bench-images`) takes the captures of each folder in `--captures`,
copies their images as photos, writes them as a video of two frames a second, too, and compares the map of each with
VIO, which takes no part in it. `--measured` names a folder of scenes whose cameras were measured by laser, as those of
Strecha et al., "On benchmarking camera calibration and multi-view stereo for high resolution imagery", CVPR 2008
(github.com/openMVG/SfM_quality_evaluation): `<scene>/images/` and `<scene>/gt_dense_cameras/`. Writes
docs/results/images-alone.md. Cases that are done in `--work` aren't run again.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import av
import numpy as np
import pandas as pd
import pycolmap
import typer

from benchmarks.cost import measure
from benchmarks.groundtruth_inputs import PROFILE, run_stage
from benchmarks.results import markdown_table, write_page
from benchmarks.stock import largest_model, stock_command, stock_poses
from groundwalk.geometry.fits import direction_angles, fit_sim3
from groundwalk.geometry.poses import Array, make_pose, rotation_angle
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.cores import machine
from groundwalk.store.images import read_image
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.settings import resolve_settings
from groundwalk.store.tables import poses_of, read_table

app = new_app(__doc__ or "")

_FPS = 2
_HEADING = (
    *("case", "input", "in the map", "models", "off VIO, RMS", "of the path", "scale", "vertical", "off gravity"),
    "revision",
)
_MEASURED_HEADING = (
    *("case", "in the map", "across", "positions off: RMS, largest", "rotations off, median", "focal length off"),
    *("COLMAP: in its model", "positions off: RMS, largest", "rotations off, median", "focal length off", "revision"),
)


def _photos(images: Sequence[Path], folder: Path) -> None:
    folder.mkdir(parents=True)
    for image in images:
        shutil.copy(image, folder)


def _video(images: Sequence[Path], folder: Path) -> None:
    folder.mkdir(parents=True)
    with av.open(str(folder / "walk.mp4"), "w") as file:
        stream = file.add_stream("libx264", rate=_FPS, options={"crf": "17"})
        stream.height, stream.width = read_image(images[0]).shape[:2]
        stream.pix_fmt = "yuv420p"
        for image in images:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(read_image(image), format="rgb24")))
        file.mux(stream.encode())


def _vio(capture: Path, work: Path) -> pd.DataFrame:
    """Import's frames of the capture as it is, all of them, in order."""
    root = DataRoot(work / "vio")
    scene = capture.name
    if not root.captures(scene).exists():
        shutil.copytree(capture, root.captures(scene) / capture.name)
        run_stage("capture_import", scene, root, 'sampling="all"')
    return read_table(root.run(PROFILE, scene, "import") / "frames.parquet", schema("import", "frames"))


def _run_case(capture: Path, kind: str, vio: pd.DataFrame, images: Sequence[Path], work: Path) -> dict[str, Any]:
    root, scene = DataRoot(work / kind), capture.name
    if not root.captures(scene).exists():
        (_photos if kind == "photos" else _video)(images, root.captures(scene) / kind)
    run_stage("capture_import", scene, root)
    run_stage("sfm", scene, root)
    run_stage("alignment", scene, root)
    truth = read_table(root.run(PROFILE, scene, "align") / "ground_truth.parquet", schema("align", "ground_truth"))
    frames = read_table(root.run(PROFILE, scene, "import") / "frames.parquet", schema("import", "frames"))
    frames = frames.set_index("frame_id").loc[truth["frame_id"]]
    names = frames["image"].map(lambda image: Path(image).stem)
    if kind == "video":
        names = (frames["t_ns"] * 1e-9 * _FPS).round().astype(int).map(lambda index: images[index].stem)
    of_vio = vio.set_index(vio["image"].map(lambda image: Path(image).stem)).reindex(names)
    map_T_cam, vio_T_cam = poses_of(truth, "map_cam"), poses_of(of_vio, "vio_cam")
    both = np.isfinite(map_T_cam[:, 0, 0]) & np.isfinite(vio_T_cam[:, 0, 0])
    vio_S_map = fit_sim3(vio_T_cam[both, :3, 3], map_T_cam[both, :3, 3])
    off_m = np.linalg.norm(vio_S_map.points(map_T_cam[both, :3, 3]) - vio_T_cam[both, :3, 3], axis=1)
    path_m = np.linalg.norm(np.diff(vio_T_cam[both, :3, 3], axis=0), axis=1).sum()
    up_map = np.einsum("nij,nkj->nik", map_T_cam[both, :3, :3], vio_T_cam[both, :3, :3])[:, :, 1].mean(axis=0)
    manifest = load_manifest(root.run(PROFILE, scene, "align"))
    figures = manifest["figures"]
    has_up, has_scale = figures["vertical_source"] != "none", figures["scale_source"] != "none"
    return {
        "in the map": f"{int(both.sum())} of {len(truth)}",
        "models": int(load_manifest(root.run(PROFILE, scene, "sfm"))["figures"]["models"]),
        "off VIO, RMS": f"{1000 * np.sqrt(np.mean(off_m**2)):.3g} mm",
        "of the path": f"{100 * np.sqrt(np.mean(off_m**2)) / path_m:.2g} % of {path_m:.3g} m",
        "scale": figures["scale_source"] + (f", {vio_S_map.scale:.4f} of VIO's" if has_scale else ""),
        "vertical": figures["vertical_source"],
        "off gravity": f"{np.degrees(direction_angles(up_map[None], np.array([0.0, 1, 0]))[0]):.2g}°" if has_up else "",
        "revision": manifest["git_revision"],
    }


def _measured_cameras(scene: Path) -> tuple[list[str], Array, Array]:
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
    focal = np.median(focal_px[is_placed] / true_px[is_placed]) - 1
    return [
        f"{is_placed.sum()} of {len(true_T_cam)}",
        f"{np.sqrt(np.mean(off_mm**2)):.3g}, {off_mm.max():.3g} mm",
        f"{np.median(turn_deg):.2g}°",
        f"{100 * focal:+.2f} %",
    ]


def _run_measured(scene: Path, work: Path) -> list[str]:
    root, (names, true_T_cam, true_px) = DataRoot(work / "measured"), _measured_cameras(scene)
    if not root.captures(scene.name).exists():
        _photos([scene / "images" / name for name in names], root.captures(scene.name))
    run_stage("capture_import", scene.name, root)
    run_stage("sfm", scene.name, root)
    folder = root.run(PROFILE, scene.name, "sfm")
    frames = read_table(folder.parent / "import" / "frames.parquet", schema("import", "frames"))
    images = read_table(folder / "images.parquet", schema("sfm", "images"))
    order = [names.index(Path(image).name) for image in frames["image"]]
    true = true_T_cam[order], true_px[order]
    ours = _off(
        poses_of(images, "sfm_cam"),
        images["fx"].to_numpy(float),
        (images["model_id"] == images["model_id"].mode()[0]).to_numpy(bool),
        *true,
    )
    stock = work / "measured" / "stock" / scene.name
    settings = resolve_settings(SfmSettings, "sfm", root, PROFILE, scene.name)
    measure(stock_command(scene.name, PROFILE, root, stock, settings), stock)
    cameras = pycolmap.Reconstruction(largest_model(stock) or stock).cameras.values()
    sfm_T_cam, model_N = stock_poses(stock, len(frames))
    focal_px = np.full(len(frames), np.mean([one.mean_focal_length() for one in cameras]))
    extent_m = np.linalg.norm(np.ptp(true_T_cam[:, :3, 3], axis=0))
    revision = load_manifest(folder)["git_revision"]
    return [ours[0], f"{extent_m:.3g} m", *ours[1:], *_off(sfm_T_cam, focal_px, model_N == 0, *true), revision]


@app.command()
def main(
    captures: Annotated[Path, typer.Option(help="Folder of capture folders, each of images with poses.")] = Path(
        "../shared/captures"
    ),
    work: Annotated[Path, typer.Option(help="Where it works.")] = Path("build/images_alone"),
    measured: Annotated[Path | None, typer.Option(help="Folder of scenes with measured cameras.")] = None,
    out: Annotated[Path, typer.Option(help="Where the page is written.")] = Path("docs/results"),
) -> None:
    """Maps of photos and video alone, against VIO that took no part, and against cameras measured by laser."""
    rows = []
    for capture in sorted(path for group in captures.iterdir() if group.is_dir() for path in group.glob("*/")):
        images = sorted(path for path in capture.iterdir() if path.suffix in (".jpg", ".png") and "frame" in path.name)
        vio = _vio(capture, work)
        for kind in ("photos", "video"):
            values = _once(work / f"{capture.name}_{kind}.json", partial(_run_case, capture, kind, vio, images, work))
            rows.append((capture.name, kind, *map(str, values.values())))
    laser = [
        (scene.name, *_once(work / f"{scene.name}_measured.json", partial(_run_measured, scene, work)))
        for scene in sorted(measured.iterdir() if measured else ())
    ]
    text = (
        "Written by `make bench-images` (`python -m benchmarks.images_alone`), not to be edited. Images of real "
        f"captures without their poses, profile {PROFILE}: as photos, and as a video of {_FPS} frames a second. Off "
        "VIO: the frames of the map after a similarity fit to ARKit's poses, which took no part and have errors of "
        "their own; off gravity: between the map's +y and ARKit's."
    )
    of_laser = (
        "## Cameras measured by laser\n\nReal photos without EXIF (Strecha et al., CVPR 2008), so that focal length, "
        "principal point and lens are found from the images; positions after a similarity fit to the measured ones. "
        "COLMAP: its incremental mapper on as many features, with an OPENCV camera that starts where ours does."
    )
    sections = ["# Photos and video alone", text, f"Machine: {machine()}.", markdown_table([_HEADING, *rows])]
    measured_sections = [of_laser, markdown_table([_MEASURED_HEADING, *laser])] if laser else []
    write_page(out, "images-alone", [*sections, *measured_sections])


def _once(done: Path, run: Callable[[], Any]) -> Any:
    """What a case gives, run where the file of it isn't there."""
    if not done.exists():
        done.parent.mkdir(parents=True, exist_ok=True)
        done.write_text(json.dumps(run()), encoding="utf-8")
    return json.loads(done.read_text(encoding="utf-8"))


if __name__ == "__main__":
    app()
