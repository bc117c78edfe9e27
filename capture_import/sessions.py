"""From a recording as the phone wrote it to sessions of sound rows: by large VIO jumps, a video's cuts, or camera."""

import math
from bisect import bisect_right
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import (
    Image,
    ImageCheck,
    ImageFile,
    Intrinsics,
    Jump,
    RawFrame,
    Recording,
    Reject,
    Session,
    poses_of,
)
from groundwalk.capture_import.checks.rows import check_rows
from groundwalk.geometry.poses import Array, make_pose, relative, rotation_angle
from groundwalk.store.choices import UNTRACKED, PoseSource, SessionSplit
from groundwalk.store.images import exif_orientation
from groundwalk.store.text import name_list

# Grey levels, of 255: a covered lens with a sensor's noise has 0 to 1, a dim or dull view 30 and more.
_MIN_CONTRAST = 2.0
# Sizes are whole: at 480x270, a width by the height of 1080 may be off by the rounding of both.
_MAX_SCALED_OFF_PX = 2.0
# A jump is motion that no hand does: beyond what an acceleration of 4 m/s^2 or 600 deg/s^2 changes between two poses,
# beyond the noise of a pose, and far beyond what the same hand does around that moment.
_ACCELERATION_M_S2 = 4.0
_ACCELERATION_DEG_S2 = 600.0
_NOISE_M = 0.03
_NOISE_DEG = 3.0
_MIN_RATIO = 8.0
_CONTEXT = 4
_MEDIAN_STEPS = 60
# At larger ones a session ends: sfm and align hold VIO to a few centimetres over such a step.
_SPLIT_M, _SPLIT_DEG = 0.5, 15.0
# What reads positions as float32 (recordings, networks, other tools) sees steps of 6e-8 of their distance from the
# origin: of 6e-5 of the extent where that is so many times as far.
_MAX_DISTANCE_EXTENTS = 1e3


def sound_sessions(
    recording: Recording,
    check_images: Callable[[list[RawFrame]], Iterable[ImageCheck | str]],
    min_relative_sharpness: float,
) -> list[Session]:
    """Check a recording's rows and images, find its jumps, and cut it at the large ones: one session at least. Where
    it has no poses, each of its cameras, or part of a video between cuts, has a session.

    `check_images` gives for each of the given frames what was measured of its image, or why it can't be used. One less
    sharp than `min_relative_sharpness` of the median is rejected.
    """
    frames, rejects = check_rows(recording)
    stated = [frame.intrinsics for frame in frames]
    frames, bad = _with_sound_images(recording, frames, check_images, min_relative_sharpness)
    rejects += bad
    recording = replace(recording, notes=[*recording.notes, *_notes_on_scaled(frames, stated)])
    if recording.pose_source == PoseSource.NONE:
        return _by_camera(recording, frames, rejects)
    t_ns = np.array([f.t_ns for f in frames], dtype=np.int64)
    jumps = _jumps_of(recording, frames) if recording.pose_source == PoseSource.VIO else []
    starts = [0, *(jump.index for jump in jumps if jump.splits)]
    # A reject is of the session that it lies in by its time; of the first where it has none.
    lies_in = [0 if r.t_ns is None else bisect_right(t_ns[starts[1:]].tolist(), r.t_ns) for r in rejects]
    return [
        Session(
            session_id=recording.recording_id + (f".part{place + 1}" if place else ""),
            recording=recording,
            frames=frames[start:stop],
            # A large jump is a row of the session that it ends, so that no session's poses have one inside.
            jumps=[jump for jump in jumps if start < jump.index <= stop],
            rejects=[reject for reject, at in zip(rejects, lies_in, strict=True) if at == place],
        )
        for place, (start, stop) in enumerate(pairwise([*starts, len(frames)]))
    ]


def _jumps_of(recording: Recording, frames: list[RawFrame]) -> list[Jump]:
    """The jumps between a recording's sound rows, in order of time."""
    t_ns, poses = np.array([f.t_ns for f in frames], dtype=np.int64), poses_of(frames)
    # Rows of lost tracking aren't sound; images have the tracking of the poses around them.
    untracked_ns = np.array([f.t_ns for f in (*recording.frames, *frames) if f.tracking in UNTRACKED], dtype=np.int64)
    found = [*steps_over_untracked(t_ns, poses, np.unique(untracked_ns)), *find_jumps(t_ns, poses)]
    return sorted({jump.index: jump for jump in found}.values(), key=lambda jump: jump.index)


