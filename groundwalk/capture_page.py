"""The page of a capture before import: what it looks like, how it was walked, and what to do better."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from markupsafe import Markup
from matplotlib.figure import Figure

from groundwalk.capture_import.capture import Session, poses_of
from groundwalk.capture_import.media.images import encode_jpeg, quarters_to_upright, turned_pixels
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sessions import duration, path_length
from groundwalk.geometry.poses import Array, rotation_angle
from groundwalk.geometry.rates import rates_at
from groundwalk.geometry.rows import evenly
from groundwalk.reports import style
from groundwalk.reports.grids import html_table, plain_grid
from groundwalk.reports.templating import fragment, plain_page
from groundwalk.reports.walk_map import data_address, draw
from groundwalk.store.choices import QualityClass, Rejected

_SHOWN, _THUMBNAIL_PX = 24, 240
_MAX_MARKS = 800
_GAP_S = 1.5  # between poses; charuco's are half a second apart
_SECTORS = 12  # of 30 degrees, all round
_ASSUMED_EXPOSURE_S = 0.01
# One place seen twice: looking the same way, this fraction of the extent apart.
_SAME_VIEW_DEG, _SAME_PLACE = 30.0, 0.1
_BLURRED_PX, _FAST_DEG_S, _FAST_M_S = 3.0, 45.0, 1.5
_DARK, _BRIGHT, _CLIPPED, _UNEVEN = 50.0, 200.0, 0.1, 2.0
_FEW_IMAGES, _REJECTED = 60, 0.1


@dataclass(frozen=True)
class Look:
    """What the page shows of a session: `poses` (N, 4, 4) of its images, NaN where unknown, `pixels_s` (N,) how fast
    the image's middle moves as the camera turns, `turning_deg_s` and `speed_m_s` (N,); of sampled images thumbnails,
    mean grey levels (of 255) and the fraction of white pixels."""

    session: Session
    has_up: bool
    poses: Array
    pixels_s: Array
    turning_deg_s: Array
    speed_m_s: Array
    sampled: Array
    thumbnails: list[str]
    brightness: Array
    clipped: Array

    def blur_px(self, exposure_s: Array | float) -> Array:
        """Lengths (N,) over which images blur by turning."""
        return self.pixels_s * exposure_s

    @property
    def exposures_s(self) -> Array:
        """(N,), NaN where the log states none."""
        return np.array([np.nan if i.exposure_s is None else i.exposure_s for i in self.session.images], float)


def look_at(session: Session, has_up: bool, reader: ImageReader) -> Look:
    """Measure a session that has images; `has_up`: +y is up in its world."""
    images = session.images
    rows = evenly(len(images), _SHOWN)
    turns = quarters_to_upright(session) if has_up else 0
    row_of = {id(images[row]): row for row in rows}
    sampled, thumbnails, brightness, clipped = [], [], [], []
    for image, rgb in reader.rgb([images[row] for row in rows], _THUMBNAIL_PX):
        sampled.append(row_of[id(image)])
        thumbnails.append(data_address("jpeg", encode_jpeg(turned_pixels(rgb, turns), 75)))
        brightness.append(float(rgb.mean()))
        clipped.append(float((rgb.min(axis=2) >= 250).mean()))
    unknown = np.full(len(images), np.nan)
    pixels_s, turning, speed = unknown, unknown, unknown
    if session.has_poses and session.recording.clock.has_times and len(session.frames) > 1:
        t_ns = np.array([image.t_ns for image in images], np.int64)
        jumps = np.array([jump.t_ns for jump in session.jumps], np.int64)
        rates = rates_at(t_ns, session.t_ns, session.poses, _GAP_S, jumps)
        focal = np.array([image.camera.fx for image in images])
        pixels_s = focal * np.linalg.norm(rates.angular[:, :2], axis=1)
        turning = np.degrees(np.linalg.norm(rates.angular, axis=1))
        if session.recording.is_metric:
            speed = np.linalg.norm(rates.velocity, axis=1)
    light = np.array(brightness), np.array(clipped)
    return Look(session, has_up, poses_of(images), pixels_s, turning, speed, np.array(sampled, int), thumbnails, *light)


def capture_page(name: str, looks: Sequence[Look], lines: Sequence[str]) -> str:
    """The page of a capture as HTML, one file: its sessions one after the other, then the lines of `inspect`."""
    rows = advice(looks)
    caption = "By the figures below. Whether this one can be used stands at the end."
    parts = [html_table(plain_grid("better", "In the next walk", caption, "recording | what to do | why", rows, 3))]
    if looks and not rows:
        parts.append(Markup("<p>Nothing below asks for another walk.</p>"))
    parts += [_session_part(look, place) for place, look in enumerate(looks)]
    parts.append(Markup("<h2>All that inspect says</h2><pre>{}</pre>").format("\n".join(lines)))
    return plain_page(name, "capture", parts)


def _session_part(look: Look, place: int) -> Markup:
    session = look.session
    with style.applied():
        plots = style.inline_svg(_plots(look), f"session-{place}")
    sampled = zip(look.thumbnails, look.sampled, strict=True)
    sheet = [(thumbnail, session.images[row].source, _moment(session, row)) for thumbnail, row in sampled]
    more = {"sheet": sheet, "path": _path(look), "has_up": look.has_up, "plots": plots}
    return fragment("session.html.j2", session=session, facts=_facts(look), **more)


def _moment(session: Session, row: int) -> str:
    image = session.images[row]
    if not session.recording.clock.has_times:
        return image.source
    return f"{(image.t_ns - session.frames[0].t_ns) * 1e-9:.1f} s"


def _facts(look: Look) -> Iterator[tuple[str, str, str]]:
    """Figures of a session: (number, what it is, more)."""
    session = look.session
    images = session.images
    rejected = len(session.rejects)
    seconds, metres = duration(session), path_length(session, False)
    over = "" if np.isnan(seconds) else f" over {seconds:.0f} s"
    yield f"{len(images)}", f"sound images{over}", f"{rejected} rows or images are rejected"
    if session.has_poses:
        unit = "m" if session.recording.is_metric else "of an unknown unit"
        x, y, z = np.ptp(look.poses[:, :3, 3] @ _level(look).T, axis=0).tolist()
        extent = "×".join(f"{side:.1f}" for side in (max(x, z), min(x, z), y))
        if not np.isnan(metres):
            speed = _range(look.speed_m_s, "m/s")
            yield f"{metres:.1f} m", "path", f"{extent} m across; speed {speed}"
        else:
            yield extent, f"extent, {unit}", "the path's length is unknown: no times, or no unit"
        covered = len(set(_headings(look).tolist()))
        shown = "" if look.has_up else "; by the longest two sides of the path, as up isn't known"
        yield f"{100 * covered / _SECTORS:.0f} %", "of the directions all round are looked at", f"30° each{shown}"
        back = _revisited(look)
        yield f"{100 * back:.0f} %", "of images see a place that was seen before", "a tenth of the extent, 30°, later"
    sharpness = np.array([image.check.sharpness for image in images])
    yield f"{np.median(sharpness):.2f}", "sharpness, median", f"0 (blurred) to 1; lowest {sharpness.min():.2f}"
    if len(look.brightness):
        low, high = look.brightness.min(), look.brightness.max()
        more = f"{low:.0f} to {high:.0f} of 255; white: {100 * look.clipped.max():.0f} % of an image at most"
        yield f"{np.median(look.brightness):.0f}", "brightness, median of sampled images", more
    exposures = look.exposures_s
    if np.isfinite(exposures).any():
        yield f"{1000 * np.nanmedian(exposures):.1f} ms", "exposure, median", f"{_range(1000 * exposures, 'ms')}"
    else:
        yield "unknown", "exposure", "the log states none"
    blur = look.blur_px(exposures)
    if not np.isfinite(look.pixels_s).any():
        yield "unknown", "blur length", "no poses with times to tell how fast the camera moves"
    elif np.isfinite(blur).any():
        what = "blur length of what is far away, by turning, median"
        yield f"{np.nanmedian(blur):.1f} px", what, _range(blur, "px")
    else:
        usual = np.nanmedian(look.blur_px(_ASSUMED_EXPOSURE_S))
        yield "unknown", "blur length", f"exposure is unknown; {usual:.1f} px by turning if it is 10 ms"


def _range(values: Array, unit: str) -> str:
    known = values[np.isfinite(values)]
    if not len(known):
        return "unknown"
    median, most = np.percentile(known, [50, 95])
    return f"{median:.2g} {unit} (median), {most:.2g} {unit} (95th percentile)"


def _level(look: Look) -> Array:
    """Rotation (3, 3) of the world, after which y is up, or across the path's two longest sides where up is unknown."""
    if look.has_up:
        return np.eye(3)
    xyz = look.poses[:, :3, 3]
    sides = np.linalg.svd(xyz - xyz.mean(axis=0), full_matrices=True)[2] if len(xyz) > 1 else np.eye(3)
    return np.array([sides[0], sides[2], sides[1]])


