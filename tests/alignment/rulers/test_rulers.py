"""Rulers from pixels to a check: boards that judge the map's scale, set it, or are wrong themselves."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.check_models import CheckedMap, check_models
from groundwalk.alignment.definition import STAGE
from groundwalk.alignment.ground_truth import AlignResult
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.rulers.detection import detect, find_rulers, held_out_corners, nominal_corners
from groundwalk.alignment.rulers.measurement import RulerDetections, RulerMeasurement, measure_rulers
from groundwalk.alignment.rulers.scale_check import RulerCheck, check_rulers, describe, rulers_table
from groundwalk.alignment.settings import AlignSettings, AprilTagRuler, CharucoRuler, rulers_of
from groundwalk.geometry.poses import Array, inverse, make_pose, transform
from groundwalk.geometry.shutter import readout_fraction, readout_lines
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.choices import RulerPart
from groundwalk.store.files import sha256_of
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.settings import resolve_settings
from groundwalk.store.tables import camera_of, poses_of, read_table
from tests.known import cells, put, table_of, without_vio
from tests.synthetic_walks import Scene, Walks, align

BOARD = {
    "kind": "charuco",
    "squares_x": 11,
    "squares_y": 8,
    "square_mm": 200.0,
    "marker_mm": 150.0,
    "dictionary": "DICT_6X6_250",
}
LENS = [0.09, -0.12]
SIZE = (1920, 1440)


def opencv_camera(frames: pd.DataFrame, row: int) -> tuple[Array, Array]:
    """Matrix (3, 3) and distortion (8,) of a frame, as cv2.projectPoints takes them."""
    camera = camera_of(frames.iloc[row])
    return camera.matrix, np.array([*camera.distortion, *[0.0] * 8][:8])


@pytest.fixture
def scene(walks: Walks) -> Scene:
    """Two walks, noise-free but for what a phone's VIO drifts by."""
    return with_cameras(walks.make(sessions=2, frames=60, drift_m=0.003))


def with_cameras(scene: Scene) -> Scene:
    frames = scene.frames.assign(fy=1400.0, cx=960.0, cy=720.0)
    return replace(scene, frames=frames.assign(distortion=cells([LENS] * len(frames))))


def ruler(**changes: Any) -> CharucoRuler:
    (made,) = rulers_of([{**BOARD, **changes}])
    assert isinstance(made, CharucoRuler)
    return made


def sighted(
    scene: Scene, of: CharucoRuler, *, printed: float = 1.0, mirror: bool = False, near: int = 20, frames: int = 60
) -> RulerDetections:
    """The board 5 m in front of frame `near`, facing it, as the frames of its walk see it. `printed`: its true
    size as a share of the stated one."""
    nominal = nominal_corners(of)
    middle = nominal.xyz_m.mean(axis=0)
    on_board = (nominal.xyz_m - middle) * [-1 if mirror else 1, 1, 1] * printed
    map_T_board = scene.true_T_cam[near] @ make_pose(np.eye(3), [0.0, 0.0, 5.0])
    xyz = transform(map_T_board, on_board)
    rng = np.random.default_rng(near)
    rows: list[int] = []
    corner: list[int] = []
    pixels: list[Array] = []
    for row in range(60 * (near // 60), 60 * (near // 60) + frames):
        seen = transform(inverse(scene.true_T_cam[row]), xyz)
        if (seen[:, 2] < 1).any():
            continue
        xy, _ = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), *opencv_camera(scene.frames, row))
        xy = xy.reshape(-1, 2)
        # Beyond the image a lens model may turn back.
        if (np.abs(seen[:, :2]) > 0.75 * seen[:, 2:]).any() or (xy < 0).any() or (xy > SIZE).any():
            continue
        rows += [row] * len(xy)
        corner += range(len(xy))
        pixels.append(xy + rng.normal(0, 0.2, xy.shape))
    assert len(pixels) >= min(frames, 3)
    return RulerDetections(
        of,
        nominal,
        held_out_corners(of, nominal, np.array(corner)),
        np.array(rows),
        np.array(corner),
        np.concatenate(pixels),
    )


