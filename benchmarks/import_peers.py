"""Import beside nerfstudio's converters on the same captures: `python -m benchmarks.import_peers`.

`--nerfstudio` names the Python of an environment in which the user installed nerfstudio; its `ns-process-data record3d`
and `polycam` then read the same two captures as our import (it has no converter for Stray Scanner): walks with known
poses and intrinsics, an image with every pose, in which a few frames are broken. A frame is right when its image is the
true one, its pose true to 1e-4 m and rad, whatever the axes and the origin, and its intrinsics to 0.1 % of the width.
"""

import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import pandas as pd
import typer

import benchmarks.import_captures  # noqa: F401  (puts the tests' writers on the path)
from groundwalk.artefacts import DataRoot, UserError
from groundwalk.artefacts.cli import new_app
from groundwalk.artefacts.tables import poses_of
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, Array, inverse, relative, rotation_angle

# isort: split
from capture_writers import HEIGHT, WIDTH, WRITERS, Walk, image, make_walk

FRAMES = 60
# Truncated image, NaN in the pose, pose that isn't rigid.
TRUNCATED, NOT_A_NUMBER, NOT_RIGID = (20, 22), (40,), (50, 52)
app = new_app(__doc__ or "")


@dataclass(frozen=True)
class Result:
    """Frames that a converter gave: which of the walk's images each is, its pose up to axes and origin, its camera."""

    seconds: float
    index: Array
    poses: Array
    camera: Array


def write_record3d(folder: Path, walk: Walk) -> None:
    WRITERS["record3d"].write(folder, walk)
    metadata = json.loads((folder / "metadata.json").read_text())
    for i in NOT_A_NUMBER:
        metadata["poses"][i][4] = float("nan")
    for i in NOT_RIGID:
        metadata["poses"][i][:4] = [0.0, 0.0, 0.0, 0.5]
    (folder / "metadata.json").write_text(json.dumps(metadata))
    for i in TRUNCATED:
        _truncate(folder / "rgb" / f"{i}.jpg")


def write_polycam(folder: Path, walk: Walk) -> None:
    WRITERS["polycam"].write(folder, walk)
    (folder / "keyframes" / "depth").mkdir()
    for i in (*NOT_A_NUMBER, *NOT_RIGID):
        path = folder / "keyframes" / "cameras" / f"{walk.t_ns[i] // 1000}.json"
        camera = json.loads(path.read_text())
        change = {"t_03": float("nan")} if i in NOT_A_NUMBER else {f"t_{r}{c}": 0.5 for r in range(3) for c in range(3)}
        path.write_text(json.dumps(camera | change))
    for i in TRUNCATED:
        _truncate(folder / "keyframes" / "images" / f"{walk.t_ns[i] // 1000}.jpg")


def ours(capture: Path, data: DataRoot, scene: str) -> Result:
    """Our import of a capture, as its own process."""
    data.captures(scene).parent.mkdir(parents=True, exist_ok=True)
    data.captures(scene).symlink_to(capture)
    options = ["--profile", "tiny", "--data", str(data.root), "--set", "sampling='all'"]
    seconds = _run([sys.executable, "-m", "groundwalk.capture_import", "--scene", scene, *options])
    frames = pd.read_parquet(data.run("tiny", scene, "import") / "frames.parquet")
    images = [cv2.imread(str(data.captures(scene) / name)) for name in frames["image"]]
    return Result(
        seconds,
        np.array([_which(i) for i in images]),
        poses_of(frames, "vio_cam"),
        frames[["fx", "fy", "cx", "cy"]].to_numpy(),
    )


