"""Images rendered from other images by a depth sensor and by poses: `python -m benchmarks.reprojected_depth`.

A judge of poses and lenses that shares nothing with structure from motion's features: where the pixels of one image, at
the sensor's depth, lie in another image by both poses and cameras, both should look alike. Of a finished run (import,
sfm, align) of a capture with depth. Writes docs/results/reprojected_depth.md.
"""

from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pandas as pd
import pycolmap
import typer
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from benchmarks.real_figures import Run
from benchmarks.results import circumstances, markdown_table, write_page
from benchmarks.stock import largest_model, run_stock
from groundwalk.alignment.depth import HIGH_CONFIDENCE, MAX_RANGE_M, read_depth
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.depth_images import smooth_pixels
from groundwalk.geometry.pose_similarity import fit_similar_poses
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.sfm.database import image_id
from groundwalk.store import DataRoot
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.images import read_grey_image
from groundwalk.store.progress import track
from groundwalk.store.tables import poses_of

app = new_app(__doc__ or "")
_SIZE = 960, 720  # of the images that are compared
_FEWEST = 3000  # pixels that both images show
_OCCLUDED = 0.03  # of the depth: the other image's sensor sees another surface
_OURS, _PHONE = "ground truth, its cameras", "the phone's poses and cameras"
_MIXED, _STOCK = "ground truth, the phone's cameras", "stock COLMAP's poses and cameras"
Way = tuple[Array, list[Camera]]  # poses world_T_cam (N, 4, 4) in metres, and a camera for each


def _camera(row: pd.Series, size: tuple[int, int], distortion: Array) -> Camera:
    whole = Camera(*size, row["fx"], row["fy"], row["cx"], row["cy"], distortion=tuple(distortion))
    return whole.resized(*_SIZE)


def _stock_way(run: Run, map_T_cam: Array) -> Way | None:
    """Stock COLMAP's, which has no metres, brought onto the ground truth; None where it misses a frame."""
    run_stock(run.scene, run.profile, run.root, run.stock_folder)
    model, largest = run.stock_model(len(map_T_cam)), largest_model(run.stock_folder)
    if model is None or largest is None or not model.registered.all():
        return None
    fit = fit_similar_poses(map_T_cam, model.sfm_T_cam)
    built = pycolmap.Reconstruction(largest)
    cameras = [built.camera(built.image(image_id(row)).camera_id) for row in range(len(map_T_cam))]
    names = ["fx", "fy", "cx", "cy"]
    of_stock = [_camera(pd.Series(c.params[:4], names), (c.width, c.height), c.params[4:]) for c in cameras]
    return fit.a_S_b.poses(model.sfm_T_cam), of_stock


def _depth(row: pd.Series, folder: Path) -> Array | None:
    """Depth of high confidence (H, W), away from edges, in metres, else NaN; None for a frame without."""
    if not isinstance(row["depth"], str) or not isinstance(row["depth_confidence"], str):
        return None
    metres, level = read_depth(folder / row["depth"], folder / row["depth_confidence"], row["depth_sha256"])
    return np.where((level == HIGH_CONFIDENCE) & smooth_pixels(metres) & (metres < MAX_RANGE_M), metres, np.nan)


def _psnr(ways: dict[str, Way], greys: list[Array], depths: list[Array | None], i: int, j: int) -> dict[str, float]:
    """By each way, the peak signal-to-noise ratio (dB) of image i where its depth is known against image j there, over
    the pixels for which all ways have a place in j, after the best gain and offset of brightness; empty for too few."""
    of_i, of_j = depths[i], depths[j]
    assert of_i is not None
    row, column = np.nonzero(np.isfinite(of_i))
    metres = of_i[row, column]
    step = np.array(_SIZE) / of_i.shape[::-1]
    px = (np.column_stack([column, row]) + 0.5) * step
    there, seen = _sampled(greys[i], px), dict[str, Array]()
    for name, (world_T_cam, cameras) in ways.items():
        in_i = np.column_stack([cameras[i].unproject(px), np.ones(len(px))]) * metres[:, None]
        in_j = transform(inverse(world_T_cam[j]) @ world_T_cam[i], in_i)
        in_j[in_j[:, 2] <= 0] = np.nan
        at = cameras[j].project(in_j[:, :2] / in_j[:, 2:])
        seen[name] = _sampled(greys[j], at)
        if of_j is not None:
            sensed = _sampled(np.nan_to_num(of_j), at / step, order=0)
            seen[name][~(np.abs(sensed - in_j[:, 2]) <= _OCCLUDED * in_j[:, 2])] = np.nan
    both = np.isfinite([there, *seen.values()]).all(axis=0)
    if both.sum() < _FEWEST:
        return {}
    result = {}
    for name, grey in seen.items():
        gain = np.column_stack([grey[both], np.ones(both.sum())])
        error = gain @ np.linalg.lstsq(gain, there[both], rcond=None)[0] - there[both]
        result[name] = 10 * float(np.log10(255**2 / np.mean(error**2)))
    return result