def read(scene: Scene, *sightings: RulerDetections) -> list[RulerMeasurement]:
    return measure_rulers(sightings, scene.frames, scene.images)


def aligned_by(scene: Scene, *sightings: RulerDetections) -> tuple[AlignResult, pd.DataFrame]:
    readings = read(scene, *sightings)
    aligned = align(scene.inputs(rulers=readings), AlignSettings())
    return aligned, aligned.checks[aligned.checks["check"] == "ruler_scale"].reset_index(drop=True)


def stretch_vio(scene: Scene, factor: float) -> None:
    poses = poses_of(scene.frames, "vio_cam")
    poses[:, :3, 3] *= factor
    scene.set_vio(poses)


def scale_error(scene: Scene, aligned: AlignResult) -> float:
    """The map's scale against the truth."""
    path, true = aligned.map_T_cam[:60, :3, 3], scene.true_T_cam[:60, :3, 3]
    return float(
        np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / np.linalg.norm(np.diff(true, axis=0), axis=1).sum() - 1
    )


@pytest.mark.parametrize(
    ("stretched", "printed", "mirror", "sets", "status", "words"),
    [
        (1.0, 1.0, False, False, "passed", ""),
        (1.05, 1.0, False, False, "failed", r"its squares measure 21.* 200 mm stated \(\+[45]\."),
        (1.0, 0.9, False, True, "failed", "its squares measure 180.* 200 mm stated"),
        (1.0, 1.0, True, True, "failed", "mirrored"),
    ],
    ids=["right", "VIO's scale", "another size", "mirrored"],
)
def test_a_board_judges_the_scale_and_a_wrong_one_sets_none(
    scene: Scene, stretched: float, printed: float, mirror: bool, sets: bool, status: str, words: str
) -> None:
    stretch_vio(scene, stretched)
    aligned, checks = aligned_by(scene, sighted(scene, ruler(use_for_scale=sets), printed=printed, mirror=mirror))
    (check,) = checks.to_dict("records")
    assert check["status"] == status and re.search(words, check["reason"]) and check["limit"] == 0.03
    assert check["cause"] == ("ruler and map inconsistent" if status == "failed" else None)
    assert set(aligned.ground_truth["scale_source"]) == {"vio"}
    assert scale_error(scene, aligned) == pytest.approx(stretched - 1, abs=0.01)


def test_a_board_sets_the_scale_and_half_of_it_judges(scene: Scene) -> None:
    stretch_vio(scene, 1.015)
    plain, _ = aligned_by(scene)
    assert scale_error(scene, plain) == pytest.approx(0.015, abs=0.004)
    sighting = sighted(scene, ruler(use_for_scale=True))
    aligned, checks = aligned_by(scene, sighting)
    assert abs(scale_error(scene, aligned)) < 0.003
    assert checks["status"].tolist() == ["passed"]
    assert set(aligned.ground_truth["scale_source"]) == {"ruler: charuco"}
    assert aligned.main.component.scale.sd < 0.004
    assert sighting.held_out.sum() == 35
    table = rulers_table(checked_rulers(scene, read(scene, sighting), AlignSettings())[1])
    assert table["part"].tolist() == ["all", "for_scale", "held_out"] and table["used_for_scale"].all()
    assert (table["corner_rms_mm"] < 10).all() and (table["reprojection_px"] < 0.5).all()
    np.testing.assert_allclose(table["scale_error_percent"], 0, atol=0.3)


def examined(scene: Scene, readings: list[RulerMeasurement], **settings: Any) -> RulerCheck:
    (check,) = checked_rulers(scene, readings, AlignSettings(**settings))[1]
    return check


def checked_rulers(
    scene: Scene, readings: list[RulerMeasurement], settings: AlignSettings, reference: Reference | None = None
) -> tuple[CheckedMap, list[RulerCheck]]:
    checked = check_models(scene.inputs(rulers=readings, reference=reference), settings)
    return checked, check_rulers(checked.components, readings, settings.max_ruler_size_error)


