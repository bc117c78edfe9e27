"""Do a recording's poses and intrinsics explain its images, and if not, which usual mistake would?

For pairs of images with enough parallax, matched points must lie on each other's epipolar lines and in front of both
cameras. That is tried with the poses as the format declares them and as they would be under each usual mistake.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from groundwalk.capture_import.capture import Image, RawFrame, Session, poses_of
from groundwalk.capture_import.checks.features import LONG_SIDE, detect_features, match_features
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.pose_conventions import POSE_CONVENTIONS, turned_image
from groundwalk.geometry.poses import Array, relative, rotation_angle
from groundwalk.store.parallel import in_parallel

# Points this near to their epipolar line, in pixels of the working image, are explained: odometry is off by some tenths
# of a degree from one image to the next.
_NEAR_PX = 2.0
_MAX_PAIRS = 8
# Pairs are searched in so many parts of the session, so that a missing image moves one of them at most.
_PARTS = 64
_MIN_MATCHES = 30
_MIN_PAIRS = 4
_MAX_INTERVAL_S = 4.0
_MAX_TURN_DEG = 35.0
_MIN_STEP_M = 0.08
# Poses without a unit: of so many, spread over the session, each is paired with one of the nearest so many.
_MAX_POSES, _NEAREST = 256, 8
# Another convention is the true one where it explains so much more, as a fraction of all matches, and most of them.
_MIN_GAIN = 0.2
_MIN_MOST = 0.6

# Of a guess, from a telephoto to a wide lens, in steps of a hundredth.
_FOCAL_FACTORS = np.exp(np.arange(-1.2, 1.2, 0.01)).tolist()

# Where fewer matches are explained, even the best convention is doubtful.
MIN_EXPLAINED = 0.5

# A camera for the check: its pose (4, 4) and fx, fy, cx, cy of the working image.
Camera = tuple[Array, Array]
# OpenCV's coefficients; empty where none are stated: a phone's main lens moves points by a pixel or two of the working
# image, and much alike in both.
Distortion = tuple[float, ...]
Change = Callable[[Camera], Camera]


@dataclass(frozen=True)
class ConventionCheck:
    """The fraction of matches that the declared convention explains, and the best of the others.

    `contradicted` is the name of a convention that fits clearly better; None where the declared one fits, or where too
    few pairs have parallax.
    """

    pairs: int
    declared: float
    other_explained: float
    contradicted: str | None


class _MatchedPair(NamedTuple):
    """Matched points of two images (N, 2) in pixels of the working size, (0, 0) the image's corner, the cameras, and
    the distortion that is stated of each."""

    points: tuple[Array, Array]
    cameras: tuple[Camera, Camera]
    distortion: tuple[Distortion, Distortion]


def check_convention(session: Session, reader: ImageReader) -> ConventionCheck:
    """Compare a session's poses with its images, in every convention."""
    matched = _matched_pairs(session, reader)
    if not matched:
        return ConventionCheck(0, np.nan, np.nan, None)
    table = np.array([[_explained(pair, change) for _, change in CONVENTIONS] for pair in matched])
    mean = table.mean(axis=0)
    best = 1 + int(np.argmax(mean[1:]))
    wins = np.mean(table[:, best] > table[:, 0])
    contradicted = len(matched) >= _MIN_PAIRS and mean[best] > max(_MIN_MOST, mean[0] + _MIN_GAIN) and wins > 0.75
    name = CONVENTIONS[best][0] if contradicted else None
    return ConventionCheck(len(matched), float(mean[0]), float(mean[best]), name)


