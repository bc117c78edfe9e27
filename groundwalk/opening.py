"""Finding a scene's run, and telling it from what isn't one."""

import os
from pathlib import Path
from typing import Any

from groundwalk.run import Run
from groundwalk.store.errors import UserError
from groundwalk.store.files import read_json
from groundwalk.store.hints import run_command
from groundwalk.store.manifests import MANIFEST, is_manifest, missing_stage, outdated_stages
from groundwalk.store.settings import STAGES, DataRoot, is_name
from groundwalk.store.text import name_list


def open_run(scene_or_folder: str | os.PathLike[str], profile: str, data: Path) -> Run:
    """See `groundwalk.open`."""
    if isinstance(scene_or_folder, str) and is_name(scene_or_folder):
        root = DataRoot(data)
        folder = root.run(profile, scene_or_folder)
        if not folder.is_dir():
            raise _no_run(root, profile, scene_or_folder)
        return _run(folder, root)
    folder = Path(os.path.abspath(scene_or_folder))  # noqa: PTH100, as Path.resolve would follow links out of data/runs
    if not folder.is_dir():
        raise UserError("there is no run", where=folder, expected="a folder data/runs/<profile>/<scene>")
    beside = [DataRoot(folder.parents[2])] if folder.parent.parent.name == "runs" else []
    return _run(folder, *beside, DataRoot(data))


def _run(folder: Path, *roots: DataRoot) -> Run:
    """The run of a folder, with the scene's captures of the first data folder that has them."""
    manifests = _manifests(folder)
    if not manifests:
        if any(folder.glob(".*.partial")):
            raise missing_stage(folder / STAGES[0], STAGES[0], folder.name)
        raise _foreign(folder)
    scene = str(next(iter(manifests.values()))["scene"].get("name"))
    captures = next((path for path in (root.captures(scene) for root in roots) if path.is_dir()), None)
    return Run(folder, captures, manifests, outdated_stages(folder, manifests))


def _manifests(folder: Path) -> dict[str, dict[str, Any]]:
    """The manifests of the finished stages, in order; UserError for one that is damaged."""
    manifests = {}
    for stage in STAGES:
        file = folder / stage / MANIFEST
        if not file.is_file():
            continue
        content = read_json(file)
        types = {"profile": str, "scene": dict, "inputs": dict}
        has_types = all(isinstance(content.get(name), type_) for name, type_ in types.items())
        if not (is_manifest(content) and has_types and content.get("stage") == stage):
            raise UserError(
                "a stage's manifest is damaged, or of another program",
                where=file,
                expected=f"a JSON object that the stage {stage} wrote",
                do=run_command(folder / stage) + ", where the folder is a run of groundwalk",
            )
        manifests[stage] = content
    return manifests


def _no_run(data: DataRoot, profile: str, scene: str) -> UserError:
    runs = data.root / "runs"
    there = sorted(f"{path.name} of profile {path.parent.name}" for path in runs.glob("*/*") if is_name(path.name))
    return UserError(
        f"scene {scene} has no run of profile {profile}",
        where=runs,
        found=name_list(there, 5),
        do=f"{run_command(data.run(profile, scene, STAGES[-1]))}; or name the profile or data folder of another run",
    )


def _foreign(folder: Path) -> UserError:
    if is_manifest(read_json(folder / MANIFEST)):
        return UserError(
            "this is the folder of one stage", where=folder, do=f"open its run: groundwalk.open({str(folder.parent)!r})"
        )
    there = sorted(path.name for path in folder.iterdir())
    return UserError(
        "this isn't the folder of a run",
        where=folder,
        expected=f"a folder for each stage, {', '.join(STAGES)}, with its {MANIFEST}",
        found=name_list(there, 5),
    )
