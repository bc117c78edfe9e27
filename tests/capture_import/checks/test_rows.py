"""Rows, times, jumps and sharpness, and that nothing depends on the unit and origin of a reference; without files."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from groundwalk.capture_import.capture import ImageFile, Intrinsics, RawFrame, Recording, Session
from groundwalk.capture_import.checks.convention import unitless_parallax_pairs
from groundwalk.capture_import.checks.plausibility import plausibility_faults
from groundwalk.capture_import.checks.rows import check_rows
from groundwalk.capture_import.media.images import sharpness
from groundwalk.capture_import.sessions import far_origin, find_jumps, moved, sound_sessions
from groundwalk.geometry.poses import Array, make_pose, rotation_angle, yaw_rotation
from groundwalk.store.choices import Clock, PoseSource, Tracking
from tests.capture_import.capture_writers import image, make_walk


def session_of(t_ns: np.ndarray, poses: list[Array | None]) -> Recording:
    frames = [
        RawFrame(int(t), pose, number=i, source=f"row {i}") for i, (t, pose) in enumerate(zip(t_ns, poses, strict=True))
    ]
    return Recording("phone", Clock.BOOT, Path(), frames)


@given(st.lists(st.integers(0, 2**62), max_size=60))
def test_kept_times_rise_and_nothing_vanishes(times: list[int]) -> None:
    frames, rejects = check_rows(session_of(np.array(times, dtype=np.int64), [np.eye(4)] * len(times)))
    kept = [f.t_ns for f in frames]
    assert all(a < b for a, b in pairwise(kept))
    assert len(kept) + len(rejects) == len(times)


def test_one_wild_time_costs_one_row() -> None:
    t_ns = np.arange(50) * 10**8
    t_ns[20] = 10**17
    _, rejects = check_rows(session_of(t_ns, [np.eye(4)] * 50))
    assert [r.source for r in rejects] == ["row 20"]


def test_poses_between_poses_are_interpolated_and_gaps_are_not_bridged() -> None:
    walk = make_walk(60)
    missing = [i for i in range(60) if i % 3 == 1 or 30 < i < 40]
    poses: list[Array | None] = [None if i in missing else pose for i, pose in enumerate(walk.vio_T_cam)]
    posed, rejects = check_rows(session_of(walk.t_ns, poses))
    assert [r.source for r in rejects] == [f"row {i}" for i in range(31, 41)]
    for frame in posed:
        assert frame.vio_T_cam is not None
        off = np.linalg.inv(frame.vio_T_cam) @ walk.vio_T_cam[frame.number]
        assert np.linalg.norm(off[:3, 3]) < 5e-3 and rotation_angle(off[:3, :3]) < 5e-3


def reference_of(scale: float, origin: Array) -> tuple[Recording, Array]:
    """A walk as a reference without a unit, in a world of so many units a metre with another origin; its poses."""
    walk = make_walk(40)
    world = make_pose(walk.vio_T_cam[:, :3, :3], scale * (walk.vio_T_cam[:, :3, 3] + origin))
    return replace(session_of(walk.t_ns, list(world)), pose_source=PoseSource.REFERENCE, is_metric=False), world


SCALES = st.floats(-6, 6).map(lambda exponent: 10.0**exponent)
ORIGINS = st.tuples(*[st.floats(-1e6, 1e6)] * 3).map(np.array)


@settings(max_examples=25)
@given(SCALES, ORIGINS, st.integers(0, 5))
def test_pairs_rows_and_frames_do_not_depend_on_unit_and_origin(scale: float, origin: Array, broken: int) -> None:
    walk, (session, _) = make_walk(40), reference_of(scale, origin)
    here = session_of(walk.t_ns, list(walk.vio_T_cam))
    assert unitless_parallax_pairs(session.frames) == unitless_parallax_pairs(here.frames)
    assert not check_rows(session)[1]
    # A broken number is one among those around it.
    far = make_pose(np.eye(3), scale * (origin + np.array([0, 1e7, 0])))
    with_broken = replace(
        session, frames=[replace(f, vio_T_cam=far) if f.number == broken else f for f in session.frames]
    )
    _, (reject,) = check_rows(with_broken)
    assert reject.source == f"row {broken}" and "from the others' middle" in reject.reason
    raw = Session("walk", session, list(session.frames))
    assert not plausibility_faults([raw])


@given(SCALES, ORIGINS)
def test_a_far_origin_is_taken_off_and_stated(scale: float, origin: Array) -> None:
    raw, world = reference_of(scale, origin)
    session = Session("walk", raw, list(raw.frames))
    off, extent = far_origin([session]), float(np.linalg.norm(np.ptp(world[:, :3, 3], axis=0)))
    assert (off is not None) == (np.linalg.norm(np.median(world[:, :3, 3], axis=0)) > 1000 * extent)
    if off is not None:
        near = moved(session, off).poses
        assert np.linalg.norm(near[:, :3, 3], axis=1).max() < 12 * extent
        np.testing.assert_allclose(near[:, :3, 3] + off, world[:, :3, 3], rtol=1e-12)
        assert far_origin([moved(session, off)]) is None
    assert far_origin([replace(session, recording=replace(raw, pose_source=PoseSource.VIO))]) is None


@pytest.mark.parametrize(
    ("distortion", "fault"),
    [
        ((0.1, -0.2, 0.0, 0.0, 0.3, 0.4, 0.1, 0.02), None),
        ((0.1,) * 12, "distortion has 12 coefficients"),
        ((1e200, 0.0), "distortion isn't plausible: a coefficient of 1e+200"),
    ],
)
def test_an_image_whose_lens_has_no_place_in_the_tables_is_left_out(
    distortion: tuple[float, ...], fault: str | None
) -> None:
    session = session_of(np.arange(3) * 10**8, [np.eye(4)] * 3)
    camera = Intrinsics(480.0, 480.0, 320.0, 240.0, 640, 480, distortion)
    frames = [replace(frame, image=ImageFile(Path("a.jpg")), intrinsics=camera) for frame in session.frames]
    reasons = [reject.reason for reject in check_rows(replace(session, frames=frames))[1]]
    assert len(reasons) == (0 if fault is None else 3) and all(str(fault) in reason for reason in reasons)


@given(st.floats(0.15, 50.0), st.integers(8, 80), st.floats(-np.pi, np.pi))
def test_a_jump_is_found_where_it_is(jump_m: float, at: int, direction: float) -> None:
    walk = make_walk(90)
    poses = walk.vio_T_cam.copy()
    poses[at:, :3, 3] += jump_m * np.array([np.cos(direction), 0.0, np.sin(direction)])
    jumps = find_jumps(walk.t_ns, poses)
    assert [j.index for j in jumps] == [at]
    assert jumps[0].jump_m == pytest.approx(jump_m, abs=0.05)


def test_a_turn_of_the_whole_frame_is_a_jump_and_gauges_do_not_matter() -> None:
    walk = make_walk(90)
    turned = walk.vio_T_cam.copy()
    turned[40:] = make_pose(yaw_rotation(np.radians(25.0)), np.zeros(3)) @ turned[40:]
    found = find_jumps(walk.t_ns, turned)
    assert [j.index for j in found] == [40] and found[0].jump_deg == pytest.approx(25, abs=1)
    elsewhere = make_pose(yaw_rotation(1.0), [100.0, -3.0, 7.0]) @ turned
    again = find_jumps(walk.t_ns, elsewhere)
    assert again[0].jump_m == pytest.approx(found[0].jump_m, abs=1e-9)


@pytest.mark.parametrize("state", [Tracking.LIMITED, Tracking.LOST])
@pytest.mark.parametrize("stands", [True, False])
def test_vio_that_stood_still_while_the_phone_called_it_limited_or_lost_has_jumped(
    state: Tracking, stands: bool
) -> None:
    walk = make_walk(90)
    poses, untracked = walk.vio_T_cam.copy(), range(40, 50 if stands else 41)
    if stands:
        poses[50:, :3, 3] += poses[39, :3, 3] - poses[50, :3, 3]
        poses[40:50, :3, 3] = poses[39, :3, 3]
    recording = session_of(walk.t_ns, list(poses))
    frames = [replace(f, tracking=state if f.number in untracked else Tracking.NORMAL) for f in recording.frames]
    (session,) = sound_sessions(replace(recording, frames=frames), lambda _: [], 0.0)
    assert [(j.t_ns, j.splits) for j in session.jumps][-1:] == [(walk.t_ns[50], False)] * stands
    moved_m = np.linalg.norm(walk.vio_T_cam[50, :3, 3] - walk.vio_T_cam[39, :3, 3])
    assert not stands or session.jumps[-1].jump_m == pytest.approx(moved_m, rel=0.2)


def test_sharpness_falls_with_blur_and_not_with_exposure() -> None:
    large = cv2.resize(image(3), (640, 480), interpolation=cv2.INTER_NEAREST)
    gray: NDArray[np.uint8] = cv2.cvtColor(large, cv2.COLOR_BGR2GRAY).astype(np.uint8)
    last = sharpness(gray)
    for length in (3, 7, 15, 31):
        blurred = sharpness(cv2.blur(gray, (length, 1)).astype(np.uint8))
        assert blurred < last
        last = blurred
    assert sharpness((gray * 0.5).astype(np.uint8)) == pytest.approx(sharpness(gray), abs=0.02)