def with_focal_length(sessions: list[Session], reader: ImageReader) -> tuple[list[Session], str]:
    """A recording's sessions with the focal length by which its poses explain its images, where it states none; and a
    line on that, empty where it states one."""
    if sessions[0].recording.has_intrinsics or not sessions[0].has_poses:
        return sessions, ""
    matched = _matched_pairs(max(sessions, key=lambda session: len(session.images)), reader)
    if len(matched) < _MIN_PAIRS:
        return sessions, "warning: the focal length isn't stated, and too few images tell it: it is guessed"

    def cost(factor: float) -> float:
        errors = np.concatenate([_epipolar(pair, _times(factor, factor, 1, 1))[0] for pair in matched])
        return float(np.mean(np.minimum(np.nan_to_num(errors, nan=np.inf), _NEAR_PX) ** 2))

    factor = min(_FOCAL_FACTORS, key=cost)

    def scaled(frame: RawFrame) -> RawFrame:
        camera = frame.intrinsics
        if camera is None:
            return frame
        return replace(frame, intrinsics=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))

    sessions = [replace(session, frames=[scaled(frame) for frame in session.frames]) for session in sessions]
    focal_px = np.median([image.camera.fx for session in sessions for image in session.images])
    return sessions, f"the focal length isn't stated: {focal_px:.0f} px by the poses and the images, to some 2 %"


def _matched_pairs(session: Session, reader: ImageReader) -> list[_MatchedPair]:
    """A session's pairs of images with parallax and enough matches; none without poses."""
    if not session.has_poses:
        return []
    frames = session.images
    is_walk = session.recording.is_metric and session.recording.clock.has_times
    pairs = parallax_pairs(frames) if is_walk else unitless_parallax_pairs(frames)
    views = reader.gray([frames[i] for i in sorted({i for pair in pairs for i in pair})], LONG_SIDE)
    features = dict(in_parallel(lambda view: (view[0].number, detect_features(view[1])), views))
    matched = []
    for a, b in pairs:
        features_a, features_b = features.get(frames[a].number), features.get(frames[b].number)
        if features_a is None or features_b is None:
            continue
        matches = match_features(features_a[1], features_b[1])
        if len(matches) >= _MIN_MATCHES:
            points = features_a[0][matches[:, 0]], features_b[0][matches[:, 1]]
            lenses = frames[a].camera.distortion, frames[b].camera.distortion
            matched.append(_MatchedPair(points, (_camera(frames[a]), _camera(frames[b])), lenses))
    return matched


def parallax_pairs(frames: Sequence[RawFrame]) -> list[tuple[int, int]]:
    """Pairs of frames near in time whose poses differ by a step and little rotation, spread over the session.

    Distances are the same in all conventions but the world-to-camera one, so that a wrong one has pairs too.
    """
    poses = poses_of(frames)
    t_s = np.array([frame.t_ns for frame in frames]) * 1e-9
    borders: list[int] = []
    if len(frames):
        borders = np.searchsorted(t_s, np.linspace(t_s[0], t_s[-1], _PARTS + 1)).tolist()
    candidates = (_with_parallax(poses, t_s, range(a, b)) for a, b in pairwise(borders))
    return _spread([pair for pair in candidates if pair is not None])


def unitless_parallax_pairs(frames: Sequence[RawFrame]) -> list[tuple[int, int]]:
    """Pairs as those of `parallax_pairs` where poses have no unit or no times: each frame and one of the
    nearest, about as far as nearest ones with little rotation are. The same at any scale and origin, as good in any
    order of the frames."""
    poses = poses_of(frames)
    used = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), _MAX_POSES)).astype(int))
    pairs: dict[tuple[int, int], None] = {}
    for a in used.tolist():
        distance = np.linalg.norm(poses[used, :3, 3] - poses[a, :3, 3], axis=1)
        nearest = used[np.argsort(distance, kind="stable")[1 : _NEAREST + 1]]
        steps = relative(poses[a], poses[nearest])
        nearest = nearest[np.degrees(rotation_angle(steps[:, :3, :3])) <= _MAX_TURN_DEG]
        far = np.linalg.norm(poses[nearest, :3, 3] - poses[a, :3, 3], axis=1)
        if len(far) and far[-1] > 0:
            b = int(nearest[np.argmax(far >= far[-1] / 2)])
            pairs[min(a, b), max(a, b)] = None
    return _spread(list(pairs))


def _spread(pairs: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """So many of the pairs as are tried."""
    spread = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _MAX_PAIRS)).astype(int))
    return [pairs[i] for i in spread]


