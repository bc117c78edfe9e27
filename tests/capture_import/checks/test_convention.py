"""The convention check: right poses pass, each usual mistake is named."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from groundwalk.capture_import.capture import Image, ImageFile, Intrinsics, RawFrame, Recording, Session
from groundwalk.capture_import.checks.clock import check_clock
from groundwalk.capture_import.checks.convention import CONVENTIONS, check_convention
from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.media.images import check_image
from groundwalk.geometry.lens import rational_of_fisheye, undistort
from groundwalk.geometry.poses import Array, interpolate, make_pose
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.choices import Clock, PoseSource
from tests.capture_import.capture_writers import reader_of, sessions_in
from tests.known import there

# What undoes a mistake, where it isn't the mistake itself.
UNDONE_BY = {
    "quaternions are w first, read as w last": "quaternions are w last, read as w first",
    "image is turned by 90 degrees clockwise against the pose": "image is turned by 90 degrees counter-clockwise "
    "against the pose",
}


def room(
    tmp_path: Path,
    count: int = 10,
    step_m: float = 0.12,
    pace: float = 1.0,
    focal: float = 300.0,
    lens: tuple[float, ...] = (),
) -> Session:
    """A walk along two textured walls at different depths, seen by a camera that looks around."""
    rng = np.random.default_rng(3)
    coarse = cv2.resize(rng.integers(0, 255, (150, 150), dtype=np.uint8), (1200, 1200), interpolation=cv2.INTER_CUBIC)
    texture = cv2.addWeighted(coarse, 0.5, rng.integers(0, 255, (1200, 1200), dtype=np.uint8), 0.5, 0)
    camera = Intrinsics(focal, focal, 165.0, 118.0, distortion=lens)
    images = []
    for i in range(count):
        at = pace * i
        yaw, pitch, roll = 0.06 * np.sin(at), 0.05 * np.cos(2 * at), 0.3 + 0.05 * np.sin(3 * at)
        rotation = cv2.Rodrigues(np.array([np.pi + pitch, yaw, 0.0]))[0] @ cv2.Rodrigues(np.array([0, 0, roll]))[0]
        pose = make_pose(rotation, [step_m * i, 1.5 + step_m / 2 * np.sin(i), -step_m / 2 * i])
        picture = np.zeros((240, 320), np.uint8)
        for depth, left, right in ((-4.0, -3.0, 0.6), (-2.6, 0.6, 3.0)):
            picture = np.maximum(picture, _wall(texture, camera, pose, depth, left, right))
        path = tmp_path / f"{i}.png"
        cv2.imwrite(str(path), picture)
        check = check_image(path.read_bytes(), 1.0)
        images.append(Image(i * 10**8, pose, ImageFile(path), camera, number=i, source=path.name, check=check))
    return Session("room", Recording("phone", Clock.BOOT, tmp_path, images), [*images])


def _wall(
    texture: np.ndarray, camera: Intrinsics, world_T_cam: Array, depth: float, left: float, right: float
) -> np.ndarray:
    """A wall in the plane z = depth between two x, as the camera sees it."""
    cam_R_world, centre = world_T_cam[:3, :3].T, world_T_cam[:3, 3]
    per_px = 0.006
    # Texture pixels to the world, then to the camera.
    plane = np.array([[per_px, 0, -3.0], [0, -per_px, 4.5], [0, 0, 1]])
    world = np.array([[1, 0, 0], [0, 1, 0], [0, 0, depth]]) - np.outer(centre, [0, 0, 1])
    columns = np.arange(texture.shape[1]) * per_px - 3.0
    strip = np.where((columns >= left) & (columns < right), texture, 0).astype(np.uint8)
    x, y = np.meshgrid(np.arange(320.0), np.arange(240.0))
    px = np.stack([x.ravel() - camera.cx, y.ravel() - camera.cy], axis=1)
    ray = np.column_stack([undistort(px / [camera.fx, camera.fy], camera.distortion), np.ones(len(px))])
    at = np.linalg.solve(cam_R_world @ world @ plane, ray.T)
    at = (at[:2] / at[2]).astype(np.float32).reshape(2, 240, 320)
    return cv2.remap(strip, at[0], at[1], cv2.INTER_LINEAR)


def with_mistake(session: Session, name: str) -> Session:
    change = dict(CONVENTIONS)[name]
    images: list[RawFrame] = []
    for image in session.images:
        camera = image.camera
        pose, k = change((there(image.vio_T_cam), np.array([camera.fx, camera.fy, camera.cx, camera.cy])))
        mistaken = replace(Intrinsics(*k.tolist()), distortion=camera.distortion)
        images.append(replace(image, vio_T_cam=pose, intrinsics=mistaken))
    return replace(session, frames=images)


FISHEYE = tuple(rational_of_fisheye([0.0] * 4, 1.1, 1e-3).tolist())


MISTAKES = (
    "camera y and z axes have the other sign (ARKit's or OpenGL's for OpenCV's, or back)",
    "poses are world to camera",
    "quaternions are w first, read as w last",
    "image is turned by 90 degrees clockwise against the pose",
)


@pytest.mark.parametrize(
    ("focal", "lens", "mistakes"), [(300.0, (), MISTAKES), (190.0, FISHEYE, MISTAKES[:1])], ids=["pinhole", "fisheye"]
)
def test_right_poses_pass_and_mistakes_are_named(
    tmp_path: Path, focal: float, lens: tuple[float, ...], mistakes: tuple[str, ...]
) -> None:
    session = room(tmp_path, focal=focal, lens=lens)
    right = check_convention(session, reader_of(tmp_path))
    assert right.pairs >= 4 and right.declared > 0.9 and right.contradicted is None
    for name in mistakes:
        wrong = check_convention(with_mistake(session, name), reader_of(tmp_path))
        assert wrong.contradicted == UNDONE_BY.get(name, name)
    # Images without parallax tell nothing.
    still = check_convention(replace(session, frames=session.frames[:1] * 5), reader_of(tmp_path))
    assert still.pairs == 0 and still.contradicted is None


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


@pytest.fixture(scope="module")
def slow_walk(tmp_path_factory: pytest.TempPathFactory) -> Session:
    return room(tmp_path_factory.mktemp("slow"), count=40, step_m=0.004, pace=0.3)


@pytest.mark.parametrize("offset_s", [0.0, 0.12, -0.08])
def test_a_clock_that_is_off_is_measured(slow_walk: Session, offset_s: float) -> None:
    session = slow_walk
    # Poses at four times the rate of the images, which are stamped too early by the offset.
    poses, off_ns = np.array([frame.vio_T_cam for frame in session.frames]), round(offset_s * 1e9)

    def at(t_ns: np.ndarray) -> np.ndarray:
        return interpolate(session.t_ns, poses, t_ns)

    images = session.images[5:-5]
    stamps = np.array([image.t_ns - off_ns for image in images])
    stamped = [replace(i, t_ns=int(t), vio_T_cam=p) for i, t, p in zip(images, stamps, at(stamps), strict=True)]
    dense_ns = np.setdiff1d(np.arange(0, int(session.t_ns[-1]), 25_000_000), stamps)
    dense = [
        RawFrame(int(t), pose, number=100 + i) for i, (t, pose) in enumerate(zip(dense_ns, at(dense_ns), strict=True))
    ]
    frames = sorted([*dense, *stamped], key=lambda frame: frame.t_ns)
    check = check_clock(replace(session, frames=frames), reader_of(session.recording.folder))
    assert check.offset_s == pytest.approx(offset_s, abs=0.02)


def test_import_stops_at_a_wrong_convention(tmp_path: Path, shared_captures: Path) -> None:
    folder = tmp_path / "captures" / "chair" / "walk"
    folder.mkdir(parents=True)
    for path in (shared_captures / "chair" / "chair_scan").glob("frame_*"):
        if path.suffix == ".jpg":
            (folder / path.name).write_bytes(path.read_bytes())
            continue
        row = json.loads(path.read_text())
        pose = np.reshape(row["cameraPoseARFrame"], (4, 4)) @ np.diag([1.0, -1.0, -1.0, 1.0])
        (folder / path.name).write_text(json.dumps(row | {"cameraPoseARFrame": pose.ravel().tolist()}))
    with pytest.raises(UserError, match=r"(?s)don't fit the images.*y and z axes have the other sign"):
        execute(STAGE, "chair", "tiny", DataRoot(tmp_path))


@pytest.mark.slow
@pytest.mark.parametrize("capture", ["chair", "corridor"])
def test_every_mistake_is_found_in_real_captures(shared_captures: Path, capture: str) -> None:
    root = (shared_captures / capture).resolve()
    (session,) = sessions_in(root)
    load = reader_of(root)
    right = check_convention(session, load)
    assert right.declared > 0.85 and right.contradicted is None
    for name, _ in CONVENTIONS[1:]:
        wrong = check_convention(with_mistake(session, name), load)
        assert wrong.contradicted is not None, name
        # The one that was found leads back to the right poses.
        mended = check_convention(with_mistake(with_mistake(session, name), wrong.contradicted), load)
        assert mended.declared > 0.85, name