@pytest.mark.parametrize(
    ("printed", "expected"),
    [
        (0.92, [(False, "failed"), (False, "undecided"), (True, "passed")]),
        # Certainly within the limit, perhaps beyond it, and within what VIO knows.
        (0.98, [(True, "passed"), (False, "undecided"), (True, "passed")]),
    ],
)
def test_a_wider_sigma_of_vio_never_lets_a_print_of_another_size_set_the_scale_without_a_word(
    scene: Scene, printed: float, expected: list[tuple[bool, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    readings = read(scene, sighted(scene, ruler(use_for_scale=True), printed=printed))
    outcomes = []
    for phone_scale_sd in (0.002, 0.01, 0.05, 0.08, 0.2):
        monkeypatch.setattr("groundwalk.alignment.map_frame._PHONE_SCALE_SD", phone_scale_sd)
        check = examined(scene, readings)
        reason = check.result.reason
        outcomes.append((check.sets_scale, str(check.result.status)))
        assert reason in describe(check) and (rulers_table([check])["reason"] == reason).all()
        if not check.sets_scale:
            assert "doesn't set the scale" in reason
        elif reason or printed == 0.92:
            (largest,) = re.findall(r"can't tell a stated size that is wrong by up to ([\d.]+)%", reason)
            assert float(largest) / 100 > max(1 - printed, 0.03)
        else:
            assert phone_scale_sd == 0.002
    assert [a for a, b in zip(outcomes, [None, *outcomes], strict=False) if a != b] == expected


def test_the_setting_that_is_advised_lets_a_print_that_differs_set_the_scale(walks: Walks) -> None:
    """The print is 8 % too small, VIO's scale of a walk of 2.3 m known to ± 4.9 %."""
    noise = {"sfm_m": 0.001, "sfm_deg": 0.05, "drift_m": 0.01, "jitter_m": 0.001}
    short = with_cameras(walks.make(sessions=1, speed_m=2.3 / 60, **noise))
    readings = read(short, sighted(short, ruler(use_for_scale=True), printed=0.92))
    check = examined(short, readings)
    assert not check.sets_scale and check.result.status == "undecided"
    assert "its squares measure 18" in check.result.reason and "200 mm stated (-7." in check.result.reason
    assert "raise [align] max_ruler_size_error in data/scenes/<scene>.toml" in check.result.advice
    (enough,) = map(float, re.findall(r"\[align\] max_ruler_size_error = ([\d.]+)", check.result.reason))
    insisted = examined(short, readings, max_ruler_size_error=enough)
    assert insisted.sets_scale and insisted.result.status == "passed"
    assert not examined(short, readings, max_ruler_size_error=enough - 0.011).sets_scale


def test_a_board_stands_in_where_vio_moves_too_little_for_a_scale(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    # VIO that may be off by so much tells no scale.
    monkeypatch.setattr("groundwalk.consistency.scale.STEP_SCALE_SD", 1e3)
    plain, _ = aligned_by(scene, sighted(scene, ruler()))
    assert set(plain.ground_truth["scale_source"]) == {"none"}
    aligned, checks = aligned_by(scene, sighted(scene, ruler(use_for_scale=True)))
    assert abs(scale_error(scene, aligned)) < 0.003
    assert set(aligned.ground_truth["scale_source"]) == {"ruler: charuco"}
    assert aligned.sessions["scale"].isna().all()
    (row,) = checks.to_dict("records")
    assert row["status"] == "passed" and "nothing tells a stated size that is wrong" in row["reason"]


def test_a_board_seen_once_is_undecided(scene: Scene) -> None:
    sighting = sighted(scene, ruler(use_for_scale=True))
    first = sighting.row == sighting.row[0]
    once = replace(sighting, row=sighting.row[first], corner=sighting.corner[first], xy_px=sighting.xy_px[first])
    aligned, checks = aligned_by(scene, once)
    assert checks["status"].tolist() == ["undecided"]
    assert "seen in 1 frame (walk0/" in checks["reason"].iloc[0]
    assert set(aligned.ground_truth["scale_source"]) == {"vio"}


def test_views_from_nearly_one_place_are_undecided(scene: Scene, walks: Walks) -> None:
    # The camera of the walk's middle, moved by half a centimetre from frame to frame.
    for row in range(60):
        scene.true_T_cam[row] = scene.true_T_cam[20] @ make_pose(np.eye(3), [0.005 * (row - 20), 0.0, 0.0])
    scene.set_sfm(walks.gauge.poses(scene.true_T_cam))
    (reading,) = read(scene, sighted(scene, ruler()))
    assert "degrees apart" in reading.problem


def test_two_rulers_that_disagree_are_both_named(scene: Scene) -> None:
    other = ruler(name="small", dictionary="DICT_5X5_250", use_for_scale=True)
    aligned, checks = aligned_by(
        scene, sighted(scene, ruler(use_for_scale=True)), sighted(scene, other, printed=0.98, near=80)
    )
    assert checks["status"].tolist() == ["failed", "failed"]
    for reason, name in zip(checks["reason"], ("small", "charuco"), strict=True):
        assert f"inconsistent with ruler {name}" in reason and "mm stated" in reason and "%" in reason
    assert set(aligned.ground_truth["scale_source"]) == {"vio"}


def by_reference(scene: Scene, *, metric: bool) -> Reference:
    scene.frames = without_vio(scene.frames)
    return Reference(scene.true_T_cam, is_metric=metric, is_up_known=True, gives_map=True)


def test_a_board_says_nothing_of_a_reference_without_unit(scene: Scene) -> None:
    _, (check,) = checked_rulers(
        scene, read(scene, sighted(scene, ruler())), AlignSettings(), by_reference(scene, metric=False)
    )
    assert check.result.status == "undecided" and "the reference's unknown unit" in check.result.reason


@pytest.mark.parametrize("printed", [1.0, 0.9])
def test_a_board_judges_the_scale_of_a_reference_and_never_sets_it(scene: Scene, printed: float) -> None:
    reference = by_reference(scene, metric=True)
    readings = read(scene, sighted(scene, ruler(use_for_scale=True), printed=printed))
    found, (judged,) = checked_rulers(scene, readings, AlignSettings(), reference)
    assert judged.result.status == ("passed" if printed == 1.0 else "failed") and not judged.sets_scale
    assert found.components[0].scale.source == "reference"
    text = describe(judged)
    assert "the map's scale is the reference's; map's scale " in text and "not used for scale" in text
    assert ("in the map scaled by the reference its squares measure 18" in text) == (printed != 1.0)
    assert len(rulers_table([judged])) == 3


@pytest.mark.parametrize("first_row", ["top", "left"])
def test_a_rolling_shutter_is_undone_in_corners(scene: Scene, first_row: str) -> None:
    """Each corner is seen from where the camera was at its row's time, some of them 10 px off."""
    rng = np.random.default_rng(4)
    readout_s, motion = 0.02, rng.normal(0, 0.4, (len(scene.frames), 6))
    still = sighted(scene, ruler())
    xyz = transform(scene.true_T_cam[20] @ make_pose(np.eye(3), [0.0, 0.0, 5.0]), still.corners.xyz_m)
    (line,) = readout_lines([first_row], *SIZE)
    pixels = still.xy_px.copy()
    for i, (row, corner) in enumerate(zip(still.row, still.corner, strict=True)):
        for _ in range(4):
            turn, velocity = motion[row, :3], motion[row, 3:]
            tau = readout_s * readout_fraction(line, pixels[i][None])[0]
            row_T_cam = inverse(make_pose(Rotation.from_rotvec(turn * tau).as_matrix(), velocity * tau))
            in_row = transform(row_T_cam @ inverse(scene.true_T_cam[row]), xyz[corner])
            camera = opencv_camera(scene.frames, row)
            seen: np.ndarray = cv2.projectPoints(in_row[None], np.zeros(3), np.zeros(3), *camera)[0]
            pixels[i] = seen.ravel()
    pixels += rng.normal(0, 0.2, pixels.shape)
    scene.frames["first_row"] = first_row
    scene_at_rest = replace(scene)
    (ignored,) = read(scene, replace(still, xy_px=pixels))
    # Velocities are in the model's units.
    step, true_step = (
        np.linalg.norm(p[1, :3, 3] - p[0, :3, 3]) for p in (poses_of(scene.images, "sfm_cam"), scene.true_T_cam)
    )
    motion[:, 3:] *= step / true_step
    columns = [f"{name}_{axis}" for name in ("angular", "velocity") for axis in "xyz"]
    scene.images = scene.images.assign(readout_s=readout_s, **dict(zip(columns, motion.T, strict=True)))
    (undone,) = read(scene, replace(still, xy_px=pixels))
    (reference,) = read(scene_at_rest, still)
    fits = [reading.fits[RulerPart.ALL] for reading in (reference, undone, ignored)]
    residual_px = [np.nanmedian(np.linalg.norm(fit.residual_px, axis=1)) for fit in fits]
    assert residual_px[1] < 1.2 * residual_px[0] and residual_px[2] > 3 * residual_px[0]
    assert abs(fits[1].log_scale - fits[0].log_scale) < 0.002


# ------------------------------------------------------------------ images


def drawn(of: CharucoRuler, size: tuple[int, int] = (640, 480)) -> tuple[np.ndarray, Array]:
    """An image of the board in perspective, and where its inner corners are, the first pixel's centre at 0.5."""
    pixels = 60
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, of.dictionary))
    board = cv2.aruco.CharucoBoard((of.squares_x, of.squares_y), of.square_mm, of.marker_mm, dictionary)
    width, height = pixels * of.squares_x, pixels * of.squares_y
    flat = board.generateImage((width, height))
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=np.float32)
    target = np.array([[90, 80], [560, 110], [520, 420], [120, 380]], dtype=np.float32)
    homography = cv2.getPerspectiveTransform(corners, target)
    # warpPerspective counts from the first pixel's centre; sampled finely, then averaged as a sensor does.
    half, fine = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]]), np.diag([4.0, 4.0, 1.0])
    turned = np.linalg.inv(half) @ fine @ homography @ half
    image = cv2.warpPerspective(flat, turned, (4 * size[0], 4 * size[1]), borderValue=255)
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    inner = pixels * nominal_corners(of).xyz_m[:, :2] / (1e-3 * of.square_mm)
    return cv2.GaussianBlur(image, (0, 0), 0.8), cv2.perspectiveTransform(inner[None], homography)[0]


