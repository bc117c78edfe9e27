"""Control points from files to a check: within their bounds where all is right, and named where a survey is wrong."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.check_models import CheckedMap, check_models
from groundwalk.alignment.components import NO_SCALE, NOT_GIVEN, GivenFrame, PlacedComponent
from groundwalk.alignment.control.check import ControlCheck, check_control, describe
from groundwalk.alignment.control.points import ControlPoints, find_points
from groundwalk.alignment.control.tables import control_table, draw_control, points_table
from groundwalk.alignment.definition import STAGE
from groundwalk.alignment.georeference import of_surveys
from groundwalk.alignment.given_frame import by_surveys
from groundwalk.alignment.settings import AlignSettings, controls_of
from groundwalk.geometry.earth import geodetic_of
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.schemas import schema
from groundwalk.store.tables import camera_of, poses_of, read_table
from tests.known import cells, rewrite, table_of, there, without_vio
from tests.known import rows as records
from tests.synthetic_walks import Scene, Walks

SD_M = 0.003
FEET = 1 / 0.3048
NAMES = [f"P{number:02d}" for number in range(12)]
# The survey's axes: east, north, up.
ENU_R_MAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


def made(walks: Walks, seed: int, **changes: Any) -> tuple[Scene, Array]:
    """Two walks whose poses are as uncertain as stated, and twelve points (12, 3) around them in the true map."""
    scene = walks.make(
        seed=seed, sessions=2, frames=25, speed_m=0.25, sfm_m=0.002, sfm_deg=0.02, phone_scale=0.003, **changes
    )
    scene.frames = scene.frames.assign(fy=1400.0, cx=960.0, cy=720.0, distortion=cells([[]] * len(scene.frames)))
    rng = np.random.default_rng(seed)
    ahead = scene.true_T_cam[rng.choice(len(scene.frames), 12, replace=False)]
    return scene, transform(ahead, np.column_stack([rng.uniform(-0.7, 0.7, (12, 2)), rng.uniform(1.5, 3, 12)]))


def observed(scene: Scene, xyz: Array, seed: int) -> pd.DataFrame:
    """Pixels of the points in all frames that see them within 15 m, read off to half a pixel."""
    rng, rows = np.random.default_rng(seed), []
    for row, pose in enumerate(scene.true_T_cam):
        seen = transform(inverse(pose), xyz)
        xy = camera_of(scene.frames.iloc[row]).project(seen[:, :2] / seen[:, 2:]) + rng.normal(0, 0.5, (len(xyz), 2))
        inside = (seen[:, 2] > 1) & (seen[:, 2] < 15) & (xy > 0).all(axis=1) & (xy < [1920, 1440]).all(axis=1)
        rows += [(scene.frames["frame_id"].iloc[row], NAMES[k], *xy[k]) for k in np.flatnonzero(inside)]
    return pd.DataFrame(rows, columns=["frame", "point", "x_px", "y_px"])


def judged(
    scene: Scene,
    xyz: Array,
    folder: Path,
    change: Callable[[Array], Array] = lambda enu: enu,
    *,
    seed: int = 0,
    metric: bool = True,
    ruler_sd: float | None = None,
) -> ControlCheck:
    """The check of a survey of the points, with errors of 3 mm, that `change` spoils; in a map whose scale, where
    `ruler_sd` is given, is off by as much, as by a printed board."""
    enu = xyz @ ENU_R_MAP.T + [500000.0, 4649776.0, 120.0] + np.random.default_rng(seed + 99).normal(0, SD_M, xyz.shape)
    survey = pd.DataFrame(change(enu), columns=["x_m", "y_m", "z_m"]).assign(point=NAMES)
    survey.to_csv(folder / "survey.csv", index=False)
    observed(scene, xyz, seed).to_csv(folder / "seen.csv", index=False)
    checked = check_models(scene.inputs(), AlignSettings())
    placed = checked.placed
    if not metric:
        component = replace(placed[0].component, scale=NO_SCALE)
        placed = [PlacedComponent(component, component.metric_S_sfm)]
    if ruler_sd is not None:
        scale = replace(placed[0].component.scale, sd=ruler_sd)
        log = -np.log(0.37) + ruler_sd * np.random.default_rng(seed + 7).normal()
        component = replace(placed[0].component, scale=replace(scale, log=float(log)))
        placed = [PlacedComponent(component, component.metric_S_sfm)]
    return checked_in(scene, replace(checked, placed=placed), points_of(scene, folder))


def points_of(scene: Scene, folder: Path, **changes: Any) -> ControlPoints:
    """The points of a survey in the folder's files."""
    table = {"points": "survey.csv", "images": "seen.csv", "sd_m": SD_M, "pixel_sd": 0.5}
    (settings,) = controls_of([table | changes])
    return find_points(settings, scene.frames, folder, Path)


