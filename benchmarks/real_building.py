"""What a building says of a walk through it: the directions of its walls of turns, the bands of its floor of scale.

All horizontal edges of a building of right angles lie along two directions, whichever way a walk turns. Each image
shows them, so each pose says where they lie; poses whose heading drifts have them drift. Where the tiles of a floor are
laid in rows of equal length, bands across it lie at equal distances. Each image is drawn onto the floor by its pose;
poses whose scale drifts have the bands nearer to or farther from each other as the walk goes on.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure as Drawing
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, median_filter
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

from benchmarks.real_figures import OURS, STOCK, VIO_WAY, Figure, Run, rows_in_time
from groundwalk.consistency.windows import POSE_SD, fit_rigid
from groundwalk.geometry.lens import distort, undistort
from groundwalk.geometry.poses import Array, path_length
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, VIO
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel
from groundwalk.store.tables import points_in_map, poses_of

WALLS = "directions of walls, 5th to 95th percentile"
SPACING, SPACING_SPREAD = "spacing of floor bands, median", "spacing of floor bands, standard deviation"
_MIN_LENGTH = 0.03  # of an edge, in image widths
_STEP_DEG, _SHARPNESS_DEG = 0.05, 0.25
# Edges that are nearly upright say nothing of directions on the floor, nor do those seen nearly from below or above.
_MIN_TILT, _MAX_TILT = 0.08, 0.98
_SMOOTHED = 9  # frames, in the running median
_COLOURS = {VIO_WAY: VIO, OURS: GROUND_TRUTH, STOCK: NEUTRAL}
_PIXEL_M, _AHEAD_M, _ASIDE_M = 0.01, (1.6, 3.6), 0.35  # of the floor: what of it is drawn, from each frame on
_HEIGHTS_M = (0.8, 2.2)  # of a hand over the floor
_MIN_LEG_M, _TURN_SPAN_M = 10.0, 2.0
_BLUR_PX, _MIN_CONTRAST, _MIN_WIDTH_PX = 4.0, 15.0, 4.0
_SD_OF_MEDIAN = 1.4826  # standard deviation of normal numbers over their median deviation
_REGULAR = 0.06  # spacings are within this fraction of their median; others are between no neighbours


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


def wall_figures(run: Run, picture: Path) -> list[Figure]:
    """How far the directions of walls spread by VIO, by ground truth and by stock COLMAP's largest model, on the frames
    that each has, over a capture of one session; draws them."""
    frames, images = run.table("import", "frames"), run.table("sfm", "images")
    vio = poses_of(frames, "vio_cam")
    ways = {VIO_WAY: vio, OURS: run.map_T_cam()}
    if (stock := run.stock_model(len(frames))) is not None:
        ways[STOCK] = stock.sfm_T_cam
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
        figures.append(Figure(WALLS, spread, "deg", way))
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


def floor_bands(
    image_of: Callable[[int], NDArray[np.uint8]],
    intrinsics_N4: Array,
    distortion: Sequence[Array],
    map_T_cam: Array,
    floor_y: float,
) -> Array:
    """Where dark bands cross a floor (B,), metres along a straight walk of N frames, +y up in the map."""
    xz = map_T_cam[:, [0, 2], 3]
    along = np.linalg.svd(xz - xz.mean(axis=0))[2][0]
    along *= np.sign(along @ (xz[-1] - xz[0]))
    across, walked = np.array([-along[1], along[0]]), xz @ along
    middle = float(np.median(xz @ across))
    place = np.arange(walked.min(), walked.max() + _AHEAD_M[1], _PIXEL_M)
    brightness, count = np.zeros(len(place)), np.zeros(len(place))
    for row, pose in enumerate(map_T_cam):
        drawn = np.flatnonzero((place > walked[row] + _AHEAD_M[0]) & (place < walked[row] + _AHEAD_M[1]))
        aside = middle + np.linspace(-_ASIDE_M, _ASIDE_M, 15)
        floor = place[drawn, None, None] * along + aside[None, :, None] * across
        points = np.stack([floor[..., 0], np.full(floor.shape[:2], floor_y), floor[..., 1]], axis=-1)
        in_camera = (points.reshape(-1, 3) - pose[:3, 3]) @ pose[:3, :3]
        focal, centre = intrinsics_N4[row, :2], intrinsics_N4[row, 2:]
        px = distort(in_camera[:, :2] / in_camera[:, 2:], distortion[row]) * focal + centre - 0.5
        u, v = px.astype(np.float32).reshape(*floor.shape[:2], 2).transpose(2, 0, 1)
        image = image_of(row)
        inside = ((u > 0) & (v > 0) & (u < image.shape[1] - 1) & (v < image.shape[0] - 1)).all(axis=1)
        if np.count_nonzero(inside) < len(drawn) / 2:
            continue
        grey = np.median(cv2.remap(image.astype(np.float32), u, v, cv2.INTER_LINEAR), axis=1)[inside]
        brightness[drawn[inside]] += grey - np.median(grey)
        count[drawn[inside]] += 1
    profile = gaussian_filter1d(brightness / np.maximum(count, 1), _BLUR_PX)
    peaks, _ = find_peaks(-profile, prominence=_MIN_CONTRAST, width=_MIN_WIDTH_PX)
    return place[peaks] + _PIXEL_M * np.array([_vertex(profile[k - 1 : k + 2]) for k in peaks])


def _vertex(three: Array) -> float:
    """Where the parabola through three neighbours has its extreme, from the middle one."""
    before, here, after = three
    return float(0.5 * (before - after) / (before - 2 * here + after))


def straight_legs(xyz_N3: Array) -> list[NDArray[np.int64]]:
    """The straight parts of a walk at right angles, rows of those of 10 m and more."""
    travelled = path_length(xyz_N3)
    ahead, behind = (np.searchsorted(travelled, travelled + side * _TURN_SPAN_M / 2) for side in (1, -1))
    step = xyz_N3[np.minimum(ahead, len(travelled) - 1)] - xyz_N3[np.maximum(behind, 0)]
    heading = np.arctan2(step[:, 0], step[:, 2])
    aligned = np.angle(np.exp(4j * heading).mean()) / 4
    quarter = np.rint((heading - aligned) / (np.pi / 2)).astype(np.int64) % 4
    parts = np.split(np.arange(len(quarter)), np.flatnonzero(np.diff(quarter)) + 1)
    return [part for part in parts if travelled[part[-1]] - travelled[part[0]] >= _MIN_LEG_M]


def spacings(bands_B: Array) -> Array:
    """The distances of neighbouring bands; what is no band, or a band that wasn't found, makes none."""
    apart = np.diff(bands_B)
    return apart[np.abs(apart / np.median(apart) - 1) < _REGULAR] if len(apart) else apart


