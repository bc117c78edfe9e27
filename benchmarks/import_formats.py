"""How clearly import's checks tell usual mistakes apart: `python -m benchmarks.import_formats`.

Each format is written from a walk along textured walls; its poses are put into every usual wrong convention, and its
images are taken late. `--captures` does the same with real captures, and blurs their images; `--trajectories` lists
what is found in recordings of poses alone.
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from benchmarks.import_scene import rendered_walk
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, Session
from groundwalk.capture_import.checks.clock import check_clock
from groundwalk.capture_import.checks.convention import CONVENTIONS, Change, check_convention
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.formats import FORMATS
from groundwalk.capture_import.media.images import decode_gray, sharpness
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.store.cli import new_app
from groundwalk.store.progress import track
from tests.capture_import.capture_writers import WRITERS, Walk, reader_of, rejects_of, sessions_in

SEEN = 50
LATE_S = 0.1
# Smears in pixels of a 1920 px image.
SMEARS_PX = (1, 5, 15, 31)
app = new_app(__doc__ or "")


def with_mistake(session: Session, change: Change) -> Session:
    """The session with its images' poses and intrinsics changed."""
    images = []
    for image in session.images:
        camera, pose = image.camera, image.frame.vio_T_cam
        assert pose is not None
        pose, k = change((pose, np.array([camera.fx, camera.fy, camera.cx, camera.cy])))
        intrinsics = replace(Intrinsics.of(k.tolist()), distortion=camera.distortion)
        images.append(replace(image, frame=replace(image.frame, vio_T_cam=pose, intrinsics=intrinsics)))
    return replace(session, images=images)


def convention(session: Session, reader: ImageReader) -> str:
    """Share of matches that fit as declared and in the next best convention; mistakes found, of how many."""
    right = check_convention(session, reader)
    mistakes = track(CONVENTIONS[1:], "putting in mistakes")
    wrong = [check_convention(with_mistake(session, change), reader) for _, change in mistakes]
    count = sum(check.contradicted is not None for check in wrong)
    return f"{right.declared:.0%} | {right.other_explained:.0%} | {count} of {len(wrong)}"


def clock(name: str, late: Walk, folder: Path) -> str:
    """The offset that is found where images are LATE_S late."""
    WRITERS[name].write(folder / "walk", late)
    check = check_clock(sessions_in(folder)[0], reader_of(folder))
    return f"{check.correlation:.2f}: none" if check.offset_s is None else f"{check.offset_s:+.3f} s"


def smeared(session: Session, length_px: int) -> float:
    """Median sharpness of some of a session's images, smeared sideways by pixels of a 1920 px image."""
    values = []
    some = [image.frame.image for image in session.images[:: max(1, len(session.images) // 12)]]
    for path in [image.path for image in some if isinstance(image, ImageFile)]:
        gray = np.asarray(decode_gray(path.read_bytes(), 1920), np.uint8)
        values.append(sharpness(np.asarray(cv2.blur(gray, (length_px, 1)), np.uint8)))
    return float(np.median(values))


@app.command()
def main(
    captures: Annotated[Path | None, typer.Option(help="Real captures with images, a folder each.")] = None,
    trajectories: Annotated[Path | None, typer.Option(help="A folder of real poses-only recordings.")] = None,
    only: Annotated[list[str] | None, typer.Option("--format", help="These formats alone.")] = None,
) -> None:
    """Print the tables as Markdown."""
    print(f"| format | fits as declared | next best | mistakes found | images {LATE_S:g} s late |")
    print("|---|---|---|---|---|")
    walk, late = rendered_walk(SEEN), rendered_walk(SEEN, LATE_S)
    for name in only or [format.id for format in FORMATS.values() if WRITERS[format.id].images]:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            WRITERS[name].write(folder / "seen" / "walk", walk)
            fits = convention(sessions_in(folder / "seen")[0], reader_of(folder / "seen"))
            offset = clock(name, late, folder / "late") if WRITERS[name].clock else "has no times"
        print(f"| {name} | {fits} | {offset} |", flush=True)
    if captures is not None:
        _print_captures(captures)
    if trajectories is not None:
        _print_trajectories(trajectories)


def _print_captures(captures: Path) -> None:
    smears = " | ".join(f"sharpness, smeared by {px} px" for px in SMEARS_PX)
    print(f"\n| real capture | poses | images | rejects | fits as declared | next best | mistakes found | {smears} |")
    print("|---|---|---|---|---|---|---|" + "---|" * len(SMEARS_PX))
    reader = reader_of(captures)
    for source in find_recordings(captures, Path("/nonexistent"), Limits()):
        sessions = sound_sessions(source.read(Limits()), reader.check, 0.5)
        session = max(sessions, key=lambda s: len(s.images))
        blurs = " | ".join(f"{smeared(session, px):.2f}" for px in SMEARS_PX)
        print(
            f"| {source.recording_id} | {len(session.frames)} | {len(session.images)} | {len(rejects_of(sessions))} "
            f"| {convention(session, reader)} | {blurs} |",
            flush=True,
        )


def _print_trajectories(trajectories: Path) -> None:
    print("\n| real recording | format | poses | rate, Hz | path, m | rejects | jumps |")
    print("|---|---|---|---|---|---|---|")
    for source in find_recordings(trajectories, Path("/nonexistent"), Limits()):
        sessions = sound_sessions(source.read(Limits()), lambda frames: [], 0.5)
        t_s = np.concatenate([s.t_ns for s in sessions]) * 1e-9
        path = sum(float(np.linalg.norm(np.diff(s.poses[:, :3, 3], axis=0), axis=1).sum()) for s in sessions)
        jumps = ", ".join(f"{j.jump_m:.1f} m" for s in sessions for j in s.jumps) or "none"
        print(
            f"| {source.recording_id} | {source.format.id} | {len(t_s)} | {(len(t_s) - 1) / np.ptp(t_s):.0f} "
            f"| {path:.0f} | {len(rejects_of(sessions))} | {jumps} |"
        )


if __name__ == "__main__":
    app()
