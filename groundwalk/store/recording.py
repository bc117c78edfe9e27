"""Rerun recordings: one file a stage with its blueprint inside."""

import contextlib
import os
import shutil
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.store.files import written_aside
from groundwalk.store.images import small_jpeg
from groundwalk.store.parallel import in_parallel

UP_AXIS = rr.ViewCoordinates.RIGHT_HAND_Y_UP
TIMELINE = "time"
"""The clock of every recording: since the first frame of the walk."""
FRAME_TIMELINE = "frame"
"""Beside it, of recordings in which walks follow one another, however far apart their clocks are."""

_CHUNK = 1 << 20
_MAX_IMAGES, _IMAGE_PX = 500, 320  # of a walk: some 7 MB


@contextlib.contextmanager
def open_recording(path: Path, stage: str, name: str, blueprint: object) -> Iterator[rr.RecordingStream]:
    """Write `path`; it gets its name only when the block ends well.

    Each stage is an application of its own, so that every recording keeps its own blueprint when several are opened
    in one viewer.
    """
    with written_aside(path) as partial, partial.open("wb") as file, tempfile.TemporaryDirectory() as folder:
        # Rerun waits without end where it can't write its file, on a full disk: so it writes into a pipe.
        pipe = Path(folder, "recording")
        os.mkfifo(pipe)
        reading = os.fdopen(os.open(pipe, os.O_RDONLY | os.O_NONBLOCK), "rb")
        writing = pipe.open("wb", buffering=0)  # the pipe doesn't end before Rerun has opened it
        os.set_blocking(reading.fileno(), True)
        failure: list[BaseException] = []
        copying = threading.Thread(target=_copy, args=(reading, file, failure), daemon=True)
        stream = rr.RecordingStream(f"groundwalk_{stage}", recording_id=f"{name}/{stage}")
        try:
            copying.start()
            stream.save(pipe, default_blueprint=blueprint)  # type: ignore[arg-type]
            writing.close()
            stream.send_recording_name(f"{name} · {stage}")
            yield stream
            stream.flush()
        finally:
            writing.close()
            stream.disconnect()
        copying.join()
        if failure:
            raise failure[0]


def _copy(source: BinaryIO, target: BinaryIO, failure: list[BaseException]) -> None:
    """Copy until the end; all is read, too, where it can't be written."""
    with source:
        try:
            shutil.copyfileobj(source, target)
        except Exception as error:
            failure.append(error)
            while source.read(_CHUNK):
                pass


def tabbed(tabs: Iterable[rrb.Container]) -> rrb.Blueprint:
    """A blueprint of tabs over the frames."""
    panel = rrb.TimePanel(timeline=FRAME_TIMELINE, state="collapsed")
    return rrb.Blueprint(rrb.Tabs(*tabs), panel, collapse_panels=True)


def set_time(stream: rr.RecordingStream, t_ns: int) -> None:
    """Move the recording's clock to a time in nanoseconds since the walk's first frame."""
    stream.set_time(TIMELINE, duration=np.timedelta64(int(t_ns), "ns"))


def log_camera(
    stream: rr.RecordingStream,
    path: str,
    world_T_cam: Array,
    frame: Any,
    colour: tuple[int, int, int],
    size_m: float = 0.3,
    static: bool = False,
) -> None:
    """A camera frustum at `path`: pose (4, 4) in OpenCV axes, `frame` a row of import.frames or a Camera.

    Frusta are pinholes: an image shown in one has to be free of distortion for what lies before it to fall on it.
    """
    stream.log(path, rr.Transform3D(translation=world_T_cam[:3, 3], mat3x3=world_T_cam[:3, :3]), static=static)
    pinhole = rr.Pinhole(
        focal_length=(frame.fx, frame.fy),
        principal_point=(frame.cx, frame.cy),
        width=int(frame.width),
        height=int(frame.height),
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=size_m,
        color=colour,
    )
    stream.log(f"{path}/image", pinhole, static=static)


def log_images(stream: rr.RecordingStream, path: str, frames: pd.DataFrame, times: list[tuple[str, Array]]) -> None:
    """Small upright images of rows of import.frames with the `file` of each; of a long walk not all, and those whose
    file is gone are left out: no result hangs on them. `times` (N,) are those of the frames on each timeline: numbers
    of frames, or nanoseconds since the walk's first."""
    files = frames["file"].tolist()
    there = np.flatnonzero([file.is_file() for file in files])
    shown = there[evenly(len(there), _MAX_IMAGES)]
    gravity = frames[["gravity_x", "gravity_y"]].to_numpy(float)
    jpegs = list(in_parallel(lambda row: small_jpeg(files[row], _IMAGE_PX, *gravity[row]), shown))
    indexes = [
        rr.TimeColumn(name, duration=at[shown].astype("timedelta64[ns]"))
        if name == TIMELINE
        else rr.TimeColumn(name, sequence=at[shown])
        for name, at in times
    ]
    if jpegs:
        columns = rr.EncodedImage.columns(blob=jpegs, media_type=["image/jpeg"] * len(jpegs))
        stream.send_columns(path, indexes=indexes, columns=columns)


def log_path(
    stream: rr.RecordingStream, path: str, xyz_N3: Array, colour: tuple[int, int, int], radius_px: float = 1.5
) -> None:
    """A trajectory as one static line; NaN positions break it."""
    is_finite = np.isfinite(xyz_N3).all(axis=1)
    # Where it flips, a strip begins or ends.
    borders = np.flatnonzero(np.diff(np.concatenate([[False], is_finite, [False]]).astype(int)))
    strips = [xyz_N3[start:stop] for start, stop in borders.reshape(-1, 2)]
    stream.log(path, rr.LineStrips3D(strips, colors=colour, radii=rr.Radius.ui_points(radius_px)), static=True)
