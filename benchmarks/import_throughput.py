"""How fast import is against bare decoding, and how much memory it takes: `python -m benchmarks.import_throughput`.

The bare loop decodes the same files to RGB arrays and does nothing else: JPEG with one thread a core (with the decoder
that import uses, and with OpenCV's), video with FFmpeg's threads. A second loop decodes no further than import does: to
grey at its reduced scale, and video frames as they come. Import is the whole stage: hashes, checks, tables and the
recording. They run in turns in one process; medians are compared: seconds on the clock, and
seconds of processor, which other work on the machine changes less.
"""

import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated

import av
import cv2
import simplejpeg
import typer

from benchmarks.import_captures import write_images, write_video
from benchmarks.stages import measure
from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.media.images import WORKING_LONG_SIDE, decode_gray
from groundwalk.store import DataRoot, execute
from groundwalk.store.cli import new_app
from groundwalk.store.cores import usable_cores
from groundwalk.store.manifests import load_manifest

app = new_app(__doc__ or "")


def decode_jpegs(folder: Path, decode: Callable[[Path], object]) -> int:
    """Decode every JPEG below the folder, one thread a core; returns how many."""
    cv2.setNumThreads(1)
    with ThreadPoolExecutor(usable_cores()) as pool:
        return sum(1 for _ in pool.map(lambda path: decode(path) is None, sorted(folder.rglob("*.jpg"))))


def simplejpeg_rgb(path: Path) -> int:
    return len(simplejpeg.decode_jpeg(path.read_bytes(), "RGB"))


def opencv_bgr(path: Path) -> int:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    return 0 if image is None else len(image)


def reduced_gray(path: Path) -> int:
    return len(decode_gray(path.read_bytes(), WORKING_LONG_SIDE))


def decode_video(folder: Path, to_rgb: bool = True) -> int:
    """Decode every frame of the folder's video, to RGB or no further; returns how many."""
    with av.open(next(folder.rglob("*.mp4"))) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        return sum(not to_rgb or len(frame.to_ndarray(format="rgb24")) > 0 for frame in container.decode(stream))


def in_turns(runs: dict[str, Callable[[], object]], rounds: int) -> dict[str, tuple[float, float]]:
    """Median seconds of each run, on the clock and of processor, the runs taking turns."""
    seconds: dict[str, list[tuple[float, float]]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, run in runs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            run()
            seconds[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return {
        name: (statistics.median(w for w, _ in times), statistics.median(c for _, c in times))
        for name, times in seconds.items()
    }


def throughput(captures: Path, count: int, video: bool, rounds: int, data: DataRoot, scene: str) -> None:
    """Print one row a bare loop: import against it."""
    bare: dict[str, Callable[[], object]] = (
        {
            "FFmpeg to RGB": lambda: decode_video(captures),
            "FFmpeg, not converted": lambda: decode_video(captures, to_rgb=False),
        }
        if video
        else {
            "simplejpeg to RGB": lambda: decode_jpegs(captures, simplejpeg_rgb),
            "cv2.imread": lambda: decode_jpegs(captures, opencv_bgr),
            "reduced grey": lambda: decode_jpegs(captures, reduced_gray),
        }
    )
    runs = {**bare, "import": lambda: execute(STAGE, scene, "tiny", data, force=True)}
    took = in_turns(runs, rounds)
    wall, cpu = took["import"]
    steps = load_manifest(data.run("tiny", scene, "import"))["seconds"]
    parts = ", ".join(f"{name} {seconds:.2f}" for name, seconds in steps.items())
    for name in bare:
        bare_wall, bare_cpu = took[name]
        print(
            f"| {scene} | {count} | {count / wall:.0f} | {name} | {count / bare_wall:.0f} | {bare_wall / wall:.0%} "
            f"| {cpu:.1f} | {bare_cpu:.1f} | {bare_cpu / cpu:.0%} | {parts} |",
            flush=True,
        )


def peak_mib(data: DataRoot, scene: str) -> float:
    """Peak memory of an import as its own process."""
    command = [
        sys.executable,
        "-m",
        "groundwalk.capture_import",
        "--scene",
        scene,
        "--profile",
        "tiny",
        "--data",
        str(data.root),
    ]
    command += ["--set", "min_frames=0"]  # the same rule of sampling for short captures
    return measure(command, data.run("tiny", scene, "import")).peak_mib


@app.command()
def main(
    images: Annotated[int, typer.Option(help="JPEG images in the capture.")] = 1600,
    frames: Annotated[int, typer.Option(help="Video frames in the capture.")] = 1800,
    rounds: Annotated[int, typer.Option(help="Turns that each loop and import take; 0: memory alone.")] = 3,
    memory: Annotated[bool, typer.Option(help="Measure memory as well.")] = True,
    capture: Annotated[Path | None, typer.Option(help="Measure this folder of JPEG images too.")] = None,
) -> None:
    """Measure throughput and memory; prints Markdown tables."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    with tempfile.TemporaryDirectory() as temporary:
        data = DataRoot(Path(temporary))
        if rounds:
            write_images(data.captures("images") / "walk", images)
            write_video(data.captures("video") / "walk", frames)
            _throughputs(data, images, frames, rounds, capture)
        if memory:
            _memory(data)


def _throughputs(data: DataRoot, images: int, frames: int, rounds: int, capture: Path | None) -> None:
    print(f"{usable_cores()} cores, medians of {rounds} turns\n")
    print("| capture | images | import, 1/s | bare loop | its 1/s | ratio | import, cpu s | bare | ratio | steps, s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    throughput(data.captures("images"), images, False, rounds, data, "images")
    throughput(data.captures("video"), frames, True, rounds, data, "video")
    if capture is not None:
        data.captures("given").symlink_to(capture.resolve(), target_is_directory=True)
        count = len(list(capture.rglob("*.jpg")))
        throughput(capture, count, False, rounds, data, "given")


def _memory(data: DataRoot) -> None:
    print("\n| capture | images | peak MiB |\n|---|---|---|")
    for kind, write in (("images", write_images), ("video", write_video)):
        for count in (100, 400, 1600):
            scene = f"{kind}{count}"
            write(data.captures(scene) / "walk", count)
            print(f"| {kind} | {count} | {peak_mib(data, scene):.0f} |", flush=True)


if __name__ == "__main__":
    app()