def test_corners_are_detected_where_they_are_drawn() -> None:
    of = ruler(squares_x=7, squares_y=5, dictionary="DICT_4X4_50")
    image, truth = drawn(of)
    found = detect(of, image)
    assert sorted(found.corner) == list(range(24))
    error = found.xy - truth[found.corner]
    assert np.abs(error.mean(axis=0)).max() < 0.02, "pixel convention"
    assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 0.06


def test_tags_are_detected_and_an_id_seen_twice_is_not() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    image = np.full((480, 640), 255, dtype=np.uint8)
    for tag, (x, y) in ((3, (50, 60)), (7, (250, 60)), (7, (450, 60)), (11, (250, 280))):
        image[y : y + 120, x : x + 120] = cv2.aruco.generateImageMarker(dictionary, tag, 120)
    (tags,) = rulers_of([{"kind": "apriltag", "tag_mm": 100, "ids": [3, 7]}])
    assert isinstance(tags, AprilTagRuler)
    found = detect(tags, image)
    assert found.corner.tolist() == [12, 13, 14, 15]
    np.testing.assert_allclose(found.xy, [[50, 60], [170, 60], [170, 180], [50, 180]], atol=0.6)


@pytest.mark.parametrize(
    ("flip", "changes", "words"),
    [
        (True, {}, "mirrored"),
        (False, {"squares_x": 5, "squares_y": 7}, "squares_x = 7, squares_y = 5"),
        (False, {"squares_x": 9}, "count the squares"),
        (False, {"dictionary": "DICT_6X6_250"}, "markers of DICT_4X4_50"),
    ],
)
def test_why_a_board_isnt_detected(flip: bool, changes: dict, words: str, tmp_path: Path) -> None:
    printed = {"squares_x": 7, "squares_y": 5, "dictionary": "DICT_4X4_50"}
    image, _ = drawn(ruler(**printed))
    path = tmp_path / "0.png"
    cv2.imwrite(str(path), image[:, ::-1] if flip else image)
    frames = pd.DataFrame({"image": ["0.png"]})
    (sighting,) = find_rulers([ruler(**{**printed, **changes})], frames, lambda image: tmp_path / image)
    assert words in sighting.absence and not len(sighting.row)


