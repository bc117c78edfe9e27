"""Finding the recordings in a capture folder, and reading one."""

import hashlib
import os
import re
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from groundwalk.capture_import.capture import ImageFile, Limits, RawFrame, Recording, Reject
from groundwalk.capture_import.formats import FORMATS, Format
from groundwalk.capture_import.media.archive import SUFFIXES, unpack
from groundwalk.capture_import.media.video import is_video
from groundwalk.capture_import.parsing import images_in, in_order, is_image
from groundwalk.capture_import.refusal import are_images_alone, no_capture
from groundwalk.store import UserError, progress
from groundwalk.store.choices import PoseSource, Rejected
from groundwalk.store.errors import MachineError
from groundwalk.store.hints import setting_of
from groundwalk.store.registry import PluginError
from groundwalk.store.text import name_list, natural_order

_MAX_DEPTH = 5
_MAX_ID_BYTES = 120
_OTHER_ARCHIVES = (".7z", ".bz2", ".gz", ".rar", ".tar", ".tgz", ".xz", ".zst")
# The simulator's truth is for checks alone; import never opens it.
_IGNORED = {"true_poses.parquet", "true_cameras.parquet", "SIMULATED.json", "LICENSE", "README.md", "__MACOSX"}
# Depth beside images of the same folder: 3D Scanner App's, NeRFCapture's and 7-Scenes'.
_DEPTH = re.compile(r"(depth|conf)_\d{1,9}\.png|.*\.depth\.png")


@dataclass(frozen=True)
class RecordingSource:
    """A recording: where it is, in which format, the way to it by the names that a user sees, what the search for it
    has to say, and its id."""

    path: Path
    format: Format
    parts: tuple[str, ...]
    notes: tuple[str, ...] = ()
    recording_id: str = ""

    def read(self, limits: Limits) -> Recording:
        """The recording's rows; UserError where it can't be read as a whole, or no row can."""
        try:
            with FORMATS.guard(self.format.id):
                raw = self.format.read(self.path, limits)
                _check(raw)
        except OSError as error:
            raise _unreadable(self.path, error) from None
        if not raw.frames:
            raise UserError(
                "no frame of this recording can be read",
                where=self.path,
                expected=f"{self.format.label}: {self.format.recognised_by}",
                found=f"{raw.rejects[0].source}: {raw.rejects[0].reason}" if raw.rejects else "no rows",
            )
        notes = [*raw.notes, *self.notes]
        cameras = [frame.intrinsics for frame in raw.frames if isinstance(frame.image, ImageFile)]
        if unsized := sum(camera is not None and camera.width is None for camera in cameras):
            # Nothing would show images that were scaled.
            notes.append(f"the log states no size of {unsized} images: their intrinsics are taken for the files' own")
        without_row = _images_without_a_row(raw)
        if len(without_row) > len(cameras) > 0:  # as where a tool placed few of them
            photos = setting_of("import", 'format = "photos"')
            count = len(without_row) + len(cameras)
            notes.append(f"{len(without_row)} of {count} images have no pose: {photos} reads all, without poses")
        rejects = [*raw.rejects, *without_row]
        return replace(raw, recording_id=self.recording_id, format=self.format.id, notes=notes, rejects=rejects)


def _check(raw: Recording) -> None:
    """TypeError or ValueError where a reader returned something else than import's checks expect."""
    if not isinstance(raw, Recording):
        raise TypeError(f"read returned a {type(raw).__name__}, not a Recording")
    if raw.pose_source == PoseSource.VIO and not raw.clock.has_times:
        raise ValueError(f"the recording's poses are VIO on the clock {raw.clock}, which has no times")
    for frame in raw.frames:
        if not isinstance(frame, RawFrame):
            raise TypeError(f"read returned a {type(frame).__name__} among its frames, not a RawFrame")
        if frame.vio_T_cam is not None and np.shape(frame.vio_T_cam) != (4, 4):
            raise ValueError(f"{frame.source}: vio_T_cam has shape {np.shape(frame.vio_T_cam)}, not (4, 4)")


def _images_without_a_row(raw: Recording) -> list[Reject]:
    """The image files beside those of a recording that none of its rows names."""
    named = {frame.image.path for frame in raw.frames if isinstance(frame.image, ImageFile)}
    used = named | {file for f in raw.frames if f.depth for file in (f.depth.path, f.depth.confidence)}
    told = {re.split(r"[/ ]", reject.source)[-1] for reject in raw.rejects}
    reason, rejects = "no row of the log that can be read names this image", []
    for image in (image for folder in in_order({path.parent for path in named}) for image in images_in(folder)):
        if image not in used and image.name not in told and not _DEPTH.fullmatch(image.name):
            source = image.relative_to(raw.folder).as_posix() if image.is_relative_to(raw.folder) else image.name
            rejects.append(Reject(source, None, reason, Rejected.IMAGE))
    return rejects


