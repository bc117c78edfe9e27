"""A tiny walk, and writers that store it as each app would."""

import json
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pandas as pd
import pycolmap
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import Limits, Recording, Reject, Session
from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, Array, inverse, make_pose, tq_from_pose
from groundwalk.store import DataRoot, execute
from groundwalk.store.manifests import load_manifest

WIDTH, HEIGHT = 96, 72
_CAMERA, _SIZE = ("fx", "fy", "cx", "cy"), ("width", "height")
_ZUP_T_YUP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


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

    @property
    def all(self) -> list[int]:
        return list(range(len(self.t_ns)))

    @property
    def seen(self) -> list[int]:
        """The poses with an image."""
        return np.flatnonzero(self.has_image).tolist()

    def stated(self, index: int, camera: Sequence[str] = _CAMERA, size: Sequence[str] = _SIZE) -> dict[str, float]:
        """An image's intrinsics, and its size unless that has no keys."""
        return dict(zip(camera, self.camera[index].tolist(), strict=True)) | dict(zip(size, self.size, strict=False))

    def jpeg(self, index: int) -> bytes:
        return cv2.imencode(".jpg", self.picture(index), [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()

    def png(self, index: int) -> bytes:
        return cv2.imencode(".png", self.picture(index))[1].tobytes()

    def write_video(self, path: Path, indices: Sequence[int], hidden: int = 0) -> None:
        """A video of what is seen at these poses, at their rate; an edit list hides the first `hidden` ones."""
        rate_hz = round(1e9 / float(np.median(np.diff(self.t_ns[list(indices)]))))
        write_video(path, [self.picture(i) for i in indices], rate_hz, hidden)

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
    place = {"latitude": 48.123456, "longitude": 11.654321} if private else {}
    files = {"info.json": _json({"title": "a room", "appVersionString": "1.9.7"} | place)}
    for i, pose in enumerate(walk.arkit()):
        fx, fy, cx, cy = walk.camera[i].tolist()
        row = {
            "time": walk.t_ns[i] * 1e-9,
            "frame_index": i,
            "cameraPoseARFrame": pose.ravel().tolist(),
            "intrinsics": [fx, 0, cx, 0, fy, cy, 0, 0, 1],
            "projectionMatrix": np.diag([2 * fx / walk.size[0], 2 * fy / walk.size[1], 0, 0]).ravel().tolist(),
            "exposureDuration": 0.01,
        }
        files[f"frame_{i:05d}.json"] = _json(row | place)
    _write(folder, files | {f"frame_{i:05d}.jpg": walk.jpeg(i) for i in walk.seen})


def write_video(path: Path, pictures: Sequence[np.ndarray], rate_hz: int, hidden: int = 0, **options: str) -> None:
    """A video of pictures (H, W, 3), the same to the byte each time; an edit list hides the first `hidden` ones."""
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=rate_hz, options={"crf": "10"} | options)
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for tick, bgr in enumerate(pictures, -hidden):
            # When it's left to the encoder, the conversion's result differs now and then.
            frame = av.VideoFrame.from_ndarray(bgr, format="bgr24").reformat(format="yuv420p")
            frame.pts, frame.time_base = tick, Fraction(1, rate_hz)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_stray_scanner(folder: Path, walk: Walk, per_frame: bool = True) -> None:
    """Stray Scanner: OpenCV camera axes, xyzw."""
    t, q = tq_from_pose(walk.vio_T_cam)
    lines = [", ".join(["timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw"] + [*_CAMERA] * per_frame)]
    for i in walk.all:
        values = [f"{walk.t_ns[i] * 1e-9:.9f}", f"{i:06d}", _row(t[i], q[i], sep=", ")]
        lines.append(", ".join(values + [_row(walk.camera[i], sep=", ")] * per_frame))
    fx, fy, cx, cy = walk.camera[-1]
    matrix = f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0"
    _write(folder, {"odometry.csv": "\n".join(lines).encode(), "camera_matrix.csv": matrix.encode()})
    walk.write_video(folder / "rgb.mp4", walk.all)


def write_record3d(folder: Path, walk: Walk, archive: bool = False) -> None:
    """Record3D: an exported folder, or an .r3d archive beside it."""
    t, q = tq_from_pose(walk.arkit())
    metadata = {
        **dict(zip("wh", walk.size, strict=True)),
        "fps": 10,
        "K": [80.0, 0, 0, 0, 80.0, 0, 48.5, 35.5, 1],
        "poses": np.hstack([q, t]).tolist(),
        "frameTimestamps": (walk.t_ns * 1e-9).tolist(),
        "perFrameIntrinsicCoeffs": walk.camera.tolist(),
    }
    files = {f"{'rgbd' if archive else 'rgb'}/{i}.jpg": walk.jpeg(i) for i in walk.seen}
    files["metadata" if archive else "metadata.json"] = _json(metadata)
    _write(folder.with_suffix(".r3d") if archive else folder, files)


def write_polycam(folder: Path, walk: Walk) -> None:
    """Polycam raw."""
    files = {f"keyframes/images/{walk.t_ns[i] // 1000}.jpg": walk.jpeg(i) for i in walk.seen}
    for i, pose in enumerate(walk.arkit()):
        name = f"{walk.t_ns[i] // 1000}.json"
        camera = {f"t_{r}{c}": pose[r, c] for r in range(3) for c in range(4)} | walk.stated(i)
        files[f"keyframes/cameras/{name}"] = _json(camera)
        files[f"keyframes/corrected_cameras/{name}"] = _json(camera | {"t_03": 99.0})
    _write(folder, files)


def write_nerf_capture(folder: Path, walk: Walk) -> None:
    """NeRFCapture: frames out of order, as the app writes them."""
    frames = [
        {
            "file_path": f"images/{i}",
            "transform_matrix": walk.arkit()[i].tolist(),
            "timestamp": walk.t_ns[i] * 1e-9,
            **walk.stated(i, ("fl_x", "fl_y", "cx", "cy"), ("w", "h")),
        }
        for i in walk.seen[::-1]
    ]
    files = {f"images/{i}.png": walk.png(i) for i in walk.seen}
    _write(folder, files | {"transforms.json": _json({"frames": frames})})


def write_scan_capture(folder: Path, walk: Walk) -> None:
    """ScanCapture: a row a pose, a frame every second pose."""
    t, q = tq_from_pose(walk.arkit())
    lines = ["# phone iOS 15", "# timestamp, status, tx, ty, tz, qx, qy, qz, qw, w, h, fx, fy, cx, cy, exposure"]
    for i in walk.all:
        numbers = _row(t[i], q[i], walk.size, walk.camera[i], sep=", ")
        lines.append(f"{walk.t_ns[i] // 1000}, normal, {numbers}, 16000")
    _write(folder, {"poses.txt": "\n".join(lines).encode()})
    walk.write_video(folder / "images.mp4", walk.seen)


def write_ios_logger(folder: Path, walk: Walk) -> None:
    """ios_logger: quaternions w first, seconds since 1970."""
    t, q = tq_from_pose(walk.arkit())
    seconds = (walk.t_ns * 1e-9)[:, None]
    poses = [_row(seconds[i], t[i], q[i, 3:], q[i, :3], sep=",") for i in walk.all]
    frames = [_row(seconds[i], [n], walk.camera[i], sep=",") for n, i in enumerate(walk.seen)]
    _write(folder, {"ARposes.txt": "\r\n".join(poses).encode(), "Frames.txt": "\r\n".join(frames).encode()})
    walk.write_video(folder / "Frames.m4v", walk.seen)


def write_spectacular_ai(folder: Path, walk: Walk) -> None:
    """Spectacular AI: device axes, world +z up, video every second pose."""
    device_T_cam = make_pose(Rotation.from_rotvec([0.3, -1.2, 0.5]).as_matrix(), [0.02, -0.01, 0.005])
    t, q = tq_from_pose(_ZUP_T_YUP @ walk.vio_T_cam @ inverse(device_T_cam))
    names = ("focalLengthX", "focalLengthY", "principalPointX", "principalPointY")
    output, data = [], []
    for i in walk.all:
        time = walk.t_ns[i] * 1e-9
        position, orientation = (
            dict(zip("xyz", t[i].tolist(), strict=True)),
            dict(zip("xyzw", q[i].tolist(), strict=True)),
        )
        output.append({"time": time, "status": "TRACKING", "position": position, "orientation": orientation})
        data.append({"time": time, "sensor": {"type": "gyroscope", "values": [0, 0, 0]}})
        if i in walk.seen:
            camera = dict(zip(names, walk.camera[i].tolist(), strict=True))
            data.append({"time": time, "frames": [{"cameraInd": 0, "cameraParameters": camera}]})
    calibration = {"cameras": [{"model": "pinhole", "imuToCamera": inverse(device_T_cam).tolist()}]}
    rows = {"output.jsonl": output, "data.jsonl": data, "calibration.json": [calibration]}
    _write(folder, {name: b"\n".join(map(_json, content)) for name, content in rows.items()})
    walk.write_video(folder / "data.mp4", walk.seen)


def write_frames_jsonl(folder: Path, walk: Walk) -> None:
    """Our own format."""
    rows: list[dict[str, object]] = [{"groundwalk": "frames", "version": 1, "device": "phone", "clock": "boot"}]
    for i, pose in enumerate(walk.vio_T_cam):
        image = {"image": f"images/{i}.jpg", **walk.stated(i)} if i in walk.seen else {}
        row = {"t_ns": int(walk.t_ns[i]), "vio_T_cam": pose.ravel().tolist(), "tracking": "normal"}
        rows.append(row | image)
    files = {f"images/{i}.jpg": walk.jpeg(i) for i in walk.seen}
    _write(folder, files | {"frames.jsonl": b"\n".join(map(_json, rows))})


def write_arkit_logger(folder: Path, walk: Walk) -> None:
    """ARKit Data Logger: poses only."""
    rows = [f"{walk.t_ns[i]} {_row(p[:3].ravel())}" for i, p in enumerate(walk.arkit())]
    _write(folder, {"ARKit_camera_pose.txt": "\n".join(["# Created at noon", *rows]).encode()})


def write_arcore_logger(folder: Path, walk: Walk) -> None:
    """ARCore Data Logger: poses only."""
    t, q = tq_from_pose(walk.arkit())
    rows = [f"{walk.t_ns[i]} {_row(q[i], t[i])}" for i in walk.all]
    _write(folder, {"ARCore_sensor_pose.txt": "\n".join(["# Created at noon", *rows]).encode()})


def write_invisible_map(folder: Path, walk: Walk) -> None:
    """An invisible map's walk: poses only, column-major."""
    poses = [{"timestamp": walk.t_ns[i] * 1e-9, "pose": p.T.ravel().tolist()} for i, p in enumerate(walk.arkit())]
    _write(folder, {"walk.json": _json({"map_id": "m", "pose_data": poses})})


def write_arkit_scenes(folder: Path, walk: Walk) -> None:
    """ARKitScenes raw: world-to-camera axis-angle in a world with +z up."""
    cam_T_world = inverse(_ZUP_T_YUP @ walk.vio_T_cam)
    vectors = Rotation.from_matrix(cam_T_world[:, :3, :3]).as_rotvec()
    times = [f"{t_ns * 1e-9:.3f}" for t_ns in walk.t_ns]
    lines = [f"{times[i]} {_row(vectors[i], cam_T_world[i, :3, 3])}" for i in walk.all]
    files = {f"vga_wide/4711_{times[i]}.png": walk.png(i) for i in walk.seen}
    for i in walk.seen:
        files[f"vga_wide_intrinsics/4711_{times[i]}.pincam"] = _row(walk.size, walk.camera[i]).encode()
    _write(folder, files | {"lowres_wide.traj": "\n".join(lines).encode()})


def _tum_row(walk: Walk, i: int) -> str:
    return f"{walk.t_ns[i] * 1e-9:.9f} {_row(*tq_from_pose(walk.vio_T_cam[i]))}"


def write_tum(folder: Path, walk: Walk) -> None:
    """TUM RGB-D's lists, with one camera for all images."""
    files = {f"rgb/{i}.png": walk.png(i) for i in walk.seen}
    files["rgb.txt"] = "".join(f"{walk.t_ns[i] * 1e-9:.9f} rgb/{i}.png\n" for i in walk.seen).encode()
    files["groundtruth.txt"] = "\n".join(_tum_row(walk, i) for i in walk.all).encode()
    files["camera.txt"] = _row(walk.camera[0]).encode()
    _write(folder, files)


def write_pose_list(folder: Path, walk: Walk) -> None:
    """A SLAM system's trajectory beside images that are named by their times."""
    files = {f"images/{walk.t_ns[i]}.png": walk.png(i) for i in walk.seen}
    rows = ["# time, position, quaternion", *(_tum_row(walk, i) for i in walk.all)]
    files["CameraTrajectory.txt"] = "\n".join(rows).encode()
    files["camera.txt"] = _row(walk.camera[0]).encode()
    _write(folder, files)


def write_euroc(folder: Path, walk: Walk) -> None:
    """EuRoC: poses of a body, world +z up, with one camera for all images; its pixel centres are whole numbers."""
    body_T_cam = make_pose(Rotation.from_euler("xyz", [90, 20, 5], degrees=True).as_matrix(), [0.1, -0.2, 0.3])
    t, q = tq_from_pose(_ZUP_T_YUP @ walk.vio_T_cam @ inverse(body_T_cam))
    rows = [f"{walk.t_ns[i]},{_row(t[i], q[i, 3:], q[i, :3], sep=',')}" for i in walk.all]
    camera = (
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {body_T_cam.ravel().tolist()}\nrate_hz: 20\n"
        f"resolution: {list(walk.size)}\nintrinsics: {(walk.camera[0] - [0, 0, 0.5, 0.5]).tolist()} #fu, fv, cu, cv\n"
        "distortion_model: radial-tangential\ndistortion_coefficients: [0.0, 0.0, 0.0, 0.0]\n"
    )
    listed = "".join(f"{walk.t_ns[i]},{walk.t_ns[i]}.png\n" for i in walk.seen)
    files = {f"mav0/cam0/data/{walk.t_ns[i]}.png": walk.png(i) for i in walk.seen}
    files |= {"mav0/cam0/data.csv": f"#t,file\n{listed}".encode(), "mav0/cam0/sensor.yaml": camera.encode()}
    files["mav0/state_groundtruth_estimate0/data.csv"] = "\n".join(["#t,p,q", *rows]).encode()
    _write(folder, files)


def write_rtabmap(folder: Path, walk: Walk) -> None:
    """RTAB-Map's export, of frames with an image."""
    files = {f"scan_rgb/{i}.jpg": walk.jpeg(i) for i in walk.seen}
    for i in walk.seen:
        fx, fy, cx, cy = walk.camera[i].tolist()
        files[f"scan_calib/{i}.yaml"] = (
            f"%YAML:1.0\nimage_width: {walk.size[0]}\nimage_height: {walk.size[1]}\ncamera_matrix:\n   rows: 3\n"
            f"   data: [ {fx!r}, 0., {cx!r}, 0., {fy!r}, {cy!r}, 0., 0., 1. ]\n"
            "distortion_coefficients:\n   rows: 1\n   data: [ 0., 0., 0., 0., 0. ]\n"
        ).encode()
    files["scan_camera_poses.txt"] = "\n".join(f"{_tum_row(walk, i)} {i}" for i in walk.seen).encode()
    _write(folder, files)


def write_kitti(folder: Path, walk: Walk) -> None:
    """A sequence of KITTI's with images of camera 2 and poses of camera 0, half a metre to its right."""
    fx, fy, cx, cy = (walk.camera[0] - [0, 0, 0.5, 0.5]).tolist()
    cam_T_cam0 = make_pose(np.eye(3), [0.5, 0, 0])
    pinholes = [f"P0: {fx} 0 {cx} 0 0 {fy} {cy} 0 0 0 1 0", f"P2: {fx} 0 {cx} {fx * 0.5} 0 {fy} {cy} 0 0 0 1 0"]
    lists = {
        "calib": pinholes,
        "times": [repr(t * 1e-9) for t in walk.t_ns.tolist()],
        "poses": [_row((pose @ cam_T_cam0)[:3].ravel()) for pose in walk.vio_T_cam],
    }
    files = {f"{name}.txt": "\n".join(rows).encode() for name, rows in lists.items()}
    _write(folder, files | {f"image_2/{i:06d}.png": walk.png(i) for i in walk.seen})


def write_seven_scenes(folder: Path, walk: Walk) -> None:
    """7-Scenes: a sequence, with the scene's split beside it."""
    files = {f"frame-{i:06d}.pose.txt": b"\n".join(_row(r).encode() for r in p) for i, p in enumerate(walk.vio_T_cam)}
    for i in walk.seen:
        picture = image(i, 640, 480) if walk.pictures is None else walk.picture(i)
        files[f"frame-{i:06d}.color.png"] = cv2.imencode(".png", picture)[1].tobytes()
    _write(folder, files)


def write_cambridge(folder: Path, walk: Walk) -> None:
    """Cambridge Landmarks: world-to-camera quaternions, w first, and a VisualSFM model with focal lengths."""
    _, q = tq_from_pose(inverse(walk.vio_T_cam))
    name = f"{folder.name}/frame{{:05d}}".format
    rows = [f"{name(i)}.png {_row(walk.vio_T_cam[i, :3, 3], q[i, 3:], q[i, :3])}" for i in walk.seen]
    cameras = [f"{name(i)}.jpg {walk.camera[i, 0].item()!r} 1 0 0 0 0 0 0 0 0" for i in walk.seen]
    heads = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
    files = {f"{name(i)}.png": walk.png(i) for i in walk.seen}
    files["dataset_train.txt"] = "\n".join([*heads, *rows]).encode()
    files["reconstruction.nvm"] = "\n".join(["NVM_V3", "", str(len(cameras)), *cameras]).encode()
    _write(folder.parent, files)


def write_colmap(folder: Path, walk: Walk) -> None:
    """A COLMAP model in binary, written by its own library, over a flat folder of images."""
    model = pycolmap.Reconstruction()
    for number, i in enumerate(walk.seen, start=1):
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
    _write(folder, {f"images/{i:06d}.jpg": walk.jpeg(i) for i in walk.seen})


def write_nerfstudio(folder: Path, walk: Walk) -> None:
    """nerfstudio: OpenGL camera axes, one size for all frames, their own focal lengths."""
    frames = [
        {
            "file_path": f"images/{i:06d}.jpg",
            "transform_matrix": walk.arkit()[i].tolist(),
            **walk.stated(i, ("fl_x", "fl_y", "cx", "cy"), ()),
        }
        for i in walk.seen[::-1]
    ]
    content = {"camera_model": "OPENCV", **dict(zip("wh", walk.size, strict=True)), "frames": frames}
    files = {f"images/{i:06d}.jpg": walk.jpeg(i) for i in walk.seen}
    _write(folder, files | {"transforms.json": _json(content)})


def write_llff(folder: Path, walk: Walk) -> None:
    """LLFF: rows in the order of the images' names as text, one focal length, the principal point in the middle."""
    names = [f"{i}.jpg" for i in walk.seen]
    rows = []
    for i in (walk.seen[k] for k in np.argsort(names)):
        right, down, forward, position = walk.vio_T_cam[i, :3].T
        matrix = np.column_stack([down, right, -forward, position, [*walk.size[::-1], walk.camera[0, 0]]])
        rows.append([*matrix.ravel(), 0.1, 100.0])
    _write(folder, {f"images/{name}": walk.jpeg(i) for name, i in zip(names, walk.seen, strict=True)})
    np.save(folder / "poses_bounds.npy", np.array(rows))


def _json(content: object) -> bytes:
    return json.dumps(content).encode()


def _row(*parts: Iterable[float], sep: str = " ") -> str:
    """Numbers that read back the same."""
    return sep.join(repr(float(value)) for part in parts for value in part)


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
    "kitti": Written(write_kitti, camera=False),
    "seven_scenes": Written(write_seven_scenes, camera=False, clock=False),
    "cambridge": Written(write_cambridge, camera=False, clock=False),
    "colmap": Written(write_colmap, clock=False),
    "nerfstudio": Written(write_nerfstudio, clock=False),
    "llff": Written(write_llff, camera=False, clock=False),
    "pose_list": Written(write_pose_list, camera=False),
}


