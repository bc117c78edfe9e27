"""Writes captures as the app 3D Scanner App exports them: a JSON file a pose, a JPEG for some of them, info.json."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, inverse, rotation_angle
from groundwalk.simulation.place import Vec
from groundwalk.store.simulated import FRAME


@dataclass(frozen=True)
class SessionFrames:
    """One session as its phone saw it: times (s since boot), vio_T_cam (OpenCV axes), fx fy cx cy, exposure (s),
    sensor noise in grey levels; `image_every` says which poses come with a JPEG."""

    name: str
    time_s: Vec
    vio_T_cam: Vec
    intrinsics_N4: Vec
    exposure_s: Vec
    noise: Vec
    width: int
    height: int
    image_every: int

    @property
    def image_indices(self) -> range:
        """The poses that have a picture."""
        return range(0, len(self.time_s), self.image_every)


def write_frames(folder: Path, session: SessionFrames) -> None:
    """info.json and every frame's JSON; pictures are written apart."""
    folder.mkdir(parents=True, exist_ok=True)
    speed, spin = _rates(session.time_s, session.vio_T_cam)
    arkit = session.vio_T_cam @ ARKIT_CAM_T_CAM
    for i in range(len(session.time_s)):
        frame = {
            "cameraPoseARFrame": _float32(arkit[i]),
            "projectionMatrix": _float32(_projection(session.intrinsics_N4[i], session.width, session.height)),
            "intrinsics": _float32(_matrix(session.intrinsics_N4[i])),
            "frame_index": i,
            "cameraGrain": float(np.float32(np.clip((session.noise[i] - 1.5) / 50, 0, 1))),
            "exposureDuration": float(np.float32(session.exposure_s[i])),
            "time": float(session.time_s[i]),
            "motionQuality": float(np.float32(np.clip(1 - 0.23 * speed[i] - 0.25 * spin[i], 0, 1))),
            "averageVelocity": float(np.float32(speed[i])),
            "averageAngularVelocity": float(np.float32(spin[i])),
        }
        _write_json(folder / f"{FRAME.format(i)}.json", frame)
    _write_json(folder / "info.json", _info(session, arkit[-1]))


def _rates(time_s: Vec, vio_T_cam: Vec) -> tuple[Vec, Vec]:
    """Speed (m/s) and turning rate (rad/s) since the frame before; 0 for the first."""
    step = np.diff(time_s)
    speed = np.linalg.norm(np.diff(vio_T_cam[:, :3, 3], axis=0), axis=1) / step
    turn = rotation_angle((inverse(vio_T_cam[:-1]) @ vio_T_cam[1:])[:, :3, :3]) / step
    return np.append(0.0, speed), np.append(0.0, turn)


def _matrix(intrinsics: Vec) -> Vec:
    fx, fy, cx, cy = intrinsics
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _projection(intrinsics: Vec, width: int, height: int) -> Vec:
    """ARKit's projection matrix with the far plane at infinity, for the same intrinsics."""
    fx, fy, cx, cy = intrinsics
    near = 0.001
    return np.array(
        [
            [2 * fx / width, 0, 1 - 2 * cx / width, 0],
            [0, 2 * fy / height, 2 * cy / height - 1, 0],
            [0, 0, -1, -near],
            [0, 0, -1, 0],
        ]
    )


def _float32(matrix: Vec) -> list[float]:
    """Row-major values as the app has them, in single precision."""
    return [float(v) for v in np.float32(matrix).ravel()]


def _info(session: SessionFrames, last_pose: Vec) -> dict[str, Any]:
    def named(matrix: Vec) -> dict[str, float]:
        # The app names entries by column, then row.
        return {f"m{c + 1}{r + 1}": float(np.float32(matrix[r, c])) for c in range(4) for r in range(4)}

    return {
        "title": session.name,
        "numImages": len(session.time_s),
        "captureMode": 3,
        "captureResolution": -1,
        "projectVersion": 1,
        "appVersionString": "1.9.7",
        "appBuildString": "1",
        "isFavorite": 0,
        "numVertices": 0,
        "numFaces": 0,
        "numVertices_orig": -1,
        "numFaces_orig": -1,
        "modifiedStatusRefinedModel": 1,
        "editStatusTexturedModel": 1,
        "transformToWorldMap": named(np.eye(4)),
        "lastCameraPose": named(last_pose),
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
