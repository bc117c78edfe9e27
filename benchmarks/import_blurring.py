"""What the blurring of faces finds, and what it blurs for nothing: `python -m benchmarks.import_blurring`.

One portrait (public domain, of matplotlib's sample data) is put into pictures in many sizes: that shows down to which
size the detectors see anything, not how many real faces they find. `--captures` names real captures that show nobody:
all that is found there is false.
"""

import time
from pathlib import Path
from typing import Annotated

import cv2
import matplotlib
import numpy as np
import typer

from groundwalk.capture_import.capture import ImageFile, Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.media.blurring import FaceDetector, Region
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.store.cli import new_app
from groundwalk.store.progress import track

WIDTHS_PX = (160, 120, 80, 60, 40, 30, 24, 20)
PLACES = ((150, 120), (700, 300), (1300, 600))
# Where the face is in the portrait: its centre and width, in pixels.
_FACE_X, _FACE_Y, _FACE_WIDTH = 265, 215, 180
app = new_app(__doc__ or "")


def with_portrait(width: int, x: int, y: int) -> tuple[np.ndarray, tuple[float, float]]:
    """A picture (1440, 1920, 3) with the portrait at x, y, its face so wide; and where the face's centre is."""
    portrait = decode_rgb((Path(matplotlib.get_data_path()) / "sample_data/grace_hopper.jpg").read_bytes(), 2**31)
    scale = width / _FACE_WIDTH
    small = cv2.resize(portrait, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[: 1440 - y, : 1920 - x]
    picture = _background()
    picture[y : y + small.shape[0], x : x + small.shape[1]] = small
    return picture, (x + _FACE_X * scale, y + _FACE_Y * scale)


def _background() -> np.ndarray:
    rng = np.random.default_rng(1)
    coarse = rng.integers(60, 200, (9, 12, 3), dtype=np.uint8)
    return cv2.resize(coarse, (1920, 1440), interpolation=cv2.INTER_LINEAR)


def is_detected(regions: list[Region], centre: tuple[float, float]) -> bool:
    x, y = centre
    return any(r.x < x < r.x + r.width and r.y < y < r.y + r.height for r in regions)


@app.command()
def main(
    captures: Annotated[Path | None, typer.Option(help="Real captures that show nobody.")] = None,
    face_model: Annotated[Path | None, typer.Option(help="YuNet's file, as [import] face_model names it.")] = None,
    images: Annotated[int, typer.Option(help="Images looked at in each recording, spread over it.")] = 24,
) -> None:
    """Print the tables as Markdown."""
    detect = FaceDetector(face_model)
    print("| width, px | the portrait's face found |\n|---|---|")
    for width in WIDTHS_PX:
        faces = [is_detected(detect(picture), at) for picture, at in (with_portrait(width, *p) for p in PLACES)]
        print(f"| {width} | {sum(faces)} of {len(faces)} |", flush=True)
    if captures is None:
        return
    print("\n| real capture | images | images with a false region | false regions | s an image |")
    print("|---|---|---|---|---|")
    for recording in find_recordings(captures, Path("/nonexistent"), Limits()):
        paths = [f.image.path for f in recording.read(Limits()).frames if isinstance(f.image, ImageFile)]
        paths = [paths[i] for i in np.unique(np.linspace(0, len(paths) - 1, images).astype(int))]
        start = time.process_time()
        regions = [detect(decode_rgb(path.read_bytes(), 2**31)) for path in track(paths, "looking for faces")]
        seconds = (time.process_time() - start) / len(paths)
        print(
            f"| {recording.recording_id} | {len(paths)} | {sum(map(bool, regions))} | {sum(map(len, regions))} "
            f"| {seconds:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    app()
