"""Writes captures as 3D Scanner App exports them, with what import reads of them: a JSON file a pose, info.json."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
    arkit, w, h = session.vio_T_cam @ ARKIT_CAM_T_CAM, session.width, session.height
    content: dict[str, Any] = {"info": {"title": session.name, "appVersionString": "1.9.7"}}
    for i, (fx, fy, cx, cy) in enumerate(session.intrinsics_N4):
        # ARKit's, with the far plane at infinity.
        projection = [
            [2 * fx / w, 0, 1 - 2 * cx / w, 0],
            [0, 2 * fy / h, 2 * cy / h - 1, 0],
            [0, 0, -1, -0.001],
            [0, 0, -1, 0],
        ]
        content[FRAME.format(i)] = {
            "cameraPoseARFrame": _float32(arkit[i]),
            "projectionMatrix": _float32(projection),
            "intrinsics": _float32([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]),
            "exposureDuration": float(np.float32(session.exposure_s[i])),
            "time": float(session.time_s[i]),
        }
    for name, values in content.items():
        (folder / f"{name}.json").write_text(json.dumps(values, indent=2) + "\n", encoding="utf-8")


def _float32(matrix: ArrayLike) -> list[float]:
    """Row-major values as the app has them, in single precision."""
    return np.asarray(matrix, np.float32).ravel().tolist()
