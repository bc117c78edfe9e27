"""References without a unit: the same verdicts at any scale, origin and order."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundwalk.capture_import.capture import RawFrame, Recording, Session
from groundwalk.capture_import.checks.convention import check_convention, unitless_parallax_pairs
from groundwalk.capture_import.checks.plausibility import plausibility_faults
from groundwalk.capture_import.checks.rows import check_rows
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.capture_import.sessions import far_origin, moved
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store.choices import PoseSource
from groundwalk.store.tables import poses_of
from tests.capture_import.capture_writers import imported, make_walk, reader_of, write_nerfstudio
from tests.capture_import.checks.test_convention import room, with_mistake
from tests.capture_import.checks.test_rows import session_of

ECEF, UTM = (4186461.3, 834911.7, 4723432.9), (499123.4, 5412345.6, 210.0)


def in_world(session: Session, scale: float, origin: tuple[float, float, float]) -> Session:
    """The session as a reference without a unit, in a world of so many units a metre that begins elsewhere."""

    def of(frame: RawFrame) -> RawFrame:
        assert frame.vio_T_cam is not None
        pose = make_pose(frame.vio_T_cam[:3, :3], scale * (frame.vio_T_cam[:3, 3] + origin))
        return replace(frame, vio_T_cam=pose)

    frames = [of(frame) for frame in session.frames]
    raw = replace(session.recording, pose_source=PoseSource.REFERENCE, is_metric=False, frames=frames)
    return replace(session, recording=raw, frames=frames)


@pytest.mark.parametrize(("scale", "origin"), [(0.02, (0, 0, 0)), (1.0, ECEF), (1000.0, UTM)])
def test_mistakes_are_named_at_any_scale_and_origin(
    tmp_path: Path, scale: float, origin: tuple[float, float, float]
) -> None:
    session, load = in_world(room(tmp_path), scale, origin), reader_of(tmp_path)
    right = check_convention(session, load)
    assert right.pairs >= 4 and right.declared > 0.9 and right.contradicted is None
    name = "poses are world to camera, in OpenCV's axes"
    assert check_convention(with_mistake(session, name), load).contradicted == name
    shuffled = [session.frames[i] for i in np.random.default_rng(0).permutation(len(session.frames))]
    name = "camera y and z axes have the other sign (ARKit's or OpenGL's for OpenCV's, or back)"
    assert check_convention(with_mistake(replace(session, frames=shuffled), name), load).contradicted == name


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
    raw = Session("walk", session, list(session.frames), [], [])
    assert not plausibility_faults([raw])


@given(SCALES, ORIGINS)
def test_a_far_origin_is_taken_off_and_stated(scale: float, origin: Array) -> None:
    raw, world = reference_of(scale, origin)
    session = Session("walk", raw, list(raw.frames), [], [])
    off, extent = far_origin([session]), float(np.linalg.norm(np.ptp(world[:, :3, 3], axis=0)))
    assert (off is not None) == (np.linalg.norm(np.median(world[:, :3, 3], axis=0)) > 1000 * extent)
    if off is not None:
        near = moved(session, off).poses
        assert np.linalg.norm(near[:, :3, 3], axis=1).max() < 12 * extent
        np.testing.assert_allclose(near[:, :3, 3] + off, world[:, :3, 3], rtol=1e-12)
        assert far_origin([moved(session, off)]) is None
    assert far_origin([replace(session, recording=replace(raw, pose_source=PoseSource.VIO))]) is None


def test_a_georeferenced_data_set_comes_in_near_its_origin(tmp_path: Path) -> None:
    """Of all recordings the same origin, in the tables and in words."""
    walk = make_walk(24)
    root = tmp_path / "captures" / "place"
    write_nerfstudio(root, walk)
    content = json.loads((root / "transforms.json").read_text())
    for i, frame in enumerate(sorted(content["frames"], key=lambda row: row["file_path"])):
        folder = "a" if i < len(content["frames"]) / 2 else "b"
        (root / "images" / folder).mkdir(exist_ok=True)
        (root / frame["file_path"]).rename(root / "images" / folder / Path(frame["file_path"]).name)
        frame["file_path"] = f"images/{folder}/{Path(frame['file_path']).name}"
        for row, value in zip(frame["transform_matrix"], ECEF, strict=False):
            row[3] += value
    (root / "transforms.json").write_text(json.dumps(content))
    lines = [line for line in inspect_capture(root) if "reference_origin_x" in line]
    assert len(lines) == 2 and "(4186460, 834910, 4723430) of the data set's own coordinates" in lines[0]
    made = imported(tmp_path)
    origins = made["sessions"][[f"reference_origin_{axis}" for axis in "xyz"]]
    assert origins.to_numpy().tolist() == [[4186460.0, 834910.0, 4723430.0]] * 2
    centres = poses_of(made["reference"], "map_cam")[:, :3, 3] + origins.to_numpy()[0]
    assert len(centres) and np.abs(centres - ECEF).max() < 10
