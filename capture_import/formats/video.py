"""A video by any phone or drone, without poses: MP4, MOV and others that FFmpeg reads.

What matters: pixels are stored as the sensor has them, and the container says how to turn them; frames come at any
rate, each with its time; nothing says how wide the lens is, and stabilisation crops the image on top.
"""

from pathlib import Path

from groundwalk.capture_import.capture import Limits, RawFrame, Recording, VideoFrame
from groundwalk.capture_import.data_sets import guessed_intrinsics, images_alone
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.video import first_frame, frame_times, is_video
from groundwalk.store.choices import Clock
from groundwalk.store.tables import GUESS_SD


def read(path: Path, limits: Limits) -> Recording:
    """All frames of a video; import uses the sharpest around each tick."""
    times = frame_times(path, limits)
    first, quarters, is_hdr = first_frame(path, limits)
    width, height = (first.height, first.width) if quarters % 2 else (first.width, first.height)
    frames = [
        RawFrame(
            int(t_ns),
            image=VideoFrame(path, index),
            intrinsics=guessed_intrinsics(width, height, GUESS_SD),
            quarters=quarters,
            number=index,
            source=f"{path.name} frame {index}",
        )
        for index, t_ns in enumerate(times)
    ]
    notes = [f"{len(frames)} frames without poses, focal length unknown"]
    if is_hdr:
        notes.append("the video is HDR: its images are tone-mapped to SDR (ITU-R BT.2390)")
    return images_alone(Clock.VIDEO, path.parent, frames, [], notes)


FORMAT = Format(
    id="video",
    label="video",
    meaning="video",
    files=("*.mp4|*.mov",),
    looks_for="a video file, and no log of poses",
    detect=is_video,
    read=read,
    is_file=True,
    is_images_alone=True,
)
