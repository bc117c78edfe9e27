"""What each capture format's reader was held against, with the figures: `python -m benchmarks.import_formats`.

Each format is written from a simulated walk and read back; with broken rows, a jump, images in front of textured walls
whose poses are put into every usual wrong convention, and images that are late; and each is damaged many times.
`--captures` and `--trajectories` add real recordings.
"""

import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
import typer

from benchmarks.import_scene import rendered_walk
from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits
from groundwalk.capture_import.checks.clock import check_clock
from groundwalk.capture_import.checks.convention import (
    CONVENTIONS,
    MatchedPair,
    best_convention,
    check_convention,
    matched_pairs,
)
from groundwalk.capture_import.checks.scan import scan_images
from groundwalk.capture_import.checks.views import Views
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.formats import FORMATS
from groundwalk.capture_import.intake import ImportedSession, Intake, measures, take_in
from groundwalk.capture_import.media.images import decode_gray, sharpness
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.geometry.poses import relative, rotation_angle
from groundwalk.store.cli import new_app
from groundwalk.store.progress import track

# isort: split
from tests.capture_import.capture_mutations import mutate
from tests.capture_import.capture_writers import WRITERS, Walk, make_walk
from tests.capture_import.test_mutations import no_longer_than, take_all

POSES = 24
SEEN = 50
JUMP_M = 3.0
LATE_S = 0.1
# Smears in pixels of a 1920 px image.
SMEARS_PX = (5, 15, 31)
app = new_app(__doc__ or "")


def take(name: str, walk: Walk, folder: Path) -> tuple[Intake, Views]:
    """Write a walk in a format and take it in."""
    WRITERS[name].write(folder / "place" / "walk", walk)
    return take_written(name, folder)


def take_written(name: str, folder: Path) -> tuple[Intake, Views]:
    (source,) = find_recordings(folder / "place", folder / "unpacked", Limits())
    assert source.format.id == name
    views = Views([(folder / "place").resolve(), (folder / "unpacked").resolve()], Limits())
    return take_in(source.read(Limits()), ImportSettings(), lambda frames: measures(views.scan(frames))), views


def read_back(name: str, folder: Path) -> str:
    """The largest errors of the poses of a walk that is written and read."""
    walk = make_walk(POSES)
    intake, _ = take(name, walk, folder)
    (session,) = intake.sessions
    assert not intake.rejects
    kept = np.arange(POSES) if len(session.frames) == POSES else np.flatnonzero(walk.has_image)
    off = relative(walk.vio_T_cam[kept], session.poses)
    metres, radians = np.linalg.norm(off[:, :3, 3], axis=1).max(), rotation_angle(off[:, :3, :3]).max()
    return f"{metres:.0e} m, {radians:.0e} rad"


