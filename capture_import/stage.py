"""The import stage: any phone capture to frames, poses, rejects and splits."""

import dataclasses
import json
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence, Set
from pathlib import Path
from typing import Any, cast

import pandas as pd

from groundwalk.capture_import import tables
from groundwalk.capture_import.capture import GpsFix, ImageCheck, RawFrame, Session
from groundwalk.capture_import.checks.clock import MAX_OFFSET_S, check_clock
from groundwalk.capture_import.checks.convention import MIN_EXPLAINED, check_convention, with_focal_length
from groundwalk.capture_import.checks.features import MAX_FRACTION, find_near_copies
from groundwalk.capture_import.checks.gravity import STATE_GRAVITY, check_gravity, with_gravity
from groundwalk.capture_import.checks.plausibility import MAX_SPEED_M_S, plausibility_faults
from groundwalk.capture_import.discovery import RecordingSource, find_recordings
from groundwalk.capture_import.media.blurring import Blurring, FaceDetector, Region, read_boxes, write_boxes
from groundwalk.capture_import.media.depth import place_depths
from groundwalk.capture_import.media.images import quarters_to_upright
from groundwalk.capture_import.media.placing import Placement, place_images
from groundwalk.capture_import.media.reading import ImageReader
from groundwalk.capture_import.recording import blueprint, log_session
from groundwalk.capture_import.sampling import select_enough
from groundwalk.capture_import.sessions import describe_origin, far_origin, moved, sound_sessions, with_numbered_cameras
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.capture_import.splits import LEAK_S, SplitResult, nearest_split, refuse_lists, split_frames
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import Rejected
from groundwalk.store.errors import MachineError
from groundwalk.store.files import write_json
from groundwalk.store.hints import groundwalk_command, setting_of
from groundwalk.store.images import image_file
from groundwalk.store.manifests import BLURRED
from groundwalk.store.registry import PluginError
from groundwalk.store.simulated import are_simulated
from groundwalk.store.tables import dataset_frames, have_times, table_of
from groundwalk.store.text import grouped_reasons, name_list, printable

_SAME_FRAMES = 0.5  # of a recording's, those that another one has, too: then they are one recording
_VIO = ["t_ns", "vio_cam_tx", "vio_cam_ty", "vio_cam_tz"]


