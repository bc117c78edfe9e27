"""The import stage: any phone capture to frames, poses, rejects and splits."""

import dataclasses
import json
import shlex
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, cast

import pandas as pd

from groundwalk.capture_import.capture import RawFrame, Reject
from groundwalk.capture_import.checks.clock import MAX_OFFSET_S, ClockCheck, check_clock
from groundwalk.capture_import.checks.convention import MIN_EXPLAINED, ConventionCheck, check_convention
from groundwalk.capture_import.checks.gravity import STATE_GRAVITY, check_gravity, with_gravity
from groundwalk.capture_import.checks.near_copies import MAX_FRACTION, find_near_copies
from groundwalk.capture_import.checks.plausibility import MAX_SPEED_M_S, plausibility_faults
from groundwalk.capture_import.checks.scan import ImageScan, LoadGray, load_gray
from groundwalk.capture_import.checks.views import Views
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.intake import ImportedSession, Intake, Scan, measures, take_in
from groundwalk.capture_import.media.blurring import CascadeDetector, Detector
from groundwalk.capture_import.media.depth import place_depths
from groundwalk.capture_import.media.images import ImageCheck
from groundwalk.capture_import.media.placing import Placement, place_images
from groundwalk.capture_import.media.spool import Spool
from groundwalk.capture_import.media.upright import first_row, quarters_to_upright, turned
from groundwalk.capture_import.origin import describe_origin, far_origin, moved
from groundwalk.capture_import.recording import blueprint, log_session
from groundwalk.capture_import.selection import Selection, select_enough
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.capture_import.splits import LEAK_S, SplitResult, nearest_split, refuse_lists, split_frames
from groundwalk.capture_import.tables import (
    frames_table,
    jumps_table,
    printable,
    reference_table,
    rejects_table,
    sessions_table,
    vio_table,
)
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import ImageSide
from groundwalk.store.files import write_json
from groundwalk.store.hints import groundwalk_command, setting_of
from groundwalk.store.simulated import appearances_of, are_simulated
from groundwalk.store.tables import dataset_frames, have_times
from groundwalk.store.text import grouped_reasons, name_list


def run(r: StageRun[ImportSettings]) -> None:
    """Import the scene's captures."""
    root = r.captures.resolve()
    detect = CascadeDetector() if r.settings.blur else None
    with r.step("images"):
        unpacked = r.scratch / "unpacked"
        unpacked.mkdir(exist_ok=True)
        sources = find_recordings(root, unpacked, r.settings.limits, r.settings.format)
        refuse_lists(r.scene.split, [source.session_id for source in sources])
        r.simulated |= are_simulated(path for path in unpacked.rglob("*") if path.is_file())
        roots = [root, unpacked.resolve()]
    intakes, fits = [], []
    for source in sources:
        views = Views(roots, r.settings.limits)
        with r.step("images"):
            intake = _take_in(r, source, views)
        with r.step("gravity"):
            intakes.append(_with_gravity(r, intake, views))
        if r.settings.check_convention:
            with r.step("poses against images"):
                fits.append(_check_poses(r, intakes[-1], views))
    sessions = [session for intake in intakes for session in intake.sessions]
    rejects = [reject for intake in intakes for reject in intake.rejects]
    _refuse_same_ids(sessions, root)
    _refuse_empty(sessions, rejects, root)
    _report_fits(r, fits)
    origin = far_origin(sessions)
    if origin is not None:
        r.say(describe_origin(origin))
        sessions = [moved(session, origin) for session in sessions]

    to_upright = {s.session_id: quarters_to_upright(s) for s in sessions}
    quarters = to_upright if r.settings.upright else dict.fromkeys(to_upright, 0)
    sessions = [turned(s, quarters[s.session_id]) for s in sessions]
    with r.step("tables"):
        frames, bad = _all_frames(r, sessions, {i: (quarters[i], to_upright[i]) for i in quarters}, detect)
        rejects += bad
        dataset = dataset_frames(frames)
        split = split_frames(dataset, r.scene.split, r.settings.split_by == "time")
        frames["split"] = nearest_split(frames, dataset.assign(split=split.of_frame))
        frames = frames[frames["split"] != "unused"].reset_index(drop=True)
        with_frames = dict(iter(frames.groupby("session_id")))
        by_session = {s.session_id: with_frames.get(s.session_id, frames.iloc[:0]) for s in sessions}
        table = sessions_table(
            sessions, by_session, appearances_of(root), origin, reference_is_metric=r.settings.reference_is_metric
        )
        _write(r, sessions, frames, table, by_session, rejects)
    _report(r, sessions, frames, table, rejects, split)
    _report_same_images(r, frames)
    with r.step("near copies"):
        _report_near_copies(r, sessions, frames, lambda views, size: load_gray(views, size, roots, r.settings.limits))
    if detect is not None:
        _report_blurred(r, frames)

    rejects_of: dict[str, list[Reject]] = defaultdict(list)
    for reject in rejects:
        rejects_of[reject.session_id].append(reject)
    with r.step("recording"), r.recording(blueprint([s.session_id for s in sessions])) as stream:
        for session in r.track(sessions, "writing the recording"):
            rejected = rejects_of[session.session_id]
            spooled = _spooled(r, session.recording.session_id)
            log_session(stream, session, by_session[session.session_id], rejected, _image_path(r.work, root), spooled)


