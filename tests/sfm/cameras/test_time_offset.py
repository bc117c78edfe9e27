"""The offset of time stamps from turns: frames of a phone that turns, with VIO that is a little off."""

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, inverse
from groundwalk.sfm.cameras.motion import offset_of_frames

FRAMES, RATE_HZ = 60, 2.0
IMAGE_SD, VIO_SD = 3e-4, 1e-3


def turned(t_s: Array, seed: int) -> Array:
    """A hand's rotations (N, 3, 3) at times (N,)."""
    phase = np.random.default_rng(seed).uniform(0, 6, (3, 3))
    angles = sum(
        a * np.sin(w * t_s[:, None] + p) for a, w, p in zip((0.5, 0.15, 0.04), (0.7, 2.1, 5.0), phase, strict=True)
    )
    return Rotation.from_rotvec(angles).as_matrix()


def estimated(offset_s: float, seed: int, turns: float = 1.0, sessions: int = 1, has_vio: bool = True) -> float:
    """The offset by a model whose images were taken so many seconds before their time stamps."""
    rng = np.random.default_rng(seed)
    stamp_s = np.arange(FRAMES) / RATE_HZ

    def rotations(t_s: Array, sd: float) -> Array:
        noise = Rotation.from_rotvec(rng.normal(0, sd, (len(t_s), 3))).as_matrix()
        return turned(turns * t_s, seed) @ noise

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(camera_id=1, model="PINHOLE", width=640, height=480, params=[480, 480, 320, 240])
    model.add_camera_with_trivial_rig(camera)
    pose = np.tile(np.eye(4), (FRAMES, 1, 1))
    pose[:, :3, :3] = rotations(stamp_s - offset_s, IMAGE_SD)
    for row, cam_T_sfm in enumerate(inverse(pose)):
        image = pycolmap.Image(name=f"{row}.jpg", camera_id=1, image_id=row + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_T_sfm[:3]))
    vio = np.tile(np.eye(4), (FRAMES, 1, 1))
    vio[:, :3, :3] = rotations(stamp_s, VIO_SD)
    dt = 1e-4
    before, after = (turned(turns * (stamp_s + side * dt), seed) for side in (-1, 1))
    angular = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / (2 * dt)
    if not has_vio:
        vio[:] = np.nan
    session = np.arange(FRAMES) * sessions // FRAMES
    return offset_of_frames(model, session.astype(str), stamp_s, vio, angular)


@pytest.mark.parametrize("offset_s", [0.02, -0.015])
@pytest.mark.parametrize("sessions", [1, 2])
def test_turns_tell_the_offset(offset_s: float, sessions: int) -> None:
    errors = [estimated(offset_s, seed, sessions=sessions) - offset_s for seed in range(5)]
    assert np.abs(errors).max() < 0.004


def test_without_an_offset_a_phone_that_hardly_turns_or_without_vio_there_is_none() -> None:
    assert [estimated(0.0, seed) for seed in range(5)].count(0.0) >= 4
    assert estimated(0.02, 0, turns=0.001) == 0.0
    assert estimated(0.02, 0, has_vio=False) == 0.0
