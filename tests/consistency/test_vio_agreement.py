"""VIO held against a model: windows, scale, and which frames move otherwise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.consistency.scale import recording_scale
from groundwalk.consistency.trajectories import TrajectoryPair, path_windows
from groundwalk.consistency.windows import compare_windows
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, make_pose, path_length, yaw_rotation


def _walk(seed: int, frames: int = 60) -> Array:
    rng = np.random.default_rng(seed)
    turn = np.cumsum(rng.normal(0, 0.2, frames))
    step = rng.uniform(0.2, 1.0, (frames, 1)) * np.stack([np.cos(turn), np.zeros(frames), np.sin(turn)], axis=1)
    return make_pose(yaw_rotation(-turn), np.cumsum(step, axis=0))


def pair(sfm_T_cam: Array, vio_T_cam: Array) -> TrajectoryPair:
    return TrajectoryPair(sfm_T_cam, vio_T_cam, path_length(vio_T_cam[:, :3, 3]))


@settings(max_examples=50)
@given(seed=st.integers(0, 1000), frames=st.integers(1, 80), length_m=st.floats(0.5, 30.0))
def test_windows_overlap_and_have_the_whole_path(seed: int, frames: int, length_m: float) -> None:
    travelled = path_length(_walk(seed, frames)[:, :3, 3])
    windows = path_windows(travelled, length_m)
    assert sorted(set(np.concatenate(windows).tolist())) == list(range(frames))
    for inside in windows:
        assert (np.diff(inside) == 1).all()
        assert len(inside) >= min(6, frames)
        # Longer only where frames are so few that it must be.
        assert travelled[inside[-1]] - travelled[inside[0]] <= length_m + 1e-6 or len(inside) <= 6


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), scale=st.floats(0.01, 100.0))
def test_scale_is_found_in_any_gauge_in_spite_of_wrong_frames(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    vio = _walk(seed)
    sfm = Sim3(1 / scale, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)).poses(vio)
    sfm[[7, 31], :3, 3] += 3.0 / scale
    found = recording_scale([pair(sfm[:25], vio[:25]), pair(sfm[25:], vio[25:])])
    assert found is not None
    assert np.exp(found.log) == pytest.approx(scale, rel=1e-4)
    metric_T_cam = Sim3(float(np.exp(found.log)), np.eye(3), np.zeros(3)).poses(sfm)
    windows = compare_windows(pair(metric_T_cam, vio))
    assert {int(row) for w in windows for row in w.inside[w.wrong]} == {7, 31}
    # A coarser fit tells the same frames.
    coarse = compare_windows(pair(metric_T_cam, vio), tolerance=0.05)
    assert [w.wrong.tolist() for w in coarse] == [w.wrong.tolist() for w in windows]


def test_what_doesnt_move_has_no_scale_and_what_is_collapsed_is_an_error() -> None:
    vio = _walk(1)
    still = np.tile(np.eye(4), (60, 1, 1))
    assert recording_scale([pair(vio, still)]) is None
    assert recording_scale([pair(vio[:2], vio[:2])]) is None
    assert compare_windows(pair(vio[:2], vio[:2])) == []
    with pytest.raises(GeometryError):
        recording_scale([pair(still, vio)])
