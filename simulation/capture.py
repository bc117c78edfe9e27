"""Writes captures as 3D Scanner App exports them, with what import reads of them: a JSON file a pose, info.json."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.geometry.poses import ARKIT_CAM_T_CAM
from groundwalk.simulation.place import Vec
from groundwalk.store.simulated import FRAME


@dataclass(frozen=True)
class SessionFrames:
    """One session as its phone saw it: times (s since boot), vio_T_cam (OpenCV axes), fx fy cx cy, exposure (s);
    `image_every` says which poses come with a JPEG."""

    name: str
    time_s: Vec
    vio_T_cam: Vec
    intrinsics_N4: Vec
    exposure_s: Vec
    width: int
    height: int
    image_every: int

    @property
    def image_indices(self) -> range:
        return range(0, len(self.time_s), self.image_every)


def write_frames(folder: Path, session: SessionFrames) -> None:
    """info.json and every frame's JSON; pictures are written apart."""
    folder.mkdir(parents=True, exist_ok=True)
    arkit = session.vio_T_cam @ ARKIT_CAM_T_CAM
    for i, (fx, fy, cx, cy) in enumerate(session.intrinsics_N4):
        frame = {
            "cameraPoseARFrame": _float32(arkit[i]),
            "projectionMatrix": _float32(_projection(session.intrinsics_N4[i], session.width, session.height)),
            "intrinsics": _float32(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])),
            "exposureDuration": float(np.float32(session.exposure_s[i])),
            "time": float(session.time_s[i]),
        }
        _write_json(folder / f"{FRAME.format(i)}.json", frame)
    _write_json(folder / "info.json", {"title": session.name, "appVersionString": "1.9.7"})


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


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
