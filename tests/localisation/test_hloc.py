"""HLoc's covariances: those of poses by pixels that scatter, and none where few keypoints agree."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import make_pose, transform
from groundwalk.localisation.entries import HLocSettings
from groundwalk.localisation.hloc import HLocLocaliser, absolute_pose
from groundwalk.localisation.localisers import StructureSettings
from groundwalk.localisation.prepared import prepare
from groundwalk.scoring.errors import pose_error, within_bounds
from tests.localisation.scenes import LOGGED, features, place, training, walk


def test_a_covariance_is_as_poses_scatter() -> None:
    """COLMAP's loss makes it larger, in all directions alike."""
    rng, camera = np.random.default_rng(0), Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    map_T_cam = make_pose(Rotation.from_rotvec([0.4, -1.1, 0.3]).as_matrix(), np.array([0.3, -0.2, 0.5]))
    px, depth = rng.uniform([0, 0], [640, 480], (120, 2)), rng.uniform(1, 5, 120)
    xyz = transform(map_T_cam, np.column_stack([(px - [320, 240]) / 500, np.ones(120)]) * depth[:, None])
    errors, covariances = [], []
    for _ in range(150):
        found = absolute_pose(px + rng.normal(0, 1, px.shape), xyz, camera, seed=0)
        assert found is not None and found[2].sum() > 110
        errors.append(pose_error(found[0], map_T_cam))
        covariances.append(found[1])
    sd_ratio = np.sqrt(
        np.linalg.eigvals(np.linalg.solve(np.mean(covariances, axis=0), np.cov(np.array(errors).T))).real
    )
    assert (sd_ratio > 0.6).all() and (sd_ratio < 1.1).all()


def test_a_covariance_holds_the_error_and_few_keypoints_have_none() -> None:
    scene, views, unseen = place(), walk(48), walk(12, seed=5)
    localiser = HLocLocaliser(prepare("room", training(scene, views), StructureSettings()), HLocSettings())
    inside = []
    for number in range(len(unseen)):
        seen = features(scene, unseen, number)
        answer = localiser.localise_features(seen, LOGGED)
        assert answer.map_T_cam is not None and answer.covariance is not None
        inside.append(within_bounds(answer.map_T_cam[None], unseen.map_T_cam[number][None], answer.covariance[None])[0])
        few = np.linspace(0, len(seen) - 1, 25).astype(int)
        answer = localiser.localise_features(
            replace(seen, px=seen.px[few], size_px=seen.size_px[few], descriptors=seen.descriptors[few]), LOGGED
        )
        assert answer.covariance is None and answer.inliers < 30
    assert np.mean(inside) > 0.8
