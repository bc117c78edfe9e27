"""Odometry in another unit, or along other camera axes, is refused with what is wrong."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.fusion.files.conventions import refuse_other_conventions, refuse_unrelated, shares_vertical
from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from tests.fusion.upright_walks import as_walk, upright_walk


def phone_walk(seed: int, frames: int = 60) -> Walk:
    """A walk with a camera that is pitched and rolled, as phones' are, a frame a second."""
    t_ns, truth, vio, apr = upright_walk(seed, frames)
    angles = np.random.default_rng(seed).normal([-10, 0, 0], [6, 0, 4], (frames, 3))
    held = make_pose(Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ np.diag([1.0, -1, -1]), np.zeros(3))
    return as_walk(t_ns, truth @ held, vio @ held, apr @ held)


def with_vio(walk: Walk, vio_T_cam: np.ndarray) -> Walk:
    return replace(walk, vio_T_cam=vio_T_cam)


def test_walks_as_they_should_be_pass_and_so_do_thirty_frames_a_second_and_gaps() -> None:
    walks = [phone_walk(1), phone_walk(2)]
    refuse_other_conventions(walks, "Place")
    refuse_unrelated(walks, "Place")
    slowly = replace(walks[0], t_ns=walks[0].t_ns // 30)
    gaps = with_vio(walks[1], np.where((np.arange(60) % 7 == 0)[:, None, None], np.nan, walks[1].vio_T_cam))
    refuse_other_conventions([slowly, gaps], "Place")
    refuse_other_conventions([replace(walks[0], map_T_cam=np.full((60, 4, 4), np.nan))], "Place")
    refuse_other_conventions([], "Place")


@pytest.mark.parametrize("steps", [10**9, 10**6, 10**3])
def test_times_in_another_unit_are_refused(steps: int) -> None:
    walk = phone_walk(1)
    with pytest.raises(UserError, match="times aren't nanoseconds"):
        refuse_other_conventions([replace(walk, t_ns=walk.t_ns // steps)], "Place")


def test_odometry_along_other_camera_axes_is_refused_with_the_axes_that_fit() -> None:
    walk = phone_walk(1)
    with pytest.raises(UserError, match=r"(?s)along other axes.* 100% .*x right, y up.*diag\(1, -1, -1, 1\)"):
        refuse_other_conventions([with_vio(walk, walk.vio_T_cam @ np.diag([1.0, -1, -1, 1]))], "Place")


def test_odometry_of_another_recording_is_refused() -> None:
    walk = phone_walk(1)
    with pytest.raises(UserError, match=r"(?s)moves unlike.*of the same frames"):
        refuse_unrelated([with_vio(walk, walk.vio_T_cam[::-1])], "Place")


@pytest.mark.parametrize("factor", [100.0, 0.001, 3.28])
def test_odometry_in_another_unit_is_refused(factor: float) -> None:
    walk = phone_walk(1)
    vio_T_cam = walk.vio_T_cam.copy()
    vio_T_cam[:, :3, 3] *= factor
    with pytest.raises(UserError, match="isn't in metres"):
        refuse_other_conventions([with_vio(walk, vio_T_cam)], "Place")


def test_a_world_whose_z_is_up_shares_no_vertical_with_the_map() -> None:
    walk = phone_walk(1)
    z_up = make_pose(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]), np.zeros(3))
    assert shares_vertical(walk.map_T_cam, walk.vio_T_cam)
    assert not shares_vertical(walk.map_T_cam, z_up @ walk.vio_T_cam)
    assert shares_vertical(walk.map_T_cam, np.full_like(walk.vio_T_cam, np.nan))