def _all_frames(
    r: StageRun[ImportSettings],
    sessions: list[ImportedSession],
    quarters: dict[str, tuple[int, int]],
    detect: CascadeDetector | None,
) -> tuple[pd.DataFrame, list[Reject]]:
    """The rows of `frames` of all sessions, their images in place, and what was rejected of them. quarters: by session,
    by how many an image was turned, and by how many it would have to be."""
    used, denser = select_enough(sessions, r.settings)
    if denser is not None:
        r.say(denser)
    parts, rejects = [], []
    for session in sessions:
        selection = used[session.session_id]
        if selection.images:
            placed, bad = _placed_frames(r, session, selection, quarters[session.session_id], detect)
            parts.append(placed)
            rejects += bad
    return pd.concat(parts, ignore_index=True), rejects


def _write(
    r: StageRun[ImportSettings],
    sessions: list[ImportedSession],
    frames: pd.DataFrame,
    table: pd.DataFrame,
    by_session: dict[str, pd.DataFrame],
    rejects: list[Reject],
) -> None:
    """Write the stage's tables; `table` is that of sessions."""
    r.write("frames", frames.drop(columns=["recording", "stated_split", "content_sha256"]))
    r.write("sessions", table)
    r.write("rejects", rejects_table(rejects))
    r.write("jumps", jumps_table(sessions))
    reference = [reference_table(s, by_session[s.session_id]) for s in sessions]
    r.write("reference", pd.concat(reference, ignore_index=True))
    r.write("vio", pd.concat([vio_table(s) for s in sessions], ignore_index=True))


def _placed_frames(
    r: StageRun[ImportSettings],
    session: ImportedSession,
    selection: Selection,
    turns: tuple[int, int],
    detect: Detector | None,
) -> tuple[pd.DataFrame, list[Reject]]:
    """Place a session's selected images and their depth: rows of the frames table, and depth images that can't be used.

    `turns` are the quarter turns that images are turned by, and those that would put gravity down.
    """
    quarters, to_upright = turns
    where = Placement(
        root=r.captures.resolve(),
        work=r.work,
        spooled=_spooled(r, session.recording.session_id),
        how=r.settings.images,
        quarters=quarters,
        to_upright=to_upright,
        limits=r.settings.limits,
        detect=detect,
    )
    places = place_images(selection.images, session.session_id, where)
    depths, rejects = place_depths(selection.images, session.session_id, where)
    stated = session.recording.first_row if r.settings.first_row == "auto" else r.settings.first_row

    def first_row_of(width: int, height: int) -> ImageSide:
        return first_row(width, height, stated, quarters)

    return frames_table(session, selection, places, depths, first_row_of), rejects


def _image_path(work: Path, root: Path) -> Callable[[str], Path]:
    """Where the image of a `frames.image` entry is while the artefact isn't finished."""
    return lambda entry: work / entry.removeprefix("import:") if entry.startswith("import:") else root / entry


def _take_in(r: StageRun[ImportSettings], source: RecordingSource, views: Views) -> Intake:
    raw = source.read(r.settings.limits)
    for note in raw.notes:
        r.say(f"{raw.session_id}: {note}")

    def scan(frames: list[RawFrame]) -> Iterator[ImageCheck | str]:
        if r.settings.blur or r.settings.upright:  # images that change later aren't written ahead
            yield from measures(views.scan(frames))
            return
        spool = Spool(_spooled(r, raw.session_id), frames, r.settings)
        for place, result in enumerate(views.scan(frames, spool.in_colour)):
            if isinstance(result, ImageScan):
                spool.add(place, result)
                yield result.check
            else:
                yield result
        spool.flush()

    intake = take_in(raw, r.settings, _cached(r, source.session_id, scan))
    for fault in plausibility_faults(intake):
        if fault.is_unusable:
            raise UserError(
                f"the motion of {raw.session_id} isn't plausible",
                where=raw.folder,
                found=fault.text,
                expected=f"poses that change, by at most {MAX_SPEED_M_S:g} m/s",
                do=fault.remedy,
            )
        r.say(f"warning: {raw.session_id}: {fault.text}")
    return intake


