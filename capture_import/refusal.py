"""Why a folder holds no capture that can be read: what was recognised, what is missing for it, and what to do."""

import os
import re
import shlex
from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path

from groundwalk.capture_import.formats import Format, is_in
from groundwalk.capture_import.media.video import is_video
from groundwalk.capture_import.parsing import first_bytes, images_in, in_order, is_image
from groundwalk.store import UserError
from groundwalk.store.hints import groundwalk_command, setting_of
from groundwalk.store.text import in_words, name_list

_MAX_NEAREST = 3
_MAX_FOLDERS = 200
_IMAGES_ALONE = 'format = "photos" (or "video")'
# What keys of an unknown log are about, by what apps and tools call them.
_KEYS = {
    "poses": r"transform|pose|matrix|rotation|quat|position|translation|^tx$",
    "intrinsics": r"intrinsic|focal|\bf[xy]\b|fl_x|^K$",
    "times": r"time|stamp",
}
_LOGS = (".json", ".jsonl", ".csv", ".txt", ".yaml", ".yml")
# Lists of poses as trajectory tools (evo) write them, by how many numbers a row has.
_LISTS = {8: "TUM's list of poses (time, position, quaternion xyzw)", 12: "KITTI's list of poses (3x4, in row order)"}
_READ_BESIDE = "it's read as poses.txt beside its images, or beside images/"


def no_capture(root: Path, formats: Sequence[Format], chosen: Format | None, others: str) -> UserError:
    """The error for a folder or file in which no recording was found; `others` are recordings in other formats than
    the chosen one."""
    what = "no capture in a known format" if chosen is None else f"no capture in the format {chosen.id}"
    if not root.is_dir():
        return UserError(what, where=root, found="a file of an unknown kind", do=f"{groundwalk_command()} formats")
    if around := _around(root, formats):
        do = f"{groundwalk_command()} inspect {shlex.quote(str(around[0]))}"
        return UserError(what, where=root, found=f"a part of the recording {around[0]}", do=do)
    nearest = _nearest(root, formats)
    logs = list(islice(_unknown_logs(root), _MAX_NEAREST))
    has_images = any(is_image(path) or is_video(path) for path in root.rglob("*"))
    alone = f"; or read the images without poses: {setting_of('import', _IMAGES_ALONE)}" if has_images else ""
    list_them = f"{groundwalk_command()} formats lists what is recognised"
    images = images_in(root)
    names = sorted(os.fsencode(p.name).decode("utf-8", "replace") for p in root.iterdir() if p not in set(images))
    content = name_list([*([f"{len(images)} images"] if images else []), *names], 8)
    found = others or "; ".join([content, *logs])
    if nearest:
        do = f"copy the recording again, with all its files; {list_them}{alone}"
        others_like = "\n            ".join(nearest[1:])
        return UserError(nearest[0], where=root, expected=others_like or None, found=found, do=do)
    if logs:
        do = (
            "if its poses are the phone's own (VIO), write frames.jsonl from it, in a few lines: "
            f"docs/reference/capture-formats.md (from another app's log); of SfM, export a COLMAP model{alone}"
        )
    elif images:
        do = "photos are read from three on, and others in a format that is recognised: " + list_them
    else:
        do = f"{list_them}; any app can write frames.jsonl: docs/reference/capture-formats.md"
    expected = None if chosen is None else f"{chosen.label}: {chosen.recognised_by}"
    return UserError(what, where=root, expected=expected, found=found, do=do)


def are_images_alone(root: Path, unpacked: Path, formats: Sequence[Format]) -> bool:
    """Whether a capture, whose archives are `unpacked`, is no part and has no part of a recording in these formats, and
    no log that seems to hold poses."""
    if _around(root, formats):
        return False
    folders = [folder for folder in (root, unpacked) if folder.is_dir()]
    return not any(_nearest(folder, formats) or any(_unknown_logs(folder)) for folder in folders)


def _around(root: Path, formats: Iterable[Format]) -> list[Path]:
    """The recordings of which a folder is a part."""
    return [p for p in root.parents[:2] if any(f.fits(p) for f in formats if not f.is_file)]


def _nearest(root: Path, formats: Iterable[Format]) -> list[str]:
    """What is here and missing of the formats of which most is here, best first."""
    folders = [root, *in_order(p for p in [*root.glob("*/"), *root.glob("*/*/")] if not p.name.startswith("."))]
    partly = []
    for folder in folders[:_MAX_FOLDERS]:
        for form in (form for form in formats if not form.is_file):
            here = form.has(folder)
            # `images/` or `*.jpg` alone are in all captures.
            names = list(zip(form.files, here, strict=True))
            # And poses.txt is what tools call a list of poses, too.
            is_told = any(
                is_here
                and not all(re.fullmatch(r"(\*/)*\*\..*|[\w*]+/", one) for one in name.split("|"))
                and not (name == "poses.txt" and _list_of_poses(folder / name))
                for name, is_here in names
            )
            missing = [name.replace("|", " or ") for name, is_here in names if not is_here]
            if is_told and form.missing is not None:
                missing = [lacks] if (lacks := form.missing(folder)) else []
            if is_told and missing:
                place = "" if folder == root else f" ({folder.relative_to(root)})"
                found = [next(n for n in name.split("|") if is_in(folder, n)) for name, is_here in names if is_here]
                verbs = [f"{in_words(n)} {'is' if len(n) == 1 else 'are'}" for n in (found, missing)]
                partly.append((-sum(here) / len(here), f"{form.label}{place}: {verbs[0]} here, {verbs[1]} not"))
    return [text for _, text in sorted(partly, key=lambda item: item[0])[:_MAX_NEAREST]]


def _unknown_logs(root: Path) -> Iterable[str]:
    """What the keys of logs in a folder and below seem to be about."""
    for log in in_order(p for p in root.rglob("*") if p.suffix.lower() in _LOGS):
        name = log.relative_to(root).as_posix()
        if listed := _list_of_poses(log):
            yield f"{name} seems to be {listed}; {_READ_BESIDE}"
            continue
        text = first_bytes(log).decode("utf-8", "ignore")
        # Of a table its first line, with the comments above.
        head = re.match(r"(?:#.*\n)*.*", text)
        keys = re.findall(r'"([A-Za-z_]\w{0,40})"\s*:', text) or re.findall(r"[A-Za-z_]\w*", head[0] if head else "")
        about = []
        for meaning, pattern in _KEYS.items():
            if key := next((key for key in keys if re.search(pattern, key, re.IGNORECASE)), None):
                about.append(f"{meaning} ({key})")
        if about and about[0].startswith("poses"):
            yield f"{name} seems to hold {in_words(about)}"


def _list_of_poses(log: Path) -> str | None:
    """Which list of poses a file's first rows seem to be."""
    lines = first_bytes(log, 1 << 12).decode("utf-8", "ignore").splitlines()
    rows = [line.split() for line in lines[:-1] or lines if line.strip() and not line.startswith("#")]
    is_number = all(re.fullmatch(r"[-+.\deE]+", value) for row in rows for value in row)
    return _LISTS.get(len(rows[0])) if rows and is_number and len(set(map(len, rows))) == 1 else None
