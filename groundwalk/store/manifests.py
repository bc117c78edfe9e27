"""Manifests of finished artefacts: what they have to say, and whether the artefact is still as it was written."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from groundwalk.store.errors import UserError
from groundwalk.store.files import KEY_FILE, RECORDING, hash_files, leads_outside, partial_folder, read_json
from groundwalk.store.hints import run_command
from groundwalk.store.settings import STAGES

MANIFEST = "manifest.json"
BLURRED = "blurred.csv"
"""In import's artefact: the regions of images that it blurred."""
FEATURES = "features.db"
"""In sfm's artefact: features and matches, for a run that adds recordings or takes some out."""
# Not among the hashed outputs: a recording is a view of the tables, and neither it nor a database is the same twice.
UNHASHED = (MANIFEST, RECORDING, KEY_FILE, FEATURES)


def load_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a finished artefact; UserError where it can't be read or isn't one."""
    content = read_json(folder / MANIFEST)
    if not is_manifest(content):
        raise UserError(
            f"the manifest of artefact {folder.name} is damaged",
            where=folder / MANIFEST,
            expected="a JSON object with `outputs` and `simulated`, as the stage wrote it",
            do=_again(folder),
        )
    return content


def is_manifest(content: dict[str, Any]) -> bool:
    """Whether the content of a manifest file has what every manifest has."""
    outputs = content.get("outputs")
    return (
        isinstance(outputs, dict)
        and all(isinstance(digest, str) for digest in outputs.values())
        and isinstance(content.get("simulated"), bool)
    )


def output_hashes(folder: Path) -> dict[str, str]:
    """sha256 of every file of an artefact that counts as its output."""
    unhashed = {folder / name for name in UNHASHED}
    return hash_files(folder, (p for p in folder.rglob("*") if p.is_file() and p not in unhashed))


def listed_files(folder: Path) -> set[str]:
    """The files of an artefact that its stage wrote, by its manifest; none where that is damaged."""
    outputs = read_json(folder / MANIFEST).get("outputs")
    return {*outputs, *UNHASHED} if isinstance(outputs, dict) else set()


def load_verified(folder: Path) -> dict[str, Any]:
    """The manifest of a finished artefact all of whose outputs are as they were written; UserError otherwise."""
    manifest = load_manifest(folder)
    listed: dict[str, str] = manifest["outputs"]
    there = [folder / name for name in listed if not leads_outside(name) and (folder / name).is_file()]
    try:
        hashes = hash_files(folder, there)
    except OSError as error:
        raise UserError("an artefact can't be read", where=error.filename, found=error.strerror) from None
    if damaged := [name for name, digest in sorted(listed.items()) if hashes.get(name) != digest]:
        raise UserError(
            f"artefact {folder.name} isn't as its stage wrote it: {len(damaged)} of {len(listed)} files have another "
            f"sha256 than in the manifest, {len(listed) - len(there)} of them are gone",
            where=folder / damaged[0],
            do=_again(folder),
        )
    return manifest


def missing_stage(folder: Path, stage: str, scene: str) -> UserError:
    """The error for a stage that was never run, or not to its end; `folder` is its artefact's."""
    state = "has begun but not finished" if partial_folder(folder).is_dir() else "hasn't been run"
    return UserError(f"stage {stage} of scene {scene} {state}", where=folder, do=run_command(folder))


def is_whole(folder: Path, key: str) -> bool:
    """Whether a finished artefact of this key is there with all that it was written with."""
    manifest = read_json(folder / MANIFEST)
    if manifest.get("key") != key:
        return False
    try:
        load_verified(folder)
    except UserError:
        return False
    return not manifest.get("recorded") or (folder / RECORDING).is_file()


class Replaced(NamedTuple):
    """An artefact that was made from another one than is there now: which one it is, and from which, as scene and
    stage."""

    artefact: tuple[str, str]
    source: tuple[str, str]

    def __str__(self) -> str:
        return "{1} of scene {0}".format(*self.source)


def replaced_input(manifest_of: Callable[[str, str], dict[str, Any]], scene: str, stage: str) -> Replaced | None:
    """Where an artefact, or one that it was made from, was made from one that was made anew since. `manifest_of` gives
    the manifest of a scene's stage, whatever its file holds; one that isn't there, or is damaged, wasn't made anew."""
    for source, hashes in manifest_of(scene, stage).get("inputs", {}).items():
        its_scene, _, its_stage = source.partition("/")
        if its_stage not in STAGES:
            continue
        now = manifest_of(its_scene, its_stage)
        if is_manifest(now) and now["outputs"] != hashes:
            return Replaced((scene, stage), (its_scene, its_stage))
        if replaced := replaced_input(manifest_of, its_scene, its_stage):
            return replaced
    return None


def outdated_stages(folder: Path, manifests: dict[str, dict[str, Any]]) -> dict[str, str]:
    """Stage -> an input that isn't any more what the stage, or one that it was made from, read. `folder` is that of a
    scene's run, with the manifests of its finished stages."""
    own = {str(manifest["scene"].get("name")) for manifest in manifests.values()}

    def manifest_of(scene: str, stage: str) -> dict[str, Any]:
        return manifests.get(stage, {}) if scene in own else read_json(folder.parent / scene / stage / MANIFEST)

    replaced = {stage: replaced_input(manifest_of, scene, stage) for scene in own for stage in manifests}
    return {stage: str(of) for stage, of in replaced.items() if of}


def _again(folder: Path) -> str:
    return f"{run_command(folder)}, which makes it anew"
