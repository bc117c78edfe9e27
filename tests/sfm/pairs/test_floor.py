"""Floor features on drawn images of a floor between bare walls."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.features.sift import even_sift
from groundwalk.geometry.poses import Array, inverse, make_pose, relative, rotation_angle
from groundwalk.sfm.cameras.lenses import prior_lenses
from groundwalk.sfm.cameras.motion import Motion
from groundwalk.sfm.database import Workspace, create_database, image_id, read_pair_results
from groundwalk.sfm.pairs.floor import PairSource, floor_features, floor_matches, match_floor
from groundwalk.sfm.pairs.matching import guide_pairs, match_pairs, mutual_matches
from groundwalk.sfm.pairs.odometry import odometry
from groundwalk.sfm.settings import SfmSettings

SIZE, FOCAL_PX, HEIGHT_M = (960, 720), 800.0, 1.4
DISTORTION = [0.09, -0.12, 0.0, 0.0]
TEXEL_M, SIDE_M = 0.005, 12.0
SETTINGS = SfmSettings()
PAIRS = np.array([[0, 1]])


def quiet(done: int, note: str = "") -> None: ...


def camera() -> pycolmap.Camera:
    parameters = [FOCAL_PX, FOCAL_PX, SIZE[0] / 2, SIZE[1] / 2, *DISTORTION]
    return pycolmap.Camera(camera_id=1, model="OPENCV", width=SIZE[0], height=SIZE[1], params=parameters)


@cache
def texture() -> NDArray[np.uint8]:
    """Tiles of slightly different greys, with stains: most of it has no feature."""
    rng = np.random.default_rng(7)
    texels = round(SIDE_M / TEXEL_M)
    tiles = cv2.resize(
        rng.uniform(140, 170, (20, 20)).astype(np.float32), (texels, texels), interpolation=cv2.INTER_NEAREST
    )
    for _ in range(5000):
        centre, radius = rng.integers(0, texels, 2), int(rng.integers(2, 4))
        cv2.circle(tiles, tuple(int(x) for x in centre), radius, float(rng.uniform(100, 200)), -1)
    return np.clip(cv2.GaussianBlur(tiles, (0, 0), 1.0), 0, 255).astype(np.uint8)


def pose(yaw_deg: float, pitch_deg: float, xyz: list[float]) -> Array:
    """A camera's pose in a world with y down, at HEIGHT_M over the floor: its z axis ahead, down by the pitch."""
    turn = Rotation.from_euler("yx", [yaw_deg, -pitch_deg], degrees=True)
    return make_pose(turn.as_matrix(), xyz)


def on_floor(world_T_cam: Array, px: Array) -> Array:
    """Where the rays through pixels (M, 2) meet the floor y = HEIGHT_M, (M, 3); NaN above the horizon."""
    rays = np.column_stack([np.asarray(camera().cam_from_img(px)), np.ones(len(px))]) @ world_T_cam[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        times = (HEIGHT_M - world_T_cam[1, 3]) / rays[:, 1]
    return np.where((times > 0)[:, None], world_T_cam[:3, 3] + times[:, None] * rays, np.nan)


def image(world_T_cam: Array) -> NDArray[np.uint8]:
    """The floor as far as a bare wall 7 m on."""
    px = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), axis=-1).reshape(-1, 2).astype(float) + 0.5
    xyz = on_floor(world_T_cam, px)
    is_floor = np.linalg.norm(xyz - world_T_cam[:3, 3], axis=1) < 7
    texel = np.where(is_floor[:, None], (xyz[:, [0, 2]] + SIDE_M / 2) / TEXEL_M, -1).astype(np.float32)
    drawn = cv2.remap(texture(), texel[:, 0].reshape(SIZE[::-1]), texel[:, 1].reshape(SIZE[::-1]), cv2.INTER_AREA)
    return np.where(is_floor.reshape(SIZE[::-1]), drawn, 215).astype(np.uint8)


def gravity_in(world_T_cam: Array) -> Array:
    return np.asarray(world_T_cam[1, :3])


TURN = [pose(0, 17, [0, 0, 0]), pose(35, 15, [0.1, 0.02, 0.7])]


def test_the_floor_matches_better_as_seen_from_above() -> None:
    images = [image(p) for p in TURN]
    a, b = (floor_features(grey, camera(), gravity_in(p)) for grey, p in zip(images, TURN, strict=True))
    matches = floor_matches(a, b)

    ordinary = [even_sift(grey, 2048, max(SIZE), 0.02) for grey in images]
    of_ordinary = mutual_matches(*(features.descriptors.astype(np.float32) for features in ordinary))
    assert len(matches) > 1.3 * len(of_ordinary)
    apart_m = np.linalg.norm(on_floor(TURN[0], a.px[matches[:, 0]]) - on_floor(TURN[1], b.px[matches[:, 1]]), axis=1)
    assert np.median(apart_m) < 0.01 and apart_m.max() < 0.05
    # On the floor in heights of each camera: as far from its foot as the world has it.
    foot = TURN[0][:3, 3] * [1, 0, 1]
    distance = np.linalg.norm(on_floor(TURN[0], a.px) * [1, 0, 1] - foot, axis=1) / HEIGHT_M
    np.testing.assert_allclose(np.linalg.norm(a.on_floor, axis=1), distance, atol=1e-3)


