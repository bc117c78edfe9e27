"""Mapping from VIO: triangulate by its poses, join sessions by the points that they share, adjust everything freely.

VIO is the start alone: the adjustments don't use it. But a pose that the images hardly determine stays near VIO's,
which is why the rows of such a model say so (`uses_vio`).
"""

from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.fits import fit_yaw
from groundwalk.geometry.poses import Array, inverse, transform, yaw_rotation
from groundwalk.sfm.database import image_id

Ints = NDArray[np.int64]

_MIN_FRAMES = 3
_MIN_OBSERVATIONS = 30
# VIO's own errors over a few metres, seen from a few metres: first generous, then as strict as mapping is.
_ROUNDS_PX = (16.0, 8.0, 4.0)
_ROUND_STEPS = 30
_LOSS_PX = 1.0
_MIN_SHARED_POINTS = 30
_JOIN_TRIALS = 1000
_MAX_JOIN_ERROR_M = 0.5


def map_from_vio(
    database: Path,
    images: Path,
    folder: Path,
    vio_T_cam: Array,
    session_N: NDArray[np.object_],
    options: pycolmap.IncrementalPipelineOptions,
    seed: int,
) -> list[pycolmap.Reconstruction]:
    """A model of each group of sessions that share enough points; frames without VIO (NaN) are in none."""
    has_pose = np.isfinite(vio_T_cam[:, 0, 0])
    rows = {s: np.flatnonzero(has_pose & (session_N == s)) for s in np.unique(session_N)}
    rows = {session: members for session, members in rows.items() if len(members) >= _MIN_FRAMES}
    with pycolmap.Database.open(database) as opened:
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        names = {image.image_id: image.name for image in opened.read_all_images()}
        start = np.concatenate(
            [[0], np.cumsum([opened.num_keypoints_for_image(image_id(r)) for r in range(len(has_pose))])]
        )
        matches = _matches(opened, start)

    def triangulated(world_T_cam: Array, members: Ints, error_px: float) -> pycolmap.Reconstruction:
        model = _posed(world_T_cam, members, cameras, names)
        options.triangulation.complete_max_reproj_error = options.triangulation.merge_max_reproj_error = error_px
        options.mapper.filter_max_reproj_error = error_px
        return pycolmap.triangulate_points(model, database, images, folder, options=options)

    xyz = np.full((start[-1], 3), np.nan)
    for members in rows.values():
        _collect_points(triangulated(vio_T_cam, members, _ROUNDS_PX[0]), members, start, xyz)
    models = []
    for group in join_sessions(xyz, matches, np.searchsorted(start, matches, side="right") - 1, rows, seed):
        world_T_cam = vio_T_cam.copy()
        for session, world_T_vio in group.items():
            world_T_cam[rows[session]] = world_T_vio @ vio_T_cam[rows[session]]
        members = np.sort(np.concatenate([rows[session] for session in group]))
        for error_px in _ROUNDS_PX:
            model = triangulated(world_T_cam, members, error_px)
            pycolmap.bundle_adjustment(model, _adjustment())
            for row in members.tolist():
                cam_T_world = model.image(image_id(row)).cam_from_world().matrix()
                world_T_cam[row] = inverse(np.vstack([cam_T_world, [0.0, 0.0, 0.0, 1.0]]))
        for row in members.tolist():
            if model.image(image_id(row)).num_points3D < _MIN_OBSERVATIONS:
                model.deregister_frame(image_id(row))
        models.append(model)
    return models


