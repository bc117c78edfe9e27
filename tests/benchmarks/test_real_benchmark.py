"""The real benchmark's comparisons are right where the answer is known, and its tables say what was found."""

import csv
import io
import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.real import app
from benchmarks.real_cases import Result, Target, judge, named_case, standard_cases
from benchmarks.real_figures import (
    CRASHED,
    OURS,
    PASSED,
    RATIO,
    REFUSED,
    STOCK,
    Figure,
    Paths,
    Verdict,
    place,
    three_way_figures,
    verdict_of,
    with_sigma,
)
from benchmarks.real_report import csv_text, write_report, write_stability
from benchmarks.real_scale import (
    BOARD,
    BOUNDS,
    DEPTH,
    HELD_OUT,
    HELD_OUT_RMS,
    WITHIN_BOUNDS,
    board_figures,
    depth_figures,
)
from benchmarks.real_stability import RESAMPLINGS, Tried, agreeing, copy_without, left_out
from benchmarks.stages import run_timed
from benchmarks.stock import create_shared_database, session_cameras
from groundwalk.alignment.rulers.settings import CharucoRuler, rulers_of
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import make_pose


def poses(count: int, *, straight: bool = False) -> np.ndarray:
    rng = np.random.default_rng(3)
    rotations = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3))).as_matrix()
    xyz = np.linspace(0, 5, count)[:, None] * np.array([1.0, 0.1, 0.3])
    return make_pose(rotations, xyz if straight else xyz + rng.normal(0, 0.5, (count, 3)))


def moved(vio_T_cam: np.ndarray, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return Sim3(3.7, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)).poses(vio_T_cam)


@pytest.mark.parametrize("straight", [False, True])
def test_models_that_agree_have_no_residuals_in_any_gauge(straight: bool) -> None:
    vio_T_cam = poses(20, straight=straight)
    # A path that is straight but for a millimetre leaves the turn about it to noise, if positions alone decide.
    vio_T_cam[:, :3, 3] += np.random.default_rng(0).normal(0, 1e-3, (20, 3))
    sfm_T_cam = np.concatenate([moved(vio_T_cam[:10], 1), moved(vio_T_cam[10:], 2)])
    group = np.array(["a|0"] * 10 + ["b|1"] * 10, object)
    placed = place(vio_T_cam, sfm_T_cam, group)
    assert placed.position_m == pytest.approx(0, abs=1e-9)
    assert placed.rotation_deg == pytest.approx(0, abs=1e-6)
    assert placed.xyz_vio == pytest.approx(vio_T_cam[:, :3, 3])


def test_rotations_are_compared_where_a_straight_path_leaves_the_turn_about_it_open() -> None:
    vio_T_cam = poses(30, straight=True)
    rng = np.random.default_rng(1)
    vio_T_cam[:, :3, 3] += rng.normal(0, 1e-3, (30, 3))
    sfm_T_cam = vio_T_cam.copy()
    sfm_T_cam[:, :3, 3] += rng.normal(0, 1e-3, (30, 3))
    assert np.median(place(vio_T_cam, sfm_T_cam, np.full(30, "a", object)).rotation_deg) < 1e-6


def test_a_frame_that_is_off_shows_by_as_much() -> None:
    vio_T_cam = poses(200)
    sfm_T_cam = vio_T_cam.copy()
    sfm_T_cam[7, :3, 3] += [0.0, 0.2, 0.0]
    sfm_T_cam[9, :3, :3] = sfm_T_cam[9, :3, :3] @ Rotation.from_rotvec([0, 0, np.radians(2)]).as_matrix()
    placed = place(vio_T_cam, sfm_T_cam, np.full(200, "a", object))
    # The fit takes up a little of it.
    assert placed.position_m[7] == pytest.approx(0.2, rel=0.05)
    assert placed.rotation_deg[9] == pytest.approx(2, rel=0.05)
    assert np.median(placed.position_m) < 0.005
    assert placed.step_m[7] == pytest.approx(0.2, rel=0.05) and placed.step_deg[10] == pytest.approx(2, rel=0.05)
    assert np.isnan(placed.step_m[0]) and np.nanmedian(placed.step_m) < 0.005


