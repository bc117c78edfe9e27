"""The commands `add` and `remove`: recordings put into a finished ground truth, or taken out of it.

The change is made in a data folder of its own, hidden in the scene's run, by the stages as they are: its captures are
links to those of the scene, with the new recording or without the old one, and what its runs go on from is the scene's
run. When all is done it is put in place; until then nothing of the scene has changed.
"""

import contextlib
import os
import shutil
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from groundwalk.cli import stage_of
from groundwalk.pipeline import Step, run_steps
from groundwalk.store import progress
from groundwalk.store.choices import MapUnit
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.errors import MachineError, UserError
from groundwalk.store.files import (
    CHANGE,
    KEY_FILE,
    link_or_copy,
    partial_folder,
    read_json,
    swap_in,
    write_json,
    written_aside,
)
from groundwalk.store.hints import run_command
from groundwalk.store.inputs import capture_files, has_capture_files, held
from groundwalk.store.locks import locked
from groundwalk.store.manifests import MANIFEST, listed_files, load_manifest
from groundwalk.store.outdated import is_up_to_date
from groundwalk.store.settings import DataRoot, resolve_settings
from groundwalk.store.tables import map_unit, table_of

app = new_app("Recordings into a finished ground truth, or out of it.")
_STAGES = ("import", "sfm", "align")
RefineOption = Annotated[
    bool, typer.Option("--refine", help="Make everything anew, old poses too; features and matches are reused.")
]


@app.command()
def add(
    recording: Annotated[Path, typer.Argument(help="A recording, or a folder of them; it is copied.")],
    scene: SceneOption,
    profile: ProfileOption = "demo",
    refine: RefineOption = False,
    data: DataOption = Path("data"),
) -> None:
    """Add a recording to a finished ground truth, whose poses, classes and map frame stay as they are to the bit.

    A recording that doesn't fit is refused, and then nothing has changed.
    """
    recording = recording.resolve()
    if not recording.exists() or (recording.is_dir() and not has_capture_files(recording)):
        raise UserError("the recording isn't there", where=recording, expected="a recording, or a folder of them")
    _change(DataRoot(data), profile, scene, recording, "", refine)


@app.command()
def remove(
    session: Annotated[str, typer.Argument(help="The recording: the name of its folder or file.")],
    scene: SceneOption,
    profile: ProfileOption = "demo",
    refine: RefineOption = False,
    data: DataOption = Path("data"),
) -> None:
    """Take a recording out of a finished ground truth; what the others have stays as it is to the bit.

    Its files are moved into the hidden folder .removed of the captures.
    """
    _change(DataRoot(data), profile, scene, None, session, refine)


def _change(data: DataRoot, profile: str, scene: str, new: Path | None, gone: str, refine: bool) -> None:
    """Make a change and put it in place; UserError, and nothing changed, where it can't be made."""
    run, captures = data.run(profile, scene), data.captures(scene)
    if data.scene(scene)[0].is_group:
        raise UserError(f"{scene} is a group of scenes", do="name one of its scenes")
    aside, key = partial_folder(run / CHANGE), f"{new or ''} {gone} {refine}"
    with locked(run / CHANGE):
        note = read_json(aside / KEY_FILE)
        if note.get("key") != key or "done" not in note:
            note = {"key": key, "before": _keys(data, profile, scene)}
            place = Path(new.name) if new else _path_of(captures, gone)
            note["into"] = _folder_for(captures, data, profile, scene) if new else ""
            if new and (os.path.lexists(captures / place) or place.name == note["into"]):
                raise UserError(f"the captures have {place} already", where=captures / place, do="give it another name")
            if read_json(aside / KEY_FILE) != note:
                shutil.rmtree(aside, ignore_errors=True)
                aside.mkdir(parents=True)
                write_json(aside / KEY_FILE, note)
            with held(data, profile, [scene], _STAGES) as refuse_changed:
                try:
                    made = DataRoot(aside, run, holds=not refine)
                    _copy_captures(made.captures(scene), captures.resolve(), note["into"], new, place)
                    _make(made, data, profile, scene)
                except (UserError, OSError) as error:
                    if not isinstance(error, MachineError):  # after one the same command resumes
                        shutil.rmtree(aside, ignore_errors=True)
                    raise
                refuse_changed()
            write_json(aside / KEY_FILE, note | {"done": place.as_posix()})
        _put_in_place(aside, data, profile, scene, new is not None)
    _tell(data, profile, scene)


def _keys(data: DataRoot, profile: str, scene: str) -> dict[str, str]:
    """The keys of the finished stages; UserError where one isn't up to date."""
    for name in _STAGES:
        if not is_up_to_date(stage_of(name), scene, profile, data):
            folder = data.run(profile, scene, name)
            raise UserError(
                f"{name} of scene {scene} isn't finished, or isn't up to date",
                where=folder,
                expected="a finished ground truth to change",
                do=run_command(folder),
            )
    return {name: load_manifest(data.run(profile, scene, name))["key"] for name in _STAGES}


def _path_of(captures: Path, recording: str) -> Path:
    """Where a recording lies in the captures."""
    paths = {file.relative_to(captures) for file in capture_files(captures)}
    found = {p for path in paths for p in (path, *path.parents) if recording in (p.name, p.stem)}
    top = sorted(p for p in found if not found & {*p.parents})
    if len(top) != 1:
        folders = sorted({path.parts[0] for path in paths if len(path.parts) > 1})
        raise UserError(
            f"the captures have no recording {recording!r} in a folder or file of its own",
            where=captures,
            found=", ".join(map(str, top)) or None,
            expected=f"one of {', '.join(folders)}" if folders else "several recordings, each in a folder of its own",
        )
    return top[0]


