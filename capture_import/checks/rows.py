"""Which rows of a log are sound: poses, intrinsics and times."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from groundwalk.capture_import.capture import Intrinsics, RawFrame, Recording, Reject, poses_of
from groundwalk.geometry.poses import Array, interpolate, nearest_rotation, rigidity_error
from groundwalk.store.choices import PoseSource, Tracking

# Float32 logs are off by 1e-6, rounded text logs by 1e-3 at most; a wrong convention by far more.
_RIGID_TOLERANCE = 5e-3
# Of a rotation, before its rigidity is computed from products.
_MAX_ENTRY = 1e5
# An hour-long walk drifts metres; a position beyond this is a broken number. A reference may have any unit and origin:
# there it is one so many times as far from the middle as nine in ten are.
_MAX_POSITION_M, _MAX_POSITION_EXTENTS, _NINE_IN_TEN = 1e5, 1e3, 90
# OpenCV's k1, k2, p1, p2, k3 to k6; those of the widest fisheye lenses are some tens.
_MAX_COEFFICIENTS, _MAX_COEFFICIENT = 8, 1e4
# Poses further apart aren't interpolated between: a hand may turn by a right angle meanwhile.
_MAX_GAP_S = 0.5
_WORST_LAST = (Tracking.UNKNOWN, Tracking.NORMAL, Tracking.LIMITED, Tracking.LOST)
# Grey levels, of 255: a covered lens with a sensor's noise has 0 to 1, a dim or dull view 30 and more.
_MIN_CONTRAST = 2.0


def check_rows(recording: Recording) -> tuple[list[RawFrame], list[Reject]]:
    """The sound rows of a recording (times strictly rising, every pose rigid, every image with intrinsics and a pose),
    and why the others aren't.

    Poses come out orthonormal. A row without a pose gets one interpolated between the poses around it, unless these
    are too far apart; where a recording has no poses, none has one.
    """
    rejects = list(recording.rejects)
    is_reference = recording.pose_source == PoseSource.REFERENCE
    position_fault = _reference_position_fault(recording) if is_reference else _vio_position_fault
    readable = []
    for frame in recording.frames:
        reason = _pose_fault(frame.vio_T_cam, position_fault) or _intrinsics_fault(frame)
        if reason:
            rejects.append(Reject.of(frame, reason))
        else:
            readable.append(_orthonormal(frame))

    ordered: list[RawFrame] = []
    for frame, is_rising in zip(readable, _longest_rising([f.t_ns for f in readable]), strict=True):
        if is_rising:
            ordered.append(frame)
        else:
            is_same = ordered and frame.t_ns == ordered[-1].t_ns
            rejects.append(Reject.of(frame, "time is a duplicate" if is_same else "time goes backward"))

    if recording.pose_source == PoseSource.NONE:
        return ordered, rejects
    frames = []
    for frame, posed in zip(ordered, _with_poses(ordered), strict=True):
        if posed is None:
            rejects.append(Reject.of(frame, f"no pose within {_MAX_GAP_S:g} s on both sides"))
        elif posed.tracking == Tracking.LOST:
            rejects.append(Reject.of(posed, "not tracking"))
        else:
            frames.append(posed)
    return frames, rejects


def _vio_position_fault(position: Array) -> str | None:
    return "pose is more than 100 km from the origin" if np.abs(position).max() > _MAX_POSITION_M else None


def _reference_position_fault(recording: Recording) -> Callable[[Array], str | None]:
    """What is wrong with a position (3,) among those of a reference."""
    poses = [frame.vio_T_cam for frame in recording.frames if frame.vio_T_cam is not None]
    positions = np.array([pose[:3, 3] for pose in poses if np.isfinite(pose).all()]).reshape(-1, 3)
    if not len(positions):
        return lambda _: None
    middle = np.median(positions, axis=0)
    distances = np.linalg.norm(positions - middle, axis=1)
    limit = _MAX_POSITION_EXTENTS * float(np.percentile(distances, _NINE_IN_TEN, method="lower"))

    def fault(position: Array) -> str | None:
        distance = float(np.linalg.norm(position - middle))
        return f"pose is {distance:.3g} from the others' middle: a broken number?" if 0 < limit < distance else None

    return fault


def _pose_fault(pose: Array | None, position_fault: Callable[[Array], str | None]) -> str | None:
    if pose is None:
        return None
    if not np.isfinite(pose).all():
        return "pose has a value that isn't finite"
    if fault := position_fault(pose[:3, 3]):
        return fault
    if np.abs(pose[:, :3]).max() > _MAX_ENTRY:
        return "pose isn't rigid"
    error = float(rigidity_error(pose))
    if error > _RIGID_TOLERANCE:
        return "pose is mirrored" if np.isinf(error) else f"pose isn't rigid (off by {error:.2g})"
    return None


def _intrinsics_fault(frame: RawFrame) -> str | None:
    if frame.image is None:
        return None
    camera = frame.intrinsics
    if camera is None:
        return "image has no intrinsics"
    numbers = np.array([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion])
    if not np.isfinite(numbers).all():
        return "intrinsics have a value that isn't finite"
    if camera.fx <= 0 or camera.fy <= 0:
        return f"focal length {camera.fx:g}, {camera.fy:g} isn't positive"
    if len(camera.distortion) > _MAX_COEFFICIENTS:
        return f"distortion has {len(camera.distortion)} coefficients, expected k1, k2, p1, p2, k3 to k6 at most"
    if np.abs(numbers[4:]).max(initial=0.0) > _MAX_COEFFICIENT:
        return f"distortion isn't plausible: a coefficient of {np.abs(numbers[4:]).max():g}"
    return None


def size_fault(camera: Intrinsics, width: int, height: int) -> str | None:
    """What is wrong with an image of this size under these intrinsics, or None."""
    if camera.width is not None and (width, height) != (camera.width, camera.height):
        return f"image is {width}x{height}, its intrinsics are for {camera.width}x{camera.height}"
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        return f"principal point {camera.cx:.1f}, {camera.cy:.1f} is outside the image of {width}x{height}"
    if not 0.1 < camera.fx / max(width, height) < 20 or not 0.5 < camera.fx / camera.fy < 2:
        return f"focal length {camera.fx:.1f}, {camera.fy:.1f} isn't plausible for an image of {width}x{height}"
    return None


def content_fault(contrast: float) -> str | None:
    """What is wrong with an image whose grey levels have this standard deviation, of 255; or None."""
    if contrast < _MIN_CONTRAST:
        return f"image shows nothing: its grey levels vary by {contrast:.1f} of 255 (at least {_MIN_CONTRAST:g})"
    return None


def _orthonormal(frame: RawFrame) -> RawFrame:
    if frame.vio_T_cam is None:
        return frame
    pose = frame.vio_T_cam.copy()
    pose[:3, :3] = nearest_rotation(pose[:3, :3])
    pose[3] = (0, 0, 0, 1)
    return replace(frame, vio_T_cam=pose)


def _longest_rising(times: Sequence[int]) -> list[bool]:
    """Which entries are in the longest strictly rising subsequence: one wild time costs one row, not all behind it."""
    tails: list[int] = []
    tail_index: list[int] = []
    previous = [-1] * len(times)
    for i, t in enumerate(times):
        at = bisect_left(tails, t)
        if at == len(tails):
            tails.append(t)
            tail_index.append(i)
        elif t < tails[at]:
            tails[at], tail_index[at] = t, i
        previous[i] = tail_index[at - 1] if at else -1
    is_rising = [False] * len(times)
    i = tail_index[-1] if tail_index else -1
    while i >= 0:
        is_rising[i] = True
        i = previous[i]
    return is_rising


def _with_poses(frames: list[RawFrame]) -> list[RawFrame | None]:
    """The rows, those without a pose with one between its neighbours' where these are near in time."""
    posed = [f for f in frames if f.vio_T_cam is not None]
    if len(posed) == len(frames):
        return list(frames)
    times = np.array([f.t_ns for f in posed], dtype=np.int64)
    poses = poses_of(posed)
    out: list[RawFrame | None] = []
    for frame in frames:
        if frame.vio_T_cam is not None:
            out.append(frame)
            continue
        after = int(np.searchsorted(times, frame.t_ns))
        if after == 0 or after == len(times) or (times[after] - times[after - 1]) * 1e-9 > _MAX_GAP_S:
            out.append(None)
            continue
        around = slice(after - 1, after + 1)
        pose = interpolate(times[around], poses[around], np.array([frame.t_ns]))[0]
        # The worse state of the two poses holds between them.
        tracking = max((posed[after - 1].tracking, posed[after].tracking), key=_WORST_LAST.index)
        out.append(replace(frame, vio_T_cam=pose, tracking=tracking))
    return out