def test_vios_part_of_the_residuals_is_its_own_error() -> None:
    truth = poses(400)
    rng = np.random.default_rng(4)
    vio, ours, stock = (truth.copy() for _ in range(3))
    for of, sd_m in ((vio, 0.005), (ours, 0.001), (stock, 0.002)):
        of[:, :3, 3] += rng.normal(0, sd_m, (400, 3))
    session = np.array(["a"] * 300 + ["b"] * 100, object)
    # A model apart, which stock lacks, takes no part.
    model = np.where(np.arange(400) < 390, 0, -1)
    paths = Paths(session, np.arange(400), vio, moved(ours, 1), np.zeros(400, int), moved(stock, 2), model)
    figures = {(f.name, f.way, f.subject): f.value for f in three_way_figures(paths)}
    for name in ("", "a", "b"):
        assert figures["VIO's part of the residuals, position RMS", OURS, name] == pytest.approx(8.66, rel=0.1)
        assert figures["ours and stock apart, position RMS", OURS, name] == pytest.approx(3.87, rel=0.1)
    # The sum of 1170 squares of independent errors has a relative deviation of sqrt(2 / 1170), their root half of it.
    sigma = figures["common frames against VIO, position RMS, one sigma", OURS, ""]
    assert sigma == pytest.approx(8.83 * np.sqrt(0.5 / 1170), rel=0.7)


def test_frames_without_a_model_or_vio_and_groups_of_few_are_not_compared() -> None:
    vio_T_cam = poses(25)
    sfm_T_cam = vio_T_cam.copy()
    sfm_T_cam[0], vio_T_cam[1] = np.nan, np.nan
    group = np.array(["a"] * 16 + ["few"] * 3 + [None] * 6, object)
    placed = place(vio_T_cam, sfm_T_cam, group)
    assert list(np.flatnonzero(np.isfinite(placed.position_m))) == list(range(2, 16))


def test_a_target_is_held_against_the_worst_subject() -> None:
    figures = [Figure("rms", 4.0, "mm"), Figure("rms", 6.0, "mm", subject="walk"), Figure("rms", 9.0, "mm", STOCK)]
    assert judge(figures, Target("rms", 5, "mm")).met
    worst = judge(figures, Target("rms", 5, "mm", every_subject=True))
    assert (worst.met, worst.value) == (False, 6.0)
    assert judge(figures, Target("rms", 4, at_least=True, every_subject=True)).value == 4.0
    assert judge(figures, Target("rms", 8, way=STOCK)).value == 9.0


@pytest.mark.parametrize("figures", [[], [Figure("rms", np.nan)]])
def test_a_figure_that_is_not_there_misses_its_target(figures: list[Figure]) -> None:
    judged = judge(figures, Target("rms", 5))
    assert (judged.met, judged.value) == (False, None)


def test_verdicts() -> None:
    assert verdict_of({"import": 0, "sfm": 0, "align": 0}, {}, []) == Verdict(PASSED)
    logs = {"import": "", "sfm": "working\nerror: too few frames for a model\n  where:    x\n"}
    assert verdict_of({"import": 0, "sfm": 2}, logs, []) == Verdict(REFUSED, "sfm", "too few frames for a model")
    logs = {"import": "", "sfm": "", "align": "error: the SfM model is wrong\n"}
    refused = verdict_of({"import": 0, "sfm": 0, "align": 2}, logs, ["wrong intrinsics", "disconnected session"])
    assert refused == Verdict(REFUSED, "align", "wrong intrinsics")
    crashed = verdict_of({"import": 1}, {"import": "Traceback\nValueError: no"}, [])
    assert (crashed.outcome, crashed.cause) == (CRASHED, "ValueError: no")


def test_a_failed_command_is_measured_and_its_words_are_kept(tmp_path: Path) -> None:
    status, cost = run_timed(["bash", "-c", "echo error: no >&2; exit 2"], tmp_path, tmp_path / "log")
    assert status == 2 and cost.wall_s > 0
    assert (tmp_path / "log").read_text(encoding="utf-8") == "error: no\n"


def frames_table(counts: dict[str, int]) -> pd.DataFrame:
    rows = [
        {"session_id": session, "t_ns": 10 * i, "image": f"{session}/{i}.jpg"}
        for session, count in counts.items()
        for i in range(count)
    ]
    return pd.DataFrame(rows).sample(frac=1, random_state=0)


def test_resamplings_leave_out_images_session_by_session_in_time() -> None:
    frames = frames_table({"a": 7, "b": 4})
    keeps = {r.name: r.keep for r in RESAMPLINGS if r.keep is not None}
    assert left_out(frames, keeps["every 2nd image"]) == {f"{s}.jpg" for s in ("a/1", "a/3", "a/5", "b/1", "b/3")}
    assert left_out(frames, keeps["every 3rd image"]) == {
        f"{s}.jpg" for s in ("a/1", "a/2", "a/4", "a/5", "b/1", "b/2")
    }
    first, second = (left_out(frames, keeps[f"{half} half"]) for half in ("first", "second"))
    assert not first & second and first | second == set(frames["image"])
    assert left_out(frames, keeps["files in another order"]) == set()