def _by_camera(recording: Recording, frames: list[RawFrame], rejects: list[Reject]) -> list[Session]:
    """A session a camera, in order of their first images, or a part of a video between cuts; rejects are of the first
    one."""
    of_session: dict[tuple[str, int], list[RawFrame]] = {}
    starts_s, part = list[float](), 0
    for frame in frames:
        if isinstance(frame, Image) and frame.check.part != part:
            part = frame.check.part
            starts_s.append((frame.t_ns - frames[0].t_ns) * 1e-9)
        of_session.setdefault((frame.camera_name, part), []).append(frame)
    if starts_s:
        cuts = name_list([f"{start_s:.1f} s" for start_s in starts_s], 8)
        note = f"the video has {len(starts_s)} cuts, at {cuts}: each part is a session of its own"
        recording = replace(recording, notes=[*recording.notes, note])
    return [
        Session(
            session_id=recording.recording_id + (f".{'part' if part else 'camera'}{place + 1}" if place else ""),
            recording=recording,
            frames=own,
            rejects=() if place else rejects,
        )
        for place, ((_, part), own) in enumerate((of_session or {("", 0): []}).items())
    ]


def with_numbered_cameras(of_recording: Sequence[list[Session]]) -> list[list[Session]]:
    """A capture's sessions, recording by recording, with cameras that no log names told apart by numbers: those of one
    maker, model, lens, focal length and size are one, and each recording has its own where nothing states these. What a
    camera is called in the file doesn't leave import."""
    numbers: dict[str, int] = {}

    def numbered(session: Session) -> Session:
        if session.has_poses or session.recording.device != "unknown" or not session.frames:
            return session
        name = session.frames[0].camera_name
        key = name if name.partition("|")[0].strip() else f"{session.recording.recording_id}|{name}"
        device = f"camera {numbers.setdefault(key, len(numbers) + 1)}"
        return replace(session, recording=replace(session.recording, device=device))

    return [[numbered(session) for session in sessions] for sessions in of_recording]


def path_length(session: Session, reference_is_metric: bool) -> float:
    """Length of the session's path, metres; NaN where the unit of its poses or their order isn't known.
    `reference_is_metric`: references without a stated unit are in metres."""
    if not (session.recording.clock.has_times and (session.recording.is_metric or reference_is_metric)):
        return math.nan
    return float(np.linalg.norm(np.diff(session.poses[:, :3, 3], axis=0), axis=1).sum())


def duration(session: Session) -> float:
    """Seconds from the first to the last pose; NaN where the recording has no times."""
    if not session.recording.clock.has_times:
        return math.nan
    return float(session.t_ns[-1] - session.t_ns[0]) * 1e-9 if session.frames else 0.0


def _with_sound_images(
    recording: Recording,
    frames: list[RawFrame],
    check_images: Callable[[list[RawFrame]], Iterable[ImageCheck | str]],
    min_relative_sharpness: float,
) -> tuple[list[RawFrame], list[Reject]]:
    """The rows, those with a sound image as `Image`, and why the others' images aren't."""
    with_image = [frame for frame in frames if frame.image is not None]
    image_of: dict[int, Image] = {}
    rejects = []
    for frame, result in zip(with_image, check_images(with_image), strict=True):
        if isinstance(result, str):
            rejects.append(Reject.of(frame, result))
            continue
        scaled = _at_size_of_image(frame, result)
        if fault := _image_fault(scaled, result):
            rejects.append(Reject.of(frame, fault))
        else:
            image_of[id(frame)] = Image(**vars(scaled), check=result)
    median = float(np.median([image.check.sharpness for image in image_of.values()])) if image_of else 0.0
    faults = {
        key: f"too blurred: sharpness {image.check.sharpness:.2f}, median of the session {median:.2f}"
        for key, image in image_of.items()
        if image.check.sharpness < min_relative_sharpness * median
    }
    if not recording.clock.has_times:
        # Of photos that are the same but for metadata, one: for training, where a data set lists it for both sides, and
        # the one whose focal length is known best, as messengers send copies without EXIF.
        first: dict[str, Image] = {}
        sharp = [image for key, image in image_of.items() if key not in faults]
        for image in sorted(sharp, key=lambda image: (image.split == SessionSplit.TEST, image.camera.focal_sd)):
            first.setdefault(image.check.content_sha256, image)
        for key, image in image_of.items():
            original = first.get(image.check.content_sha256, image)
            if key not in faults and original is not image:
                faults[key] = f"image is a copy of that of {original.source}"
    elif recording.pose_source == PoseSource.VIO:
        shown: dict[str, Image] = {}
        for key, image in image_of.items():
            before = shown.setdefault(image.check.content_sha256 or image.source, image)
            assert before.vio_T_cam is not None and image.vio_T_cam is not None  # check_rows interpolates
            motion = relative(before.vio_T_cam, image.vio_T_cam)
            moved_m, turned_deg = np.linalg.norm(motion[:3, 3]), np.degrees(rotation_angle(motion[:3, :3]))
            if moved_m > _NOISE_M or turned_deg > _NOISE_DEG:
                off = f"{moved_m:.2f} m and {turned_deg:.0f} degrees"
                faults[key] = f"image is that of {before.source} again, while the pose is {off} from there"
    rejects += [Reject.of(image_of.pop(key), fault) for key, fault in faults.items()]
    return [image_of.get(id(frame), frame) for frame in frames], rejects


