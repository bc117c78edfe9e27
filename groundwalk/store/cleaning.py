"""Removing a scene's artefacts: what a manifest, a key file or the simulator's marker lists, nothing else."""

import contextlib
import os
import shutil
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from groundwalk.store.errors import UserError
from groundwalk.store.files import CHANGE, KEY_FILE, old_folder, partial_folder, read_json
from groundwalk.store.locks import lock_file, locked
from groundwalk.store.manifests import MANIFEST, listed_files
from groundwalk.store.settings import STAGES, DataRoot
from groundwalk.store.simulated import SIMULATED_MARKER, marker_of, simulated_files


@dataclass
class Cleaned:
    """What was removed, and what was left because this program didn't make it."""

    removed: list[Path] = field(default_factory=list)
    left: list[Path] = field(default_factory=list)


def clean_scene(data: DataRoot, profile: str, scene: str) -> Cleaned:
    """Remove data/runs/<profile>/<scene> and the simulated captures of the scene, each file only where it's listed.

    Never follows a link. UserError for a profile or scene that there isn't, and where a stage of the scene is under
    way; nothing is removed then.
    """
    runs, captures = data.run(profile, scene), data.captures(scene)
    if not os.path.lexists(runs.parent):
        data.profile(profile)
    if not data.config_files("scenes", scene) and not any(map(os.path.lexists, (runs, captures))):
        raise UserError(
            f"there is no scene {scene!r}",
            where=data.root,
            expected=f"a folder {captures} or {runs}, or a file scenes/{scene}.toml",
        )
    cleaned = Cleaned()
    through_link = runs.is_symlink() or runs.parent.is_symlink()
    folders = [] if through_link else [runs / stage for stage in (*STAGES, CHANGE)]
    traces = {folder: (folder, partial_folder(folder), old_folder(folder), lock_file(folder)) for folder in folders}
    stages = [folder for folder in folders if any(map(os.path.lexists, traces[folder]))]
    with contextlib.ExitStack() as locks:
        for folder in (*stages, *([captures] if _are_simulators(captures) else [])):
            locks.enter_context(locked(folder))
        for stage in stages:
            _clean_stage(stage, cleaned)
        if _are_simulators(captures):
            _clean_captures(captures, cleaned)
    if os.path.lexists(lock_file(captures)):
        with contextlib.suppress(UserError), locked(captures):  # a lock that others hold stays
            lock_file(captures).unlink()
    if through_link:
        cleaned.left.append(runs)
    elif runs.is_dir():
        named = {parent for path in cleaned.left for parent in path.parents}
        cleaned.left += [path for path in sorted(runs.iterdir()) if path not in named]
        _remove_empty(runs)
    return cleaned


def _are_simulators(captures: Path) -> bool:
    """Whether the simulator wrote a capture folder, or left one unfinished: real ones stay, whoever reads them."""
    hidden = map(_is_folder, (partial_folder(captures), old_folder(captures)))
    return any(hidden) or (_is_folder(captures) and (captures / SIMULATED_MARKER).exists())


def _clean_stage(final: Path, cleaned: Cleaned) -> None:
    for folder in (final, old_folder(final)):
        files = listed_files(folder)
        if _is_folder(folder) and files and read_json(folder / MANIFEST).get("stage") == final.name:
            _remove_listed(folder, files, MANIFEST, cleaned)
    _remove_partial(partial_folder(final), cleaned)
    lock_file(final).unlink(missing_ok=True)


def _clean_captures(captures: Path, cleaned: Cleaned) -> None:
    for folder in (captures, old_folder(captures)):
        if _is_folder(folder) and marker_of(folder):
            if files := simulated_files(folder):
                _remove_listed(folder, files, SIMULATED_MARKER, cleaned)
            else:
                cleaned.left.append(folder)
    _remove_partial(partial_folder(captures), cleaned)


def _remove_partial(folder: Path, cleaned: Cleaned) -> None:
    """A run's unfinished folder is its own as a whole: nothing else has a key file under that hidden name."""
    if _is_folder(folder) and (isinstance(read_json(folder / KEY_FILE).get("key"), str) or not any(folder.iterdir())):
        shutil.rmtree(folder)
        cleaned.removed.append(folder)


def _remove_listed(folder: Path, files: Collection[str], last: str, cleaned: Cleaned) -> None:
    """Remove the listed files, `last` as the last one, so that a clean that was killed can be done again."""
    foreign = []
    for base, folders, names in os.walk(folder, topdown=False, followlinks=False):
        for path in (Path(base) / name for name in sorted(names)):
            relative = path.relative_to(folder).as_posix()
            if relative not in files:
                foreign.append(path)
            elif relative != last:
                path.unlink()
        for path in (Path(base) / name for name in sorted(folders)):
            if path.is_symlink():
                foreign.append(path)
            else:
                _remove_empty(path)
    (folder / last).unlink()
    _remove_empty(folder)
    cleaned.removed.append(folder)
    cleaned.left += foreign


def _remove_empty(folder: Path) -> None:
    with contextlib.suppress(OSError):
        folder.rmdir()


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()