def test_a_resampled_copy_has_all_but_the_left_out_files_and_the_capture_stays(tmp_path: Path) -> None:
    source = tmp_path / "capture"
    for i in range(9):
        path = source / "walk" / f"frame_{i}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(str(i), encoding="utf-8")
        path.with_suffix(".json").write_text("{}", encoding="utf-8")
    before = {path: path.stat().st_mtime_ns for path in source.rglob("*.*")}
    copy_without(source, tmp_path / "copy", {"walk/frame_3.jpg"}, order_seed=0)
    copied = {path.relative_to(tmp_path / "copy").as_posix() for path in (tmp_path / "copy").rglob("*.*")}
    assert copied == {path.relative_to(source).as_posix() for path in before} - {"walk/frame_3.jpg"}
    assert {path: path.stat().st_mtime_ns for path in source.rglob("*.*")} == before


def ruler_rows(**rows: dict[str, object]) -> pd.DataFrame:
    """An align.rulers table of a part a row."""
    common = {"frames": 20, "vio_scale_error_percent": -1.2, "vio_scale_sd_percent": 1.0, "corner_rms_mm": 0.4}
    common |= {"reprojection_px": 0.5, "flatness_mm": 0.3, "scale_error_percent": -1.2, "used_for_scale": False}
    return pd.DataFrame([common | {"part": part} | values for part, values in rows.items()])


def test_a_board_judges_vios_scale_and_its_held_out_corners_the_scale_by_it() -> None:
    judging = ruler_rows(all={})
    setting = ruler_rows(all={}, for_scale={}, held_out={"scale_error_percent": -0.1, "corner_rms_mm": 0.7})
    values = {f.name: f.value for f in board_figures(judging, setting.assign(used_for_scale=True))}
    assert values[BOARD] == -1.2 and values[WITHIN_BOUNDS] == pytest.approx(1.2 / 1.96)
    assert (values[HELD_OUT], values[HELD_OUT_RMS]) == (0.1, 0.7)
    # A board that wasn't let set the scale, or that isn't seen beside VIO's scale, reaches nothing.
    assert HELD_OUT not in {f.name for f in board_figures(judging, setting)}
    assert board_figures(judging.assign(vio_scale_error_percent=np.nan), setting) == []


def test_a_case_with_a_board_is_a_scene_with_that_ruler(tmp_path: Path) -> None:
    (tmp_path / "captures" / "charuco" / "walk").mkdir(parents=True)
    for case in standard_cases(tmp_path / "captures"):
        (board,) = rulers_of(tomllib.loads(case.board)["ruler"])
        assert isinstance(board, CharucoRuler) and board.size_mm == 22 and not board.use_for_scale
        assert HELD_OUT in {target.name for target in case.targets}


def test_depth_over_the_maps_by_distance_and_confidence() -> None:
    row = {"session_id": "walk", "component": 0, "near_m": 3.0, "far_m": 5.0, "confidence": None, "samples": 140}
    row |= {"median_ratio": 1.01, "median_ratio_se": 0.002}
    far = row | {"near_m": 5.0, "far_m": np.nan, "confidence": 2, "component": 1}
    figures = depth_figures(
        pd.DataFrame([row, far, row | {"near_m": 0.0, "samples": 3}]).astype({"confidence": "Int64"})
    )
    assert [(f.subject, f.name, f.value) for f in figures[::3]] == [
        ("walk, 3 to 5 m", f"{DEPTH}, any confidence", 1.01),
        ("walk, 5 m or more, model 2", f"{DEPTH}, high confidence", 1.01),
    ]
    assert len(figures) == 6 and figures[2].value == 140