def _at_size_of_image(frame: RawFrame, check: ImageCheck) -> RawFrame:
    """The row with its intrinsics at the image's own size, where that has the shape of the one that they state: images
    are often made smaller, and nobody changes the file beside them."""
    camera = frame.intrinsics
    if camera is None or not camera.width or not camera.height:
        return frame
    x, y = check.width / camera.width, check.height / camera.height
    if x == y == 1 or abs(y * camera.width - check.width) > _MAX_SCALED_OFF_PX:
        return frame
    at_size = Intrinsics(camera.fx * x, camera.fy * y, camera.cx * x, camera.cy * y, check.width, check.height)
    return replace(frame, intrinsics=replace(at_size, distortion=camera.distortion, focal_sd=camera.focal_sd))


def _notes_on_scaled(frames: list[RawFrame], stated: list[Intrinsics | None]) -> list[str]:
    """A line on images whose intrinsics were `stated` for another size."""
    scaled = [
        (image.camera, before)
        for image, before in zip(frames, stated, strict=True)
        if isinstance(image, Image) and before is not None and image.camera is not before
    ]
    if not scaled:
        return []
    now, before = scaled[0]
    sizes = f"{now.width}x{now.height}, their intrinsics for {before.width}x{before.height}"
    return [f"{len(scaled)} images are {sizes}: scaled"]


def _image_fault(frame: RawFrame, check: ImageCheck) -> str | None:
    """What is wrong with an image that could be decoded, under its intrinsics."""
    camera, width, height = frame.intrinsics, check.width, check.height
    assert camera is not None  # check_rows rejects images without
    is_swapped = width != height and (camera.height, camera.width) == (width, height)
    if is_swapped and isinstance(frame.image, ImageFile) and (turn := exif_orientation(frame.image.path)) >= 5:
        return (
            f"image is stored {width}x{height}, its intrinsics are for {camera.width}x{camera.height}, as "
            f"viewers show it: EXIF orientation {turn} isn't applied; write the pixels turned (mogrify -auto-orient)"
        )
    if camera.width is not None and (width, height) != (camera.width, camera.height):
        return f"image is {width}x{height}, its intrinsics are for {camera.width}x{camera.height}"
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        return f"principal point {camera.cx:.1f}, {camera.cy:.1f} is outside the image of {width}x{height}"
    if not 0.1 < camera.fx / max(width, height) < 20 or not 0.5 < camera.fx / camera.fy < 2:
        return f"focal length {camera.fx:.1f}, {camera.fy:.1f} isn't plausible for an image of {width}x{height}"
    if check.contrast < _MIN_CONTRAST:
        return f"image shows nothing: its grey levels vary by {check.contrast:.1f} of 255 (at least {_MIN_CONTRAST:g})"
    return None


def find_jumps(t_ns: NDArray[np.int64], poses: Array) -> list[Jump]:
    """Steps between poses (N, 4, 4) at rising times (N,) that no hand can do.

    Each step is compared with the motion that the steps around it extrapolate (their median velocity, so that one
    neighbouring jump doesn't matter); the residual must be explained by acceleration, pose noise, or the median
    residual in the neighbourhood.
    """
    if len(poses) < 4:
        return []
    dt, beyond_m, beyond_deg = _steps(t_ns, poses)
    usual_m, usual_deg = (median_filter(b, size=_MEDIAN_STEPS + 1, mode="nearest") for b in (beyond_m, beyond_deg))
    limit_m = np.maximum(_NOISE_M + _ACCELERATION_M_S2 * dt**2, _MIN_RATIO * usual_m)
    limit_deg = np.maximum(_NOISE_DEG + _ACCELERATION_DEG_S2 * dt**2, _MIN_RATIO * usual_deg)
    jumps = np.flatnonzero((beyond_m > limit_m) | (beyond_deg > limit_deg))
    splits = (beyond_m > _SPLIT_M) | (beyond_deg > _SPLIT_DEG)
    return [
        Jump(int(i) + 1, int(t_ns[i + 1]), float(dt[i]), float(beyond_m[i]), float(beyond_deg[i]), bool(splits[i]))
        for i in jumps
    ]


