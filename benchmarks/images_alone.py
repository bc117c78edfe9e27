"""Photos and video alone: the images of real captures without their poses, against the phone's own poses.

`python -m benchmarks.images_alone` (`make bench-images`) takes the captures of each folder in `--captures`,
copies their images as photos, writes them as a video of two frames a second, too, and compares the map of each with
VIO, which takes no part in it. Writes docs/results/images-alone.md. Cases that are done in `--work` aren't run again.
"""

import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import av
import numpy as np
import pandas as pd
import typer

from benchmarks.groundtruth_inputs import PROFILE, run_stage
from benchmarks.results import CAPTURES, kept, markdown_table, write_page
from groundwalk.geometry.fits import direction_angles, fit_sim3
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.cores import machine
from groundwalk.store.images import read_image
from groundwalk.store.manifests import load_manifest
from groundwalk.store.tables import poses_of, table_of

app = new_app(__doc__ or "")

_FPS = 2
_HEADING = (
    *("case", "input", "in the map", "models", "off VIO, RMS", "of the path", "scale", "vertical", "off gravity"),
    "revision",
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
    return table_of(root.run(PROFILE, scene), "import", "frames")


def _run_case(capture: Path, kind: str, vio: pd.DataFrame, images: Sequence[Path], work: Path) -> dict[str, Any]:
    root, scene = DataRoot(work / kind), capture.name
    if not root.captures(scene).exists():
        (_photos if kind == "photos" else _video)(images, root.captures(scene) / kind)
    run_stage("capture_import", scene, root)
    run_stage("sfm", scene, root)
    run_stage("alignment", scene, root)
    truth = table_of(root.run(PROFILE, scene), "align", "ground_truth")
    frames = table_of(root.run(PROFILE, scene), "import", "frames")
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


@app.command()
def main(
    captures: Annotated[Path, typer.Option(help="Folder of capture folders, each of images with poses.")] = CAPTURES,
    work: Annotated[Path, typer.Option(help="Where it works.")] = Path("build/images_alone"),
    out: Annotated[Path, typer.Option(help="Where the page is written.")] = Path("docs/results"),
) -> None:
    """Maps of photos and video alone, against VIO that took no part."""
    rows = []
    for capture in sorted(path for group in captures.iterdir() if group.is_dir() for path in group.glob("*/")):
        images = sorted(path for path in capture.iterdir() if path.suffix in (".jpg", ".png") and "frame" in path.name)
        vio = _vio(capture, work)
        for kind in ("photos", "video"):
            row = kept(work / f"{capture.name}_{kind}.json", partial(_run_case, capture, kind, vio, images, work))
            rows.append((capture.name, kind, *map(str, row.values())))
    text = (
        "Written by `make bench-images` (`python -m benchmarks.images_alone`), not to be edited. Images of real "
        f"captures without their poses, profile {PROFILE}: as photos, and as a video of {_FPS} frames a second. Off "
        "VIO: the frames of the map after a similarity fit to ARKit's poses, which took no part and have errors of "
        "their own; off gravity: between the map's +y and ARKit's."
    )
    table = markdown_table([_HEADING, *rows])
    write_page(out, "images-alone", ["# Photos and video alone", text, f"Machine: {machine()}.", table])


if __name__ == "__main__":
    app()
