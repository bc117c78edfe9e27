"""Surveyed points against a map: held-out errors are as large as they are said to be."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.control import fit_control
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, inverse, make_pose, transform
from groundwalk.geometry.rulers import Observations, triangulate_points

POINTS, FRAMES, FOCAL_PX = 12, 16, 1400.0
SURVEY_SD_M, PIXEL_SD, POSITION_SD_M, ROTATION_SD = 0.003, 0.5, 0.002, 3e-4
SURVEY_S_MAP = Sim3(1.0, Rotation.from_euler("xyz", [1.5, 0.3, -2.0]).as_matrix(), np.array([5e5, 4.6e6, 120.0]))


def mapped(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """True points (12, 3) in a room, as triangulated by poses with errors, and the covariances (12, 3, 3) of these."""
    xyz = rng.uniform([-3, 0, -3], [3, 2.5, 3], (POINTS, 3))
    at = np.column_stack([*rng.uniform(-5, 5, (2, FRAMES)), rng.uniform(1, 2, FRAMES)])[:, [0, 2, 1]]
    true = make_pose(Rotation.align_vectors([[0, 0, 1.0]], [[0, 0, 1.0]])[0].as_matrix(), at)
    for row in range(FRAMES):
        forward = xyz.mean(axis=0) - at[row]
        right = np.cross(forward, [0.0, -1.0, 0.0])
        axes = np.stack([right, np.cross(forward, right), forward])
        true[row, :3, :3] = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T
    corner, frame = (index.ravel() for index in np.meshgrid(np.arange(POINTS), np.arange(FRAMES)))
    seen = transform(inverse(true)[frame], xyz[corner])
    ahead = seen[:, 2] > 1
    corner, frame, seen = corner[ahead], frame[ahead], seen[ahead]
    xy = seen[:, :2] / seen[:, 2:] + rng.normal(0, PIXEL_SD / FOCAL_PX, (len(seen), 2))
    turned = Rotation.from_rotvec(rng.normal(0, ROTATION_SD, (FRAMES, 3))).as_matrix() @ true[:, :3, :3]
    poses = make_pose(turned, true[:, :3, 3] + rng.normal(0, POSITION_SD_M, (FRAMES, 3)))
    covariance = np.tile(np.diag([*[ROTATION_SD**2] * 3, *[POSITION_SD_M**2] * 3]), (FRAMES, 1, 1))
    observations = Observations(corner, frame, xy, np.full(len(corner), FOCAL_PX))
    found, of_point, _ = triangulate_points(observations, poses, covariance, POINTS, min_pixel_sd=0.1)
    return xyz, found, of_point


@pytest.mark.parametrize("map_scale", [1.0, 0.37], ids=["se3", "sim3"])
def test_held_out_points_are_within_their_bounds(map_scale: float) -> None:
    """Twelve points surveyed to 3 mm: the map is within 5 mm of them, and as many as should are within 95 % bounds."""
    inside, errors, off = [], [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        xyz, found, covariance = mapped(rng)
        survey = SURVEY_S_MAP.points(xyz) + rng.normal(0, SURVEY_SD_M, xyz.shape)
        fit = fit_control(
            survey,
            np.full(POINTS, SURVEY_SD_M),
            found * map_scale,
            covariance * map_scale**2,
            np.ones(POINTS, dtype=bool),
            rigid=map_scale == 1.0,
        )
        inverses = np.linalg.inv(fit.held_out_covariance)
        inside += (np.einsum("ni,nij,nj->n", fit.held_out, inverses, fit.held_out) <= 7.815).tolist()
        errors += np.linalg.norm(fit.held_out, axis=1).tolist()
        off += np.linalg.norm(fit.survey_S_map.points(found * map_scale) - SURVEY_S_MAP.points(xyz), axis=1).tolist()
    assert 0.85 <= np.mean(inside) <= 0.99
    assert np.sqrt(np.mean(np.square(off))) < 0.005
    assert np.median(errors) > SURVEY_SD_M