def _sampled(grey: Array, px: Array, order: int = 3) -> Array:
    """An image (of spline coefficients, for order 3) at pixels (M, 2), NaN outside."""
    at = np.where(np.isfinite(px), px, -9.0).T[::-1] - 0.5
    sampled: NDArray[np.float64] = map_coordinates(grey, at, order=order, prefilter=False, cval=np.nan)
    return sampled


@app.command()
def main(
    scene: SceneOption = "charuco",
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
    work: Annotated[Path, typer.Option(help="Folder for stock COLMAP's model.")] = Path("build/reprojected_depth"),
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("docs/results"),
) -> None:
    """Render, compare and write the page."""
    run = Run(scene, DataRoot(data), work / "stock", profile)
    frames, truth = run.table("import", "frames"), run.table("align", "ground_truth").set_index("frame_id")
    truth, folder = truth.reindex(frames["frame_id"]).reset_index(), run.root.captures(scene)
    sizes = list(frames[["width", "height"]].itertuples(index=False, name=None))
    ours = [_camera(row, size, row["distortion"]) for size, (_, row) in zip(sizes, truth.iterrows(), strict=True)]
    phone = [_camera(row, size, np.zeros(0)) for size, (_, row) in zip(sizes, frames.iterrows(), strict=True)]
    ways: dict[str, Way] = {_OURS: (run.map_T_cam(), ours), _MIXED: (run.map_T_cam(), phone)}
    if (stock := _stock_way(run, run.map_T_cam())) is not None:
        ways[_STOCK] = stock
    within = ways | {_PHONE: (poses_of(frames, "vio_cam"), phone)}
    small = (
        cv2.resize(read_grey_image(folder / image), _SIZE, interpolation=cv2.INTER_AREA) for image in frames["image"]
    )
    greys = [spline_filter(image.astype(float)) for image in small]
    depths, session = [_depth(row, folder) for _, row in frames.iterrows()], frames["session_id"].to_numpy()
    found: dict[bool, list[dict[str, float]]] = {True: [], False: []}
    for i in track([i for i, depth in enumerate(depths) if depth is not None], "rendering images"):
        for j in (j for j in range(len(frames)) if j != i):
            is_within = bool(session[i] == session[j])
            if figures := _psnr(within if is_within else ways, greys, depths, i, j):
                found[is_within].append(figures)
    rows = [
        ["images", "pairs", "poses and cameras", "PSNR mean (dB)", "median", "pairs in which ground truth is ahead %"]
    ]
    for is_within, label in ((True, "of one session"), (False, "of two sessions")):
        table = pd.DataFrame(found[is_within])
        for name in table:
            ahead = "" if name == _OURS else f"{100 * (table[_OURS] > table[name]).mean():.1f}"
            psnr = f"{table[name].mean():.2f}", f"{table[name].median():.2f}"
            rows.append([label, f"{len(table):,}", str(name), *psnr, ahead])
    sections = [
        "# Images rendered by a depth sensor and by poses",
        "Written by `python -m benchmarks.reprojected_depth`, not to be edited. Measured: the pixels of one image at"
        " the phone's own depth (high confidence, away from edges), looked up in another image by the poses and cameras"
        f" of both, {_SIZE[0]}x{_SIZE[1]}; peak signal-to-noise ratio of grey levels after the best gain and offset."
        " Nothing here has seen a feature or a match. The phone's sessions have worlds of their own, so that its poses"
        " are compared within sessions alone; stock COLMAP has no metres, and is brought onto ground truth.",
        circumstances(),
        f"## {scene}",
        markdown_table(rows),
    ]
    write_page(out, "reprojected_depth", sections)


if __name__ == "__main__":
    app()