def run(r: StageRun[ImportSettings]) -> None:
    settings, root = r.settings, r.captures.resolve()
    face_model = r.data.root / settings.face_model if settings.face_model else None
    # Before images are read, as one may be missing.
    boxes = read_boxes(r.data.root / settings.blur_boxes) if settings.blur_boxes else {}
    blurring = Blurring(FaceDetector(face_model) if settings.blur else None, boxes)
    unpacked = r.scratch / "unpacked"
    reader = ImageReader([root, unpacked.resolve()], settings.limits)
    with r.step("images"):
        unpacked.mkdir(exist_ok=True)
        sources = find_recordings(root, unpacked, settings.limits, settings.format, r.say)
        refuse_lists(r.scene.split, [source.recording_id for source in sources])
        r.simulated |= are_simulated(path for path in unpacked.rglob("*") if path.is_file())
    of_recording, errors = _read_recordings(r, sources, reader)
    refuse_lists(r.scene.split, [sessions[0].recording.recording_id for sessions in of_recording])
    of_recording = with_numbered_cameras(of_recording)
    sessions = [session for of_one in of_recording for session in of_one]
    _refuse_unusable(sessions, root)

    origin = far_origin(sessions)
    if origin is not None:
        r.say(describe_origin(origin))
        sessions = [moved(session, origin) for session in sessions]

    with r.step("tables"):
        selection_of, denser = select_enough(sessions, settings)
        if denser is not None:
            r.say(denser)
        of_session, regions_of = [], dict[str, tuple[str, list[Region]]]()
        for i, session in enumerate(sessions):
            selection = selection_of[session.session_id]
            if not selection.images:
                continue
            where = Placement(root, r.work, session, settings.images == "copy", reader)
            places = place_images(selection.images, where, blurring, quarters_to_upright(session))
            regions_of |= {
                session.frame_id(image.number): (image.source, place.regions)
                for image, place in zip(selection.images, places, strict=True)
                if place.regions is not None
            }
            depths, rejects = place_depths(selection.images, where)
            sessions[i] = dataclasses.replace(session, rejects=[*session.rejects, *rejects])
            of_session.append(tables.frames_table(session, selection, places, depths, settings.first_row))
        frames = pd.concat(of_session, ignore_index=True)
        dataset = dataset_frames(frames)
        split = split_frames(dataset, r.scene.split, settings.split_by == "time")
        frames["split"] = nearest_split(frames, dataset.assign(split=split.of_frame))
        frames = frames[frames["split"] != "unused"].reset_index(drop=True)
        if r.before is not None:
            frames = held_frames(r, frames, errors)
        frames_of = {s.session_id: frames[frames["session_id"] == s.session_id] for s in sessions}
        session_rows = tables.sessions_table(
            sessions, frames_of, origin, reference_is_metric=settings.reference_is_metric
        )
        sessions = _keep_gps(r, sessions)
        r.write("frames", frames.drop(columns=["recording", "stated_split", "content_sha256"]))
        r.write("sessions", session_rows)
        r.write("rejects", tables.rejects_table(sessions, errors))
        r.write("jumps", tables.jumps_table(sessions))
        references = [tables.reference_table(session, frames_of[session.session_id]) for session in sessions]
        r.write("reference", pd.concat(references, ignore_index=True))
        r.write("vio", pd.concat([tables.vio_table(session) for session in sessions], ignore_index=True))

    _report(r, sessions, frames, session_rows, split)
    with r.step("near copies"):
        _report_near_copies(r, sessions, frames, reader)
    _report_blurring(r, frames, regions_of, boxes.keys())
    with r.step("recording"), r.recording(blueprint([session.session_id for session in sessions])) as stream:
        for session in r.track(sessions, "writing the recording"):
            log_session(stream, session, frames_of[session.session_id], lambda image: image_file(image, root, r.work))


def _read_recordings(
    r: StageRun[ImportSettings], sources: Sequence[RecordingSource], reader: ImageReader
) -> tuple[list[list[Session]], dict[str, UserError]]:
    """The sessions of each recording, and why others are left out, by their ids. UserError where all are."""
    of_recording, errors = list[list[Session]](), dict[str, UserError]()
    fits, offsets = list[float](), list[float]()
    for source in sources:
        try:
            with r.step("images"):
                sessions = _read_sessions(r, source, reader)
            with r.step("gravity"):
                check = check_gravity(sessions, reader)
                if check.line:
                    line = f"{source.recording_id}: gravity {check.line}"
                    r.say(line if check.is_aligned else f"warning: {line}; {STATE_GRAVITY}")
                sessions = with_gravity(sessions, check)
            if r.settings.check_convention:
                with r.step("poses against images"):
                    fit, offset_s = _check_poses(r, sessions, reader)
                fits += [] if fit is None else [fit]
                offsets += [] if offset_s is None else [offset_s]
        except (PluginError, MachineError):
            raise
        except UserError as error:
            errors[source.recording_id] = error
        else:
            of_recording.append(sessions)
    if not of_recording:
        raise next(iter(errors.values()))
    for recording_id, why in errors.items():
        r.say(f"warning: {recording_id} is left out: {why.line}")
    r.figure("recordings_left_out", len(errors))
    r.figure("convention_fit_lowest", min(fits, default=None))
    r.figure("clock_offset_s", max(offsets, key=abs, default=None))
    return of_recording, errors