def checked_in(scene: Scene, checked: CheckedMap, points: ControlPoints) -> ControlCheck:
    return check_control(points, scene.frames, scene.images, checked.placed, checked.frames.has_ground_truth)


@pytest.fixture(scope="module")
def place(walks: Walks) -> tuple[Scene, Array]:
    return made(walks, 1)


@pytest.mark.parametrize("metric", [True, False])
def test_points_that_agree_pass(metric: bool, place: tuple[Scene, Array], tmp_path: Path) -> None:
    check = judged(*place, tmp_path, metric=metric)
    (row,) = records(control_table([check]))
    assert row.status == "passed" and row.used == row.held_out == 12 and row.rms_m < 0.015
    assert row.fit == ("se3" if metric else "sim3")
    assert abs(row.map_scale - (1 if metric else np.exp(-np.log(0.37)))) < 0.01
    assert row.tilt_deg < 0.2 and "tilt" in describe(check)
    table = points_table([check])
    assert table["point"].tolist() == NAMES and table["reason"].eq("").all()
    draw_control(tmp_path / "control.png", [check], place[0].true_T_cam[:, :3, 3])
    assert (tmp_path / "control.png").stat().st_size > 10_000


def test_simulated_surveys_are_within_5_mm_and_within_their_bounds(walks: Walks, tmp_path: Path) -> None:
    """Twelve points of 3 mm an axis in each of ten maps, whose scale a print sets that is off by 0.02 %, one sigma."""
    within, off = [], []
    for seed in range(10):
        scene, xyz = made(walks, seed)
        check = judged(scene, xyz, tmp_path, seed=seed, ruler_sd=2e-4)
        assert check.fit is not None and check.used.all() and check.result.status != "failed"
        within += check.within_bounds.tolist()
        truth = xyz @ ENU_R_MAP.T + [500000.0, 4649776.0, 120.0]
        off.append(check.fit.survey_S_map.points(check.mapped.xyz) - truth)
    rms_m = np.median(np.sqrt(np.mean(np.sum(np.square(off), axis=2), axis=1)))
    assert rms_m < 0.005 and 0.85 <= np.mean(within) <= 0.99, (rms_m, np.mean(within))


def test_a_survey_in_wgs84_places_the_map_on_earth(place: tuple[Scene, Array], tmp_path: Path) -> None:
    """As the same points in metres do with an origin; a survey in local axes doesn't."""
    origin = (46.5191, 6.5668, 410.0)
    check = judged(*place, tmp_path)
    survey = pd.read_csv(tmp_path / "survey.csv")
    local = survey[["x_m", "y_m", "z_m"]].to_numpy() - survey[["x_m", "y_m", "z_m"]].to_numpy().mean(axis=0)
    earth = pd.DataFrame(geodetic_of(origin, local), columns=["latitude_deg", "longitude_deg", "altitude_m"])
    earth.assign(point=NAMES).to_csv(tmp_path / "survey.csv", index=False)
    pd.DataFrame(local, columns=["x_m", "y_m", "z_m"]).assign(point=NAMES).to_csv(tmp_path / "local.csv")
    checked = check_models(place[0].inputs(), AlignSettings())
    found = []
    for changes in ({}, {"points": "local.csv", "origin": list(origin)}):
        again = checked_in(place[0], checked, points_of(place[0], tmp_path, **changes))
        placed = there(of_surveys([check, again], checked.placed))
        assert placed.used == 12 and placed.rms_m < 0.02 and not placed.gives_scale
        found.append(placed.places(again.mapped.xyz)[2])
    assert of_surveys([check], checked.placed) is None
    placed.write(tmp_path / "georeference.json")
    assert "as the survey states it" in (tmp_path / "georeference.json").read_text()
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    np.testing.assert_allclose(found[0], earth, atol=0.03)
    np.testing.assert_allclose(found[0][:, :2], earth.iloc[:, :2], atol=3e-7)


