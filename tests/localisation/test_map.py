"""The map's file, and what it answers and refuses."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.features.sift import Features
from groundwalk.geometry.poses import Array
from groundwalk.localisation.build import build_map, priors_of
from groundwalk.localisation.calibration import Trial, calibrated
from groundwalk.localisation.compact import CompactMap, point_covariances, read_map, write_map
from groundwalk.localisation.entries import MapSettings
from groundwalk.localisation.localisers import StructureSettings
from groundwalk.localisation.prepared import Prepared, prepare
from groundwalk.localisation.query import MapLocaliser
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import UserError
from tests.known import there
from tests.localisation.scenes import HIGH, LOGGED, LOGGED_HIGH, Place, features, place, training, walk

Built = tuple[Place, Prepared, CompactMap]
EXTRACTION, SETTINGS = StructureSettings(), MapSettings(max_points=900)


@pytest.fixture(scope="module")
def built() -> Built:
    scene, views = place(), walk(15)
    prepared = prepare("room", training(scene, views), EXTRACTION)
    return scene, prepared, build_map(prepared, SETTINGS)


@pytest.fixture(scope="module")
def file(built: Built, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("map") / "map.gwm"
    write_map(path, built[2])
    return path


def gravity_of(pose: Array) -> Array:
    return pose[:3, :3].T @ [0, -1.0, 0]


def test_queries_are_localised(built: Built, file: Path) -> None:
    localiser, views = MapLocaliser(read_map(file)), walk(12, seed=9)
    for view in range(12):
        seen, truth = features(built[0], views, view, seed=5), views.map_T_cam[view]
        for gravity, prior in ((gravity_of(truth), None), (None, None), (gravity_of(truth), views.map_T_cam[view])):
            answer = localiser.localise_features(seen, LOGGED, gravity, prior)
            assert answer.map_T_cam is not None, answer.reason
            assert position_error(answer.map_T_cam, truth) < 0.05 and rotation_error_deg(answer.map_T_cam, truth) < 0.6
            # Those that joined because the pose predicts them there are seen, but no evidence.
            assert 0.5 * answer.candidates < answer.inliers <= min(answer.candidates, answer.seen.inlier.sum())
            assert np.linalg.eigvalsh(there(answer.covariance)).min() > 0


def test_a_high_image_is_localised_in_a_map_of_wide_ones(built: Built, file: Path) -> None:
    localiser, views = MapLocaliser(read_map(file)), walk(6, seed=9, camera=HIGH)
    for view in range(6):
        seen, truth = features(built[0], views, view, seed=5), views.map_T_cam[view]
        answer = localiser.localise_features(seen, LOGGED_HIGH, gravity_of(truth))
        pose = there(answer.map_T_cam)
        assert position_error(pose, truth) < 0.012 and rotation_error_deg(pose, truth) < 0.08


def test_a_map_without_a_vertical_takes_no_notice_of_gravity(built: Built, file: Path) -> None:
    scene, prepared, _ = built
    unknown = replace(prepared.training, gravity=np.full_like(prepared.training.gravity, np.nan))
    content = replace(read_map(file), priors=priors_of(replace(prepared, training=unknown), prepared.points))
    views = walk(4, seed=9)
    for view in range(4):
        seen = features(scene, views, view, seed=5)
        wrong = Rotation.from_euler("x", 30, degrees=True).as_matrix() @ gravity_of(views.map_T_cam[view])
        told, not_told = (MapLocaliser(content).localise_features(seen, LOGGED, down) for down in (wrong, None))
        np.testing.assert_array_equal(there(told.map_T_cam), there(not_told.map_T_cam))


def test_bad_queries_are_refused_with_their_reason(file: Path) -> None:
    localiser, elsewhere = MapLocaliser(read_map(file)), features(place(seed=7), walk(3), 1)
    noise = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
    for answer in (
        localiser.localise(noise, LOGGED),
        localiser.localise_features(elsewhere, LOGGED),
        localiser.localise_features(elsewhere, LOGGED, np.array([0, 1.0, 0])),
    ):
        assert answer.map_T_cam is None and answer.covariance is None and answer.refusal and answer.reason


def test_hidden_points_take_no_part(built: Built, file: Path) -> None:
    localiser = MapLocaliser(read_map(file))
    answer = localiser.localise_features(built[1].training.features[3], LOGGED)
    hidden = np.zeros(len(localiser.map.xyz), bool)
    hidden[answer.seen.points[answer.seen.inlier][::2]] = True
    again = localiser.localise_features(built[1].training.features[3], LOGGED, hidden=hidden)
    assert not hidden[again.seen.points].any()


def test_calibration_asks_for_more_inliers_than_wrong_answers_had(built: Built, file: Path) -> None:
    localiser = MapLocaliser(read_map(file))
    views = built[1].training.views
    trials = [
        Trial(localiser.localise_features(f, LOGGED), views.map_T_cam[row], 20 + row)
        for row, f in enumerate(built[1].training.features)
    ]
    assert calibrated(trials).min_inliers == 60  # 1.75 times 34
    assert calibrated(trials[:3]).min_inliers == 30


def test_a_map_comes_back_as_it_was_written(built: Built, file: Path) -> None:
    content, written = read_map(file), built[2]
    assert len(content.xyz) == 900
    np.testing.assert_allclose(content.xyz, written.xyz, atol=0.00051)
    np.testing.assert_allclose(content.descriptors, written.descriptors, atol=0.02)
    np.testing.assert_allclose(content.map_T_view, written.map_T_view, atol=1e-6)
    np.testing.assert_array_equal(content.seen, written.seen)
    assert (content.lenses, content.priors, content.calibration) == (
        written.lenses,
        written.priors,
        written.calibration,
    )


@pytest.mark.parametrize(
    "change",
    [
        lambda b: b[:-100],
        lambda b: b[:20],
        lambda b: b"no map" + b[6:],
        lambda b: b[: len(b) // 2] + bytes([b[len(b) // 2] ^ 1]) + b[len(b) // 2 + 1 :],
        lambda b: b"",
    ],
    ids=["cut short", "its start alone", "another file", "a bit changed", "empty"],
)
def test_files_that_are_no_whole_map_are_refused(file: Path, tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    damaged = tmp_path / "damaged.gwm"
    damaged.write_bytes(change(file.read_bytes()))
    with pytest.raises(UserError, match="can't be read"):
        read_map(damaged)


def test_a_map_of_another_kind_or_version_is_refused(file: Path, tmp_path: Path) -> None:
    for arrays, message in (
        ({"xyz": np.zeros(3, np.uint8)}, "can't be read"),
        ({"metadata": np.frombuffer(b'{"version":1}', np.uint8)}, "another version"),
        ({"metadata": np.frombuffer(b'{"version":3}', np.uint8)}, "lacks a section"),
    ):
        np.savez(tmp_path / "other.npz", **arrays)
        with pytest.raises(UserError, match=message):
            read_map(tmp_path / "other.npz")
    with pytest.raises(UserError, match="can't be read"):
        read_map(tmp_path / "none")


def test_a_map_is_read_and_asked_without_torch_open3d_and_pycolmap(file: Path) -> None:
    program = f"""