def nerfstudio(python: Path, kind: str, capture: Path, folder: Path) -> Result:
    """nerfstudio's converter on a capture, without copies in smaller sizes and with all images."""
    command = [str(python), "-m", "nerfstudio.scripts.process_data", kind, "--data", str(capture)]
    options = ["--output-dir", str(folder), "--num-downscales", "0", "--max-dataset-size", "-1"]
    seconds = _run([*command, *options, *(["--crop-border-pixels", "0"] if kind == "polycam" else [])])
    content = json.loads((folder / "transforms.json").read_text())
    frames = content["frames"]
    images = [cv2.imread(str(folder / frame["file_path"])) for frame in frames]
    poses = np.array([frame["transform_matrix"] for frame in frames]) @ ARKIT_CAM_T_CAM
    camera = np.array([[{**content, **frame}[key] for key in ("fl_x", "fl_y", "cx", "cy")] for frame in frames])
    return Result(seconds, np.array([_which(i) for i in images]), poses, camera)


def judge(result: Result, walk: Walk, expected_camera: Array) -> str:
    """A table row's cells: frames, right ones, broken ones let through, seconds."""
    broken = {*TRUNCATED, *NOT_A_NUMBER, *NOT_RIGID}
    known = result.index >= 0
    # The origin and the axes of the world are free: frames are held against the first one that is known to be sound.
    sound = np.array([bool(k) and int(i) not in broken for k, i in zip(known, result.index, strict=True)])
    first = int(np.flatnonzero(sound)[0])
    truth = relative(walk.vio_T_cam[int(result.index[first])], walk.vio_T_cam[result.index.astype(int)])
    with np.errstate(invalid="ignore"):
        off = inverse(truth) @ (np.linalg.inv(result.poses[first]) @ result.poses)
        metres = np.linalg.norm(off[:, :3, 3], axis=1)
    rotations = np.where(np.isfinite(off[:, :3, :3]), off[:, :3, :3], 0.0)
    radians = np.array([float(rotation_angle(r)) if np.linalg.det(r) > 0.5 else np.inf for r in rotations])
    pose_right = sound & (metres < 1e-4) & (radians < 1e-4)
    off_share = np.abs(result.camera - expected_camera[result.index.astype(int)]).max(axis=1) / WIDTH
    camera_right = sound & (off_share < 1e-3)
    right = pose_right & camera_right
    return (
        f"{len(sound)} | {right.sum()} | {pose_right.sum()} | {camera_right.sum()} ({np.median(off_share):.1%} off) "
        f"| {(~sound).sum()} | {result.seconds:.1f}"
    )


def _truncate(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 3])


def _which(bgr: np.ndarray | None) -> int:
    """Which of the walk's images this is; a truncated one is none."""
    if bgr is None or bgr.shape != (HEIGHT, WIDTH, 3):
        return -1
    errors = [np.abs(bgr.astype(int) - image(i)).mean() for i in range(FRAMES)]
    return int(np.argmin(errors)) if min(errors) < 20 else -1


def _run(command: list[str]) -> float:
    start = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise UserError("a converter failed", where=" ".join(command), found=(done.stdout + done.stderr)[-2000:])
    return time.perf_counter() - start


@app.command()
def main(
    nerfstudio_python: Annotated[
        Path | None, typer.Option("--nerfstudio", help="A Python that has nerfstudio and ffmpeg.")
    ] = None,
) -> None:
    """Print one row a capture and converter, as Markdown."""
    print("| capture | converter | frames | right | pose right | intrinsics right | broken let through | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    walk = make_walk(FRAMES, every=1)
    for kind, write in (("record3d", write_record3d), ("polycam", write_polycam)):
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary).resolve()
            write(folder / "walk", walk)
            cells = judge(ours(folder / "walk", DataRoot(folder / "data"), kind), walk, walk.camera)
            print(f"| {kind} | groundwalk | {cells} |", flush=True)
            if nerfstudio_python is None:
                print(f"| {kind} | nerfstudio: not measured, no --nerfstudio given | | | | | | |")
            else:
                cells = judge(nerfstudio(nerfstudio_python, kind, folder / "walk", folder / "ns"), walk, walk.camera)
                print(f"| {kind} | nerfstudio | {cells} |", flush=True)
    print("| stray_scanner | nerfstudio: has no converter | | | | | | |")


if __name__ == "__main__":
    app()