def join_sessions(
    xyz_K3: Array, matches_M2: Ints, frames_M2: Ints, rows: dict[str, Ints], seed: int
) -> list[dict[str, Array]]:
    """Groups of sessions with a common frame: for each session world_T_vio (4, 4), yaw and translation.

    Features k have a point `xyz_K3[k]` in their session's VIO frame, or NaN; matches tie two features, of the frames
    `frames_M2`; `rows` are the frames of each session. The largest session begins a group, and of the others the one
    that shares most points with it is fitted to it, robustly, until none shares enough.
    """
    session_of = {int(row): session for session, members in rows.items() for row in members}
    of_match = np.array(
        [[session_of.get(a, ""), session_of.get(b, "")] for a, b in frames_M2.tolist()], object
    ).reshape(-1, 2)
    tied = np.isfinite(xyz_K3[matches_M2]).all(axis=(1, 2)) & (of_match[:, 0] != of_match[:, 1])
    # Either side may be the one that is fixed.
    features = np.concatenate([matches_M2[tied], matches_M2[tied][:, ::-1]])
    fixed_of, free_of = np.concatenate([of_match[tied], of_match[tied][:, ::-1]]).T
    rng = np.random.default_rng(seed)
    remaining = sorted(rows, key=lambda s: (-len(rows[s]), s))
    groups: list[dict[str, Array]] = []
    while remaining:
        group = {remaining.pop(0): np.eye(4)}
        refused: set[str] = set()
        while candidates := [s for s in remaining if s not in refused]:
            shared = {s: np.flatnonzero(np.isin(fixed_of, list(group)) & (free_of == s)) for s in candidates}
            session = max(candidates, key=lambda s: len(shared[s]))
            ties = shared[session]
            fit = None
            if len(ties) >= _MIN_SHARED_POINTS:
                world_T_fixed = np.stack([group[s] for s in fixed_of[ties]])
                fixed, free = xyz_K3[features[ties, 0]], xyz_K3[features[ties, 1]]
                fit = _fit_yaw_robustly(transform(world_T_fixed, fixed), free, rng)
            if fit is None:
                refused.add(session)
                continue
            group[session] = fit
            remaining.remove(session)
            refused.clear()
        groups.append(group)
    return groups


def _fit_yaw_robustly(xyz_a: Array, xyz_b: Array, rng: np.random.Generator) -> Array | None:
    """a_T_b (4, 4) of yaw and translation for points (N, 3) with many wrong ones; None where too few agree.

    RANSAC over two points (Fischler and Bolles 1981), then least squares over those that agree.
    """
    i, j = rng.integers(0, len(xyz_a), (2, _JOIN_TRIALS))
    along_a, along_b = xyz_a[j] - xyz_a[i], xyz_b[j] - xyz_b[i]
    yaw = np.arctan2(along_a[:, 0], along_a[:, 2]) - np.arctan2(along_b[:, 0], along_b[:, 2])
    middle_a, middle_b = (xyz_a[i] + xyz_a[j]) / 2, (xyz_b[i] + xyz_b[j]) / 2
    rotation = yaw_rotation(yaw)
    shift = middle_a - np.einsum("tij,tj->ti", rotation, middle_b)

    def agreeing(trial: int) -> NDArray[np.bool_]:
        error2 = np.sum((xyz_b @ rotation[trial].T + shift[trial] - xyz_a) ** 2, axis=1)
        return np.asarray(error2 < _MAX_JOIN_ERROR_M**2)

    agree = agreeing(max(range(_JOIN_TRIALS), key=lambda trial: np.count_nonzero(agreeing(trial))))
    return fit_yaw(xyz_a[agree], xyz_b[agree]) if agree.sum() >= _MIN_SHARED_POINTS else None


def _matches(database: pycolmap.Database, start: Ints) -> Ints:
    """All verified matches as pairs of features (M, 2), counted over all frames."""
    matches = [np.empty((0, 2), np.int64)]
    ids, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(ids, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches.append(np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2) + start[[a - 1, b - 1]])
    return np.concatenate(matches)


def _posed(
    world_T_cam: Array, rows: Ints, cameras: dict[int, pycolmap.Camera], names: dict[int, str]
) -> pycolmap.Reconstruction:
    model = pycolmap.Reconstruction()
    for row in rows.tolist():
        number = image_id(row)
        model.add_camera_with_trivial_rig(cameras[number])
        image = pycolmap.Image(image_id=number, camera_id=number, name=names[number])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(world_T_cam[row])[:3]))
    return model


def _collect_points(model: pycolmap.Reconstruction, rows: Ints, start: Ints, xyz_K3: Array) -> None:
    for row in rows.tolist():
        for index, feature in enumerate(model.image(image_id(row)).points2D):
            if feature.has_point3D():
                xyz_K3[start[row] + index] = model.point3D(feature.point3D_id).xyz


def _adjustment() -> pycolmap.BundleAdjustmentOptions:
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    adjustment.print_summary = False
    adjustment.ceres.solver_options.num_threads = 1
    adjustment.ceres.solver_options.max_num_iterations = _ROUND_STEPS
    adjustment.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    adjustment.ceres.loss_function_scale = _LOSS_PX
    return adjustment
