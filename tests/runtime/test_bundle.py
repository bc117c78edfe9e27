"""A bundle from outside the toolkit: poses of images, damage that is seen, and images that it can't be asked about."""

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk import UserError
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.gravity import upright_rotation
from groundwalk.geometry.poses import pose_from_tq
from groundwalk.runtime import open_bundle
from groundwalk.runtime.bundle_file import MANIFEST, write_manifest
from groundwalk.runtime.preprocessing import Preprocessing
from groundwalk.runtime.queries import Query
from groundwalk.store.images import read_image
from tests.picture_wall import FOCAL, HEIGHT, WIDTH

NUMBERS = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
CAMERA = Camera(WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
BLOCKED = ("torch", "open3d", "pycolmap", "pandas", "pyarrow", "scipy", "rerun", "matplotlib", "PIL")


@pytest.fixture
def image(trained_wall: Path) -> Path:
    return trained_wall / "captures/Wall/later-0.png"


@pytest.fixture
def copy(wall_bundle: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(wall_bundle, tmp_path / "bundle"))


def signed(bundle: Path) -> None:
    """Write the manifest anew, as somebody would who made a bundle like this one."""
    known = ("format", "version", "files", "sha256")
    content = json.loads((bundle / MANIFEST).read_text())
    write_manifest(bundle, {name: value for name, value in content.items() if name not in known})


@pytest.mark.parametrize("intrinsics", [CAMERA, CAMERA.matrix, NUMBERS, {"fx": 50, "fy": 50, "cx": 32, "cy": 24}])
def test_an_image_has_a_pose(wall_bundle: Path, image: Path, intrinsics: Any) -> None:
    bundle = open_bundle(wall_bundle, network="fp32", threads=1, verify=True)
    images = (image, str(image), read_image(image))
    answers = [bundle.predict(each, intrinsics=intrinsics, gravity=[0, 1, 0]) for each in images]
    for answer in answers:
        assert np.array_equal(answer.map_T_cam, answers[0].map_T_cam) and answer.scene == "Wall"
        assert answer.map_T_cam == pytest.approx(pose_from_tq(answer.position, answer.quaternion), abs=1e-12)
        assert answer.covariance is None and answer.seconds.keys() == {"preprocessing", "network"}
    grey = cv2.cvtColor(read_image(image), cv2.COLOR_RGB2GRAY)
    assert np.isfinite(bundle.predict(np.asarray(grey), intrinsics=intrinsics).map_T_cam).all()


def test_an_image_of_another_size_is_the_same_view(wall_bundle: Path, image: Path) -> None:
    bundle = open_bundle(wall_bundle)
    large = np.asarray(cv2.resize(read_image(image), (4 * WIDTH, 4 * HEIGHT), interpolation=cv2.INTER_CUBIC), np.uint8)
    position = bundle.predict(large, intrinsics=[4 * n for n in NUMBERS]).position
    assert np.linalg.norm(position - bundle.predict(image, intrinsics=NUMBERS).position) < 0.1
    same = bundle.predict(large, intrinsics=CAMERA).position  # intrinsics that say which size they are for
    assert same == pytest.approx(position, abs=1e-6)


def test_one_changed_byte_is_seen_in_any_file(copy: Path) -> None:
    for path in sorted(p for p in copy.rglob("*") if p.is_file()):
        whole = path.read_bytes()
        middle = len(whole) // 2
        path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :])
        with pytest.raises(UserError, match=r"was changed|can't be read|isn't a bundle|lacks a file") as caught:
            open_bundle(copy)
        assert str(copy) in str(caught.value.details["where"])
        path.write_bytes(whole)
    open_bundle(copy)