def _with_gravity(r: StageRun[ImportSettings], intake: Intake, views: Views) -> Intake:
    """The intake with what a test of its recording's gravity finds."""
    check, recording = check_gravity(intake, views.load), intake.sessions[0].recording
    if check.line:
        line = f"{recording.session_id}: gravity {check.line}"
        r.say(line if check.is_aligned else f"warning: {line}; {STATE_GRAVITY}")
    return with_gravity(intake, check)


def _spooled(r: StageRun[ImportSettings], recording: str) -> Path:
    return r.scratch / "spooled" / recording


def _cached(r: StageRun[ImportSettings], session_id: str, scan: Scan) -> Scan:
    """`scan`, with a finished recording's result stored in scratch: a killed run resumes from there."""
    path = r.scratch / f"{session_id}.json"

    def cached(frames: list[RawFrame]) -> Iterable[ImageCheck | str]:
        if path.is_file():
            return [e if isinstance(e, str) else ImageCheck(**e) for e in json.loads(path.read_text())]
        results = list(r.track(scan(frames), f"{session_id}: checking images", len(frames)))
        write_json(path, [e if isinstance(e, str) else dataclasses.asdict(e) for e in results])
        return results

    return cached


def _check_poses(r: StageRun[ImportSettings], intake: Intake, views: Views) -> tuple[ConventionCheck, ClockCheck]:
    """Compare a recording's longest session with its images: poses, intrinsics and clock.

    UserError where another convention fits; an offset of the clock is a warning.
    """
    session = max(intake.sessions, key=lambda s: len(s.images))
    check = check_convention(session, views.load)
    if check.contradicted:
        raise UserError(
            "the poses don't fit the images as their format declares them",
            where=session.recording.folder,
            expected=f"most matched points to fit ({check.declared:.0%} do in {check.pairs} pairs of images)",
            found=f"{check.other_explained:.0%} fit where {check.contradicted}",
            do="check which app and version wrote the capture; or skip this check: "
            f"{setting_of('import', 'check_convention = false')}",
        )
    if check.pairs and check.declared < MIN_EXPLAINED:
        r.say(
            f"warning: {session.session_id}: only {check.declared:.0%} of matched points fit the poses, and no other "
            "convention fits better"
        )
    clock = check_clock(session, views.load)
    if clock.offset_s is not None and abs(clock.offset_s) > MAX_OFFSET_S:
        r.say(
            f"warning: {session.session_id}: images fit the poses {clock.offset_s:+.3f} s from their stated "
            f"times (correlation {clock.correlation:.2f})"
        )
    return check, clock


def _report_fits(r: StageRun[ImportSettings], fits: Sequence[tuple[ConventionCheck, ClockCheck]]) -> None:
    declared = [check.declared for check, _ in fits if check.pairs]
    offsets = [clock.offset_s for _, clock in fits if clock.offset_s is not None]
    r.figure("convention_fit_lowest", min(declared, default=None))
    r.figure("clock_offset_s", max(offsets, key=abs, default=None))


def _refuse_same_ids(sessions: Sequence[ImportedSession], root: Path) -> None:
    ids = [session.session_id for session in sessions]
    if same := sorted(i for i, count in Counter(ids).items() if count > 1):
        raise UserError("two recordings have the same name", where=root, found=same[0], do="rename one of them")


def _refuse_empty(sessions: Sequence[ImportedSession], rejects: Sequence[Reject], root: Path) -> None:
    if any(s.images for s in sessions):
        return
    poses = sum(len(s.frames) for s in sessions)
    reasons = ", ".join(f"{n} x {printable(reason)}" for reason, n in _most_common(rejects)) or "no images at all"
    raise UserError(
        "the capture holds no usable image",
        where=root,
        found=f"{poses} sound poses; {reasons}",
        expected="images with intrinsics and poses",
        do=f"{groundwalk_command()} inspect {shlex.quote(str(root))}",
    )


def _most_common(rejects: Sequence[Reject]) -> list[tuple[str, int]]:
    return Counter(grouped_reasons([reject.reason for reject in rejects])).most_common(3)