def find_recordings(
    root: Path,
    unpacked: Path,
    limits: Limits,
    format_name: str = "auto",
    say: Callable[[str], None] = lambda line: None,
) -> list[RecordingSource]:
    """The recordings in `root`, in natural order of their ids: `root` itself, or folders, files and archives below it.

    `say` gets lines that name what isn't read: where a format is named, recordings of others, and what seems to be a
    recording but fits no format. Archives are unpacked into the folder `unpacked`, but not archives inside
    archives. A recording's id is its folder's (or file's) name; where two have the same, the path from `root` with
    dashes. UserError where there is none, where one fits two formats, where a link leads out of `root`, or where a name
    isn't UTF-8.
    """
    chosen = None if format_name == "auto" else FORMATS.find(format_name)
    root = root.resolve()
    if not root.exists():
        raise UserError("the capture doesn't exist", where=root, expected="a folder of phone captures")
    formats = [form for form in FORMATS.values() if not form.is_images_alone] if chosen is None else [chosen]
    try:
        search = _Search(root, unpacked, limits, formats)
        hits = search.run(root, (), 0)
        if not hits and chosen is None and are_images_alone(root, unpacked, formats):
            search = _Search(root, unpacked, limits, [form for form in FORMATS.values() if form.is_images_alone])
            hits = search.run(root, (), 0)
    except OSError as error:
        raise _unreadable(root, error) from None
    if not hits:
        raise no_capture(root, formats, chosen, search.others())
    names = [_plain((hit.parts or (root.stem if root.is_file() else root.name,))[-1]) for hit in hits]
    counts = Counter(names)
    unique = [n if counts[n] == 1 else _plain("-".join(hit.parts)) for hit, n in zip(hits, names, strict=True)]
    sources = [replace(hit, recording_id=name) for hit, name in zip(hits, unique, strict=True)]
    if others := search.others():
        say(f"not read, as {setting_of('import', 'format')} (--format of `inspect`) is {format_name}: {others}")
    if search.skipped:
        say(f"not read: {name_list(search.skipped, 8)}")
    return sorted(sources, key=lambda f: natural_order(f.recording_id))


def _unreadable(path: Path, error: OSError) -> UserError:
    return UserError(
        "a capture can't be read",
        where=error.filename or path,
        found=error.strerror,
        do="look at its permissions" if isinstance(error, PermissionError) else None,
    )


