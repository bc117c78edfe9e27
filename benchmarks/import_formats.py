"""What each capture format's reader was held against, with the figures: `python -m benchmarks.import_formats`.

Each format is written from a simulated walk and read back; each is damaged many times; poses and images of formats with
both are put into every usual wrong convention. `--captures` and `--trajectories` add real recordings.
"""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

import benchmarks.import_captures  # noqa: F401  (puts the tests' writers on the path)
from artefacts.cli import new_app
from artefacts.progress import track
from capture_import.capture import Intrinsics, Limits
from capture_import.convention import CONVENTIONS, check_convention
from capture_import.discovery import Found, find_recordings
from capture_import.formats import formats
from capture_import.intake import Intake, Session, scan_all, take_in
from capture_import.settings import ImportSettings
from geometry.poses import relative, rotation_angle

# isort: split
from capture_mutations import mutate
from capture_writers import WRITERS, make_walk
from test_import_mutations import no_longer_than, take_all

POSES = 24
app = new_app(__doc__ or "")


def read_back(name: str, folder: Path) -> tuple[Intake, float, float]:
    """Write a walk and read it: what came of it, and the largest errors in metres and radians."""
    walk = make_walk(POSES)
    WRITERS[name].write(folder / "place" / "walk", walk)
    (found,) = find_recordings(folder / "place", folder / "unpacked", Limits())
    assert found.format.name == name
    roots = [(folder / "place").resolve(), (folder / "unpacked").resolve()]
    intake = take_in(found.read(Limits()), ImportSettings(), scan_all(roots, Limits()))
    (session,) = intake.sessions
    kept = np.arange(POSES) if len(session.frames) == POSES else np.flatnonzero(walk.has_image)
    off = relative(walk.vio_T_cam[kept], session.poses)
    return intake, float(np.linalg.norm(off[:, :3, 3], axis=1).max()), float(rotation_angle(off[:, :3, :3]).max())


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


def mistakes_found(session: Session, roots: list[Path]) -> tuple[float, float, int, int]:
    """Share of matches that fit as declared and in the next best convention; mistakes found, of how many."""
    right = check_convention(session, roots, Limits())
    found = 0
    for _, change in track(CONVENTIONS[1:], "putting in mistakes"):
        images = []
        for image in session.images:
            camera, pose = image.frame.intrinsics, image.frame.vio_T_cam
            assert camera is not None and pose is not None
            pose, k = change((pose, np.array([camera.fx, camera.fy, camera.cx, camera.cy])))
            frame = replace(image.frame, vio_T_cam=pose, intrinsics=Intrinsics.of(k.tolist()))
            images.append(replace(image, frame=frame))
        found += check_convention(replace(session, images=images), roots, Limits()).contradicted is not None
    return right.declared, right.other_share, found, len(CONVENTIONS) - 1


def take_real(found: Found, root: Path) -> Intake:
    return take_in(found.read(Limits()), ImportSettings(), scan_all([root.resolve()], Limits()))


@app.command()
def main(
    damage: Annotated[int, typer.Option(help="How often each format's walk is damaged.")] = 100,
    captures: Annotated[Path | None, typer.Option(help="Real captures with images, a folder each.")] = None,
    trajectories: Annotated[Path | None, typer.Option(help="A folder of real poses-only recordings.")] = None,
) -> None:
    """Print the tables as Markdown."""
    print("| format | poses | images | rejects | off by at most | damaged: imported | refused with an error |")
    print("|---|---|---|---|---|---|---|")
    for format in formats():
        with tempfile.TemporaryDirectory() as folder:
            intake, metres, radians = read_back(format.name, Path(folder) / "back")
            imported, refused = damaged(format.name, damage, Path(folder) / "damaged")
        (session,) = intake.sessions
        print(
            f"| {format.name} | {len(session.frames)} | {len(session.images)} | {len(intake.rejects)} "
            f"| {metres:.0e} m, {radians:.0e} rad | {imported} | {refused} |",
            flush=True,
        )
    if captures is not None:
        print("\n| real capture | poses | images | rejects | jumps | fits as declared | next best | mistakes found |")
        print("|---|---|---|---|---|---|---|---|")
        for found in find_recordings(captures, Path("/nonexistent"), Limits()):
            intake = take_real(found, captures)
            session = max(intake.sessions, key=lambda s: len(s.images))
            declared, other, wrong, of = mistakes_found(session, [captures.resolve()])
            jumps = sum(len(s.jumps) for s in intake.sessions)
            print(
                f"| {found.session_id} | {len(session.frames)} | {len(session.images)} | {len(intake.rejects)} "
                f"| {jumps} | {declared:.0%} | {other:.0%} | {wrong} of {of} |",
                flush=True,
            )
    if trajectories is not None:
        print("\n| real recording | format | poses | rate, Hz | path, m | rejects | jumps |")
        print("|---|---|---|---|---|---|---|")
        for found in find_recordings(trajectories, Path("/nonexistent"), Limits()):
            intake = take_real(found, trajectories)
            t_s = np.concatenate([s.t_ns for s in intake.sessions]) * 1e-9
            path = sum(float(np.linalg.norm(np.diff(s.poses[:, :3, 3], axis=0), axis=1).sum()) for s in intake.sessions)
            jumps = ", ".join(f"{j.jump_m:.1f} m" for s in intake.sessions for j, _ in s.jumps) or "none"
            print(
                f"| {found.session_id} | {found.format.name} | {len(t_s)} | {(len(t_s) - 1) / np.ptp(t_s):.0f} "
                f"| {path:.0f} | {len(intake.rejects)} | {jumps} |"
            )


if __name__ == "__main__":
    app()