def test_other_places_and_views_without_a_floor_do_not_match() -> None:
    here = floor_features(image(TURN[0]), camera(), gravity_in(TURN[0]))
    elsewhere = pose(180, 17, [-1, 0, -1])
    assert not len(floor_matches(here, floor_features(image(elsewhere), camera(), gravity_in(elsewhere))))
    up = pose(0, -60, [0, 0, 0])
    none = floor_features(image(up), camera(), gravity_in(up))
    assert not len(none.px) and not len(floor_matches(here, none))
    blank = floor_features(np.full(SIZE[::-1], 180, np.uint8), camera(), gravity_in(TURN[0]))
    assert not len(floor_matches(here, blank))


def test_a_pair_tied_by_the_floor_has_its_true_pose_and_inliers_that_fit_it(tmp_path: Path) -> None:
    source = scene(tmp_path)
    database = source.database
    before = read_pair_results(database, PAIRS)[1][0]
    match_floor(quiet, source, PAIRS, np.array([False]))

    matches, after = read_pair_results(database, PAIRS)
    assert after[0] > before + 30 and matches[0] == read_pair_results(source.features, PAIRS)[0][0]
    kept = inliers(database)
    match_floor(quiet, source, PAIRS, np.array([False]))
    np.testing.assert_array_equal(inliers(database), kept)
    guide_pairs(quiet, database, PAIRS)
    with pycolmap.Database.open(database) as opened, pycolmap.Database.open(source.features) as raw:
        described = [opened.num_descriptors_for_image(image_id(row)) for row in (0, 1)]
        of_floor = kept[(kept >= described).all(axis=1)]
        guided = {tuple(match) for match in inliers(database).tolist()}
        assert len(of_floor) > 30 and {tuple(match) for match in of_floor.tolist()} <= guided
        cameras = [opened.read_camera(image_id(row)) for row in (0, 1)]
        keypoints = [opened.read_keypoints(image_id(row))[:, :2].astype(float) for row in (0, 1)]
        geometry = opened.read_two_view_geometry(image_id(0), image_id(1))
        assert pycolmap.estimate_two_view_geometry_pose(cameras[0], keypoints[0], cameras[1], keypoints[1], geometry)
        # No rolling shutter: the same places in both databases.
        for row in (0, 1):
            np.testing.assert_allclose(raw.read_keypoints(image_id(row))[:, :2], keypoints[row], atol=1e-3)
    assert geometry.cam2_from_cam1 is not None
    b_T_a = relative(TURN[1], TURN[0])
    off = rotation_angle(geometry.cam2_from_cam1.rotation.matrix().T @ b_T_a[:3, :3])
    assert np.degrees(off) < 0.3


def inliers(database: Path) -> NDArray[np.int64]:
    with pycolmap.Database.open(database) as opened:
        return np.asarray(opened.read_two_view_geometry(image_id(0), image_id(1)).inlier_matches, np.int64)


def scene(folder: Path) -> PairSource:
    """Two frames of a turn with ordinary features and their matches, and VIO that is off by a degree."""
    names = ["a.png", "b.png"]
    for name, p in zip(names, TURN, strict=True):
        cv2.imwrite(str(folder / name), image(p))
    frames = pd.DataFrame(
        {
            "frame_id": ["s/a", "s/b"],
            "session_id": "s",
            "width": SIZE[0],
            "height": SIZE[1],
            "first_row": "top",
            "stated_readout_s": np.nan,
            "focal_sd": 0.0,
            "fx": FOCAL_PX,
            "fy": FOCAL_PX,
            "cx": SIZE[0] / 2,
            "cy": SIZE[1] / 2,
            "distortion": [DISTORTION, DISTORTION],
        }
    )
    features, database = folder / "features.db", folder / "database.db"
    for path in (features, database):
        create_database(path, frames, names)
        with pycolmap.Database.open(path) as opened:
            for row, p in enumerate(TURN):
                found = even_sift(image(p), SETTINGS.max_features, SETTINGS.max_image_size, 0.02)
                sift = pycolmap.FeatureExtractorType.SIFT
                opened.write_keypoints(image_id(row), found.px)
                opened.write_descriptors(image_id(row), pycolmap.FeatureDescriptors(data=found.descriptors, type=sift))
        match_pairs(quiet, path, PAIRS, 0)
    lenses = prior_lenses(frames, {"s": "phone"}, SfmSettings(lens="stated", readout_s=0.0))
    motion = Motion(np.zeros((2, 3)), np.zeros(2), np.zeros((2, 3)), np.ones(2, bool))
    turned = make_pose(Rotation.from_rotvec([0, np.radians(1.0), 0]).as_matrix(), [0.01, 0, 0])
    vio_T_cam = np.stack([TURN[0], turned @ TURN[1]])
    assert np.degrees(rotation_angle((inverse(vio_T_cam[1]) @ TURN[1])[:3, :3])) > 0.9
    session, gravity = np.array(["s", "s"], object), np.stack([gravity_in(p) for p in TURN])
    return PairSource(
        database=database,
        features=features,
        work=Workspace(folder, names, folder, {}),
        frames=frames,
        lenses=lenses,
        motion=motion,
        vio=odometry(session, session, np.array([0, 500_000_000]), vio_T_cam, gravity, []),
        seed=0,
    )