def test_a_real_board_is_detected(shared_captures: Path) -> None:
    """calib.io's 8x11 board: every corner in three images of each of two sessions, in the plane to a pixel or so."""
    paths = [
        path
        for folder in sorted((shared_captures / "charuco").iterdir())
        for path in sorted(folder.glob("frame_*.jpg"))[:3]
    ]
    board = ruler(square_mm=22, marker_mm=17, legacy=True)
    frames = pd.DataFrame({"image": [str(path) for path in paths]})
    (sighting,) = find_rulers([board], frames, Path)
    nominal = nominal_corners(board).xyz_m[:, :2]
    assert len(paths) == 6
    for row in range(len(paths)):
        own = sighting.row == row
        assert own.sum() >= 60
        at, xy = nominal[sighting.corner[own]], sighting.xy_px[own]
        homography, _ = cv2.findHomography(at, xy)
        error = cv2.perspectiveTransform(at[None], homography)[0] - xy
        assert np.sqrt(np.mean(np.sum(error**2, axis=1))) < 1.5


# ------------------------------------------------------------------ settings

DISTANCE: dict[str, Any] = {
    "kind": "distance",
    "length_m": 1.253,
    "points": [
        {"name": name, "observations": [{"frame": f"walk0/{i:06d}", "xy": [10.0, 20.0]} for i in range(2)]}
        for name in ("left", "right")
    ],
}


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ([{"kind": "yardstick"}], ("'yardstick'", "charuco, apriltag, distance", "number 1")),
        ([{}], ("needs a kind",)),
        ([{"kind": "charuco", "square_cm": 2}], ("'square_cm'", "square_mm", "number 1")),
        ([{k: v for k, v in BOARD.items() if k != "square_mm"}], ("square_mm", "required")),
        ([{**BOARD, "marker_mm": 220}], ("marker_mm 220 must be less than square_mm 200",)),
        ([{**BOARD, "dictionary": "DICT_7X8"}], ("DICT_6X6_250",)),
        ([{**BOARD, "dictionary": "DICT_6X6_50", "squares_x": 14}], ("need 56 markers, DICT_6X6_50 has 50",)),
        ([BOARD, {**BOARD, "square_mm": 210}], ("two rulers are named 'charuco'", "number 2")),
        ([BOARD, {**BOARD, "name": "b", "dictionary": "DICT_6X6_50"}], ("'charuco' and 'b'", "another dictionary")),
        ([{"kind": "apriltag", "tag_mm": 80, "ids": [600]}], ("id 600", "0 to 586")),
        ([{**DISTANCE, "points": DISTANCE["points"][:1]}], ("points",)),
        ([{**DISTANCE, "length_m": -1}], ("length_m", "greater than 0")),
        ({"kind": "charuco"}, ("list of tables", "[[ruler]]")),
    ],
)
def test_what_is_wrong_with_a_ruler_is_said(tables: Any, words: tuple[str, ...]) -> None:
    with pytest.raises(UserError) as error:
        rulers_of(tables)
    for word in words:
        assert word in str(error.value)