import sys
from pathlib import Path
import numpy as np
from groundwalk.geometry.cameras import Camera
from groundwalk.localisation.compact import read_map
from groundwalk.localisation.query import MapLocaliser
localiser = MapLocaliser(read_map(Path({str(file)!r})))
grey = np.random.default_rng(0).integers(0, 255, (480, 640), np.uint8)
localiser.localise(grey, Camera(640, 480, 480, 480, 320, 240))
print(sorted({{"torch", "open3d", "pycolmap"}} & set(sys.modules)))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_sure_answer_near_a_prior_is_of_a_small_image_and_others_of_the_whole(
    built: Built, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    localiser, sizes = MapLocaliser(read_map(file)), []
    views = walk(3, seed=9, moving=False)
    seen = features(built[0], views, 1, seed=5)

    def extract(_: object, *size: int) -> Features:
        sizes.append(size)
        return seen

    monkeypatch.setattr("groundwalk.localisation.query.sift", extract)
    picture = np.zeros((480, 640), np.uint8)
    assert localiser.localise(picture, LOGGED).map_T_cam is not None
    assert sizes == [(1536, 640)]
    for sure_m, expected in ((10.0, [(410, 320)]), (0.0, [(410, 320), (1536, 640)])):
        monkeypatch.setattr("groundwalk.localisation.query._SURE_M", sure_m)
        sizes.clear()
        assert localiser.localise(picture, LOGGED, prior=views.map_T_cam[1]).map_T_cam is not None
        assert sizes == expected


def test_an_unsure_point_says_less_of_the_pose_than_a_sure_one(built: Built, file: Path) -> None:
    content = read_map(file)
    covariances = point_covariances(content)
    views = content.map_T_view[:, :3, 3]
    frames = np.bincount(content.seen, minlength=len(content.xyz))
    sd = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    assert np.linalg.eigvalsh(covariances).min() > 0 and 0.001 < np.median(sd) < 0.1
    assert np.median(sd[frames >= 6]) < np.median(sd[frames == 2])
    # What is least sure of a point that few frames saw is how far it is from them.
    row = int(np.flatnonzero(frames == 2)[0])
    view = np.repeat(np.arange(len(views)), np.diff(content.seen_bounds))
    away = content.xyz[row] - views[view[content.seen == row]].mean(axis=0)
    across = np.cross(away, [0.0, 1.0, 0.0])
    along, beside = (v @ covariances[row] @ v / (v @ v) for v in (away, across))
    assert along > beside
    exact = replace(content, priors=replace(content.priors, point_sd=0.0))
    assert not point_covariances(exact).any()
