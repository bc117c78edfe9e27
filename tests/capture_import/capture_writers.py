"""A tiny walk, and writers that store it as each app would."""

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import Limits, Reject, Session
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, Array, inverse, make_pose, tq_from_pose

WIDTH, HEIGHT = 96, 72


@dataclass(frozen=True)
class Walk:
    """The truth that a written capture must read back to: OpenCV camera axes, world +y up."""

    t_ns: np.ndarray
    vio_T_cam: Array
    camera: Array  # (N, 4): fx, fy, cx, cy
    has_image: np.ndarray  # (N,)
    pictures: np.ndarray | None = None  # (N, H, W, 3); made-up textures where there are none

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the images."""
        return (WIDTH, HEIGHT) if self.pictures is None else (self.pictures.shape[2], self.pictures.shape[1])

    def picture(self, index: int) -> np.ndarray:
        """What the camera sees at a pose (H, W, 3)."""
        return image(index) if self.pictures is None else self.pictures[index]

    def jpeg(self, index: int) -> bytes:
        return cv2.imencode(".jpg", self.picture(index), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    def png(self, index: int) -> bytes:
        return cv2.imencode(".png", self.picture(index))[1].tobytes()

    def arkit(self) -> Array:
        """The poses as ARKit writes them (N, 4, 4)."""
        return self.vio_T_cam @ inverse(ARKIT_CAM_T_CAM)


def make_walk(count: int = 24, rate_hz: float = 10.0, every: int = 2, seed: int = 0, start_s: float = 5000.0) -> Walk:
    """A curved walk at about 1 m/s, the phone upright and looking around; an image at every `every`-th pose."""
    rng = np.random.default_rng(seed)
    s = np.arange(count) / rate_hz
    positions = np.stack([2 * np.sin(0.5 * s), 1.4 + 0.02 * np.sin(6 * s), -0.9 * s], axis=-1)
    yaw, pitch, roll = 0.4 * np.sin(0.7 * s), 0.1 * np.sin(1.3 * s) - 0.1, 0.05 * np.sin(s)
    # Camera axes of a phone that looks along -z of the world: x right, y down, z forward.
    upright = np.diag([1.0, -1.0, -1.0])
    rotations = Rotation.from_euler("YXZ", np.stack([yaw, pitch, roll], axis=-1)).as_matrix() @ upright
    camera = np.stack([np.full(count, 80.0), np.full(count, 80.0), np.full(count, 48.5), np.full(count, 35.5)], axis=-1)
    camera += rng.uniform(-0.4, 0.4, (count, 1)) * [1, 1, 0.2, 0.2]
    t_ns = np.round((start_s + s) * 1e9).astype(np.int64)
    return Walk(t_ns, make_pose(rotations, positions), camera, np.arange(count) % every == 0)


def image(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A textured image (H, W, 3) that differs from index to index."""
    rng = np.random.default_rng(1000 + index)
    coarse = rng.integers(0, 255, (height // 8 + 1, width // 8 + 1, 3), dtype=np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST)


def jpeg(index: int, width: int = WIDTH, height: int = HEIGHT) -> bytes:
    return cv2.imencode(".jpg", image(index, width, height))[1].tobytes()


def write_scanner_app(folder: Path, walk: Walk, private: bool = False) -> None:
    """3D Scanner App, "All Data"."""
    folder.mkdir(parents=True)
    info: dict[str, object] = {"title": "a room", "appVersionString": "1.9.7"}
    if private:
        info |= {"latitude": 48.123456, "longitude": 11.654321}
    (folder / "info.json").write_text(json.dumps(info))
    for i, pose in enumerate(walk.arkit()):
        fx, fy, cx, cy = walk.camera[i]
        projection = np.zeros((4, 4))
        projection[0, 0], projection[1, 1] = 2 * fx / walk.size[0], 2 * fy / walk.size[1]
        row = {
            "time": walk.t_ns[i] * 1e-9,
            "frame_index": i,
            "cameraPoseARFrame": pose.ravel().tolist(),
            "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "projectionMatrix": projection.ravel().tolist(),
            "exposureDuration": 0.01,
        }
        if private:
            row |= {"latitude": 48.123456, "longitude": 11.654321}
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(row))
        if walk.has_image[i]:
            (folder / f"frame_{i:05d}.jpg").write_bytes(walk.jpeg(i))


def video_frame(bgr: np.ndarray) -> av.VideoFrame:
    """An image as an encoder takes it: when it's left to the encoder, the conversion's result differs now and then."""
    return av.VideoFrame.from_ndarray(bgr, format="bgr24").reformat(format="yuv420p")


def write_video(path: Path, walk: Walk, indices: np.ndarray) -> None:
    """A video of the walk's images with these indices, the same to the byte each time."""
    rate_hz = round(1e9 / float(np.median(np.diff(walk.t_ns[indices]))))
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=rate_hz)
        stream.width, stream.height = walk.size
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "10"}
        for index in indices:
            container.mux(stream.encode(video_frame(walk.picture(index))))
        container.mux(stream.encode())


