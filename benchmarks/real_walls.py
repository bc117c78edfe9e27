"""The directions of walls: what turns by VIO and by SfM are held against in a building of right angles.

All its horizontal edges lie along two directions at right angles, whichever way a walk turns. Each image shows them, so
each pose says where they lie; poses whose heading drifts have them drift.
"""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure as Drawing
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from benchmarks.real_figures import OURS, STOCK, VIO_WAY, Figure, Finished, rows_in_time
from benchmarks.stock import largest_model
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.poses import Array, path_length
from groundwalk.sfm.model import load_models
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, VIO
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel
from groundwalk.store.tables import poses_of

SPREAD = "directions of walls, 5th to 95th percentile"
_MIN_LENGTH = 0.03  # of an edge, in image widths
_STEP_DEG, _SHARPNESS_DEG = 0.05, 0.25
# Edges that are nearly upright say nothing of directions on the floor, nor do those seen nearly from below or above.
_MIN_TILT, _MAX_TILT = 0.08, 0.98
_SMOOTHED = 9  # frames, in the running median
_COLOURS = {VIO_WAY: VIO, OURS: GROUND_TRUTH, STOCK: NEUTRAL}


def direction_of_walls(grey: NDArray[np.uint8], intrinsics: Array, distortion: Array, upright_R_cam: Array) -> float:
    """The direction about y, degrees in 0 to 90, along or across which most of the image's edges lie.

    `intrinsics` (4,) fx, fy, cx, cy; `upright_R_cam` (3, 3) into axes of which y is up. An edge and the camera
    span a plane, and a horizontal edge runs along that plane's horizontal line.
    """
    edges = np.asarray(cv2.createLineSegmentDetector().detect(grey)[0], float).reshape(-1, 2, 2)
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    kept = length > _MIN_LENGTH * grey.shape[1]
    ends = undistort((edges[kept].reshape(-1, 2) - intrinsics[2:]) / intrinsics[:2], distortion)
    rays = np.column_stack([ends, np.ones(len(ends))]).reshape(-1, 2, 3)
    normal = np.cross(rays[:, 0], rays[:, 1])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) @ upright_R_cam.T
    tells = (np.abs(normal[:, 1]) > _MIN_TILT) & (np.abs(normal[:, 1]) < _MAX_TILT)
    degrees = np.arange(0, 90, _STEP_DEG)
    votes = np.zeros(len(degrees))
    for turn in (0, 90):
        along = np.radians(degrees + turn)
        off = np.degrees(np.arcsin(np.clip(normal[tells][:, [0, 2]] @ [np.sin(along), np.cos(along)], -1, 1)))
        votes += length[kept][tells] @ np.exp(-0.5 * (off / _SHARPNESS_DEG) ** 2)
    return float(degrees[votes.argmax()])


def wall_figures(run: Finished, picture: Path) -> list[Figure]:
    """How far the directions of walls spread by VIO, by ground truth and by stock COLMAP's largest model, on the frames
    that each has, over a capture of one session; draws them."""
    frames, images = run.table("import", "frames"), run.table("sfm", "images")
    vio = poses_of(frames, "vio_cam")
    ways = {VIO_WAY: vio, OURS: run.map_T_cam()}
    if (largest := largest_model(run.stock_folder)) is not None:
        ways[STOCK] = load_models([largest], len(frames)).sfm_T_cam
    usable = ~frames["support"].to_numpy(bool) & images["registered"].to_numpy(bool) & np.isfinite(vio[:, 0, 0])
    rows = rows_in_time(frames, usable)
    intrinsics = images[["fx", "fy", "cx", "cy"]].to_numpy(float)

    def direction(row: int) -> float:
        grey = read_grey_image(run.root.captures(run.scene) / frames["image"].iloc[row])
        distortion = np.asarray(images["distortion"].iloc[row], float)
        return direction_of_walls(grey, intrinsics[row], distortion, vio[row, :3, :3])

    by_vio = np.array(list(in_parallel(direction, rows.tolist())))
    path_m = path_length(vio[rows, :3, 3])
    drawing = Drawing(figsize=(7, 3), layout="constrained")
    axes = drawing.subplots()
    figures = []
    for way, poses in ways.items():
        known = np.isfinite(poses[rows, 0, 0])
        heading = by_vio[known] - _turned(vio[rows][known], poses[rows][known])
        smooth = median_filter(_about_its_middle(heading), _SMOOTHED, mode="nearest")
        spread = float(np.subtract(*np.percentile(smooth, [95, 5])))
        figures.append(Figure(SPREAD, spread, "deg", way))
        label = f"{way}: {spread:.2g} deg, {known.sum()} frames"
        axes.plot(path_m[known], smooth, ".-", ms=3, lw=1, color=np.array(_COLOURS[way]) / 255, label=label)
    axes.set_xlabel("VIO path, m")
    axes.set_ylabel("direction of walls, deg")
    axes.legend(fontsize=8)
    drawing.savefig(picture, dpi=80)
    return figures


def _turned(vio_T_cam: Array, other_T_cam: Array) -> Array:
    """Turns (N,) about VIO's vertical from the other poses (N, 4, 4) to VIO's, degrees, in what their mean leaves."""
    vio_R_other = vio_T_cam[:, :3, :3] @ np.swapaxes(other_T_cam[:, :3, :3], 1, 2)
    left = Rotation.from_matrix(vio_R_other) * Rotation.from_matrix(vio_R_other).mean().inv()
    return np.degrees(left.as_rotvec()[:, 1])


def _about_its_middle(degrees_N: Array) -> Array:
    """Directions that repeat after 90 degrees, each where it is nearest to their middle, which becomes 0."""
    angle = np.radians(4 * degrees_N)
    middle = np.degrees(np.arctan2(np.sin(angle).mean(), np.cos(angle).mean())) / 4
    return (degrees_N - middle + 45) % 90 - 45