def _report(
    r: StageRun[ImportSettings],
    sessions: Sequence[ImportedSession],
    frames: pd.DataFrame,
    table: pd.DataFrame,
    rejects: Sequence[Reject],
    split: SplitResult,
) -> None:
    images = sum(len(s.images) for s in sessions)
    for row in cast(Iterable[Any], table.itertuples()):
        walked = [f"{row.path_m:.1f} m"] if pd.notna(row.path_m) else []
        walked += [f"{row.duration_s:.0f} s"] if pd.notna(row.duration_s) else ["no times"]
        r.say(
            f"{row.session_id}: {row.poses} poses, {row.images} images, {row.frames} frames and {row.support_frames} "
            f"support frames selected, {' in '.join(walked)} ({row.split})"
        )
    if rejects:
        reasons = "; ".join(f"{n} x {printable(reason)}" for reason, n in _most_common(rejects))
        r.say(f"{len(rejects)} rows rejected: {reasons} (all in rejects.parquet)")
    cuts = sum(splits for s in sessions for _, splits in s.jumps)
    jumps = sum(len(s.jumps) for s in sessions)
    if jumps:
        r.say(f"VIO jumps: {jumps}, of which {cuts} split a session")
    if split.leak_s is not None and split.leak_s < LEAK_S:
        r.say(
            f"warning: test frames are {split.leak_s:.1f} s from training frames of the same walk (5 s or more are "
            "needed): accuracy on this split says nothing about new walks"
        )
    dataset = dataset_frames(frames)
    _warn_of_small_side(r, dataset)
    counts = dataset["split"].value_counts()
    figures: dict[str, float | int | str | None] = {
        "recordings": table["recording"].nunique(),
        "sessions": len(sessions),
        "poses": int(table["poses"].sum()),
        "images": images,
        "frames": len(dataset),
        "support_frames": len(frames) - len(dataset),
        **{f"frames_{name}": int(counts.get(name, 0)) for name in ("train", "val", "test")},
        "not_sampled": images - len(frames),
        "rejects": len(rejects),
        "jumps": jumps,
        "jumps_that_split": int(cuts),
        "path_m": float(table["path_m"].sum()) if table["path_m"].notna().any() else None,
        "frames_with_depth": int(frames["depth"].notna().sum()),
        "split": split.how,
        "leak_s": split.leak_s,
    }
    for name, value in figures.items():
        r.figure(name, value)


def _warn_of_small_side(r: StageRun[ImportSettings], dataset: pd.DataFrame) -> None:
    counts = dataset["split"].value_counts()
    trained, tested = counts.get("train", 0), counts.get("test", 0)
    if trained < tested:
        of_recordings: Any = dataset.groupby(["recording", "split"], sort=False).size().items()
        listed = name_list([f"{count} of {recording} {split}" for (recording, split), count in of_recordings], 8)
        r.say(
            f"warning: {trained} frames train and {tested} test: {listed}; {setting_of('split', 'test')} lists "
            "other recordings to test on, and test_fraction there says how much of a single one"
        )


def _report_same_images(r: StageRun[ImportSettings], frames: pd.DataFrame) -> None:
    of_train, test = frames[frames["split"] != "test"], frames[frames["split"] == "test"]
    trained = of_train.drop_duplicates("content_sha256").set_index("content_sha256")["frame_id"]
    same = test[test["content_sha256"].isin(trained.index)]
    r.figure("test_images_also_in_train", len(same))
    if len(same):
        first = same.iloc[0]
        r.say(
            f"warning: {len(same)} of {len(test)} test images are also training images, byte for byte but for "
            f"metadata (the first: {first.frame_id} is {trained[first.content_sha256]}): accuracy on this split means "
            "nothing"
        )


def _report_near_copies(
    r: StageRun[ImportSettings], sessions: Sequence[ImportedSession], frames: pd.DataFrame, load: LoadGray
) -> None:
    """Warn where test images without times show what training images show."""
    timeless = dataset_frames(frames[~have_times(frames)])
    frame_of = {f"{s.session_id}/{i.frame.number:06d}": i.frame for s in sessions for i in s.images}
    test, train = (list(timeless.loc[timeless["split"] == side, "frame_id"]) for side in ("test", "train"))
    if not test or not train:
        return
    copies = find_near_copies([frame_of[i] for i in test], [frame_of[i] for i in train], load)
    r.figure("test_images_near_train", len(copies.pairs) / copies.looked_at)
    if len(copies.pairs) > MAX_FRACTION * copies.looked_at:
        i, j = copies.pairs[0]
        r.say(
            f"warning: {len(copies.pairs)} of {copies.looked_at} test images show nearly what a training image shows "
            f"(as {test[i]} and {train[j]}): accuracy on this split says little about new walks. Names don't say "
            "which images were taken together: name those for testing, or put each walk into a folder of its own "
            "(docs/how-to/split.md)"
        )


def _report_blurred(r: StageRun[ImportSettings], frames: pd.DataFrame) -> None:
    faces, plates = int(frames["blurred_faces"].sum()), int(frames["blurred_plates"].sum())
    images = int((frames["blurred_faces"] + frames["blurred_plates"] > 0).sum())
    r.say(
        f"blurred {faces} faces and {plates} plates in {images} of {len(frames)} images; detectors miss some: look "
        "before you publish"
    )
    r.figure("blurred_images", images)
    r.figure("blurred_faces", faces)
    r.figure("blurred_plates", plates)