def write_stray_scanner(folder: Path, walk: Walk, per_frame: bool = True) -> None:
    """Stray Scanner: OpenCV camera axes, xyzw."""
    folder.mkdir(parents=True)
    t, q = tq_from_pose(walk.vio_T_cam)
    names = ["timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw"] + ["fx", "fy", "cx", "cy"] * per_frame
    lines = [", ".join(names)]
    for i in range(len(t)):
        values = [f"{walk.t_ns[i] * 1e-9:.9f}", f"{i:06d}", *map(repr, [*t[i].tolist(), *q[i].tolist()])]
        lines.append(", ".join(values + [repr(float(v)) for v in walk.camera[i]] * per_frame))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    fx, fy, cx, cy = walk.camera[-1]
    (folder / "camera_matrix.csv").write_text(f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0")
    write_video(folder / "rgb.mp4", walk, np.arange(len(t)))


def write_record3d(folder: Path, walk: Walk, archive: bool = False) -> None:
    """Record3D: an exported folder, or an .r3d archive beside it."""
    t, q = tq_from_pose(walk.arkit())
    metadata = {
        "w": walk.size[0],
        "h": walk.size[1],
        "fps": 10,
        "K": [80.0, 0, 0, 0, 80.0, 0, 48.5, 35.5, 1],
        "poses": np.hstack([q, t]).tolist(),
        "frameTimestamps": (walk.t_ns * 1e-9).tolist(),
        "perFrameIntrinsicCoeffs": walk.camera.tolist(),
    }
    files = {"metadata" if archive else "metadata.json": json.dumps(metadata).encode()}
    for i in np.flatnonzero(walk.has_image):
        files[f"{'rgbd' if archive else 'rgb'}/{i}.jpg"] = walk.jpeg(int(i))
    _write(folder.with_suffix(".r3d") if archive else folder, files)


def write_polycam(folder: Path, walk: Walk) -> None:
    """Polycam raw."""
    files = {}
    for i, pose in enumerate(walk.arkit()):
        fx, fy, cx, cy = walk.camera[i].tolist()
        camera = {f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)}
        camera |= {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "blur_score": 80.0}
        camera |= dict(zip(("width", "height"), walk.size, strict=True))
        name = walk.t_ns[i] // 1000
        files[f"keyframes/cameras/{name}.json"] = json.dumps(camera).encode()
        wrong = camera | {"t_03": 99.0}
        files[f"keyframes/corrected_cameras/{name}.json"] = json.dumps(wrong).encode()
        if walk.has_image[i]:
            files[f"keyframes/images/{name}.jpg"] = walk.jpeg(i)
    _write(folder, files)