def steps_over_untracked(t_ns: NDArray[np.int64], poses: Array, untracked_ns: NDArray[np.int64]) -> list[Jump]:
    """Steps between poses (N, 4, 4) at rising times (N,) over those that the phone calls limited or lost, at rising
    times (M,): it may move there while its VIO stands still, so what noise alone doesn't explain counts as a jump."""
    rows = np.flatnonzero(~np.isin(t_ns, untracked_ns))
    is_over = np.diff(np.searchsorted(untracked_ns, t_ns[rows])) > 0
    if len(rows) < 4 or not is_over.any():
        return []
    dt, beyond_m, beyond_deg = _steps(t_ns[rows], poses[rows])
    jumps = np.flatnonzero(is_over & ((beyond_m > _NOISE_M) | (beyond_deg > _NOISE_DEG)))
    return [
        Jump(int(row), int(t_ns[row]), float(dt[i]), float(beyond_m[i]), float(beyond_deg[i]), splits=False)
        for i, row in zip(jumps, rows[jumps + 1], strict=True)
    ]


def _steps(t_ns: NDArray[np.int64], poses: Array) -> tuple[Array, Array, Array]:
    """Per step between poses (N, 4, 4): seconds, and metres and degrees beyond what the steps around it predict."""
    dt: Array = np.diff(t_ns).astype(float) * 1e-9
    velocity = np.diff(poses[:, :3, 3], axis=0) / dt[:, None]
    # Rotation in the world's axes, so that neighbouring steps can be averaged.
    steps = poses[1:, :3, :3] @ np.swapaxes(poses[:-1, :3, :3], -1, -2)
    rate = np.degrees(Rotation.from_matrix(steps).as_rotvec()) / dt[:, None]
    return dt, _beyond_context(velocity, dt), _beyond_context(rate, dt)


def _beyond_context(rate_N3: Array, dt: Array) -> Array:
    """Per step: the length of its change beyond what the median rate of the steps around it predicts."""
    padded = np.pad(rate_N3, ((_CONTEXT, _CONTEXT), (0, 0)), constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * _CONTEXT + 1, axis=0)
    around = np.delete(windows, _CONTEXT, axis=-1)
    beyond: Array = np.linalg.norm(rate_N3 - np.nanmedian(around, axis=-1), axis=-1) * dt
    return beyond


def far_origin(sessions: Sequence[Session]) -> Array | None:
    """The origin (3,) to take off the positions of all references, in their unit and axes; None where these are near
    enough to theirs. Round to a power of ten of about the extent."""
    positions = [s.poses[:, :3, 3] for s in sessions if s.frames and s.has_reference]
    if not positions:
        return None
    xyz = np.concatenate(positions)
    extent, middle = float(np.linalg.norm(np.ptp(xyz, axis=0))), np.median(xyz, axis=0)
    if not 0 < _MAX_DISTANCE_EXTENTS * extent < np.linalg.norm(middle):
        return None
    step = 10.0 ** np.ceil(np.log10(extent))
    return step * np.round(middle / step)


def moved(session: Session, origin: Array) -> Session:
    """The session with poses from another origin, where they are a reference."""
    if not session.has_reference:
        return session

    def of(frame: RawFrame) -> RawFrame:
        pose = frame.vio_T_cam
        assert pose is not None  # a session has no rows without
        return replace(frame, vio_T_cam=make_pose(pose[:3, :3], pose[:3, 3] - origin))

    return replace(session, frames=[of(frame) for frame in session.frames])


def describe_origin(origin: Array) -> str:
    """A line for the user on an origin that was taken off."""
    return (
        "reference poses are far from their origin, as georeferenced ones are: the map's origin is at "
        f"({', '.join(f'{value:.12g}' for value in origin)}) of the data set's own coordinates, which sessions.parquet "
        "keeps (reference_origin_x, _y, _z)"
    )