def _read_sessions(r: StageRun[ImportSettings], source: RecordingSource, reader: ImageReader) -> list[Session]:
    """The sessions of a recording; UserError where nothing can be made of its motion."""
    recording = source.read(r.settings.limits)
    checked = r.scratch / f"{recording.recording_id}.json"

    def check_images(frames: list[RawFrame]) -> Iterable[ImageCheck | str]:
        # Decoding takes longest: a killed run resumes with the recordings that were finished.
        if checked.is_file():
            return [e if isinstance(e, str) else ImageCheck(**e) for e in json.loads(checked.read_text())]
        text = f"{recording.recording_id}: checking images"
        results = list(r.track(reader.check(frames), text, len(frames)))
        write_json(checked, [e if isinstance(e, str) else dataclasses.asdict(e) for e in results])
        return results

    sessions = sound_sessions(recording, check_images, r.settings.min_relative_sharpness)
    for note in sessions[0].recording.notes:
        r.say(f"{recording.recording_id}: {note}")
    sessions, said = with_focal_length(sessions, reader)
    if said:
        r.say(f"{recording.recording_id}: {said}")
    for fault in plausibility_faults(sessions):
        if fault.remedy:
            raise UserError(
                f"the motion of {recording.recording_id} isn't plausible",
                where=recording.folder,
                found=fault.text,
                expected=f"poses that change, by at most {MAX_SPEED_M_S:g} m/s",
                do=fault.remedy,
            )
        r.say(f"warning: {recording.recording_id}: {fault.text}")
    return sessions


def _check_poses(
    r: StageRun[ImportSettings], sessions: Sequence[Session], reader: ImageReader
) -> tuple[float | None, float | None]:
    """Compare a recording's longest session with its images: poses, intrinsics and clock. The share of matched points
    that fit, and the offset of the clock in seconds, of which a large one is a warning; None for what can't be told.

    UserError where another convention fits.
    """
    session = max(sessions, key=lambda session: len(session.images))
    check = check_convention(session, reader)
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
            f"warning: {session.session_id}: only {check.declared:.0%} of matched points fit the poses, and no "
            "other convention fits better"
        )
    clock = check_clock(session, reader)
    if clock.offset_s is not None and abs(clock.offset_s) > MAX_OFFSET_S:
        r.say(
            f"warning: {session.session_id}: images fit the poses {clock.offset_s:+.3f} s from their stated "
            f"times (correlation {clock.correlation:.2f})"
        )
    return (check.declared if check.pairs else None), clock.offset_s


def _keep_gps(r: StageRun[ImportSettings], sessions: Sequence[Session]) -> list[Session]:
    """Write the table of positions on earth, where the user asks for it; the sessions, with rows of such that can't be
    read among the rejects."""
    if not r.settings.gps:
        return list(sessions)
    fixes, kept = dict[str, list[GpsFix]](), list[Session]()
    for session in sessions:
        name, read_gps = session.recording.recording_id, session.recording.read_gps
        if name not in fixes:
            fixes[name], rejects = read_gps() if read_gps is not None else ([], [])
            session = dataclasses.replace(session, rejects=[*session.rejects, *rejects])
        kept.append(session)
    r.write("gps", tables.gps_table(fixes))
    for name, of_one in fixes.items():
        r.say(f"{name}: {len(of_one) or 'no'} positions on earth")
    return kept


def _refuse_unusable(sessions: Sequence[Session], root: Path) -> None:
    ids = Counter(session.session_id for session in sessions)
    if same := sorted(name for name, count in ids.items() if count > 1):
        raise UserError("two recordings have the same name", where=root, found=same[0], do="rename one of them")
    if not any(session.images for session in sessions):
        poses = sum(len(session.frames) for session in sessions)
        raise UserError(
            "the capture holds no usable image",
            where=root,
            found=f"{poses} sound poses; {_reasons(sessions, ', ') or 'no images at all'}",
            expected="images with intrinsics and poses",
            do=f"{groundwalk_command()} inspect {shlex.quote(str(root))}",
        )


def _reasons(sessions: Sequence[Session], separator: str) -> str:
    counts = Counter(grouped_reasons([reject.reason for session in sessions for reject in session.rejects]))
    return separator.join(f"{n} x {printable(reason)}" for reason, n in counts.most_common(3))