def write_nerf_capture(folder: Path, walk: Walk) -> None:
    """NeRFCapture: frames out of order, as the app writes them."""
    rows, files = [], {}
    for i in np.flatnonzero(walk.has_image):
        fx, fy, cx, cy = walk.camera[i].tolist()
        rows.append(
            {
                "file_path": f"images/{i}",
                "transform_matrix": walk.arkit()[i].tolist(),
                "timestamp": walk.t_ns[i] * 1e-9,
                **{"fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy, "w": walk.size[0], "h": walk.size[1]},
            }
        )
        files[f"images/{i}.png"] = walk.png(int(i))
    files["transforms.json"] = json.dumps({"w": walk.size[0], "h": walk.size[1], "frames": rows[::-1]}).encode()
    _write(folder, files)


def write_scan_capture(folder: Path, walk: Walk) -> None:
    """ScanCapture: a row a pose, a frame every second pose."""
    t, q = tq_from_pose(walk.arkit())
    lines = ["# phone iOS 15", "# timestamp, status, tx, ty, tz, qx, qy, qz, qw, w, h, fx, fy, cx, cy, exposure"]
    for i in range(len(t)):
        values = [*t[i].tolist(), *q[i].tolist(), *walk.size, *walk.camera[i].tolist()]
        lines.append(", ".join([str(walk.t_ns[i] // 1000), "normal", *map(repr, values), "16000"]))
    _write(folder, {"poses.txt": "\n".join(lines).encode()})
    write_video(folder / "images.mp4", walk, np.flatnonzero(walk.has_image))


def write_ios_logger(folder: Path, walk: Walk) -> None:
    """ios_logger: quaternions w first, seconds since 1970."""
    t, q = tq_from_pose(walk.arkit())
    poses = [[walk.t_ns[i] * 1e-9, *t[i].tolist(), q[i, 3], *q[i, :3].tolist()] for i in range(len(t))]
    frames = [[walk.t_ns[i] * 1e-9, n, *walk.camera[i].tolist()] for n, i in enumerate(np.flatnonzero(walk.has_image))]
    text = {
        name: "\r\n".join(",".join(repr(float(v)) for v in row) for row in rows)
        for name, rows in {"ARposes.txt": poses, "Frames.txt": frames}.items()
    }
    _write(folder, {name: content.encode() for name, content in text.items()})
    write_video(folder / "Frames.m4v", walk, np.flatnonzero(walk.has_image))


def write_spectacular_ai(folder: Path, walk: Walk) -> None:
    """Spectacular AI: device axes, world +z up, video every second pose."""
    device_T_cam = make_pose(Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix(), [0.02, -0.01, 0.005])
    zup_T_yup = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    t, q = tq_from_pose(zup_T_yup @ walk.vio_T_cam @ inverse(device_T_cam))
    output, data = [], []
    for i in range(len(t)):
        time = walk.t_ns[i] * 1e-9
        pose = {"position": dict(zip("xyz", t[i].tolist(), strict=True))}
        pose["orientation"] = dict(zip("xyzw", q[i].tolist(), strict=True))
        output.append({"time": time, "status": "TRACKING", **pose})
        data.append({"time": time, "sensor": {"type": "gyroscope", "values": [0, 0, 0]}})
        if walk.has_image[i]:
            fx, fy, cx, cy = walk.camera[i].tolist()
            camera = {"focalLengthX": fx, "focalLengthY": fy, "principalPointX": cx, "principalPointY": cy}
            data.append(
                {
                    "time": time,
                    "number": int(walk.has_image[:i].sum()),
                    "frames": [{"cameraInd": 0, "cameraParameters": camera}],
                }
            )
    calibration = {"cameras": [{"model": "pinhole", "imuToCamera": inverse(device_T_cam).tolist()}]}
    rows = {"output.jsonl": output, "data.jsonl": data, "calibration.json": [calibration]}
    _write(folder, {name: "\n".join(map(json.dumps, content)).encode() for name, content in rows.items()})
    write_video(folder / "data.mp4", walk, np.flatnonzero(walk.has_image))


def write_frames_jsonl(folder: Path, walk: Walk) -> None:
    """Our own format."""
    rows: list[dict[str, object]] = [{"groundwalk": "frames", "version": 1, "device": "phone", "clock": "boot"}]
    files = {}
    for i, pose in enumerate(walk.vio_T_cam):
        row: dict[str, object] = {"t_ns": int(walk.t_ns[i]), "vio_T_cam": pose.ravel().tolist(), "tracking": "normal"}
        if walk.has_image[i]:
            fx, fy, cx, cy = walk.camera[i].tolist()
            row |= {"image": f"images/{i}.jpg", "fx": fx, "fy": fy, "cx": cx, "cy": cy}
            row |= dict(zip(("width", "height"), walk.size, strict=True))
            files[f"images/{i}.jpg"] = walk.jpeg(i)
        rows.append(row)
    files["frames.jsonl"] = "\n".join(map(json.dumps, rows)).encode()
    _write(folder, files)


def write_arkit_logger(folder: Path, walk: Walk) -> None:
    """ARKit Data Logger: poses only."""
    rows = [f"{walk.t_ns[i]} " + " ".join(map(repr, p[:3].ravel().tolist())) for i, p in enumerate(walk.arkit())]
    _write(folder, {"ARKit_camera_pose.txt": "\n".join(["# Created at noon", *rows]).encode()})


def write_arcore_logger(folder: Path, walk: Walk) -> None:
    """ARCore Data Logger: poses only."""
    t, q = tq_from_pose(walk.arkit())
    rows = [f"{walk.t_ns[i]} " + " ".join(map(repr, [*q[i].tolist(), *t[i].tolist()])) for i in range(len(t))]
    _write(folder, {"ARCore_sensor_pose.txt": "\n".join(["# Created at noon", *rows]).encode()})


def write_invisible_map(folder: Path, walk: Walk) -> None:
    """An invisible map's walk: poses only, column-major."""
    poses = [
        {"timestamp": walk.t_ns[i] * 1e-9, "pose": p.T.ravel().tolist(), "id": i} for i, p in enumerate(walk.arkit())
    ]
    _write(folder, {"walk.json": json.dumps({"map_id": "m", "pose_data": poses}).encode()})


def write_arkit_scenes(folder: Path, walk: Walk) -> None:
    """ARKitScenes raw: world-to-camera axis-angle in a world with +z up."""
    zup_T_yup = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    cam_T_world = inverse(zup_T_yup @ walk.vio_T_cam)
    vectors = Rotation.from_matrix(cam_T_world[:, :3, :3]).as_rotvec()
    lines, files = [], {}
    for i in range(len(vectors)):
        time = f"{walk.t_ns[i] * 1e-9:.3f}"
        lines.append(" ".join([time, *map(repr, [*vectors[i].tolist(), *cam_T_world[i, :3, 3].tolist()])]))
        if walk.has_image[i]:
            files[f"vga_wide/4711_{time}.png"] = walk.png(i)
            numbers = " ".join(map(repr, walk.camera[i].tolist()))
            files[f"vga_wide_intrinsics/4711_{time}.pincam"] = f"{walk.size[0]} {walk.size[1]} {numbers}".encode()
    files["lowres_wide.traj"] = "\n".join(lines).encode()
    _write(folder, files)


def _tum_row(walk: Walk, i: int) -> str:
    t, q = tq_from_pose(walk.vio_T_cam[i])
    return " ".join([f"{walk.t_ns[i] * 1e-9:.9f}", *map(repr, [*t.tolist(), *q.tolist()])])


def write_tum(folder: Path, walk: Walk) -> None:
    """TUM RGB-D's lists, with one camera for all images."""
    seen = np.flatnonzero(walk.has_image).tolist()
    files = {f"rgb/{i}.png": walk.png(i) for i in seen}
    files["rgb.txt"] = "".join(f"{walk.t_ns[i] * 1e-9:.9f} rgb/{i}.png\n" for i in seen).encode()
    files["groundtruth.txt"] = "\n".join(_tum_row(walk, i) for i in range(len(walk.t_ns))).encode()
    files["camera.txt"] = " ".join(map(repr, walk.camera[0].tolist())).encode()
    _write(folder, files)


def write_euroc(folder: Path, walk: Walk) -> None:
    """EuRoC: poses of a body, world +z up, with one camera for all images."""
    body_T_cam = make_pose(Rotation.from_euler("xyz", [90, 20, 5], degrees=True).as_matrix(), [0.1, -0.2, 0.3])
    zup_T_yup, rows = make_pose(Rotation.from_euler("x", 90, degrees=True).as_matrix(), [0.0, 0.0, 0.0]), []
    for t_ns, vio_T_cam in zip(walk.t_ns, walk.vio_T_cam, strict=True):
        t, (qx, qy, qz, qw) = tq_from_pose(zup_T_yup @ vio_T_cam @ inverse(body_T_cam))
        rows.append(",".join([str(t_ns), *map(repr, [*t.tolist(), float(qw), float(qx), float(qy), float(qz)])]))
    seen = np.flatnonzero(walk.has_image).tolist()
    camera = (
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {body_T_cam.ravel().tolist()}\nrate_hz: 20\n"
        f"resolution: {list(walk.size)}\nintrinsics: {walk.camera[0].tolist()} #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )
    files = {f"mav0/cam0/data/{walk.t_ns[i]}.png": walk.png(i) for i in seen}
    files["mav0/cam0/data.csv"] = ("#t,file\n" + "".join(f"{walk.t_ns[i]},{walk.t_ns[i]}.png\n" for i in seen)).encode()
    files["mav0/cam0/sensor.yaml"] = camera.encode()
    files["mav0/state_groundtruth_estimate0/data.csv"] = "\n".join(["#t,p,q", *rows]).encode()
    _write(folder, files)


def write_rtabmap(folder: Path, walk: Walk) -> None:
    """RTAB-Map's export, of frames with an image."""
    files = {}
    for i in (seen := np.flatnonzero(walk.has_image).tolist()):
        fx, fy, cx, cy = walk.camera[i].tolist()
        files[f"scan_rgb/{i}.jpg"] = walk.jpeg(i)
        files[f"scan_calib/{i}.yaml"] = (
            f"%YAML:1.0\nimage_width: {walk.size[0]}\nimage_height: {walk.size[1]}\ncamera_matrix:\n   rows: 3\n"
            f"   data: [ {fx!r}, 0., {cx!r}, 0., {fy!r}, {cy!r}, 0., 0., 1. ]\n"
            "distortion_coefficients:\n   rows: 1\n   data: [ 0., 0., 0., 0., 0. ]\n"
        ).encode()
    files["scan_camera_poses.txt"] = "\n".join(f"{_tum_row(walk, i)} {i}" for i in seen).encode()
    _write(folder, files)


def write_seven_scenes(folder: Path, walk: Walk) -> None:
    """7-Scenes: a sequence, with the scene's split beside it."""
    files = {}
    for i, pose in enumerate(walk.vio_T_cam):
        files[f"frame-{i:06d}.pose.txt"] = "\n".join("\t".join(map(repr, row)) for row in pose.tolist()).encode()
        if walk.has_image[i]:
            files[f"frame-{i:06d}.color.png"] = (
                cv2.imencode(".png", image(i, 640, 480))[1].tobytes() if walk.pictures is None else walk.png(i)
            )
    _write(folder, files)


def write_cambridge(folder: Path, walk: Walk) -> None:
    """Cambridge Landmarks: world-to-camera quaternions, w first, and a VisualSFM model with focal lengths."""
    _, q = tq_from_pose(inverse(walk.vio_T_cam))
    rows, cameras, files = [], [], {}
    for i in np.flatnonzero(walk.has_image):
        name = f"{folder.name}/frame{i:05d}"
        xyz = walk.vio_T_cam[i, :3, 3].tolist()
        rows.append(f"{name}.png " + " ".join(map(repr, [*xyz, q[i, 3].item(), *q[i, :3].tolist()])))
        cameras.append(f"{name}.jpg {walk.camera[i, 0].item()!r} 1 0 0 0 0 0 0 0 0")
        files[f"{name}.png"] = walk.png(int(i))
    heads = "Visual Landmark Dataset V1\nImageFile, Camera Position [X Y Z W P Q R]\n\n"
    files["dataset_train.txt"] = (heads + "\n".join(rows)).encode()
    files["reconstruction.nvm"] = f"NVM_V3\n\n{len(cameras)}\n{chr(10).join(cameras)}".encode()
    _write(folder.parent, files)


def write_colmap(folder: Path, walk: Walk) -> None:
    """A COLMAP model in binary, written by its own library, over a flat folder of images."""
    model = pycolmap.Reconstruction()
    for number, i in enumerate(np.flatnonzero(walk.has_image), start=1):
        width, height = walk.size
        camera = pycolmap.Camera(
            camera_id=number, model="PINHOLE", width=width, height=height, params=walk.camera[i].tolist()
        )
        model.add_camera_with_trivial_rig(camera)
        points = np.full((number % 3, 2), 9.0)
        image = pycolmap.Image(name=f"{i:06d}.jpg", keypoints=points, camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(walk.vio_T_cam[i])[:3]))
    (folder / "sparse" / "0").mkdir(parents=True)
    model.write_binary(folder / "sparse" / "0")
    _write(folder, {f"images/{i:06d}.jpg": walk.jpeg(int(i)) for i in np.flatnonzero(walk.has_image)})


def write_nerfstudio(folder: Path, walk: Walk) -> None:
    """nerfstudio: OpenGL camera axes, one size for all frames, their own focal lengths."""
    frames, files = [], {}
    for i in np.flatnonzero(walk.has_image):
        name = f"images/{i:06d}.jpg"
        camera = dict(zip(("fl_x", "fl_y", "cx", "cy"), walk.camera[i].tolist(), strict=True))
        frames.append({"file_path": name, "transform_matrix": walk.arkit()[i].tolist(), **camera})
        files[name] = walk.jpeg(int(i))
    content = {"camera_model": "OPENCV", "w": walk.size[0], "h": walk.size[1], "frames": frames[::-1]}
    files["transforms.json"] = json.dumps(content).encode()
    _write(folder, files)


def _write(place: Path, files: dict[str, bytes]) -> None:
    """Write files into a folder, or into a zip archive where `place` has a suffix."""
    if place.suffix in (".r3d", ".zip"):
        place.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(place, "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return
    for name, content in files.items():
        path = place / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


@dataclass(frozen=True)
class Written:
    """A format's writer and what of a walk its files can hold."""

    write: Callable[[Path, Walk], None]
    images: bool = True
    camera: bool = True  # each image's own intrinsics
    clock: bool = True  # times to the microsecond


WRITERS = {
    "3d_scanner_app": Written(write_scanner_app),
    "stray_scanner": Written(write_stray_scanner),
    "record3d": Written(write_record3d),
    "polycam": Written(write_polycam),
    "nerf_capture": Written(write_nerf_capture),
    "scan_capture": Written(write_scan_capture),
    "ios_logger": Written(write_ios_logger),
    "spectacular_ai": Written(write_spectacular_ai),
    "frames_jsonl": Written(write_frames_jsonl),
    "arkit_logger": Written(write_arkit_logger, images=False),
    "arcore_logger": Written(write_arcore_logger, images=False),
    "invisible_map": Written(write_invisible_map, images=False),
    "arkit_scenes": Written(write_arkit_scenes),
    "tum": Written(write_tum, camera=False),
    "euroc": Written(write_euroc, camera=False),
    "rtabmap": Written(write_rtabmap),
    "seven_scenes": Written(write_seven_scenes, camera=False, clock=False),
    "cambridge": Written(write_cambridge, camera=False, clock=False),
    "colmap": Written(write_colmap, clock=False),
    "nerfstudio": Written(write_nerfstudio, clock=False),
}


def find_one(root: Path) -> RecordingSource:
    """The only recording in a folder; archives are unpacked beside it."""
    (found,) = find_recordings(root, root.parent / "unpacked", Limits())
    return found


def reader_of(root: Path) -> ImageReader:
    """Reads the images of a folder, and of archives that were unpacked beside it."""
    return ImageReader([root.resolve(), (root.parent / "unpacked").resolve()], Limits())


def sessions_in(root: Path) -> list[Session]:
    """The sessions of the only recording in a folder, with all images checked."""
    return sound_sessions(find_one(root).read(Limits()), reader_of(root).check, 0.5)


def rejects_of(sessions: list[Session]) -> list[Reject]:
    return [reject for session in sessions for reject in session.rejects]