def find_one(root: Path) -> RecordingSource:
    """The only recording in a folder; archives are unpacked beside it."""
    (found,) = find_recordings(root, root.parent / "unpacked", Limits())
    return found


def read_one(root: Path, format_name: str = "auto", say: Callable[[str], None] = lambda line: None) -> Recording:
    """The only recording in a folder, as it is read; `say` gets what is said of the others."""
    (found,) = find_recordings(root, root.parent / "unpacked", Limits(), format_name, say)
    return found.read(Limits())


def reader_of(root: Path) -> ImageReader:
    """Reads the images of a folder, and of archives that were unpacked beside it."""
    return ImageReader([root.resolve(), (root.parent / "unpacked").resolve()], Limits())


@dataclass(frozen=True)
class Imported:
    """What import wrote of a scene."""

    folder: Path
    tables: dict[str, pd.DataFrame]
    figures: dict[str, Any]

    def __getitem__(self, table: str) -> pd.DataFrame:
        return self.tables[table]


def imported(data: Path, *settings: str, scene: str = "place") -> Imported:
    folder = execute(STAGE, scene, "tiny", DataRoot(data), list(settings))
    tables = {path.stem: pd.read_parquet(path) for path in folder.glob("*.parquet")}
    return Imported(folder, tables, load_manifest(folder)["figures"])


def sessions_in(root: Path) -> list[Session]:
    """The sessions of the only recording in a folder, with all images checked."""
    return sound_sessions(read_one(root), reader_of(root).check, 0.5)


def rejects_of(sessions: list[Session]) -> list[Reject]:
    return [reject for session in sessions for reject in session.rejects]
