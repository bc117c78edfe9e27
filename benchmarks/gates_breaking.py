"""Ways to break a capture for `benchmarks.gates`: each takes a folder that is its own copy and changes it in place."""

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from groundwalk.geometry.poses import ARKIT_CAM_T_CAM
from groundwalk.store.images import read_image


def mirrored(walks: list[str], axis: int, folder: Path) -> None:
    """Pictures mirrored left to right (1) or upside down (0)."""
    for walk in walks:
        for path in sorted((folder / walk).glob("*.jpg")):
            flipped = cv2.flip(read_image(path)[..., ::-1], axis)
            path.unlink()
            cv2.imwrite(str(path), flipped, [cv2.IMWRITE_JPEG_QUALITY, 95])


def focal_scaled(walks: list[str], factor: float, folder: Path) -> None:
    """Captured focal lengths off by a factor."""
    for walk in walks:
        _scale(folder / walk, factor, {"intrinsics": (0, 4), "projectionMatrix": (0, 5)})


def vio_scaled(walk: str, factor: float, folder: Path) -> None:
    """One walk's VIO longer or shorter."""
    _scale(folder / walk, factor, {"cameraPoseARFrame": (3, 7, 11)})


def _scale(walk: Path, factor: float, entries: dict[str, tuple[int, ...]]) -> None:
    """Some entries of matrices of each frame times a factor."""
    for path in sorted(walk.glob("frame_*.json")):
        frame = json.loads(path.read_text())
        for name, indices in entries.items():
            for k in indices:
                frame[name][k] *= factor
        path.write_text(json.dumps(frame))


def pictures_shuffled(walks: list[str], seed: int, folder: Path) -> None:
    """Pictures dealt out anew among the poses and times of their walk."""
    rng = np.random.default_rng(seed)
    for walk in walks:
        paths = sorted((folder / walk).glob("*.jpg"))
        order = rng.permutation(len(paths))
        for k, path in enumerate(paths):
            path.rename(path.with_name(f"dealt.{k}"))
        for k, path in enumerate(paths):
            path.with_name(f"dealt.{order[k]}").rename(path)


def times_shuffled(walks: list[str], seed: int, folder: Path) -> None:
    """Times dealt out anew among the frames of their walk, picture and pose together."""
    rng = np.random.default_rng(seed)
    for walk in walks:
        paths = sorted((folder / walk).glob("frame_*.json"))
        frames = [json.loads(path.read_text()) for path in paths]
        times = [frames[k]["time"] for k in rng.permutation(len(frames))]
        for path, frame, time in zip(paths, frames, times, strict=True):
            path.write_text(json.dumps(frame | {"time": time}))


def lens_stated(distortion: tuple[float, float], folder: Path) -> None:
    """All walks as `frames.jsonl` whose app states this k1 and k2."""
    for walk in sorted(path for path in folder.iterdir() if path.is_dir()):
        lines = [{"groundwalk": "frames", "version": 1, "device": "simulated phone", "clock": "boot"}]
        for path in sorted(walk.glob("frame_*.json")):
            lines.append(_line(json.loads(path.read_text()), path.with_suffix(".jpg"), distortion))
            path.unlink()
        (walk / "info.json").unlink()
        text = "".join(json.dumps(line) + "\n" for line in lines)
        (walk / "frames.jsonl").write_text(text, encoding="utf-8")


def _line(frame: dict[str, Any], image: Path, distortion: tuple[float, float]) -> dict[str, Any]:
    """A frame of the app 3D Scanner App as a line of frames.jsonl."""
    pose = np.array(frame["cameraPoseARFrame"]).reshape(4, 4) @ ARKIT_CAM_T_CAM
    line: dict[str, Any] = {"t_ns": round(frame["time"] * 1e9), "vio_T_cam": pose.ravel().tolist()}
    if image.is_file():
        matrix = np.array(frame["intrinsics"]).reshape(3, 3)
        height, width = read_image(image).shape[:2]
        line |= {"image": image.name, "width": width, "height": height, "distortion": [*distortion, 0.0, 0.0]}
        line |= dict(zip(("fx", "fy", "cx", "cy"), matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), strict=True))
    return line


def walk_replaced(other: Path, walk: str, folder: Path) -> None:
    """A walk through another place put in the place of one of this one."""
    shutil.rmtree(folder / walk)
    shutil.copytree(other / walk, folder / walk)