def test_cameras_away_from_the_survey_are_as_far_off_on_earth_as_stated(walks: Walks, tmp_path: Path) -> None:
    """In maps that are 0.2 % too large, one sigma, the scale takes them away."""
    inside = []
    for seed in range(6):
        scene, xyz = made(walks, seed)
        survey = pd.DataFrame(xyz @ ENU_R_MAP.T, columns=["x_m", "y_m", "z_m"]).assign(point=NAMES)
        survey.to_csv(tmp_path / "survey.csv", index=False)
        observed(scene, xyz, seed).to_csv(tmp_path / "seen.csv", index=False)
        checked = check_models(scene.inputs(), AlignSettings())
        component = checked.placed[0].component
        scale = replace(component.scale, sd=0.002, log=0.002 - float(np.log(walks.gauge.scale)))
        component = replace(component, scale=scale)
        placed = [PlacedComponent(component, component.metric_S_sfm)]
        points = points_of(scene, tmp_path, origin=(46.5, 6.5, 400.0))
        found = of_surveys([checked_in(scene, replace(checked, placed=placed), points)], placed)
        assert found is not None and found.enu_S_map.scale == 1
        away = scene.true_T_cam[:, :3, 3] + [20.0, 0.0, 0.0]
        enu, sd, _ = found.places(component.metric_S_sfm.points(walks.gauge.points(away)))
        inside.append(np.abs(enu - away @ ENU_R_MAP.T) <= 1.96 * sd)
    assert np.mean(inside) >= 0.85, np.mean(inside)


def test_a_survey_gives_a_map_of_images_alone_scale_and_vertical(place: tuple[Scene, Array], tmp_path: Path) -> None:
    """And half of its points, by a fit of the others with a scale of their own, judge it."""
    judged(*place, tmp_path)
    scene = replace(place[0], frames=without_vio(place[0].frames))
    points = points_of(scene, tmp_path)

    def checked_by(given: GivenFrame) -> tuple[ControlCheck, PlacedComponent]:
        checked = check_models(scene.inputs(given=given), AlignSettings())
        return checked_in(scene, checked, points), checked.placed[0]

    check, placed = checked_by(NOT_GIVEN)
    assert placed.component.scale.source == "none" and placed.component.vertical.source == "none"
    again, metric = checked_by(by_surveys([check], placed))
    component = metric.component
    assert component.scale.source == "control: control" and component.vertical.source == "control points"
    assert abs(component.scale.log + np.log(0.37)) < 4 * component.scale.sd < 0.01
    up = fit_sim3(place[0].true_T_cam[:, :3, 3], poses_of(scene.images, "sfm_cam")[:, :3, 3]).rotation[1]
    assert np.arccos(component.vertical.up_sfm @ up) < 4 * component.vertical.sd < np.radians(1)
    assert again.sets_scale and again.used.all() and again.held_out.all() and again.result.status == "passed"
    assert "sets the map's scale ±" in describe(again) and "tilt" not in describe(again)
    np.testing.assert_allclose(again.error_m, check.error_m, atol=1e-6)


def test_points_that_the_map_knows_less_well_than_the_limit_are_told(
    place: tuple[Scene, Array], tmp_path: Path
) -> None:
    judged(*place, tmp_path)
    checked = check_models(place[0].inputs(), AlignSettings())
    check = checked_in(place[0], checked, points_of(place[0], tmp_path, max_error_m=1e-3))
    assert check.result.status == "undecided" and "0 of 12 points are seen well enough" in check.result.reason
    assert points_table([check])["reason"].str.contains("worse than the limit").all()