def _report(
    r: StageRun[ImportSettings],
    sessions: Sequence[Session],
    frames: pd.DataFrame,
    session_rows: pd.DataFrame,
    split: SplitResult,
) -> None:
    for row in cast(Iterable[Any], session_rows.itertuples()):
        walked = [f"{row.path_m:.1f} m"] if pd.notna(row.path_m) else []
        walked += [f"{row.duration_s:.0f} s"] if pd.notna(row.duration_s) else ["no times"]
        r.say(
            f"{row.session_id}: {row.poses or 'no'} poses, {row.images} images, {row.frames} frames and "
            f"{row.support_frames} support frames selected, {' in '.join(walked)} ({row.split})"
        )
    rejects = sum(len(session.rejects) for session in sessions)
    if rejects:
        r.say(f"{rejects} rows rejected: {_reasons(sessions, '; ')} (all in rejects.parquet)")
    jumps = [jump for session in sessions for jump in session.jumps]
    cuts = sum(jump.splits for jump in jumps)
    if jumps:
        r.say(f"VIO jumps: {len(jumps)}, of which {cuts} split a session")
    if split.leak_s is not None and split.leak_s < LEAK_S:
        r.say(
            f"warning: test frames are {split.leak_s:.1f} s from training frames of the same walk (5 s or more are "
            "needed): accuracy on this split says nothing about new walks"
        )
    dataset = dataset_frames(frames)
    counts = dataset["split"].value_counts()
    trained, tested = counts.get("train", 0), counts.get("test", 0)
    if trained < tested:
        of_recordings: Any = dataset.groupby(["recording", "split"], sort=False).size().items()
        listed = name_list([f"{count} of {recording} {side}" for (recording, side), count in of_recordings], 8)
        r.say(
            f"warning: {trained} frames train and {tested} test: {listed}; {setting_of('split', 'test')} lists "
            "other recordings to test on, and test_fraction there says how much of a single one"
        )
    of_train, test = frames[frames["split"] != "test"], frames[frames["split"] == "test"]
    same = test[test["content_sha256"].isin(of_train["content_sha256"])]
    if len(same):
        first = same.iloc[0]
        twin = of_train.loc[of_train["content_sha256"] == first.content_sha256, "frame_id"].iloc[0]
        r.say(
            f"warning: {len(same)} of {len(test)} test images are also training images, byte for byte but for "
            f"metadata (the first: {first.frame_id} is {twin}): accuracy on this split means nothing"
        )
    first_of = frames.drop_duplicates("content_sha256").set_index("content_sha256")["recording"]
    for recording, of_one in frames.groupby("recording", sort=False):
        originals = of_one["content_sha256"].map(first_of)
        if (copied := originals != recording).mean() > _SAME_FRAMES:
            r.say(
                f"warning: {recording} is {originals[copied].iloc[0]} again: {copied.sum()} of its {len(of_one)} "
                "frames have the same image, and count twice; take one away, as an archive beside its own folder"
            )
    images = sum(len(session.images) for session in sessions)
    figures: dict[str, float | int | str | None] = {
        "recordings": session_rows["recording"].nunique(),
        "sessions": len(sessions),
        "poses": int(session_rows["poses"].sum()),
        "images": images,
        "frames": len(dataset),
        "support_frames": len(frames) - len(dataset),
        **{f"frames_{name}": int(counts.get(name, 0)) for name in ("train", "val", "test")},
        "not_sampled": images - len(frames),
        "rejects": rejects,
        "jumps": len(jumps),
        "jumps_that_split": cuts,
        "path_m": float(session_rows["path_m"].sum()) if session_rows["path_m"].notna().any() else None,
        "frames_with_depth": int(frames["depth"].notna().sum()),
        "split": split.how,
        "leak_s": split.leak_s,
        "test_images_also_in_train": len(same),
    }
    for name, value in figures.items():
        r.figure(name, value)


