"""New images in a map, by the command and from Python: poses, refusals with reasons, and clear errors."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import PIL.Image
import pytest
from scipy.spatial.transform import Rotation

import groundwalk
from groundwalk import UserError
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import make_pose, pose_from_tq, yaw_rotation
from groundwalk.localisation.definition import STAGE
from groundwalk.localisation.locate import _answer, _refuse_other_file, app
from groundwalk.runtime.queries import file_query, image_files, known_of, query_of
from groundwalk.scoring.errors import position_error
from groundwalk.store import execute
from groundwalk.store.images import read_image
from tests.known import read_picture, there, written
from tests.localisation.board_scene import CAMERA, HEIGHT, TEST, WIDTH, Boards, other_board_picture

SMALL = ["max_features=300", "localisers.Map.max_points=400"]
ROW = int(np.flatnonzero(TEST)[1])
DOWN = [0.0, 1.0, 0.0]
FOUR = (CAMERA["fx"], CAMERA["fy"], CAMERA["cx"], CAMERA["cy"])
NUMBERS = list(FOUR)
K = [[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]]


@pytest.fixture(scope="module")
def run(boards: Boards) -> groundwalk.Run:
    execute(STAGE, "Boards", "tiny", boards.data, SMALL)
    return groundwalk.open("Boards", profile="tiny", data=boards.data.root)


@pytest.fixture(scope="module")
def map_file(run: groundwalk.Run) -> Path:
    return run.folder / "localise" / "map.gwm"


@pytest.fixture
def picture(boards: Boards) -> np.ndarray:
    return read_picture(boards.image(ROW), cv2.IMREAD_GRAYSCALE)


@pytest.mark.parametrize("intrinsics", [CAMERA, Camera(WIDTH, HEIGHT, *FOUR), K, NUMBERS, np.array(NUMBERS)])
def test_a_run_localises_an_image(run: groundwalk.Run, boards: Boards, intrinsics: Any) -> None:
    truth, file = boards.map_T_cam[ROW], boards.image(ROW)
    for image in (file, str(file), read_image(file)):
        answer = run.localise(image, intrinsics=intrinsics, gravity=DOWN, prior=truth)
        assert position_error(there(answer.map_T_cam), truth) < 0.02
        assert np.linalg.eigvalsh(there(answer.covariance)).min() > 0
        assert 10 <= answer.inliers <= answer.seen.inlier.sum() and answer.refusal is None


def test_a_wrong_prior_does_not_make_the_answer_wrong(run: groundwalk.Run, boards: Boards) -> None:
    truth = boards.map_T_cam[ROW]
    away = truth @ make_pose(np.diag([-1.0, 1.0, -1.0]), np.array([4.0, 0, -9.0]))
    answer = run.localise(boards.image(ROW), intrinsics=CAMERA, gravity=DOWN, prior=away)
    assert position_error(there(answer.map_T_cam), truth) < 0.02


def test_a_run_refuses_what_it_cannot_localise(run: groundwalk.Run, boards: Boards, picture: np.ndarray) -> None:
    turned = np.ascontiguousarray(np.rot90(picture))
    for image, refusals in (
        (np.zeros_like(picture), {"few_features"}),
        (cv2.GaussianBlur(picture, (0, 0), 25), {"few_features"}),
        (other_board_picture(boards.map_T_cam[ROW]), {"few_matches", "no_pose", "thin_evidence"}),
        (turned, {"image_size"}),
        (cv2.resize(picture, (160, 120)), {"image_size"}),
    ):
        answer = run.localise(image.astype(np.uint8), intrinsics=CAMERA, gravity=DOWN)
        assert answer.refusal in refusals and answer.reason
        assert answer.map_T_cam is None and answer.covariance is None


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"intrinsics": None}, "no intrinsics: fx, fy, cx, cy"),
        ({"intrinsics": {"fx": 300.0}}, "no intrinsics: fy, cx, cy"),
        ({"intrinsics": [300.0, 300.0]}, "these are no intrinsics"),
        ({"intrinsics": "wide"}, "these are no intrinsics"),
        ({"intrinsics": [np.nan, 300.0, 160, 120]}, "fx is no finite number"),
        ({"intrinsics": [3.0, 3.0, 160, 120]}, "focal lengths can't be"),
        ({"intrinsics": [300.0, 300.0, 960, 720]}, "principal point isn't in the image"),
        ({"intrinsics": [300.0, 300.0, 120, 160]}, "far from the image's centre"),
        ({"gravity": [0, 0, 0]}, "gravity has no direction"),
        ({"gravity": [0, 1]}, "gravity isn't"),
        ({"prior": np.eye(3)}, "prior isn't"),
        ({"prior": 2 * np.eye(4)}, "prior's rotation is none"),
        ({"model": "HLoc"}, "no structure localiser 'HLoc' that is kept in a file"),
        ({"image": np.zeros((4, 4, 4), np.uint8)}, "this isn't an image"),
        ({"image": "nowhere.png"}, "image can't be read"),
        ({"image": 7}, "this isn't an image"),
    ],
)
def test_what_a_caller_can_get_wrong_is_said(run: groundwalk.Run, boards: Boards, given: Any, message: str) -> None:
    arguments = {"image": boards.image(ROW), "intrinsics": CAMERA} | given
    with pytest.raises(UserError, match=message):
        run.localise(arguments.pop("image"), **arguments)


def test_a_run_without_the_stage_says_so(boards: Boards, tmp_path: Path) -> None:
    run = groundwalk.Run(tmp_path, None, {"import": {"scene": {"name": "Boards"}, "profile": "tiny"}}, {})
    with pytest.raises(UserError, match="stage localise of scene Boards hasn't been run"):
        run.localise(boards.image(ROW), intrinsics=CAMERA)


def test_the_command_answers_an_image_and_a_folder_with_intrinsics_beside(
    map_file: Path, boards: Boards, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    picture = read_picture(boards.image(ROW))
    cv2.imwrite(str(tmp_path / "a.png"), picture)
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros_like(picture))
    cv2.imwrite(str(tmp_path / "small.png"), cv2.resize(picture, (160, 120)))
    (tmp_path / "intrinsics.json").write_text(json.dumps(CAMERA | {"gravity": DOWN}))
    # Half the image has half the focal length, and a file of its own says so.
    half = {name: value / 2 for name, value in CAMERA.items()}
    (tmp_path / "small.json").write_text(json.dumps(half))
    cv2.imwrite(str(tmp_path / "wide.png"), cv2.resize(picture, (160, 120)))
    (tmp_path / "none.json").write_text(json.dumps({"fx": None}))
    cv2.imwrite(str(tmp_path / "none.png"), picture)
    (tmp_path / "text.png").write_text("no image")
    cv2.imwrite(str(tmp_path / "turned.png"), np.rot90(picture))
    options = ("--intrinsics", ",".join(map(str, NUMBERS)), "--gravity", "0,1,0", "--scene", "Boards")
    with pytest.raises(SystemExit, match="0"):
        app([str(boards.image(ROW)), "--map", str(map_file), *options])
    alone = capsys.readouterr()
    assert json.loads(alone.out)["inliers"] >= 10 and "1 of 1 images localised" in alone.err
    out = tmp_path / "said.jsonl"
    command = [sys.executable, "-m", "groundwalk", "locate", str(tmp_path), "--map", str(map_file), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    said = {row["image"]: row for row in map(json.loads, (tmp_path / "said.jsonl").read_text().splitlines())}
    assert list(said) == ["a.png", "black.png", "none.png", "small.png", "text.png", "turned.png", "wide.png"]
    # One image that can't be asked doesn't keep the others from their answers.
    assert "no intrinsics: fx" in said["none.png"]["reason"] and "can't be read" in said["text.png"]["reason"]
    for name in ("none.png", "text.png"):
        assert said[name]["refusal"] == "bad_input" and said[name]["position_m"] is None
    assert said["turned.png"]["refusal"] in ("image_size", "bad_input")
    pose = pose_from_tq(np.array([said["a.png"]["position_m"]]), np.array([said["a.png"]["quaternion"]]))[0]
    assert position_error(pose, boards.map_T_cam[ROW]) < 0.02 and len(said["a.png"]["covariance"]) == 36
    assert (said["black.png"]["refusal"], said["wide.png"]["refusal"]) == ("few_features", "image_size")
    assert said["black.png"]["position_m"] is None and said["a.png"]["reason"] is None
    assert said["small.png"]["refusal"] != "image_size"


def test_a_frame_of_the_scanner_app_brings_intrinsics_and_gravity(boards: Boards, tmp_path: Path) -> None:
    image = tmp_path / "frame_00007.jpg"
    image.write_bytes(boards.image(ROW).read_bytes())
    world_R_cam = yaw_rotation(np.array([0.4]))[0] @ Rotation.from_euler("xz", [20, -10], degrees=True).as_matrix()
    world_R_cam = world_R_cam @ np.diag([1.0, -1.0, -1.0])  # the world's y is up, a level camera's down
    pose = make_pose(world_R_cam @ np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0]))
    K_9 = [CAMERA["fx"], 0, CAMERA["cx"], 0, CAMERA["fy"], CAMERA["cy"], 0, 0, 1]
    frame = {"cameraPoseARFrame": pose.ravel().tolist(), "intrinsics": K_9}
    image.with_suffix(".json").write_text(json.dumps(frame))
    query = file_query(image, {})
    assert query.camera == Camera(WIDTH, HEIGHT, *FOUR)
    assert query.gravity == pytest.approx(world_R_cam.T @ [0, -1, 0])
    image.with_suffix(".json").write_text(json.dumps(frame | {"intrinsics": K_9[:4]}))
    with pytest.raises(UserError, match="intrinsics isn't"):
        file_query(image, {})


def test_intrinsics_are_of_the_nearest_source_and_its_image_size(tmp_path: Path) -> None:
    """The folder's file is of the images as captured, others of images half as large."""
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((HEIGHT // 2, WIDTH // 2, 3), np.uint8))
    stated = dict(zip(("fx", "fy", "cx", "cy"), NUMBERS, strict=True))
    written(tmp_path / "intrinsics.json", json.dumps(stated | {"width": WIDTH, "height": HEIGHT, "gravity": DOWN}))
    written(tmp_path / "b.json", json.dumps({name: value / 2 for name, value in stated.items()}))
    assert file_query(tmp_path / "a.png", {}).camera == Camera(WIDTH, HEIGHT, *FOUR)
    half = Camera(WIDTH, HEIGHT, *FOUR).resized(WIDTH // 2, HEIGHT // 2)
    own = file_query(tmp_path / "b.png", {})
    assert own.camera == half and own.gravity == pytest.approx(DOWN)
    command = {name: value / 2 + 1 for name, value in stated.items()}
    assert file_query(tmp_path / "a.png", command).camera.fx == NUMBERS[0] / 2 + 1
    assert file_query(tmp_path / "b.png", command).camera == half


def test_an_image_may_be_one_of_pillow(boards: Boards) -> None:
    with PIL.Image.open(boards.image(ROW)) as image:
        query = query_of(cast(Any, image.convert("RGB")), CAMERA, "")
    assert np.array_equal(query.image, read_image(boards.image(ROW)))


def test_photos_of_a_kind_that_is_not_read_are_refused_by_name(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.jpg"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    written(tmp_path / "IMG_1.HEIC", "a photo")
    assert [path.name for path in image_files(tmp_path)] == ["IMG_1.HEIC", "a.jpg"]
    refusal = _answer(lambda query: {}, tmp_path / "IMG_1.HEIC", CAMERA, among_others=True)
    assert refusal["refusal"] == "bad_input" and "can't be read: .HEIC, not one of .bmp" in refusal["reason"]
    with pytest.raises(UserError, match="convert it to JPEG"):
        file_query(tmp_path / "IMG_1.HEIC", CAMERA)


def test_a_query_says_which_side_is_read_out_first(boards: Boards, tmp_path: Path) -> None:
    image = tmp_path / "a.png"
    image.write_bytes(boards.image(ROW).read_bytes())
    stated = Camera(WIDTH, HEIGHT, *FOUR, first_row="left")
    assert file_query(image, {**CAMERA, "first_row": "left"}).camera == stated
    assert query_of(image, known_of(stated, None, None), "").camera == stated
    with pytest.raises(UserError, match="first_row is no side"):
        file_query(image, {**CAMERA, "first_row": "down"})


def test_a_folder_of_which_nothing_can_be_asked_is_an_error(
    map_file: Path, boards: Boards, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.png").write_bytes(boards.image(ROW).read_bytes())
    with pytest.raises(SystemExit, match="2"):
        app([str(tmp_path), "--map", str(map_file)])
    said = capsys.readouterr()
    assert "no image of the folder can be asked" in said.err and "no intrinsics" in said.err
    assert json.loads(said.out)["refusal"] == "bad_input"


def test_answers_replace_nothing_but_answers_and_need_a_place_first(
    map_file: Path, boards: Boards, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = tmp_path / "a.png"
    photo.write_bytes(boards.image(ROW).read_bytes())
    (tmp_path / "a.json").write_text(json.dumps(CAMERA))
    (tmp_path / "folder").mkdir()
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with monkeypatch.context() as patched:
        patched.setattr("groundwalk.localisation.locate.ask_map", None)  # no query is asked
        for out, message in (
            (photo, "no file of earlier answers"),
            (tmp_path / "a.json", "no file of earlier answers"),
            (tmp_path / "folder", "found:    a folder"),
            (photo / "said.jsonl", "nothing can be written there"),
        ):
            with pytest.raises(SystemExit, match="2"):
                app([str(photo), "--map", str(map_file), "--out", str(out)])
            assert message in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    for _ in range(2):  # new, and in place of earlier ones
        with pytest.raises(SystemExit, match="0"):
            app([str(photo), "--map", str(map_file), "--out", str(tmp_path / "new" / "said.jsonl")])
    assert json.loads((tmp_path / "new" / "said.jsonl").read_text())["image"] == "a.png"
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["said.jsonl"]


def test_the_command_says_what_is_wrong(
    map_file: Path, boards: Boards, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cut.gwm").write_bytes(map_file.read_bytes()[:-100])
    (tmp_path / "map.bin").write_bytes(map_file.read_bytes())
    (tmp_path / "empty").mkdir()
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "a.png").write_bytes(boards.image(ROW).read_bytes())
    (bad / "a.json").write_text("[1, 2]")
    image, known = boards.image(ROW), ("--intrinsics", "300,300,160,120")
    for arguments, message in (
        ((image, "--map", map_file), "no intrinsics: fx, fy, cx, cy"),
        ((image, "--map", map_file, "--intrinsics", "300"), "--intrinsics has something else than numbers"),
        ((image, "--map", map_file, *known, "--gravity", "a,b,c"), "--gravity has something else than numbers"),
        ((image, "--map", map_file, *known, "--scene", "Church"), "a map is of another scene"),
        ((image, "--map", tmp_path / "cut.gwm", *known), "a map can't be read"),
        ((image, "--map", tmp_path / "none.gwm", *known), "there is no such map"),
        ((image, "--map", tmp_path / "map.bin", *known), "this isn't a map's file"),
        ((tmp_path / "empty", "--map", map_file, *known), "there are no images to localise"),
        ((tmp_path / "none.png", "--map", map_file, *known), "there are no images to localise"),
        ((tmp_path / "map.bin", "--map", map_file, *known), "an image can't be read"),
        ((bad / "a.png", "--map", map_file), "a file with intrinsics has something else"),
    ):
        with pytest.raises(SystemExit, match="2"):
            app(list(map(str, arguments)))
        assert message in capsys.readouterr().err, arguments


@pytest.mark.parametrize("kind", ["pipe", "link to a pipe", "link to nothing"])
def test_answers_go_to_no_pipe_and_through_no_link(tmp_path: Path, kind: str) -> None:
    """As /dev/stdout is: reading it would never end, and a file in its place would be worse."""
    pipe, link = tmp_path / "pipe", tmp_path / "link"
    os.mkfifo(pipe)
    link.symlink_to(pipe if kind == "link to a pipe" else tmp_path / "nothing")
    out = pipe if kind == "pipe" else link
    with pytest.raises(UserError, match=r"(?s)no file of earlier answers.*leave it out"):
        _refuse_other_file(out)
    assert pipe.is_fifo() and link.is_symlink()