def one_wrong(enu: Array) -> Array:
    enu[4, 1] += 1.0
    return enu


def exchanged(enu: Array) -> Array:
    enu[[3, 7]] = enu[[7, 3]]
    return enu


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda enu: enu[:, [1, 0, 2]], "mirrored"),
        (lambda enu: enu @ Rotation.from_euler("x", 20, degrees=True).as_matrix(), r"up isn't the map's \(tilt 20°\)"),
        (lambda enu: FEET * enu, "they are in feet, metres are expected"),
        (lambda enu: 1000 * enu, "they are in millimetres, metres are expected"),
        (lambda enu: 100 * enu, "they are in centimetres, metres are expected"),
        (exchanged, "P03 and P07 are exchanged"),
        (one_wrong, r"P04 is (0\.99|1\.0)\d* m from where the images have it"),
    ],
    ids=["mirrored", "tilted", "feet", "millimetres", "centimetres", "exchanged", "metre"],
)
def test_a_wrong_survey_is_named(change: Callable[[Array], Array], reason: str, walks: Walks, tmp_path: Path) -> None:
    check = judged(*made(walks, 1), tmp_path, change)
    assert check.result.status == "failed" and re.search(reason, check.result.reason)


def test_a_tag_that_is_there_twice_is_named(place: tuple[Scene, Array], tmp_path: Path) -> None:
    """Tags 1 to 4 in every image, tag 2 twice: it isn't used, and the reason says why."""
    scene, dictionary = place[0], cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    image = np.full((480, 640), 255, np.uint8)
    for tag, left in zip((1, 2, 3, 4, 2), range(20, 600, 120), strict=True):
        image[100:180, left : left + 80] = cv2.aruco.generateImageMarker(dictionary, tag, 80)
    cv2.imwrite(str(tmp_path / "tags.png"), image)
    (tmp_path / "survey.csv").write_text("point,x_m,y_m,z_m\n1,0,0,0\n2,1,0,0\n3.1,0,1,0\n")
    (settings,) = controls_of([{"points": "survey.csv", "dictionary": "DICT_APRILTAG_36h11"}])
    frames = scene.frames.iloc[:2].assign(image="tags.png")
    points = find_points(settings, frames, tmp_path, lambda image: tmp_path / image)
    assert points.remarks.keys() == {1} and "tag 2 is there twice in 2 images" in points.remarks[1]
    assert points.point.tolist() == [0, 0, 2, 2]
    middle, corner = points.xy_px[0], points.xy_px[2]
    assert np.allclose(middle, [60, 140], atol=0.6) and np.allclose(corner, [340, 100], atol=0.6)


def test_a_corner_that_a_spreadsheet_made_a_tags_middle_is_refused(place: tuple[Scene, Array], tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text("point,x_m,y_m,z_m\n17,0,0,0\n17.1,1,0,0\n17.2,1,1,0\n")
    (settings,) = controls_of([{"points": "survey.csv", "dictionary": "DICT_APRILTAG_36h11"}])
    with pytest.raises(UserError, match=r"no corner 17\.0"):
        find_points(settings, place[0].frames.iloc[:0], tmp_path, lambda image: tmp_path / image)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("point,x_m,y_m,z_m\na,1.5,-2,0.25\n", "utf-8-sig"),
        ("point;x_m;y_m;z_m\r\na;1,5;-2;0,25\r\n", "utf-8"),
        ("point;x_m;y_m;z_m\na;1.5;-2;0.25\n", "utf-16"),
        ("point\tx_m\ty_m\tz_m\na\t1,5\t-2,0\t0,25\n", "utf-8"),
    ],
)
def test_tables_are_read_as_spreadsheets_write_them(
    text: str, encoding: str, place: tuple[Scene, Array], tmp_path: Path
) -> None:
    (tmp_path / "survey.csv").write_bytes(text.encode(encoding))
    (tmp_path / "seen.csv").write_text("frame,point,x_px,y_px\nwalk0/000000,a,5,5\n")
    assert points_of(place[0], tmp_path).xyz_m.tolist() == [[1.5, -2.0, 0.25]]