def floor_figures(run: Run) -> list[Figure]:
    """The median spacing of the floor's bands on each straight leg of a capture of one session, by VIO and by ground
    truth, and how far all spacings of each scatter about that (1.48 median deviations, as some are of a wrong band)."""
    frames, images = run.table("import", "frames"), run.table("sfm", "images")
    points = points_in_map(run.table("sfm", "points"), images, run.table("align", "ground_truth"))
    vio, map_T_cam = poses_of(frames, "vio_cam"), run.map_T_cam()
    rows = rows_in_time(frames, np.isfinite(map_T_cam[:, 0, 0]) & np.isfinite(vio[:, 0, 0]))
    vio, map_T_cam = vio[rows], map_T_cam[rows]
    hand_y = float(np.median(map_T_cam[:, 1, 3]))
    count, edges = np.histogram(hand_y - points["y"].to_numpy(float), np.arange(*_HEIGHTS_M, 0.02))
    floor_y = hand_y - float(edges[count.argmax()] + 0.01)
    intrinsics = images[["fx", "fy", "cx", "cy"]].to_numpy(float)[rows]
    distortion = [np.asarray(images["distortion"].iloc[row], float) for row in rows]
    captures = run.root.captures(run.scene)
    figures, by_way = [], dict[str, list[Array]]({VIO_WAY: [], OURS: []})
    for number, leg in enumerate(straight_legs(map_T_cam[:, :3, 3]), 1):
        map_T_vio, *_ = fit_rigid(map_T_cam[leg], vio[leg], POSE_SD)

        def image_of(k: int, leg: NDArray[np.int64] = leg) -> NDArray[np.uint8]:
            return read_grey_image(captures / frames["image"].iloc[rows[leg[k]]])

        for way, poses in ((VIO_WAY, map_T_vio @ vio[leg]), (OURS, map_T_cam[leg])):
            apart = spacings(floor_bands(image_of, intrinsics[leg], [distortion[k] for k in leg], poses, floor_y))
            if len(apart) > 1:
                by_way[way].append(apart)
                figures.append(Figure(SPACING, float(np.median(apart)), "m", way, f"leg {number}"))
    for way, by_leg in by_way.items():
        if by_leg:
            off = np.concatenate([np.abs(apart / np.median(apart) - 1) for apart in by_leg])
            figures.append(Figure("spacings of floor bands", len(off), "", way))
            figures.append(Figure(SPACING_SPREAD, 100 * _SD_OF_MEDIAN * float(np.median(off)), "%", way))
    return figures
