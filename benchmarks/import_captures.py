"""Large captures to measure import on: a camera that walks up and down in front of a textured wall.

Where it is, it sees what it saw there before; so a few images, linked many times, make a long capture whose poses are
right. The formats' writers are those of the tests.
"""

import io
import json
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 1920, 1440, 1450.0
STEPS = 24
_DEPTH_M = 2.5
_STEP_PX = 40
_WALL_SEED = 5
# Video frames until the camera is back where it began, and its step from one to the next.
_PERIOD = 2 * (STEPS - 1) * 5
_FRAME_PX = _STEP_PX / 5


def write_images(folder: Path, count: int, rate_hz: float = 3.0) -> None:
    """A 3D Scanner App recording of `count` images, 1920x1440, about 350 kB each."""
    folder.mkdir(parents=True)
    wall = _wall()
    originals = []
    for step in range(STEPS):
        original = folder.parent / f"{step}.jpg.part"
        _, encoded = cv2.imencode(".jpg", _view(wall, step * _STEP_PX), [cv2.IMWRITE_JPEG_QUALITY, 75])
        original.write_bytes(encoded.tobytes())
        originals.append(original)
    for i in range(count):
        step = _place(i)
        row = {
            "time": 1000 + i / rate_hz,
            "cameraPoseARFrame": _arkit_pose(step * _STEP_PX),
            "intrinsics": [FOCAL, 0, WIDTH / 2, 0, FOCAL, HEIGHT / 2, 0, 0, 1],
        }
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(row))
        (folder / f"frame_{i:05d}.jpg").hardlink_to(originals[step])
    for original in originals:
        original.unlink()


def write_video(folder: Path, count: int, rate_hz: int = 30) -> None:
    """A Stray Scanner recording of `count` frames, HEVC 1920x1440, a key frame a second."""
    folder.mkdir(parents=True)
    _repeat(io.BytesIO(_once(rate_hz)), folder / "rgb.mp4", count, rate_hz)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy"]
    for i in range(count):
        x = _triangle(i, _PERIOD // 2) * _FRAME_PX * _DEPTH_M / FOCAL
        camera = f"{FOCAL}, {FOCAL}, {WIDTH / 2}, {HEIGHT / 2}"
        # Upright, looking along -z: camera y is down.
        rows.append(f"{1000 + i / rate_hz:.6f}, {i:06d}, {x}, 1.4, 0.0, 1.0, 0.0, 0.0, 0.0, {camera}")
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")


@cache
def _once(rate_hz: int) -> bytes:
    """A video of one walk up and down."""
    wall, file = _wall(), io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx265", rate=rate_hz)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.options = {"preset": "ultrafast", "x265-params": f"log-level=none:keyint={rate_hz}:open-gop=0"}
        for i in range(_PERIOD):
            image = _view(wall, round(_triangle(i, _PERIOD // 2) * _FRAME_PX))
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            # An encoder's own conversion doesn't repeat.
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode())
    return file.getvalue()


def _wall() -> np.ndarray:
    """A texture with detail at many scales, wide enough for all views."""
    rng = np.random.default_rng(_WALL_SEED)
    width = WIDTH + STEPS * _STEP_PX
    wall = np.full((HEIGHT, width, 3), 128.0, np.float32)
    for cell, strength in ((240, 45), (60, 30), (15, 14), (4, 7)):
        size = (HEIGHT // cell + 2, width // cell + 2, 3)
        noise = rng.normal(0, strength, size).astype(np.float32)
        wall += cv2.resize(noise, (width, HEIGHT), interpolation=cv2.INTER_LINEAR)
    for _ in range(250):  # edges, as rooms have them
        x, y, w, h = rng.integers(0, [width, HEIGHT, 260, 260])
        cv2.rectangle(wall, (int(x), int(y)), (int(x + w), int(y + h)), rng.uniform(30, 220, 3).tolist(), -1)
    return np.clip(wall, 0, 255).astype(np.uint8)


def _view(wall: np.ndarray, x_px: int) -> np.ndarray:
    return np.ascontiguousarray(wall[:, x_px : x_px + WIDTH])


def _place(i: int) -> int:
    return _triangle(i, STEPS - 1)


def _triangle(i: int, half: int) -> int:
    at = i % (2 * half)
    return at if at <= half else 2 * half - at


def _arkit_pose(x_px: float) -> list[float]:
    """16 numbers, row-major: upright, looking along -z, moved to the right."""
    return [1, 0, 0, x_px * _DEPTH_M / FOCAL, 0, 1, 0, 1.4, 0, 0, 1, 0, 0, 0, 0, 1]


def _repeat(once: io.BytesIO, path: Path, count: int, rate_hz: int) -> None:
    """Store a video's packets again and again until there are `count`."""
    with av.open(once, "r") as source:
        stream = source.streams.video[0]
        packets = [(bytes(p), p.pts or 0, p.dts or 0, p.is_keyframe) for p in source.demux(stream) if p.size]
        base = stream.time_base or Fraction(1, rate_hz)
        tick = round(1 / (rate_hz * base))
        with av.open(path, "w") as target:
            copy = target.add_stream_from_template(stream)
            for i in range(count):
                data, pts, dts, is_key = packets[i % len(packets)]
                packet = av.Packet(data)
                shift = i // len(packets) * len(packets) * tick
                packet.pts, packet.dts, packet.time_base = pts + shift, dts + shift, base
                packet.is_keyframe, packet.stream = is_key, copy
                target.mux(packet)
