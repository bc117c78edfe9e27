"""What to do better in the next walk, by a capture's poses and images, before import."""

from collections.abc import Iterator

import numpy as np

from groundwalk.capture_import.capture import Session, poses_of
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.geometry.poses import Array, rotation_angle
from groundwalk.geometry.rates import rates_at
from groundwalk.geometry.rows import evenly
from groundwalk.store.choices import Rejected

_LOOKED_AT, _LOOKED_AT_PX = 24, 240
_MAX_COMPARED = 800
_GAP_S = 1.5  # between poses; charuco's are half a second apart
# One place seen twice: looking the same way, this fraction of the extent apart.
_SAME_VIEW_DEG, _SAME_PLACE = 30.0, 0.1
_BLURRED_PX, _FAST_DEG_S, _FAST_M_S = 3.0, 45.0, 1.5
_DARK, _BRIGHT, _CLIPPED, _UNEVEN = 50.0, 200.0, 0.1, 2.0
_FEW_IMAGES, _REJECTED = 60, 0.1


def advice_on(session: Session, has_up: bool, reader: ImageReader) -> Iterator[tuple[str, str]]:
    """What to do better, and why, of a session that has images; `has_up`: +y is up in its world."""
    count, rejected = len(session.images), sum(reject.rejected is Rejected.IMAGE for reject in session.rejects)
    if count < _FEW_IMAGES:
        yield "walk longer, or take images more often", f"{count} images; {_FEW_IMAGES} or more make a map and a test"
    if rejected > _REJECTED * (count + rejected):
        yield "see why images are rejected, above", f"{rejected} of {count + rejected}"
    yield from _on_light(session, reader)
    if not session.has_poses:
        yield "record with an app that logs poses", "images alone have no scale, no vertical and no check"
        return
    if session.recording.clock.has_times and len(session.frames) > 1:
        yield from _on_motion(session)
    if not has_up and session.has_vio:
        yield "use an app whose world is upright", "gravity is unknown, by the lines above"
    poses = poses_of(session.images)
    if len(poses) > 2 and not _comes_back(poses):
        yield "come back to where you were, with the same view", "no image sees what an earlier one did: no loop"
    steps = np.degrees(rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3]))
    if len(steps) and np.percentile(steps, 95) > _SAME_VIEW_DEG:
        yield "take images more often where you turn", f"neighbours look up to {np.percentile(steps, 95):.0f}° apart"


def _on_light(session: Session, reader: ImageReader) -> Iterator[tuple[str, str]]:
    """By mean grey levels (of 255) and fractions of white pixels of some images."""
    some = [session.images[row] for row in evenly(len(session.images), _LOOKED_AT)]
    levels = [(rgb.mean(), (rgb.min(axis=2) >= 250).mean()) for _, rgb in reader.rgb(some, _LOOKED_AT_PX)]
    if not levels:
        return
    brightness, clipped = np.array(levels).T
    low, middle, high = np.percentile(brightness, [5, 50, 95])
    white = np.median(clipped)
    if middle < _DARK:
        yield "have more light", f"brightness {middle:.0f} of 255"
    elif middle > _BRIGHT or white > _CLIPPED:
        yield "expose less, or avoid windows and sky", f"brightness {middle:.0f} of 255, {100 * white:.0f} % white"
    if high > _UNEVEN * max(low, 1.0):
        yield "lock the exposure, or avoid backlight", f"brightness goes from {low:.0f} to {high:.0f}"


def _on_motion(session: Session) -> Iterator[tuple[str, str]]:
    """By how fast the camera turns and moves, and how far the image's middle goes by its turning while it's exposed."""
    t_ns = np.array([image.t_ns for image in session.images], np.int64)
    jumps = np.array([jump.t_ns for jump in session.jumps], np.int64)
    rates = rates_at(t_ns, session.t_ns, session.poses, _GAP_S, jumps)
    focal_px = np.array([image.camera.fx for image in session.images])
    exposures_s = np.array([np.nan if i.exposure_s is None else i.exposure_s for i in session.images], float)
    blur_px, turning_deg_s, speed = (
        np.percentile(known, 90) if len(known := values[np.isfinite(values)]) else 0.0
        for values in (
            focal_px * np.linalg.norm(rates.angular[:, :2], axis=1) * exposures_s,
            np.degrees(np.linalg.norm(rates.angular, axis=1)),
            np.linalg.norm(rates.velocity, axis=1),
        )
    )
    if blur_px > _BLURRED_PX:
        why = f"in a tenth of images what is far away blurs by {blur_px:.0f} px or more"
        yield "turn more slowly, or have more light", why
    elif turning_deg_s > _FAST_DEG_S:
        yield "turn more slowly", f"a tenth of images turn at {turning_deg_s:.0f}° a second or more"
    if speed > _FAST_M_S and session.recording.is_metric:
        yield "walk more slowly", f"a tenth of images move at {speed:.1f} m/s or more"


def _comes_back(poses: Array) -> bool:
    """Whether any of images (N, 4, 4) sees what an earlier one saw, the camera having looked or been elsewhere between:
    they look the same way from nearly the same place. Of more than 800 images so many, as each is compared with
    each."""
    poses = poses[evenly(len(poses), _MAX_COMPARED)]
    xyz, forward = poses[:, :3, 3], poses[:, :3, 2]
    near = np.linalg.norm(xyz[:, None] - xyz, axis=2) <= _SAME_PLACE * np.linalg.norm(np.ptp(xyz, axis=0))
    near &= forward @ forward.T > np.cos(np.radians(_SAME_VIEW_DEG))
    left = [np.flatnonzero(~near[row, :row]).max(initial=-1) for row in range(len(near))]
    return any(near[row, : left[row] + 1].any() for row in range(len(near)))