def test_rulers_come_from_the_scenes_file_and_concern_align_alone(tmp_path: Path) -> None:
    data = DataRoot(tmp_path)
    (tmp_path / "scenes").mkdir()
    path = tmp_path / "scenes" / "Place.toml"
    seen = 'observations = [{frame = "w/000001", xy = [1, 2]}, {frame = "w/000002", xy = [3, 4.5]}]'
    points = "".join(f'[[ruler.points]]\nname = "{name}"\n{seen}\n' for name in "ab")
    tags, distance = '[[ruler]]\nkind = "apriltag"\ntag_mm = 80\n', '[[ruler]]\nkind = "distance"\nlength_m = 2\n'
    path.write_text(tags + distance + points)
    settings = resolve_settings(AlignSettings, "align", data, "tiny", "Place", [])
    assert [r.name for r in settings.rulers] == ["apriltag", "distance"]
    assert AlignSettings.model_validate(settings.model_dump(mode="json")) == settings
    assert "ruler" not in data.scene("Place")[0].model_dump_json()
    path.write_text('[ruler]\nkind = "apriltag"\ntag_mm = 80\n')
    with pytest.raises(UserError, match="list of tables"):
        data.scene("Place")


def test_a_distances_pixels_lie_in_the_image_of_a_frame_that_is_there(scene: Scene) -> None:
    (distance,) = rulers_of([DISTANCE])
    with pytest.raises(UserError, match="point 'left'"):
        find_rulers([distance], scene.frames.assign(frame_id=scene.frames["frame_id"] + "x"), Path)
    point, xy = DISTANCE["points"][1], [1921.0, 20.0]
    moved = {**point, "observations": [point["observations"][0], {"frame": "walk0/000001", "xy": xy}]}
    (outside,) = rulers_of([{**DISTANCE, "points": [DISTANCE["points"][0], moved]}])
    frames = scene.frames.assign(width=SIZE[0], height=SIZE[1])
    find_rulers([distance], frames, Path)
    with pytest.raises(UserError, match=r"(?s)'right' is outside of its image.*walk0/000001.*1920, 1440"):
        find_rulers([outside], frames, Path)


