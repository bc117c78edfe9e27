"""Which rows of a log are sound: poses, intrinsics and times."""

from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from groundwalk.capture_import.capture import RawFrame, Recording, Reject, poses_of
from groundwalk.geometry.poses import Array, interpolate, make_pose, nearest_rotation, rigidity_error
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


def check_rows(recording: Recording) -> tuple[list[RawFrame], list[Reject]]:
    """The sound rows of a recording (times strictly rising, every pose rigid, every image with intrinsics, a pose and
    a number of its own), and why the others aren't.

    Poses come out orthonormal. A row without a pose gets one interpolated between the poses around it, unless these
    are too far apart; where a recording has no poses, none has one.
    """
    rejects = list(recording.rejects)
    position_fault = _position_fault(recording)
    readable, first = [], dict[int, RawFrame]()
    for frame in recording.frames:
        if fault := _pose_fault(frame.vio_T_cam, position_fault) or _intrinsics_fault(frame):
            rejects.append(Reject.of(frame, fault))
        elif frame.image is not None and (twin := first.setdefault(frame.number, frame)) is not frame:
            rejects.append(Reject.of(frame, f"{twin.source} has the same frame number"))
        elif frame.vio_T_cam is None:
            readable.append(frame)
        else:
            rotation = nearest_rotation(frame.vio_T_cam[:3, :3])
            readable.append(replace(frame, vio_T_cam=make_pose(rotation, frame.vio_T_cam[:3, 3])))

    ordered: list[RawFrame] = []
    rising = _longest_rising([frame.t_ns for frame in readable])
    for i, frame in enumerate(readable):
        if i in rising:
            ordered.append(frame)
        else:
            is_same = ordered and frame.t_ns == ordered[-1].t_ns
            rejects.append(Reject.of(frame, "time is a duplicate" if is_same else "time goes backward"))

    if recording.pose_source == PoseSource.NONE:
        return ordered, rejects
    frames = []
    posed = [frame for frame in ordered if frame.vio_T_cam is not None]
    times, poses = np.array([f.t_ns for f in posed], dtype=np.int64), poses_of(posed)
    for frame in ordered:
        if frame.vio_T_cam is None:
            after = int(np.searchsorted(times, frame.t_ns))
            around = slice(after - 1, after + 1)
            if not 0 < after < len(times) or (times[after] - times[after - 1]) * 1e-9 > _MAX_GAP_S:
                rejects.append(Reject.of(frame, f"no pose within {_MAX_GAP_S:g} s on both sides"))
                continue
            pose = interpolate(times[around], poses[around], np.array([frame.t_ns]))[0]
            # The worse state of the two poses holds between them.
            tracking = max((row.tracking for row in posed[around]), key=_WORST_LAST.index)
            frame = replace(frame, vio_T_cam=pose, tracking=tracking)
        if frame.tracking == Tracking.LOST:
            rejects.append(Reject.of(frame, "not tracking"))
        else:
            frames.append(frame)
    return frames, rejects


def _position_fault(recording: Recording) -> Callable[[Array], str | None]:
    """What says what is wrong with a position (3,) of a recording."""
    if recording.pose_source != PoseSource.REFERENCE:
        far = f"pose is more than {_MAX_POSITION_M / 1000:g} km from the origin"
        return lambda position: far if np.abs(position).max() > _MAX_POSITION_M else None
    poses = poses_of(recording.frames)
    positions = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
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


def _longest_rising(times: Sequence[int]) -> set[int]:
    """The places in the longest strictly rising subsequence: one wild time costs one row, not all behind it."""
    tails: list[int] = []  # the place at which a subsequence of each length ends soonest
    before: list[int] = []
    for i, t in enumerate(times):
        at = bisect_left(tails, t, key=times.__getitem__)
        before.append(tails[at - 1] if at else -1)
        if at == len(tails) or t < times[tails[at]]:
            tails[at : at + 1] = [i]
    rising = set()
    i = tails[-1] if tails else -1
    while i >= 0:
        rising.add(i)
        i = before[i]
    return rising