def test_a_folder_that_is_no_usable_bundle_is_refused(copy: Path, tmp_path: Path) -> None:
    manifest = json.loads((copy / MANIFEST).read_text())
    for folder in (tmp_path / "none", tmp_path):
        with pytest.raises(UserError, match="isn't a bundle"):
            open_bundle(folder)
    with pytest.raises(UserError, match="no network 'int4'"):
        open_bundle(copy, network="int4")
    for content, message in (
        ("{", "can't be read"),
        ("[]", "isn't a bundle"),
        (manifest | {"version": [2, 0]}, "another version of its format(.|\n)*2.0(.|\n)*update groundwalk"),
        (manifest | {"version": "1"}, "another version of its format"),
        (manifest | {"scenes": ["Church"]}, "manifest was changed"),
    ):
        (copy / MANIFEST).write_text(content if isinstance(content, str) else json.dumps(content))
        with pytest.raises(UserError, match=message):
            open_bundle(copy)
    (copy / MANIFEST).write_text(json.dumps(manifest))
    (copy / "preprocessing.json").unlink()
    with pytest.raises(UserError, match=r"lacks a file(.|\n)*preprocessing\.json"):
        open_bundle(copy)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        ("preprocessing.json", {"steps": [{"step": "fold"}]}, "a step that isn't known: 'fold'"),
        ("preprocessing.json", None, "preprocessing isn't complete"),
        ("fp32.onnx", None, "can't load a bundle's network"),
    ],
)
def test_content_that_this_version_cannot_use_is_refused(copy: Path, file: str, change: Any, message: str) -> None:
    path = copy / file
    path.write_text(json.dumps(json.loads(path.read_text()) | change) if change else "{}")
    signed(copy)
    with pytest.raises(UserError, match=message):
        open_bundle(copy, network="fp32")


def test_golden_queries_tell_other_results(copy: Path) -> None:
    path = copy / "golden/golden.json"
    golden = json.loads(path.read_text())
    golden["queries"][0]["outputs"]["fp32"]["position"][1] += 0.1
    path.write_text(json.dumps(golden))
    signed(copy)
    with pytest.raises(UserError, match=r"golden query comes out differently here: network fp32(.|\n)*0\.1 m"):
        open_bundle(copy, network="fp32", verify=True)
    array = copy / "golden" / golden["queries"][0]["steps"][0]["file"]
    np.save(array, np.load(array)[:, ::-1])
    signed(copy)
    with pytest.raises(UserError, match="differently here: step pinhole"):
        open_bundle(copy, network="fp32", verify=True)