def _report_blurring(
    r: StageRun[ImportSettings],
    frames: pd.DataFrame,
    regions_of: Mapping[str, tuple[str, list[Region]]],
    listed: Set[str],
) -> None:
    """Write and say what was blurred, where something was looked for; `listed` are the images that the user names."""
    used = set(frames["frame_id"])
    regions_of = {frame_id: found for frame_id, found in regions_of.items() if frame_id in used}
    if regions_of or r.settings.blur:
        write_boxes(r.work / BLURRED, regions_of)
        images = sum(bool(regions) for _, regions in regions_of.values())
        counts = {kind: int(frames[f"blurred_{kind}"].sum()) for kind in ("faces", "plates")}
        r.say(
            f"blurred {counts['faces']} faces and {counts['plates']} plates in {images} of {len(frames)} images, which "
            f"{BLURRED} lists; detectors miss some faces and look for no plates: look before you publish"
        )
        for name, count in (("images", images), *counts.items()):
            r.figure(f"blurred_{name}", count)
    if unused := sorted(listed - used):
        r.say(f"warning: {len(unused)} images of {r.settings.blur_boxes} aren't among the frames, such as {unused[0]}")


def _report_near_copies(
    r: StageRun[ImportSettings], sessions: Sequence[Session], frames: pd.DataFrame, reader: ImageReader
) -> None:
    """Warn where test images without times show what training images show."""
    timeless = dataset_frames(frames[~have_times(frames)])
    frame_of = {s.frame_id(image.number): image for s in sessions for image in s.images}
    test, train = (list(timeless.loc[timeless["split"] == side, "frame_id"]) for side in ("test", "train"))
    if not test or not train:
        return
    looked_at, pairs = find_near_copies([frame_of[i] for i in test], [frame_of[i] for i in train], reader)
    r.figure("test_images_near_train", len(pairs) / looked_at)
    if len(pairs) > MAX_FRACTION * looked_at:
        i, j = pairs[0]
        r.say(
            f"warning: {len(pairs)} of {looked_at} test images show nearly what a training image shows "
            f"(as {test[i]} and {train[j]}): accuracy on this split says little about new walks. Names don't say "
            "which images were taken together: name those for testing, or put each walk into a folder of its own "
            "(docs/how-to/split.md)"
        )


def held_frames(r: StageRun[ImportSettings], frames: pd.DataFrame, left_out: Mapping[str, UserError]) -> pd.DataFrame:
    """The frames table with the splits that recordings had; new ones have what the rules say.

    UserError where one that is `left_out` is new, where nothing is new or gone, where a recording that was there is
    imported otherwise now, and where a new one is one that is there, by its images or its VIO.
    """
    assert r.before is not None
    rejects = table_of(r.before.parent, "import", "rejects")
    if new := left_out.keys() - set(rejects.loc[rejects["rejected"] == Rejected.RECORDING, "session_id"]):
        raise left_out[min(new)]
    before = table_of(r.before.parent, "import", "frames")
    sessions, known = set(frames["session_id"]), set(before["session_id"])
    if sessions == known:
        raise UserError(
            "the captures hold no other recording than before",
            where=r.data.captures(r.scene.name),
            expected="a recording in a folder of its own",
            do="see what import finds there: groundwalk inspect <folder>",
        )
    columns = ["frame_id", "t_ns", "image_sha256"]
    then, now = (t[t["session_id"].isin(sessions & known)][columns].reset_index(drop=True) for t in (before, frames))
    if not then.equals(now):
        raise UserError(
            "import chooses other frames of the recordings that were there",
            found=f"{len(now)} frames, {len(then)} before",
            expected="the same frames: no change of the captures, of import's settings, or of how densely it samples",
            do="undo that change, or make everything anew by groundwalk run",
        )
    for session_id in sorted(sessions - known):
        of_session = frames[frames["session_id"] == session_id]
        has_vio = of_session["vio_cam_tx"].notna()
        as_before = of_session["image_sha256"].isin(before["image_sha256"])
        as_before |= has_vio & pd.MultiIndex.from_frame(of_session[_VIO]).isin(pd.MultiIndex.from_frame(before[_VIO]))
        if as_before.mean() > _SAME_FRAMES:
            raise UserError(
                f"{session_id} is a recording that the scene has already",
                found=f"{as_before.sum()} of its {len(of_session)} frames have the image or VIO pose of another",
                do="add another recording",
            )
    if r.holds:
        split = frames["frame_id"].map(before.set_index("frame_id")["split"])
        frames = frames.assign(split=split.fillna(frames["split"]))
    return frames
