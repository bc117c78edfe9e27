"""Ways to break a capture for `benchmarks.gates`: each takes a folder that is its own copy and changes it in place."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from groundwalk.geometry.poses import ARKIT_CAM_T_CAM
from groundwalk.store.images import read_image

Break = Callable[[Path], None]
_INTRINSICS = (0, 4)  # fx and fy in the row-major matrix
_POSITION = (3, 7, 11)


def mirrored(walks: list[str], axis: int = 1) -> Break:
    """Pictures mirrored left to right (1) or upside down (0)."""

    def apply(folder: Path) -> None:
        for walk in walks:
            for path in sorted((folder / walk).glob("*.jpg")):
                flipped = cv2.flip(read_image(path)[..., ::-1], axis)
                path.unlink()
                cv2.imwrite(str(path), flipped, [cv2.IMWRITE_JPEG_QUALITY, 95])

    return apply


def focal_scaled(walks: list[str], factor: float) -> Break:
    """Captured focal lengths off by a factor."""

    def change(frame: dict[str, Any]) -> None:
        for k in _INTRINSICS:
            frame["intrinsics"][k] *= factor
        for k in (0, 5):
            frame["projectionMatrix"][k] *= factor

    return _in_frames(walks, change)


def vio_scaled(walk: str, factor: float) -> Break:
    """One walk's VIO longer or shorter."""

    def change(frame: dict[str, Any]) -> None:
        for k in _POSITION:
            frame["cameraPoseARFrame"][k] *= factor

    return _in_frames([walk], change)


def pictures_shuffled(walks: list[str], seed: int) -> Break:
    """Pictures dealt out anew among the poses and times of their walk."""

    def apply(folder: Path) -> None:
        rng = np.random.default_rng(seed)
        for walk in walks:
            paths = sorted((folder / walk).glob("*.jpg"))
            order = rng.permutation(len(paths))
            for k, path in enumerate(paths):
                path.rename(path.with_name(f"dealt.{k}"))
            for k, path in enumerate(paths):
                path.with_name(f"dealt.{order[k]}").rename(path)

    return apply


def times_shuffled(walks: list[str], seed: int) -> Break:
    """Times dealt out anew among the frames of their walk, picture and pose together."""

    def apply(folder: Path) -> None:
        rng = np.random.default_rng(seed)
        for walk in walks:
            paths = sorted((folder / walk).glob("frame_*.json"))
            frames = [json.loads(path.read_text()) for path in paths]
            times = [frames[k]["time"] for k in rng.permutation(len(frames))]
            for path, frame, time in zip(paths, frames, times, strict=True):
                path.write_text(json.dumps(frame | {"time": time}))

    return apply


def lens_stated(k1: float, k2: float) -> Break:
    """All walks as `frames.jsonl` whose app states this distortion."""

    def apply(folder: Path) -> None:
        for walk in sorted(path for path in folder.iterdir() if path.is_dir()):
            lines = [{"groundwalk": "frames", "version": 1, "device": "simulated phone", "clock": "boot"}]
            for path in sorted(walk.glob("frame_*.json")):
                lines.append(_line(json.loads(path.read_text()), path.with_suffix(".jpg"), (k1, k2)))
                path.unlink()
            (walk / "info.json").unlink()
            text = "".join(json.dumps(line) + "\n" for line in lines)
            (walk / "frames.jsonl").write_text(text, encoding="utf-8")

    return apply


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


def with_walk_of(other: Path, walk: str) -> Break:
    """A walk through another place put in the place of one of this one."""

    def apply(folder: Path) -> None:
        shutil.rmtree(folder / walk)
        shutil.copytree(other / walk, folder / walk)

    return apply


def untouched(folder: Path) -> None:
    """As it was captured."""


def _in_frames(walks: list[str], change: Callable[[dict[str, Any]], None]) -> Break:
    def apply(folder: Path) -> None:
        for walk in walks:
            for path in sorted((folder / walk).glob("frame_*.json")):
                frame = json.loads(path.read_text())
                change(frame)
                path.write_text(json.dumps(frame))

    return apply
