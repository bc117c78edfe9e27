"""The bands of a floor: a ruler of equal parts that a map's scale is held against along a corridor.

Where the tiles of a floor are laid in rows of equal length, bands across it lie at equal distances. Each image is drawn
onto the floor by its pose; poses whose scale drifts have the bands nearer to or farther from each other as the walk
goes on.
"""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.signal import find_peaks

from benchmarks.real_figures import OURS, VIO_WAY, Figure, Finished, rows_in_time
from groundwalk.consistency.windows import POSE_SD, fit_rigid
from groundwalk.geometry.lens import distort
from groundwalk.geometry.poses import Array, path_length
from groundwalk.store.images import read_grey_image
from groundwalk.store.tables import points_in_map, poses_of

SPACING, SPREAD = "spacing of floor bands, median", "spacing of floor bands, standard deviation"
_PIXEL_M, _AHEAD_M, _ASIDE_M = 0.01, (1.6, 3.6), 0.35  # of the floor: what of it is drawn, from each frame on
_HEIGHTS_M = (0.8, 2.2)  # of a hand over the floor
_MIN_LEG_M, _TURN_SPAN_M = 10.0, 2.0
_BLUR_PX, _MIN_CONTRAST, _MIN_WIDTH_PX = 4.0, 15.0, 4.0
_SD_OF_MEDIAN = 1.4826  # standard deviation of normal numbers over their median deviation
_REGULAR = 0.06  # spacings are within this fraction of their median; others are between no neighbours


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
    if not len(apart):
        return apart
    return apart[np.abs(apart / np.median(apart) - 1) < _REGULAR]


def floor_figures(run: Finished) -> list[Figure]:
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
            figures.append(Figure(SPREAD, 100 * _SD_OF_MEDIAN * float(np.median(off)), "%", way))
    return figures