# ------------------------------------------------------------------ stage


def test_the_stage_with_a_distance_that_sets_the_scale(data: DataRoot, walks: Walks) -> None:
    """Two points 3 m apart, read off in five frames; the map is then as large as they say."""
    truth = read_table(data.captures("Place") / "true_poses.parquet", schema("simulate", "true_poses"))
    true_T_cam = poses_of(truth, "map_cam")[:20]
    image = data.captures("Place") / "grey.png"
    cv2.imwrite(str(image), np.full((144, 192), 128, dtype=np.uint8))
    frames = table_of(data, "Place", "import", "frames").assign(image=image.name, image_sha256=sha256_of(image))
    frames = frames.assign(distortion=cells([[]] * 40))
    put(data, "Place", "import", "frames", frames)
    ends = transform(true_T_cam[8], np.array([[-1.5, 0.0, 8.0], [1.5, 0.0, 8.0]]))
    points = []
    for name, end in zip(("left", "right"), ends, strict=True):
        seen = []
        for row in range(5, 10):
            x, y, z = transform(inverse(true_T_cam[row]), end)
            seen.append(f'{{frame = "{frames["frame_id"][row]}", xy = [{1400 * x / z + 960}, {1400 * y / z + 720}]}}')
        points.append(f'[[ruler.points]]\nname = "{name}"\nobservations = [{", ".join(seen)}]\n')
    (data.root / "scenes").mkdir()
    (data.root / "scenes" / "Place.toml").write_text(
        '[[ruler]]\nname = "wall"\nkind = "distance"\nlength_m = 3.0\nuse_for_scale = true\n' + "".join(points)
    )
    figures = load_manifest(execute(STAGE, "Place", "tiny", data))["figures"]
    assert figures["scale_source"] == "ruler: wall"
    assert figures["checks_undecided"] == 1 and figures["checks_failed"] == 0
    table, gt = (table_of(data, "Place", "align", name) for name in ("rulers", "ground_truth"))
    assert table["used_for_scale"].all() and table["status"].eq("undecided").all()
    assert "no corners are left" in table["reason"].iloc[0]
    assert set(gt["scale_source"]) == {"ruler: wall"}
    path, true = poses_of(gt, "map_cam")[:20, :3, 3], true_T_cam[:, :3, 3]
    ratio = np.linalg.norm(path[-1] - path[0]) / np.linalg.norm(true[-1] - true[0])
    assert ratio == pytest.approx(1, abs=0.01)