def _folder_for(captures: Path, data: DataRoot, profile: str, scene: str) -> str:
    """The name of the subfolder that captures have to move into where they are one recording themselves, so that its id
    stays the same; empty where they are a folder of recordings."""
    from groundwalk.capture_import.discovery import find_recordings
    from groundwalk.capture_import.settings import ImportSettings

    settings = resolve_settings(ImportSettings, "import", data, profile, scene)
    with tempfile.TemporaryDirectory(prefix=".", dir=data.run(profile, scene)) as unpacked:
        found = find_recordings(captures, Path(unpacked), settings.limits, settings.format)
    return "" if found[0].parts else captures.resolve().name


def _copy_captures(target: Path, captures: Path, into: str, new: Path | None, place: Path) -> None:
    """What is captured (in the folder `into`, where that is named) with what is `new`, or without what lies at
    `place`."""

    def ignored(folder: str, names: list[str]) -> list[str]:
        return [name for name in names if name.startswith(".") or (not new and Path(folder, name) == captures / place)]

    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(captures, target / into, ignore=ignored, copy_function=link_or_copy, symlinks=True)
    for link in filter(Path.is_symlink, capture_files(target)):  # what it leads to may be hidden, and isn't there then
        if (file := captures / link.relative_to(target / into)).is_file():
            link.unlink()
            if (file := file.resolve()).is_relative_to(captures):
                link_or_copy(file, link)
            else:
                link.symlink_to(file)
    if new:
        copy: Any = shutil.copytree if new.is_dir() else shutil.copy2
        copy(new, target / place)


def _make(changed: DataRoot, data: DataRoot, profile: str, scene: str) -> None:
    """Run the stages on the changed captures; what a killed run of the same change did is reused."""
    from groundwalk.store.stage import execute

    for path in data.root.iterdir():
        if path.name not in ("captures", "runs") and not (changed.root / path.name).is_symlink():
            (changed.root / path.name).symlink_to(path)
    for name in _STAGES:
        execute(stage_of(name), scene, profile, changed)


def _put_in_place(aside: Path, data: DataRoot, profile: str, scene: str, is_new: bool) -> None:
    """Move what was made to where it belongs; a run that was killed here is finished by the same command."""
    captures, note = data.captures(scene), read_json(aside / KEY_FILE)
    done, into = note["done"], note.get("into")
    with contextlib.ExitStack() as locks:
        for folder in (captures, *(data.run(profile, scene, name) for name in _STAGES)):
            locks.enter_context(locked(folder))
        made = DataRoot(aside)
        if into:
            _into_folder(captures, made.captures(scene) / into)
        if is_new and not os.path.lexists(captures / done):
            arriving = captures / f".{Path(done).name}.partial"
            shutil.rmtree(arriving, ignore_errors=True)
            shutil.move(made.captures(scene) / done, arriving)
            arriving.rename(captures / done)
        elif not is_new and os.path.lexists(captures / done):
            gone = (captures / done).resolve()
            for link in filter(Path.is_symlink, capture_files(captures)):  # of others, that share its images
                if (file := link.resolve()).is_relative_to(gone) and not link.is_relative_to(captures / done):
                    with written_aside(link) as partial:
                        link_or_copy(file, partial)
            removed = captures / ".removed" / done
            while os.path.lexists(removed):
                removed = removed.with_name(f"{removed.name}~")
            removed.parent.mkdir(parents=True, exist_ok=True)
            (captures / done).rename(removed)
            progress.console.print(f"  {captures / done} is in {removed} now")
        # A folder that is finished beside its place is put there by whatever runs the stage next.
        for name in _STAGES:
            final, folder = data.run(profile, scene, name), made.run(profile, scene, name)
            if (folder / MANIFEST).is_file():
                shutil.rmtree(partial_folder(final), ignore_errors=True)
                folder.rename(partial_folder(final))
        for name in _STAGES:
            final = data.run(profile, scene, name)
            if (partial_folder(final) / MANIFEST).is_file():
                swap_in(partial_folder(final), final, listed_files)
    shutil.rmtree(aside)


def _into_folder(captures: Path, copy: Path) -> None:
    """Make of captures that are one recording, or a link to one, of which there is a copy, a folder with it."""
    if not captures.is_symlink() and (captures / copy.name).exists():
        return
    folder = captures.with_name(f".{captures.name}.partial")
    if not (folder / copy.name).exists():
        folder.mkdir(exist_ok=True)
        (copy if captures.is_symlink() else captures).rename(folder / copy.name)
    if captures.is_symlink():
        captures.unlink()
    folder.rename(captures)
    progress.console.print(f"  {captures} is a folder of recordings now, with {copy.name} in it")


def _tell(data: DataRoot, profile: str, scene: str) -> None:
    """What has changed, and what is to be run again."""
    if (data.run(profile, scene, "report") / MANIFEST).is_file():
        run_steps([Step("report", scene)], profile, data)
    versions, truth = (table_of(data.run(profile, scene), "align", table) for table in ("versions", "ground_truth"))
    number, is_metric = int(versions["version"].max()), map_unit(truth) is MapUnit.METRE
    for row in versions[versions["version"] == number].to_dict("records"):
        is_known = is_metric and row["with_ground_truth"]
        sd = f", median standard deviation {1000 * row['position_sd_m']:.1f} mm" if is_known else ""
        classes = ", ".join(f"{name} {row[f'quality_{name}']}" for name in "ABC")
        has = ", which had" if row["change"] == "removed" else ","
        progress.stdout.print(
            f"{scene}, version {number}: {row['session_id']} {row['change']}{has} {row['with_ground_truth']} of "
            f"{row['frames']} frames with ground truth ({classes}{sd})"
        )
    later = run_command(data.run(profile, scene, "report"))
    progress.stdout.print(f"what was made from the ground truth before is outdated: {later}")
