"""Focal lengths of sessions: found where they are off, applied where matches held out agree, left alone otherwise."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from geometry.fits import fit_sim3
from geometry.poses import Array, inverse, make_pose, transform
from sfm.database import camera_of, image_id
from sfm.focal_scale import FocalScales, estimate_focal_scales
from sfm.intrinsics import (
    AS_CAPTURED,
    BESIDE,
    BEYOND,
    NO_BETTER,
    REFINED,
    FocalScale,
    first_estimates,
    read_refined,
    refine_models,
)
from sfm.mapping import BuiltModel, adjust_robustly
from sfm.mapping_input import Matches
from sfm.model import load_models
from sfm.settings import SfmSettings

_FRAMES, _POINTS, _MATCHES = 14, 600, 1500
_FOCAL_PX, _SIZE_PX, _NOISE_PX = 500.0, (640, 480), 0.4
_DISTORTION = [0.05, -0.02, 0.0, 0.0]


@dataclass(frozen=True)
class World:
    """An adjusted model of two sessions in `folder`, the frames with the focal lengths that it was adjusted with, its
    true poses, and matches that took no part."""

    folder: Path
    told: BuiltModel
    frames: pd.DataFrame
    truth: Array
    matches: Matches

    def tried(self, settings: SfmSettings) -> list[FocalScale]:
        model = load_models([self.folder / "model"], len(self.frames))
        return first_estimates(model, [self.told], self.frames, settings.focal_limit)[0]

    def refined(self, settings: SfmSettings, first: list[FocalScale] | None = None) -> tuple[Path, list[FocalScale]]:
        output = self.folder / "refined"
        refine_models(
            lambda done, note="": None,
            self.folder,
            [self.told],
            [first or self.tried(settings)],
            self.frames,
            self.matches,
            settings,
            output,
        )
        return output / "model", read_refined(output)[1][0]

    def error(self, folder: Path) -> float:
        """RMS distance from the truth after a similarity fit."""
        sfm_T_cam = load_models([folder], len(self.frames)).sfm_T_cam
        placed = fit_sim3(self.truth[:, :3, 3], sfm_T_cam[:, :3, 3]).poses(sfm_T_cam)
        return float(np.sqrt(np.mean((placed[:, :3, 3] - self.truth[:, :3, 3]) ** 2)))


def make_world(folder: Path, seed: int, one: float = 1.0, two: float = 1.0) -> World:
    """`one` and `two`: what the captured focal lengths of the sessions are times the true ones."""
    rng = np.random.default_rng(seed)
    truth = _poses()
    session = np.where(np.arange(_FRAMES) % 2, "two", "one")
    frames = pd.DataFrame({"frame_id": [f"{s}/{i:06d}" for i, s in enumerate(session)], "session_id": session})
    frames[["fx", "fy", "cx", "cy"]] = [_FOCAL_PX, 1.01 * _FOCAL_PX, 322.0, 237.0]
    frames["width"], frames["height"] = _SIZE_PX
    frames["distortion"] = [_DISTORTION] * _FRAMES
    xyz = rng.uniform(-1.5, 1.5, (_POINTS, 3))
    seen = np.stack([_seen(frames.iloc[row], truth[row], xyz) for row in range(_FRAMES)])
    seen += rng.normal(0, _NOISE_PX, seen.shape)
    captured = frames.copy()
    captured[["fx", "fy"]] *= np.where(session == "one", one, two)[:, None]
    model = pycolmap.Reconstruction()
    for row, frame in enumerate(captured.itertuples(index=False)):
        number = image_id(row)
        model.add_camera_with_trivial_rig(camera_of(frame, number))
        image = pycolmap.Image(name=str(row), keypoints=seen[row], camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(truth[row])[:3]))
    for number, position in enumerate(xyz):
        model.add_point3D(position, pycolmap.Track([pycolmap.TrackElement(i + 1, number) for i in range(_FRAMES)]))
    (folder / "model").mkdir(parents=True)
    loss_px = adjust_robustly(model, folder / "model", _FRAMES)
    model.write_binary(folder / "model")
    told = BuiltModel("incremental", 0, _FRAMES, _POINTS, _FRAMES * _POINTS, _FRAMES, 0.5, "model", loss_px)
    return World(folder, told, captured, truth, _held_out(rng, frames, truth))


def _poses() -> Array:
    angle = np.linspace(0, np.pi, _FRAMES)
    centre = np.stack([4 * np.sin(angle), 0.3 * np.cos(3 * angle), -4 * np.cos(angle)], axis=1)
    forward = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return make_pose(np.stack([right, np.cross(forward, right), forward], axis=2), centre)


def _seen(frame: pd.Series, world_T_cam: Array, xyz: Array) -> Array:
    return np.asarray(camera_of(frame, 1).img_from_cam(transform(inverse(world_T_cam), xyz))).reshape(-1, 2)


def _held_out(rng: np.random.Generator, frames: pd.DataFrame, truth: Array) -> Matches:
    xyz = rng.uniform(-1.5, 1.5, (_MATCHES, 3))
    first = rng.integers(0, _FRAMES - 3, _MATCHES)
    rows = np.stack([first, first + rng.integers(1, 4, _MATCHES)], axis=1)
    every = np.stack([_seen(frames.iloc[row], truth[row], xyz) for row in range(_FRAMES)])
    xy = every[rows, np.arange(_MATCHES)[:, None]] + rng.normal(0, _NOISE_PX, (_MATCHES, 2, 2))
    return Matches(rows, xy[:, 0], xy[:, 1], np.ones(_MATCHES, bool))


def test_right_focal_lengths_are_left_alone(tmp_path: Path) -> None:
    tried = make_world(tmp_path, 0).tried(SfmSettings())
    assert [scale.session_id for scale in tried] == ["one", "two"]
    assert [scale.frames for scale in tried] == [_FRAMES // 2] * 2
    assert {scale.decision for scale in tried} == {AS_CAPTURED}
    assert {scale.applied for scale in tried} == {1.0}


def test_the_sigma_of_a_factor_is_what_it_scatters_by(tmp_path: Path) -> None:
    normalised = []
    for seed in range(15):
        world = make_world(tmp_path / str(seed), seed)
        normalised += [(scale.factor - 1) / scale.sd for scale in world.tried(SfmSettings())]
    assert np.sqrt(np.mean(np.square(normalised))) == pytest.approx(1, abs=0.4)


def test_a_model_in_another_gauge_says_the_same(tmp_path: Path) -> None:
    world = make_world(tmp_path, 1, two=1.01)
    session, intrinsics = world.frames["session_id"].to_numpy(str), world.frames[["fx", "fy", "cx", "cy"]].to_numpy()
    here = estimate_focal_scales(load_models([tmp_path / "model"], _FRAMES), session, intrinsics, world.told.loss_px)
    moved = pycolmap.Reconstruction(tmp_path / "model")
    turn = pycolmap.Rotation3d(Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix())
    moved.transform(pycolmap.Sim3d(7.0, turn, np.array([5.0, -3.0, 2.0])))
    (tmp_path / "moved").mkdir()
    moved.write_binary(tmp_path / "moved")
    there = estimate_focal_scales(load_models([tmp_path / "moved"], _FRAMES), session, intrinsics, world.told.loss_px)
    assert isinstance(here, FocalScales) and isinstance(there, FocalScales)
    assert there.factor == pytest.approx(here.factor, abs=1e-7)
    assert there.sd == pytest.approx(here.sd, rel=1e-4)


@pytest.mark.parametrize(("one", "two"), [(1.0, 1.015), (0.98, 0.98)])
def test_focal_lengths_that_are_off_are_refined_and_the_poses_are_better(
    tmp_path: Path, one: float, two: float
) -> None:
    world = make_world(tmp_path, 2, one, two)
    folder, tried = world.refined(SfmSettings())
    for scale, off in zip(tried, (one, two), strict=True):
        assert scale.decision == (REFINED if off != 1 else AS_CAPTURED)
        if off != 1:
            assert scale.applied == pytest.approx(1 / off, abs=max(3.5 * scale.sd, 5e-4))
    assert tried[1].heldout_refined_px < 0.95 * tried[1].heldout_px
    assert world.error(folder) < 0.5 * world.error(tmp_path / "model")
    # The model beside the poses has the focal lengths that they go with, and its other intrinsics as they were.
    camera = pycolmap.Reconstruction(folder).camera(image_id(1))
    frame = world.frames.iloc[1]
    assert camera.params[0] == pytest.approx(frame["fx"] * tried[1].applied)
    assert camera.params[2:] == pytest.approx([frame["cx"], frame["cy"], *_DISTORTION])


def test_a_factor_beyond_the_bound_is_told_and_nothing_is_refined(tmp_path: Path) -> None:
    tried = make_world(tmp_path, 3, two=1.1).tried(SfmSettings())
    assert [scale.decision for scale in tried] == [BESIDE, BEYOND]
    assert tried[1].factor < 0.97


def test_the_bound_holds_for_where_the_adjustments_end_too(tmp_path: Path) -> None:
    world = make_world(tmp_path, 2, 0.98, 0.98)
    # From a first factor within the bound the adjustments go on to about 1.022.
    first = [replace(scale, factor=1.015) for scale in world.tried(SfmSettings())]
    _, tried = world.refined(SfmSettings(focal_limit=0.019), first)
    assert BEYOND in [scale.decision for scale in tried]
    assert {scale.applied for scale in tried} == {1.0}


def test_factors_that_help_no_held_out_match_are_refused(tmp_path: Path) -> None:
    world = make_world(tmp_path, 4, two=1.015)
    before = {path.name: path.read_bytes() for path in (tmp_path / "model").iterdir()}
    folder, tried = world.refined(SfmSettings(focal_gain=0.99))
    assert [scale.decision for scale in tried] == [AS_CAPTURED, NO_BETTER]
    assert tried[1].applied == 1.0
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