def test_a_point_may_have_a_name_that_tables_take_for_nothing(place: tuple[Scene, Array], tmp_path: Path) -> None:
    (tmp_path / "survey.csv").write_text("point,x_m,y_m,z_m\nNA,1.5,-2,0.25\nnull,0,0,0\n")
    (tmp_path / "seen.csv").write_text("frame,point,x_px,y_px\nwalk0/000000,NA,5,5\nwalk0/000000,null,9,9\n")
    assert points_of(place[0], tmp_path).xyz_m.tolist() == [[1.5, -2.0, 0.25], [0, 0, 0]]


@pytest.mark.parametrize(
    ("survey", "seen", "what"),
    [
        ("point,x,y,z\na,0,0,0\n", "", "column x_m is missing"),
        ("point,x_m,y_m,z_m\na,0,0,0,0.002\n", "", "more fields than the first line has names"),
        ("point,x_m,y_m,z_m\na,0,0,zero\n", "", "a line isn't names and finite numbers"),
        ("point,x_m,y_m,z_m\na,0,0,NA\n", "", "a line isn't names and finite numbers"),
        ("point,x_m,y_m,z_m,sd_m\na,0,0,0,\nb,0,0,0,5 mm\n", "", "line 3"),
        ("point,x_m,y_m,z_m\na,0,0,0\n\n,,,\nb,0,0,x\n", "", "line 5"),
        ("point,x_m,y_m,z_m\n,0,0,0\n", "", "a line isn't names and finite numbers"),
        ("point,x_m,y_m,z_m\na,0,0,0\na,1,0,0\n", "", "point are listed twice"),
        ("point,x_m,y_m,z_m\na,0,0,0\n", "walk0/000000,b,5,5\n", "aren't surveyed"),
        ("point,x_m,y_m,z_m\na,0,0,0\n", "walk9/000000,a,5,5\n", "a frame that doesn't exist"),
        ("point,x_m,y_m,z_m\na,0,0,0\n", "walk0/000000,a,5,5000\n", "outside of its image"),
    ],
)
def test_files_that_are_wrong_are_refused(
    survey: str, seen: str, what: str, place: tuple[Scene, Array], tmp_path: Path
) -> None:
    (tmp_path / "survey.csv").write_text(survey)
    (tmp_path / "seen.csv").write_text("frame,point,x_px,y_px\n" + (seen or "walk0/000000,a,5,5\n"))
    with pytest.raises(UserError, match=what):
        points_of(place[0], tmp_path)


GCP_LIST = """WGS84 UTM 54N
494399.2 4232697.1 5 4.5 99.5 PHOTO.JPG north
494400.2\t4232695.9\t6\t700.5\t800.5\tphoto.jpg
# a remark
494399.2 4232697.1 5 1 2 gone.jpg north
"""