def result() -> Result:
    figures = [
        *(Figure("accepted", 1.0), Figure("images", 30), Figure("checks", 7), Figure("checks failed", 1)),
        *(Figure("k1", 0.08, subject="phone, 1920x1440"), Figure("k1, one sigma", 0.002, subject="phone, 1920x1440")),
        *(Figure("k1", 0.09, way=STOCK, subject="walk"), Figure("focal scale", 0.998, subject="walk")),
        *(Figure("all frames against VIO", 20), Figure("all frames against VIO, position RMS", 4.25, "mm")),
        *(Figure(BOARD, -1.2, "%"), Figure(BOUNDS, 1.96, "%"), Figure(HELD_OUT, 0.1, "%")),
        *with_sigma(f"{DEPTH}, any confidence", 1.01, 0.002, "", "walk, 0 to 5 m"),
        *(Figure("processor", 30.0, "s"), Figure("wall", 60.0, "s"), Figure("processor", 0.7, "", RATIO)),
    ]
    targets = [Target("accepted", 1, at_least=True), Target("processor", 0.5, way=RATIO), Target("models", 1)]
    run = ("chair", "chair", ["rate_hz=2"], 0, "0123", "abc", "2026-01-01", "a machine", 0.5)
    return Result(*run, Verdict(PASSED), ["wrong intrinsics (session_focal_length, 1)"], figures, targets)


def test_a_result_is_read_back_as_it_was(tmp_path: Path) -> None:
    result().save(tmp_path)
    assert Result.load(tmp_path / "chair.json") == result()


def test_the_report_says_met_and_missed_and_its_tables_are_whole(tmp_path: Path) -> None:
    tried = [Tried("chair", "whole", 30, Verdict(PASSED), PASSED, "abc", 30, {"A": 1, "B": 2, "C": 27})]
    tried.append(
        Tried("chair", "every 3rd image", 10, Verdict(REFUSED, "align", "disconnected session"), PASSED, "abc")
    )
    write_report(tmp_path, [result()])
    write_stability(tmp_path, tried)
    text = "\n".join((tmp_path / name).read_text(encoding="utf-8") for name in ("real.md", "real-stability.md"))
    assert "| chair | accepted | 1 | ≥ 1 | met |" in text
    assert "| chair | processor, ours / stock | 0.7 | ≤ 0.5 | **missed** |" in text
    assert "| chair | models | none | ≤ 1 | **missed** |" in text
    assert "0.0800 ± 0.0020" in text and "0 of 1 resamplings (0 %)" in text
    assert "| chair | none | -1.2 % | ± 1.96 % |" in text and "| 0.1 % | none |" in text
    assert "| chair | walk, 0 to 5 m | none | 1.0100 ± 0.0020 |  |  |  |" in text
    for table in text.split("\n\n"):
        widths = {line.count("|") for line in table.splitlines() if line.startswith("|")}
        assert len(widths) <= 1
    rows = list(csv.DictReader(io.StringIO(csv_text([result()]))))
    assert {row["met"] for row in rows if row["figure"] == "processor" and row["way"] == RATIO} == {"missed"}
    assert {row["met"] for row in rows if row["figure"] == "wall"} == {""}
    assert agreeing(tried) == (0, 1)


def test_only_captures_that_are_there_are_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "captures" / "charuco" / "walk").mkdir(parents=True)
    names = [case.name for case in standard_cases(tmp_path / "captures")]
    assert names == ["charuco", "charuco_walk"]
    assert named_case(tmp_path / "captures").targets
    arguments = ["--captures", str(tmp_path / "none"), "--work", str(tmp_path / "w"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as ended:
        app(arguments)
    assert ended.value.code == 0 and "left out: no captures" in capsys.readouterr().out
    assert not (tmp_path / "out").exists()
    with pytest.raises(SystemExit) as ended:
        app([*arguments, "--only", "chair"])
    assert ended.value.code == 2


def test_stock_has_an_opencv_camera_a_session_at_the_median_of_its_log(tmp_path: Path) -> None:
    frames = pd.DataFrame({"session_id": list("aaab"), "width": 640, "height": 480, "fx": [500.0, 501, 509, 600]})
    frames[["fy", "cx", "cy"]] = [510.0, 320.0, 240.0]
    cameras, camera_of_frame = session_cameras(frames)
    assert list(camera_of_frame) == [0, 0, 0, 1]
    assert [camera.params[0] for camera in cameras] == [501, 600]
    create_shared_database(
        tmp_path / "database.db", ["a/0.jpg", "a/1.jpg", "a/2.jpg", "b/0.jpg"], cameras, camera_of_frame
    )
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        images = sorted(database.read_all_images(), key=lambda image: image.name)
        assert [image.camera_id for image in images] == [1, 1, 1, 2]
        assert database.num_cameras() == 2 and database.num_frames() == 4
        assert {camera.model.name for camera in database.read_all_cameras()} == {"OPENCV"}
        assert all(camera.has_prior_focal_length for camera in database.read_all_cameras())