def broken_rows(name: str, folder: Path) -> str:
    """How many of the rows that are broken on purpose are told in `rejects`: a pose on the moon, a time that comes
    twice (where times aren't the files' names), an image that is cut short (where images are files)."""
    walk = make_walk(POSES)
    walk.vio_T_cam[6, 0, 3] = 4e8
    expected = ["farther than 100 km"]
    if WRITERS[name].clock and name not in ("polycam", "arkit_scenes"):
        # NeRFCapture logs poses with images alone: every second one.
        walk.t_ns[10] = walk.t_ns[8 if name == "nerf_capture" else 9]
        expected.append("time is a duplicate")
    WRITERS[name].write(folder / "place" / "walk", walk)
    images = sorted(p for p in (folder / "place").rglob("*") if p.suffix in (".jpg", ".png"))
    if images:
        cut = images[len(images) // 2]
        cut.write_bytes(cut.read_bytes()[:600])
        expected.append("broken")
    intake, _ = take_written(name, folder)
    rejected = sum(any(reason in reject.reason for reject in intake.rejects) for reason in expected)
    assert len(intake.rejects) == rejected, [reject.reason for reject in intake.rejects]
    return f"{rejected} of {len(expected)}"


def jump(name: str, folder: Path) -> str:
    """How large a jump is found where the odometry jumps by JUMP_M."""
    walk = make_walk(2 * POSES, every=1)
    walk.vio_T_cam[POSES:, 0, 3] += JUMP_M
    intake, _ = take(name, walk, folder)
    if intake.sessions[0].recording.pose_source == "reference":
        return "no VIO"
    return ", ".join(f"{j.jump_m:.2f} m" for session in intake.sessions for j, _ in session.jumps) or "none found"


def convention(name: str, walk: Walk, folder: Path) -> str:
    """Share of matches that fit as declared and in the next best convention; mistakes found, of how many."""
    intake, views = take(name, walk, folder)
    pairs = matched_pairs(intake.sessions[0], views.load)
    right = best_convention(pairs)
    wrong = [best_convention([_mistaken(pair, change) for pair in pairs]) for _, change in CONVENTIONS[1:]]
    count = sum(check.contradicted is not None for check in wrong)
    return f"{right.declared:.0%} | {right.other_explained:.0%} | {count} of {len(wrong)}"


def _mistaken(pair: MatchedPair, change: object) -> MatchedPair:
    a, b = pair.cameras
    return replace(pair, cameras=(change(a), change(b)))  # type: ignore[operator]


def clock(name: str, late: Walk, folder: Path) -> str:
    """The offset that is found where images are LATE_S late."""
    if not WRITERS[name].clock:
        return "has no times"
    intake, views = take(name, late, folder)
    check = check_clock(intake.sessions[0], views.load)
    return f"{check.correlation:.2f}: none" if check.offset_s is None else f"{check.offset_s:+.3f} s"


def damaged(name: str, count: int, folder: Path) -> tuple[int, int]:
    """Damage a walk so many times: how often it was imported (with rejects), and refused. Anything else raises."""
    WRITERS[name].write(folder / "whole" / "walk", make_walk(8))
    imported = 0
    for case in range(count):
        root = folder / "case" / "place"
        shutil.copytree(folder / "whole", root)
        done = mutate(root, np.random.default_rng([2, case]))
        with no_longer_than(20, (name, case, done)):
            imported += take_all(root, folder / "case" / "unpacked")
        shutil.rmtree(folder / "case")
    return imported, count - imported


def mistakes_detected(session: ImportedSession, roots: list[Path]) -> tuple[float, float, int, int]:
    """As `convention`, for a real session; pairs of images are chosen anew for each mistake."""
    views = Views(roots, Limits())
    right = check_convention(session, views.load)
    count = 0
    for _, change in track(CONVENTIONS[1:], "putting in mistakes"):
        images = []
        for image in session.images:
            camera, pose = image.frame.intrinsics, image.frame.vio_T_cam
            assert camera is not None and pose is not None
            pose, k = change((pose, np.array([camera.fx, camera.fy, camera.cx, camera.cy])))
            mistaken = replace(Intrinsics.of(k.tolist()), distortion=camera.distortion)
            frame = replace(image.frame, vio_T_cam=pose, intrinsics=mistaken)
            images.append(replace(image, frame=frame))
        count += check_convention(replace(session, images=images), views.load).contradicted is not None
    return right.declared, right.other_explained, count, len(CONVENTIONS) - 1


def smeared(session: ImportedSession, length_px: int) -> float:
    """Median sharpness of some of a session's images, smeared sideways by pixels of a 1920 px image."""
    values = []
    some = [image.frame.image for image in session.images[:: max(1, len(session.images) // 12)]]
    for path in [image.path for image in some if isinstance(image, ImageFile)]:
        gray = np.asarray(decode_gray(path.read_bytes(), 1920), np.uint8)
        values.append(sharpness(np.asarray(cv2.blur(gray, (length_px, 1)), np.uint8) if length_px > 1 else gray))
    return float(np.median(values))


def take_real(source: RecordingSource, root: Path) -> Intake:
    limits, roots = Limits(), [root.resolve()]
    return take_in(source.read(limits), ImportSettings(), lambda frames: measures(scan_images(frames, roots, limits)))


@app.command()
def main(
    damage: Annotated[int, typer.Option(help="How often each format's walk is damaged.")] = 100,
    captures: Annotated[Path | None, typer.Option(help="Real captures with images, a folder each.")] = None,
    trajectories: Annotated[Path | None, typer.Option(help="A folder of real poses-only recordings.")] = None,
    only: Annotated[list[str] | None, typer.Option("--format", help="These formats alone.")] = None,
) -> None:
    """Print the tables as Markdown."""
    _print_formats(only or [format.id for format in FORMATS.values()], damage)
    if captures is not None:
        _print_captures(captures)
    if trajectories is not None:
        _print_trajectories(trajectories)


def _print_formats(names: Sequence[str], damage: int) -> None:
    print(
        f"| format | read back to | broken rows told | {JUMP_M:g} m jump | fits as declared | next best "
        f"| mistakes found | images {LATE_S:g} s late | damaged: imported | refused with an error |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    walk, late = rendered_walk(SEEN), rendered_walk(SEEN, LATE_S)
    for name in names:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            cells = [
                read_back(name, folder / "back"),
                broken_rows(name, folder / "broken"),
                jump(name, folder / "jump"),
            ]
            if WRITERS[name].images:
                cells += [convention(name, walk, folder / "seen"), clock(name, late, folder / "late")]
            else:
                cells += ["no images", "", "", ""]
            imported, refused = damaged(name, damage, folder / "damaged")
        print("| " + " | ".join([name, *cells, str(imported), str(refused)]) + " |", flush=True)


def _print_captures(captures: Path) -> None:
    smears = " | ".join(f"smeared by {px} px" for px in SMEARS_PX)
    print(
        "\n| real capture | poses | images | rejects | jumps | fits as declared | next best | mistakes found "
        f"| sharpness | {smears} |"
    )
    print("|---|---|---|---|---|---|---|---|---|" + "---|" * len(SMEARS_PX))
    for source in find_recordings(captures, Path("/nonexistent"), Limits()):
        intake = take_real(source, captures)
        session = max(intake.sessions, key=lambda s: len(s.images))
        declared, other, wrong, of = mistakes_detected(session, [captures.resolve()])
        jumps = sum(len(s.jumps) for s in intake.sessions)
        blurs = " | ".join(f"{smeared(session, px):.2f}" for px in (1, *SMEARS_PX))
        print(
            f"| {source.session_id} | {len(session.frames)} | {len(session.images)} | {len(intake.rejects)} "
            f"| {jumps} | {declared:.0%} | {other:.0%} | {wrong} of {of} | {blurs} |",
            flush=True,
        )


def _print_trajectories(trajectories: Path) -> None:
    print("\n| real recording | format | poses | rate, Hz | path, m | rejects | jumps |")
    print("|---|---|---|---|---|---|---|")
    for source in find_recordings(trajectories, Path("/nonexistent"), Limits()):
        intake = take_real(source, trajectories)
        t_s = np.concatenate([s.t_ns for s in intake.sessions]) * 1e-9
        path = sum(float(np.linalg.norm(np.diff(s.poses[:, :3, 3], axis=0), axis=1).sum()) for s in intake.sessions)
        jumps = ", ".join(f"{j.jump_m:.1f} m" for s in intake.sessions for j, _ in s.jumps) or "none"
        print(
            f"| {source.session_id} | {source.format.id} | {len(t_s)} | {(len(t_s) - 1) / np.ptp(t_s):.0f} "
            f"| {path:.0f} | {len(intake.rejects)} | {jumps} |"
        )


if __name__ == "__main__":
    app()