@dataclass(frozen=True)
class _Search:
    root: Path
    unpacked: Path
    limits: Limits
    formats: list[Format]
    in_archive: bool = False
    failed: set[str] = field(default_factory=set)
    unread: list[RecordingSource] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)

    def others(self) -> str:
        """The recordings that only other formats than the chosen one fit; empty where there is none."""
        names = [f"{'/'.join(hit.parts) or hit.path.name} ({hit.format.label})" for hit in self.unread]
        return name_list(names, 8) if names else ""

    def run(self, path: Path, parts: tuple[str, ...], depth: int) -> list[RecordingSource]:
        """Recordings at or below `path`; `parts` is the way to it by the names that a user sees."""
        _refuse_link_out(self.root, path)
        fits = [f for f in FORMATS.values() if (f in self.formats or not f.is_images_alone) and self._fits(f, path)]
        candidates = [f for f in fits if f in self.formats]
        first = [f for f in candidates if not {g.id for g in candidates} & set(f.yields_to)]
        first = [f for f in first if not f.yields_to_all] or first
        if len(first) > 1:
            raise UserError(
                "a recording fits more than one format",
                where=path,
                found=", ".join(f.id for f in first),
                do=f"name one with {setting_of('import', 'format')}, or with --format of `inspect`",
            )
        if first:
            _refuse_odd_name(self.root, path)
            _refuse_links_below(self.root, path)
            notes = [f"read as {first[0].label}; it is {f.label}, too" for f in candidates if f not in first]
            # Photos name the folders of images beside them.
            for inner in () if first[0].is_images_alone else _visible(path):
                is_archive = inner.suffix.lower() in SUFFIXES
                if is_archive or (inner.is_dir() and any(self._fits(f, inner) for f in self.formats)):
                    why = "inside another recording: move it out if it's one of its own"
                    self.skipped.append(f"{'/'.join((*parts, inner.name))} ({why})")
            return [RecordingSource(path, first[0], parts, tuple(notes))]
        if path.is_file() and path.suffix.lower() in SUFFIXES and not self.in_archive:
            _refuse_odd_name(self.root, path)
            # Of its path alone, so that no two archives share a folder, and a killed run finds it again.
            digest = hashlib.sha256(os.fsencode(path.relative_to(self.root))).hexdigest()
            target = self.unpacked.resolve() / digest[:32]
            try:
                unpack(path, target, self.limits)
            except MachineError:
                raise
            except UserError as error:
                return [RecordingSource(path, _broken_archive(error), parts)]
            return replace(self, root=target, in_archive=True).run(target, parts, depth + 1)
        before, before_skipped, hits = len(self.unread), len(self.skipped), []
        if path.is_dir() and depth < _MAX_DEPTH:
            inside = [(p, (*parts, p.stem if p.is_file() else p.name)) for p in _visible(path)]
            hits = [hit for p, way in inside for hit in self.run(p, way, depth + 1)]
        if fits and not hits:
            del self.unread[before:], self.skipped[before_skipped:]
            self.unread.append(RecordingSource(path, fits[0], parts))
        elif parts and not hits and (why := _why_skipped(path, depth)):
            del self.skipped[before_skipped:]
            self.skipped.append(f"{'/'.join(parts)} ({why})")
        return hits

    def _fits(self, format: Format, path: Path) -> bool:
        """Whether a format fits; one of another package that fails is named once, and fits nothing."""
        if format.id in self.failed:
            return False
        try:
            with FORMATS.guard(format.id):
                return format.fits(path)
        except PluginError as error:
            self.failed.add(format.id)
            progress.console.print(f"warning: {error}")
            return False


def _visible(folder: Path) -> list[Path]:
    """What in a folder may be a recording, or hold one; nothing in a file."""
    inside = folder.iterdir() if folder.is_dir() else ()
    return in_order(p for p in inside if not p.name.startswith(".") and p.name not in _IGNORED)


def _why_skipped(path: Path, depth: int) -> str:
    """Why no recording was found in a file or folder that seems to hold one; empty for any other."""
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return "an archive in an archive: unpack it"
    if path.is_file() and path.suffix.lower() in _OTHER_ARCHIVES:
        return "an archive, but no zip: unpack it"
    inside = [p for p in path.iterdir() if not p.name.startswith(".")] if path.is_dir() else []
    if depth >= _MAX_DEPTH and any(p.is_dir() or p.suffix.lower() in SUFFIXES for p in inside):
        return f"recordings are looked for {_MAX_DEPTH} folders deep"
    return "no known format" if is_video(path) or any(is_image(p) or is_video(p) for p in inside) else ""


def _broken_archive(error: UserError) -> Format:
    """The format of a recording in an archive that can't be unpacked: reading it says why."""

    def read(path: Path, limits: Limits) -> Recording:
        raise error

    return Format(id="archive", label="archive", meaning="", files=(), read=read)


def _refuse_link_out(root: Path, path: Path) -> None:
    try:
        out = not path.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # a loop of links
        out = True
    if out:
        raise UserError(
            "a link leads out of the capture folder", where=path, do="copy what it points to into the capture folder"
        )


def _refuse_links_below(root: Path, path: Path) -> None:
    """Logs and videos of a recording must lie in the capture; images that don't become rejects one by one."""
    for entry in path.iterdir() if path.is_dir() else ():
        if entry.is_symlink():
            if not is_image(entry):
                _refuse_link_out(root, entry)
        elif entry.is_dir():
            _refuse_links_below(root, entry)


def _refuse_odd_name(root: Path, path: Path) -> None:
    relative = os.fsencode(path.relative_to(root))
    try:
        relative.decode("utf-8")
    except UnicodeDecodeError:
        raise UserError("a recording's name isn't UTF-8", where=root, found=repr(relative), do="rename it") from None


def _plain(name: str) -> str:
    """`name` with everything replaced that could not be part of an id, and cut where files couldn't be named by it."""
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name).strip(".") or "capture"
    if plain == "all":  # in align.drift that is all sessions together
        return "all_"
    if len(plain.encode()) <= _MAX_ID_BYTES:
        return plain
    digest = hashlib.sha256(name.encode(errors="surrogateescape")).hexdigest()[:8]
    return f"{plain.encode()[: _MAX_ID_BYTES - 9].decode(errors='ignore')}-{digest}"