def _with_parallax(poses: Array, t_s: Array, firsts: range) -> tuple[int, int] | None:
    """The first of the frames `firsts` with one behind it that it makes a pair with, and that one."""
    for a in firsts:
        behind = slice(a + 1, int(np.searchsorted(t_s, t_s[a] + _MAX_INTERVAL_S, side="right")))
        steps = relative(poses[a], poses[behind])
        turned = np.flatnonzero(np.degrees(rotation_angle(steps[:, :3, :3])) > _MAX_TURN_DEG)
        moved = np.flatnonzero(np.linalg.norm(steps[: turned[0] if len(turned) else None, :3, 3], axis=1) > _MIN_STEP_M)
        if len(moved):
            return a, a + 1 + int(moved[0])
    return None


def _camera(image: Image) -> Camera:
    pose, camera = image.vio_T_cam, image.camera
    assert pose is not None  # a sound image has one
    scale = min(1.0, LONG_SIDE / max(image.check.width, image.check.height))
    return pose, scale * np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def _epipolar(pair: _MatchedPair, change: Change) -> tuple[Array, Array, Array, Array]:
    """Of a pair's matches, its cameras changed: their distances (N,) from their epipolar lines (Sampson's), rays (N, 3)
    in both, NaN where the lens has none, and b_T_a."""
    (world_T_a, k_a), (world_T_b, k_b) = map(change, pair.cameras)
    rays_a, rays_b = (
        np.column_stack([undistort((points - k[2:]) / k[:2], lens), np.ones(len(points))])
        for points, k, lens in zip(pair.points, (k_a, k_b), pair.distortion, strict=True)
    )
    b_T_a = relative(world_T_b, world_T_a)
    errors_px = sampson_px(np.tile(b_T_a, (len(rays_a), 1, 1)), rays_b, rays_a, k_b[:2], k_a[:2])
    return errors_px, rays_a, rays_b, b_T_a


def _explained(pair: _MatchedPair, change: Change) -> float:
    """Fraction of matches near to their epipolar lines and in front of both cameras, changed."""
    errors_px, rays_a, rays_b, b_T_a = _epipolar(pair, change)
    # Depths along both rays where they come nearest: depth_b * ray_b = depth_a * R ray_a + t.
    turned, t = rays_a @ b_T_a[:3, :3].T, b_T_a[:3, 3]
    aa, bb, ab = (np.sum(x * y, axis=1) for x, y in ((turned, turned), (rays_b, rays_b), (turned, rays_b)))
    at, bt = turned @ t, rays_b @ t
    return float(np.mean((errors_px < _NEAR_PX) & (ab * bt - bb * at > 0) & (aa * bt - ab * at > 0)))


def _turned_with_intrinsics(quarters: int) -> Change:
    """The image is turned by quarters clockwise against the pose, and its intrinsics aren't."""
    turn = turned_image(quarters)
    return lambda camera: (turn(camera[0]), camera[1][[1, 0, 3, 2]])


def _times(*factors: float) -> Change:
    """fx, fy, cx and cy are so many times as large, or of an image that is mirrored about its principal point."""
    return lambda camera: (camera[0], camera[1] * np.array(factors))


CONVENTIONS: tuple[tuple[str, Change], ...] = (
    ("as declared", lambda camera: camera),
    *((name, lambda camera, change=change: (change(camera[0]), camera[1])) for name, change in POSE_CONVENTIONS),
    ("image is turned by 90 degrees clockwise against pose and intrinsics", _turned_with_intrinsics(1)),
    ("image is turned by 90 degrees counter-clockwise against pose and intrinsics", _turned_with_intrinsics(3)),
    ("the images are mirrored left to right", _times(-1, 1, 1, 1)),
    ("the images are mirrored upside down", _times(1, -1, 1, 1)),
    ("intrinsics have width and height swapped", lambda camera: (camera[0], camera[1][[1, 0, 3, 2]])),
    *(
        (f"intrinsics are for an image {1 / factor:g} times as large", _times(*[factor] * 4))
        for factor in (1 / 4, 1 / 3, 1 / 2, 2 / 3, 3 / 4, 4 / 3, 3 / 2, 2.0, 3.0, 4.0)
    ),
)
