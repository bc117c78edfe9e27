"""Which rows of a log are sound: poses, times, and VIO jumps."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import Intrinsics, RawFrame, RawSession, Reject
from groundwalk.geometry.poses import Array, interpolate, inverse, nearest_rotation, rigidity_error
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

# Grey levels, of 255: a covered lens with a sensor's noise has 0 to 1, a dim or dull view 30 and more.
_MIN_CONTRAST = 2.0

# A jump is motion that no hand does: beyond what an acceleration of 4 m/s^2 or 600 deg/s^2 changes between two poses,
# beyond the noise of a pose, and far beyond what the same hand does around that moment.
_ACCELERATION_M_S2 = 4.0
_ACCELERATION_DEG_S2 = 600.0
_NOISE_M = 0.03
_NOISE_DEG = 3.0
_MIN_RATIO = 8.0
_CONTEXT = 4
_MEDIAN_STEPS = 60


@dataclass(frozen=True)
class Jump:
    """A step of the odometry from pose `index - 1` to `index` that its surroundings don't explain."""

    index: int
    t_ns: int
    dt_s: float
    jump_m: float
    jump_deg: float


@dataclass(frozen=True)
class SoundRows:
    """A session's sound rows: times strictly rising, every pose rigid, every image with intrinsics and a pose."""

    frames: list[RawFrame]
    rejects: list[Reject]


def check_session(session: RawSession, max_gap_s: float) -> SoundRows:
    """The sound rows of a session, and why the others aren't.

    Poses come out orthonormal. A row without a pose gets one interpolated between the poses around it, unless these
    are further apart than `max_gap_s`.
    """
    rejects = list(session.rejects)

    def reject(frame: RawFrame, reason: str) -> None:
        rejects.append(Reject(session.session_id, frame.source, frame.t_ns, reason, frame.content))

    readable = []
    is_reference = session.pose_source == PoseSource.REFERENCE
    position_fault = _reference_position_fault(session) if is_reference else _vio_position_fault
    for frame in session.frames:
        reason = _pose_fault(frame.vio_T_cam, position_fault) or _intrinsics_fault(frame)
        if reason:
            reject(frame, reason)
        else:
            readable.append(_orthonormal(frame))

    ordered = []
    last_ns = None
    for frame, is_rising in zip(readable, _longest_rising([f.t_ns for f in readable]), strict=True):
        if is_rising:
            ordered.append(frame)
            last_ns = frame.t_ns
        else:
            reject(frame, "time is a duplicate" if frame.t_ns == last_ns else "time goes backward")

    frames = []
    for frame, posed in zip(ordered, _with_poses(ordered, max_gap_s), strict=True):
        if posed is None:
            reject(frame, f"no pose within {max_gap_s:g} s on both sides")
        else:
            frames.append(posed)
    return SoundRows(frames, rejects)


def find_jumps(t_ns: NDArray[np.int64], poses: Array) -> list[Jump]:
    """Steps between poses (N, 4, 4) at rising times (N,) that no hand can do.

    Each step is compared with the motion that the steps around it extrapolate (their median velocity, so that one
    neighbouring jump doesn't matter); the residual must be explained by acceleration, pose noise, or the median
    residual in the neighbourhood.
    """
    if len(poses) < 4:
        return []
    dt: Array = np.diff(t_ns).astype(float) * 1e-9
    velocity = np.diff(poses[:, :3, 3], axis=0) / dt[:, None]
    # Rotation in the world's axes, so that neighbouring steps can be averaged.
    steps = poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], -1, -2)
    rate = np.degrees(Rotation.from_matrix(steps).as_rotvec()) / dt[:, None]
    beyond_m = _beyond_context(velocity, dt)
    beyond_deg = _beyond_context(rate, dt)
    limit_m = np.maximum(_NOISE_M + _ACCELERATION_M_S2 * dt**2, _MIN_RATIO * _running_median(beyond_m))
    limit_deg = np.maximum(_NOISE_DEG + _ACCELERATION_DEG_S2 * dt**2, _MIN_RATIO * _running_median(beyond_deg))
    jumps = np.flatnonzero((beyond_m > limit_m) | (beyond_deg > limit_deg))
    return [Jump(int(i) + 1, int(t_ns[i + 1]), float(dt[i]), float(beyond_m[i]), float(beyond_deg[i])) for i in jumps]


def gravity_of(world_T_cam: Array) -> Array:
    """Unit vectors of gravity in camera axes (..., 3), for worlds whose +y is up."""
    down: Array = inverse(world_T_cam)[..., :3, :3] @ np.array([0.0, -1.0, 0.0])
    return down


def _vio_position_fault(position: Array) -> str | None:
    return "pose is more than 100 km from the origin" if np.abs(position).max() > _MAX_POSITION_M else None


def _reference_position_fault(session: RawSession) -> Callable[[Array], str | None]:
    """What is wrong with a position (3,) among those of a reference."""
    poses = [frame.vio_T_cam for frame in session.frames if frame.vio_T_cam is not None]
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


def _with_poses(frames: list[RawFrame], max_gap_s: float) -> list[RawFrame | None]:
    posed = [f for f in frames if f.vio_T_cam is not None]
    if len(posed) == len(frames):
        return list(frames)
    times = np.array([f.t_ns for f in posed], dtype=np.int64)
    poses = np.array([f.vio_T_cam for f in posed]).reshape(-1, 4, 4)
    out: list[RawFrame | None] = []
    for frame in frames:
        if frame.vio_T_cam is not None:
            out.append(frame)
            continue
        after = int(np.searchsorted(times, frame.t_ns))
        if after == 0 or after == len(times) or (times[after] - times[after - 1]) * 1e-9 > max_gap_s:
            out.append(None)
            continue
        around = slice(after - 1, after + 1)
        pose = interpolate(times[around], poses[around], np.array([frame.t_ns]))[0]
        # The worse state of the two poses holds between them.
        tracking = max((posed[after - 1].tracking, posed[after].tracking), key=_WORST_LAST.index)
        out.append(replace(frame, vio_T_cam=pose, tracking=tracking))
    return out


_WORST_LAST = (Tracking.UNKNOWN, Tracking.NORMAL, Tracking.LIMITED, Tracking.LOST)


def _beyond_context(rate_N3: Array, dt: Array) -> Array:
    """Per step: the length of its change beyond what the median rate of the steps around it predicts."""
    padded = np.pad(rate_N3, ((_CONTEXT, _CONTEXT), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _CONTEXT + 1, axis=0)
    around = np.delete(windows, _CONTEXT, axis=-1)
    beyond: Array = np.linalg.norm(rate_N3 - np.nanmedian(around, axis=-1), axis=-1) * dt
    return beyond


def _running_median(values: Array) -> Array:
    medians: Array = median_filter(values, size=_MEDIAN_STEPS + 1, mode="nearest")
    return medians
