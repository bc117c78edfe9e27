"""Floor features: SIFT of the floor as seen from above (bird's-eye view), for frames that little else ties together.

Where walls are bare, neighbouring frames of a walk share the floor, but at so shallow an angle that it turns and
stretches from one to the next by more than SIFT bears. Gravity says how the floor lies, so each frame can be drawn as
seen from above (inverse perspective mapping), in units of the camera's height over the floor; there two frames differ
by a turn and a shift.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from groundwalk.features.sift import DESCRIPTOR_SIZE, masked_sift
from groundwalk.geometry.epipolar import essential
from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.lenses import SceneLenses, lines_of, to_middle_row
from groundwalk.sfm.cameras.motion import Motion
from groundwalk.sfm.database import Ints, Workspace, image_id, keypoints_px
from groundwalk.sfm.pairs.candidates import Pairs
from groundwalk.sfm.pairs.matching import mutual_matches
from groundwalk.sfm.pairs.odometry import Odometry
from groundwalk.sfm.pairs.two_views import MAX_ERROR_PX, fitted_near, start_by_vio
from groundwalk.store.child import Report
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel

# What is drawn, in heights of the camera over the floor: so far to either side, ahead from and to, a pixel's side.
_ASIDE, _NEAR, _FAR, _PIXEL = 1.5, 0.2, 3.0, 0.004
_MAX_FEATURES, _MIN_CONTRAST = 1000, 0.01
_MARGIN = 8  # pixels of the drawing, of features from where the image ends
_MIN_MATCHES = 12
_MAX_ERROR = 0.008  # heights
_TRIALS, _CONFIDENCE = 5000, 0.999
# A hand's height over the floor stays much the same from frame to frame.
_MAX_HEIGHT_RATIO = 1.1


@dataclass(frozen=True)
class FloorFeatures:
    """K features: where they are on the floor (K, 2), to the right and ahead of the camera in its heights over it; in
    the image (K, 2), px; and their descriptors (K, 128)."""

    on_floor: Array
    px: Array
    descriptors: NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class PairSource:
    """What pairs of frames are matched by: their database, and that of the features as extracted; where the images are;
    their N frames with cameras, motion and VIO; and the seed."""

    database: Path
    features: Path
    work: Workspace
    frames: pd.DataFrame
    lenses: SceneLenses
    motion: Motion
    vio: Odometry
    seed: int


def floor_features(grey: NDArray[np.uint8], camera: pycolmap.Camera, gravity: Array) -> FloorFeatures:
    """Features of the floor in a grey image (H, W); `gravity` (3,) is a unit vector in the camera's axes."""
    ahead = np.array([0.0, 0.0, 1.0]) - gravity[2] * gravity
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    axes = np.stack([np.cross(gravity, ahead), ahead])
    right, forward = np.arange(-_ASIDE, _ASIDE, _PIXEL), np.arange(_FAR, _NEAR, -_PIXEL)
    floor = np.stack(np.meshgrid(right, forward), axis=-1)
    px, is_inside = _in_image(camera, floor.reshape(-1, 2) @ axes + gravity)
    is_inside = is_inside.reshape(floor.shape[:2])
    rows, columns = np.flatnonzero(is_inside.any(axis=1)), np.flatnonzero(is_inside.any(axis=0))
    if not len(rows):
        return FloorFeatures(np.empty((0, 2)), np.empty((0, 2)), np.empty((0, DESCRIPTOR_SIZE), np.uint8))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    source = (px - 0.5).astype(np.float32).reshape(floor.shape)[part]
    drawn = cv2.remap(grey, source[..., 0], source[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    side = 2 * _MARGIN + 1
    usable = cv2.erode(is_inside[part].astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0)
    features = masked_sift(np.asarray(drawn, np.uint8), np.asarray(usable, np.uint8), _MAX_FEATURES, _MIN_CONTRAST)
    column, row = features.px.T.astype(float) - 0.5
    on_floor = np.stack([right[columns[0]] + column * _PIXEL, forward[rows[0]] - row * _PIXEL], axis=1)
    return FloorFeatures(on_floor, _in_image(camera, on_floor @ axes + gravity)[0], features.descriptors)


def floor_matches(a: FloorFeatures, b: FloorFeatures) -> Ints:
    """Rows (M, 2) of features that a turn and a shift on the floor explain; none where these are few."""
    matches = mutual_matches(a.descriptors.astype(np.float32), b.descriptors.astype(np.float32)).astype(np.int64)
    none = np.empty((0, 2), np.int64)
    if len(matches) < _MIN_MATCHES:
        return none
    # OpenCV draws the same random numbers in each call.
    a_T_b, fits = cv2.estimateAffinePartial2D(
        b.on_floor[matches[:, 1]],
        a.on_floor[matches[:, 0]],
        ransacReprojThreshold=_MAX_ERROR,
        maxIters=_TRIALS,
        confidence=_CONFIDENCE,
    )
    if a_T_b is None or np.count_nonzero(fits) < _MIN_MATCHES:
        return none
    height_ratio = float(np.hypot(a_T_b[0, 0], a_T_b[1, 0]))
    return matches[fits.ravel() > 0] if 1 / _MAX_HEIGHT_RATIO < height_ratio < _MAX_HEIGHT_RATIO else none


def match_floor(report: Report, source: PairSource, pairs: Pairs, verified_P: NDArray[np.bool_]) -> None:
    """Match the floor in pairs of rows (P, 2), of one session each and with poses and gravity by VIO.

    Where enough of it matches, the pair's relative pose is fitted to that and to its inliers, or all its matches where
    it isn't verified (P,), from VIO's on; what fits the pose are its inliers. The frames of such pairs get the floor's
    keypoints behind their own, in the database and as extracted, without descriptors there. Doing it again changes
    nothing.
    """
    database, vio = source.database, source.vio
    with pycolmap.Database.open(database) as opened:
        cameras = {row: opened.read_camera(image_id(row)) for row in np.unique(pairs).tolist()}

    def features_of(row: int) -> FloorFeatures:
        grey = read_grey_image(source.work.images / source.work.names[row])
        floor = floor_features(grey, cameras[row], vio.gravity_cam[row])
        kept = source.work.are_usable(row, floor.px)
        return FloorFeatures(floor.on_floor[kept], floor.px[kept], floor.descriptors[kept])

    floors = dict(zip(cameras, in_parallel(features_of, cameras), strict=True))
    of_floor = []
    for a, b in pairs.tolist():
        of_floor.append(floor_matches(floors[a], floors[b]))
        report(len(of_floor))
    tied = [number for number, matches in enumerate(of_floor) if len(matches)]
    rows = np.unique(pairs[tied]).tolist()
    _append_keypoints(source.features, {row: floors[row].px for row in rows})
    readout, line = source.lenses.readout_s[source.lenses.lens], lines_of(source.frames)
    at_middle_row = {
        row: to_middle_row(floors[row].px, frame, line[row], float(readout[row]), source.motion.angular[row])
        for row, frame in zip(rows, source.frames.iloc[rows].itertuples(index=False), strict=True)
    }
    _append_keypoints(database, at_middle_row)
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        described = {row: opened.num_descriptors_for_image(image_id(row)) for row in rows}
        rays = {row: np.asarray(cameras[row].cam_from_img(keypoints_px(opened, row))) for row in rows}
        for number in tied:
            a, b = pairs[number].tolist()
            geometry = opened.read_two_view_geometry(image_id(a), image_id(b))
            others = geometry.inlier_matches if verified_P[number] else opened.read_matches(image_id(a), image_id(b))
            others = np.asarray(others, np.int64)
            first_of_floor = np.array([described[a], described[b]])
            # Where this was done before, the floor's are there already.
            others = others[(others < first_of_floor).all(axis=1)]
            matches = np.concatenate([others, of_floor[number] + first_of_floor])
            ends = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
            focal = cameras[a].mean_focal_length(), cameras[b].mean_focal_length()
            a_T_b, error_px = fitted_near(start_by_vio(np.eye(4), vio, a, b), *ends, *focal)
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            geometry.E = essential(a_T_b[None])[0]
            geometry.inlier_matches = matches[error_px < MAX_ERROR_PX].astype(np.uint32)
            opened.update_two_view_geometry(image_id(a), image_id(b), geometry)


def _append_keypoints(database: Path, px_by_row: dict[int, Array]) -> None:
    """Put keypoints (K, 2) behind those of the rows that have descriptors, in place of any that are there."""
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for row, px in px_by_row.items():
            described = opened.read_keypoints(image_id(row))[: opened.num_descriptors_for_image(image_id(row))]
            more = np.zeros((len(px), described.shape[1]), np.float32)
            more[:, :2] = px
            opened.update_keypoints(image_id(row), np.concatenate([described, more]))


def _in_image(camera: pycolmap.Camera, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (M, 2) of points (M, 3) in the camera's axes, -1 far off the image, and whether they are inside it."""
    size = np.array([camera.width, camera.height], float)
    corners = np.asarray(camera.cam_from_img(size * [[0, 0], [1, 0], [0, 1], [1, 1]]))
    # A lens's polynomial folds what is far outside back into the image.
    widest = float(np.linalg.norm(corners, axis=1).max())
    x, y, z = points.T
    ahead = (z > 0) & (x * x + y * y <= (widest * z) ** 2)
    px = np.full((len(points), 2), -1.0)
    px[ahead] = camera.img_from_cam(points[ahead])
    u, v = px.T
    return px, ahead & (u > 0) & (v > 0) & (u < size[0]) & (v < size[1])