@pytest.mark.parametrize(
    ("size", "intrinsics", "message"),
    [
        ((WIDTH, HEIGHT), None, "no intrinsics: fx, fy, cx, cy"),
        ((WIDTH, HEIGHT), {"fx": 50.0}, "no intrinsics: fy, cx, cy"),
        ((WIDTH, HEIGHT), [5e5, 5e5, 32, 24], "focal lengths can't be those of this image"),
        ((HEIGHT, WIDTH), [50, 50, 24, 32], "an image has another shape(.|\n)*64 x 48 px(.|\n)*48 x 64 px"),
        ((WIDTH // 2, HEIGHT // 2), [25, 25, 16, 12], "too small for this network(.|\n)*40 px(.|\n)*32 x 24 px"),
        ((WIDTH, HEIGHT), Camera(160, 90, 100, 100, 80, 45), "intrinsics are of an image of another shape"),
    ],
)
def test_an_image_that_it_cannot_be_asked_about_is_refused(
    wall_bundle: Path, size: tuple[int, int], intrinsics: Any, message: str
) -> None:
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    with pytest.raises(UserError, match=message):
        open_bundle(wall_bundle).predict(pixels, intrinsics=intrinsics)


def test_other_shapes_are_refused_where_the_view_depends_on_them(copy: Path) -> None:
    path = copy / "preprocessing.json"
    content = json.loads(path.read_text())
    content["steps"][0] = {"step": "resize", "short_side_px": 40}
    path.write_text(json.dumps(content))
    signed(copy)
    wide = np.zeros((HEIGHT, 2 * WIDTH, 3), np.uint8)
    with pytest.raises(UserError, match="an image has another shape"):
        open_bundle(copy).predict(wide, intrinsics=[50, 50, 64, 24])


@pytest.mark.parametrize("roll_deg", [-100.0, -20.0, 0.0, 65.0])
def test_an_upright_network_sees_the_same_however_the_phone_is_rolled(roll_deg: float) -> None:
    steps = [
        {"step": "pinhole", "short_side_px": 80, "focal_px": 90.0},
        {"step": "upright_crop", "width_px": 40, "height_px": 30},
    ]
    image = {"width_px": 160, "height_px": 120}
    upright = Preprocessing(image, {"focal_factor": 1.0, "distortion": []}, tuple(steps))
    noise = np.random.default_rng(0).integers(0, 255, (20, 20, 3), dtype=np.uint8)
    world = np.asarray(cv2.resize(noise, (400, 400), interpolation=cv2.INTER_CUBIC), np.uint8)

    def seen(roll: float) -> np.ndarray:
        """What a camera rolled by an angle sees of a distant picture, turned upright."""
        turn = Rotation.from_euler("z", roll, degrees=True)  # cam_R_level is its inverse
        about = cv2.getRotationMatrix2D((199.5, 199.5), roll, 1.0)
        pixels = cv2.warpAffine(world, about, (400, 400))[140:260, 120:280].astype(np.uint8)
        gravity = turn.inv().apply([0.0, 1.0, 0.0])
        query = Query(pixels, Camera(160, 120, 135, 135, 80, 60), gravity, None)
        return list(upright.run(query))[-1][1].astype(float)

    assert np.abs(seen(roll_deg) - seen(0.0)).mean() < 6


def test_an_upright_network_is_tilted_by_gravity() -> None:
    crop: dict[str, Any] = {"step": "upright_crop", "width_px": 4, "height_px": 4}
    upright = Preprocessing({}, {}, (crop,))
    map_R_cam = Rotation.from_euler("xyz", [160, 30, 25], degrees=True).as_matrix()
    gravity = map_R_cam.T @ [0, -1, 0]
    tilted = Rotation.from_rotvec([0.2, 0, -0.1]).as_matrix() @ map_R_cam @ upright_rotation(gravity)
    assert upright.camera_rotation(tilted, gravity) == pytest.approx(map_R_cam, abs=1e-9)
    with pytest.raises(UserError, match="an image has no gravity"):
        image = {"width_px": 16, "height_px": 12}
        lens = {"focal_factor": 1.0, "distortion": []}
        steps = ({"step": "resize", "short_side_px": 8}, crop)
        query = Query(np.zeros((12, 16, 3), np.uint8), Camera(16, 12, 12, 12, 8, 6), None, None)
        list(Preprocessing(image, lens, steps).run(query))


def locate(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "groundwalk", "locate", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_command_answers(wall_bundle: Path, image: Path, tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(image.read_bytes())
    (tmp_path / "intrinsics.json").write_text(json.dumps(dict(zip(("fx", "fy", "cx", "cy"), NUMBERS, strict=True))))
    done = locate(tmp_path, "--bundle", wall_bundle, "--verify", "--network", "fp32", "--scene", "Wall")
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout)
    expected = open_bundle(wall_bundle, network="fp32").predict(image, intrinsics=NUMBERS)
    assert row["position_m"] == pytest.approx(expected.position.tolist(), abs=1e-6)
    assert (row["image"], row["scene"], row["refusal"]) == ("a.png", "Wall", None)
    assert "3 golden queries" in done.stderr and "1 of 1 images localised" in done.stderr


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "expected: --map or --bundle\n  found:    neither"),
        (["--bundle", "b", "--map", "m"], "found:    both"),
        (["--map", "m.gwm", "--verify"], "--network and --verify are about a bundle"),
        (["--bundle", "BUNDLE", "--scene", "Church"], "a bundle is of another scene"),
        (["--bundle", "BUNDLE"], "no intrinsics: fx, fy, cx, cy"),
    ],
)
def test_the_command_says_what_is_wrong(wall_bundle: Path, image: Path, options: list[str], message: str) -> None:
    done = locate(image, *(option.replace("BUNDLE", str(wall_bundle)) for option in options))
    assert done.returncode == 2 and message in done.stderr and not done.stdout


def test_a_bundle_needs_neither_torch_nor_colmap(wall_bundle: Path, image: Path) -> None:
    """In a process where these can't be imported: from Python, and by the command."""
    program = f"""
import sys
for name in {BLOCKED!r}:
    sys.modules[name] = None
from groundwalk.runtime import open_bundle
print(open_bundle({str(wall_bundle)!r}, verify=True).predict({str(image)!r}, intrinsics={NUMBERS}).position)
sys.argv = ["groundwalk", "locate", {str(image)!r}, "--bundle", {str(wall_bundle)!r}, "--intrinsics", "50,50,32,24"]
from groundwalk.cli import app
app()
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0 and '"scene": "Wall"' in done.stdout, done.stderr