def _headings(look: Look) -> Array:
    """Sectors (N,) in which the images look."""
    x, _, z = (look.poses[:, :3, 2] @ _level(look).T).T
    return np.floor((np.arctan2(x, z) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS


def _revisited(look: Look) -> float:
    """The fraction of images that see what an earlier one saw, the camera having looked or been elsewhere between: they
    look the same way from nearly the same place. Of more than 800 images so many, as each is compared with each."""
    poses = look.poses[evenly(len(look.poses), _MAX_MARKS)]
    xyz, forward = poses[:, :3, 3], poses[:, :3, 2]
    near = np.linalg.norm(xyz[:, None] - xyz, axis=2) <= _SAME_PLACE * np.linalg.norm(np.ptp(xyz, axis=0))
    near &= forward @ forward.T > np.cos(np.radians(_SAME_VIEW_DEG))
    rows = np.arange(len(near))
    left = np.array([np.flatnonzero(~near[row, :row]).max(initial=-1) for row in rows])
    return float(np.mean([near[row, : left[row] + 1].any() for row in rows]))


def _path(look: Look) -> str:
    session = look.session
    if not session.has_poses:
        return ""
    rows = evenly(len(look.poses), _MAX_MARKS)
    x, y, z = (look.poses[rows, :3, 3] @ _level(look).T).T
    kind, none = ("vio_" if session.has_vio else ""), np.full(len(rows), np.nan)
    frames = pd.DataFrame(dict.fromkeys(("x", "y", "z", "vio_x", "vio_y", "vio_z"), none))
    frames[[f"{kind}x", f"{kind}y", f"{kind}z"]] = np.stack([x, y, z], axis=1)
    frames["session_id"], frames["quality"] = session.session_id, str(QualityClass.NONE)
    frames["frame_id"] = [session.images[row].source for row in rows]
    frames["meaning"] = [f"sharpness {session.images[row].check.sharpness:.2f}" for row in rows]
    return draw(session.session_id, "m" if session.recording.is_metric else "units", frames)


def _plots(look: Look) -> Figure:
    """Sharpness, brightness and what speed makes of images, in their order."""
    session, images = look.session, look.session.images
    has_times = session.recording.clock.has_times
    at = np.arange(len(images), dtype=float)
    if has_times:
        at = np.array([image.t_ns - session.frames[0].t_ns for image in images]) * 1e-9
    exposures, moves = look.exposures_s, bool(np.isfinite(look.pixels_s).any())
    figure, axes = style.new_figure(2 + moves, 1.4, sharex=True)
    axes[0].plot(at, [image.check.sharpness for image in images], color=style.INK, lw=0.9)
    axes[0].set(title="Sharpness", ylim=(0, 1))
    axes[1].plot(at[look.sampled], look.brightness, color=style.INK, marker="o", ms=2.5, lw=0.9)
    axes[1].set(title="Brightness of sampled images (of 255)", ylim=(0, 255))
    if moves:
        known = bool(np.isfinite(exposures).any())
        blur = look.blur_px(exposures if known else _ASSUMED_EXPOSURE_S)
        axes[2].plot(at, blur, color=style.INK, lw=0.9)
        axes[2].set(title=f"Blur by turning{'' if known else ', if exposed for 10 ms'} (px)")
        axes[2].set_ylim(bottom=0)
    axes[-1].set_xlabel("s" if has_times else "image, by name")
    return figure


def advice(looks: Sequence[Look]) -> list[tuple[str, str, str]]:
    """What to do better in the next walk: (session, what, why)."""
    rows = [(look.session.session_id, what, why) for look in looks for what, why in _advice(look)]
    if len({look.session.recording.recording_id for look in looks}) == 1:
        rows.append(("all", "record a second walk over the same ground", "one walk can't be tested by another"))
    return rows


def _advice(look: Look) -> Iterator[tuple[str, str]]:
    session = look.session
    count, rejected = len(session.images), sum(reject.rejected is Rejected.IMAGE for reject in session.rejects)
    if count < _FEW_IMAGES:
        yield "walk longer, or take images more often", f"{count} images; {_FEW_IMAGES} or more make a map and a test"
    if rejected > _REJECTED * (count + rejected):
        yield "see why images are rejected, below", f"{rejected} of {count + rejected}"
    if len(look.brightness):
        low, middle, high = np.percentile(look.brightness, [5, 50, 95])
        white = np.median(look.clipped)
        if middle < _DARK:
            yield "have more light", f"brightness {middle:.0f} of 255"
        elif middle > _BRIGHT or white > _CLIPPED:
            yield "expose less, or avoid windows and sky", f"brightness {middle:.0f} of 255, {100 * white:.0f} % white"
        if high > _UNEVEN * max(low, 1.0):
            yield "lock the exposure, or avoid backlight", f"brightness goes from {low:.0f} to {high:.0f}"
    if session.has_poses:
        yield from _advice_on_motion(look)
    else:
        yield "record with an app that logs poses", "images alone have no scale, no vertical and no check"


def _advice_on_motion(look: Look) -> Iterator[tuple[str, str]]:
    blur, turning, speed = (
        np.percentile(known, 90) if len(known := values[np.isfinite(values)]) else 0.0
        for values in (look.blur_px(look.exposures_s), look.turning_deg_s, look.speed_m_s)
    )
    if blur > _BLURRED_PX:
        why = f"in a tenth of images what is far away blurs by {blur:.0f} px or more"
        yield "turn more slowly, or have more light", why
    elif turning > _FAST_DEG_S:
        yield "turn more slowly", f"a tenth of images turn at {turning:.0f}° a second or more"
    if speed > _FAST_M_S:
        yield "walk more slowly", f"a tenth of images move at {speed:.1f} m/s or more"
    if not look.has_up and look.session.has_vio:
        yield "use an app whose world is upright", "gravity is unknown, by the lines below"
    if len(look.poses) > 2 and _revisited(look) == 0:
        yield "come back to where you were, with the same view", "no image sees what an earlier one did: no loop"
    steps = np.degrees(rotation_angle(np.swapaxes(look.poses[:-1, :3, :3], 1, 2) @ look.poses[1:, :3, :3]))
    if len(steps) and np.percentile(steps, 95) > _SAME_VIEW_DEG:
        yield "take images more often where you turn", f"neighbours look up to {np.percentile(steps, 95):.0f}° apart"