def test_a_gcp_list_of_opendronemap_is_read_as_it_is(place: tuple[Scene, Array], tmp_path: Path) -> None:
    """Points by name or coordinates, images by the names of their files; metres are those of earth, not of the grid,
    whose axes are longer or shorter by up to 0.04 %. The place is pyproj's."""
    (tmp_path / "gcp_list.txt").write_text(GCP_LIST)
    scene = replace(
        place[0], frames=place[0].frames.assign(image=[f"walk/{i}.jpg" for i in range(len(place[0].frames))])
    )
    scene.frames.loc[3, "image"] = "walk/photo.jpg"
    points = points_of(scene, tmp_path, points="gcp_list.txt", images="")
    assert points.names == ["north", "494400.2 4232695.9 6"] and points.row.tolist() == [3, 3]
    assert points.xy_px.tolist() == [[5, 100], [701, 801]]
    assert points.remarks == {0: "1 of its images aren't among the frames, such as gone.jpg"}
    place_of_first = geodetic_of(there(points.origin), points.xyz_m)[0]
    np.testing.assert_allclose(place_of_first, [38.242263044418, 140.935996501068, 5], atol=1e-8)
    step = points.xyz_m[1] - points.xyz_m[0]
    np.testing.assert_allclose(step, np.array([1.0, -1.2, 1.0]) / [0.9996, 0.9996, 1], atol=1e-3)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("EPSG:2180\n1 2 3 4 5 6.jpg\n", "coordinates that aren't known here"),
        ("+proj=utm +zone=33 +datum=WGS84 +units=us-ft\n1 2 3 4 5 6.jpg\n", "coordinates that aren't known here"),
        ("metres\n1 2 nan 4 5 6.jpg\n", "isn't a point with its height"),
        ("metres\n1 2 3 4 5\n", "line 2"),
        ("metres\n1 2 3 4 5 6.jpg a\n1 2 4 4 5 7.jpg a\n", "other coordinates than a line above"),
        ("metres\n1 2 3 4 5 6.jpg a\n", "a frame that doesn't exist"),
        ("metres\n", "no points"),
    ],
)
def test_a_gcp_list_that_is_wrong_is_refused(text: str, what: str, place: tuple[Scene, Array], tmp_path: Path) -> None:
    (tmp_path / "gcp_list.txt").write_text(text)
    with pytest.raises(UserError, match=what):
        points_of(place[0], tmp_path, points="gcp_list.txt", images="")


def test_align_writes_tables_and_picture(data: DataRoot) -> None:
    """A scene's file names a survey of what all frames of a walk see; align says where it lies, with a check."""
    truth = read_table(data.captures("Place") / "true_poses.parquet", schema("simulate", "true_poses"))
    poses = poses_of(truth, "map_cam")
    xyz = transform(poses[[3, 5, 9, 12, 25, 30, 33]], np.array([0.5, -0.4, 4.0]))
    frames = table_of(data, "Place", "import", "frames")
    seen = observed(Scene(frames, frames, frames, poses, xyz), xyz, 0)
    folder = data.root / "control"
    folder.mkdir()
    pd.DataFrame(xyz, columns=["x_m", "y_m", "z_m"]).assign(point=NAMES[:7]).to_csv(folder / "survey.csv")
    seen.to_csv(folder / "seen.csv", index=False)
    (data.root / "scenes").mkdir()
    named = 'points = "control/survey.csv"\nimages = "control/seen.csv"\nup = "y"\nmax_error_m = 0.3\n'
    (data.root / "scenes" / "Place.toml").write_text(f"[[control]]\n{named}")
    execute(STAGE, "Place", "tiny", data)
    survey, points, checks = (table_of(data, "Place", "align", t) for t in ("control", "control_points", "checks"))
    (row,) = records(survey)
    assert row.fit == "se3" and row.used >= 6 and row.rms_m < 0.1 and row.tilt_deg < 1
    assert points["point"].tolist() == NAMES[:7] and "control_points" in checks["check"].tolist()
    assert (data.run("tiny", "Place", "align") / "control.png").is_file()
    # Without VIO it is the survey that makes the map metric and upright.
    rewrite(data, "Place", "import", "frames", without_vio(frames))
    execute(STAGE, "Place", "tiny", data, force=True)
    assert not (data.run("tiny", "Place", "align") / "checks.png").exists()  # nothing to draw
    aligned = table_of(data, "Place", "align", "ground_truth")
    assert set(aligned["scale_source"].dropna()) == {"control: control"}
    assert set(aligned["vertical_source"].dropna()) == {"control points"}
    found = poses_of(aligned, "map_cam")
    has_truth = np.isfinite(found[:, 0, 0])
    by_truth = fit_sim3(poses[has_truth, :3, 3], found[has_truth, :3, 3])
    assert abs(by_truth.scale - 1) < 0.05 and by_truth.rotation[1, 1] > np.cos(np.radians(3))
