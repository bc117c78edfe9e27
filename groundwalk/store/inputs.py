"""What a stage reads: locked while it reads, hashed into its key, verified before use."""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from groundwalk.store.definition import Stage
from groundwalk.store.errors import UserError
from groundwalk.store.files import hash_files, read_json, sha256_of, state_of_files
from groundwalk.store.hints import groundwalk_command, link_command, run_command
from groundwalk.store.locks import locked
from groundwalk.store.manifests import MANIFEST, Replaced, load_manifest, load_verified, missing_stage, replaced_input
from groundwalk.store.settings import DataRoot, SceneConfig, Settings
from groundwalk.store.simulated import TRUTH_FILES, are_simulated


@dataclass
class Inputs:
    """The inputs of one run of a stage with its settings. `hashes`, which go into the stage's key, are there once they
    are held by `lock`. `captures_state`: with which it hashed captures, `state_of_files`. Where the artefact that is
    there was made from captures in this state, they aren't read again: a campaign's may be terabytes."""

    stage: Stage[Any]
    scene: SceneConfig
    profile: str
    data: DataRoot
    settings: Settings
    hashes: dict[str, Any] = field(default_factory=dict)
    captures_state: str | None = None

    def verify(self) -> None:
        """UserError where an input isn't as its stage wrote it, or an image as import saw it."""
        for _, _, folder in self.sources:
            load_verified(folder)
        from groundwalk.store.images import verify_images  # OpenCV

        for leaf in self.data.leaves(self.scene) if self.stage.reads_images(self.settings) else ():
            verify_images(self.data.captures(leaf), self.data.run(self.profile, leaf, "import"))

    def refuse_outdated(self) -> None:
        """UserError where an artefact among the inputs was made from others than are there now."""
        for scene, stage, _ in self.sources:
            if replaced := self._replaced_input(scene, stage):
                its_scene, its_stage = replaced.artefact
                folder = self.data.run(self.profile, its_scene, its_stage)
                raise UserError(
                    f"artefact {its_stage} of scene {its_scene} is outdated: {replaced} has been made anew since",
                    where=folder,
                    do=run_command(folder),
                )

    def refuse_changed(self) -> None:
        """UserError where an input isn't any more what it was when it was verified: no lock stops other programs."""
        self.verify()
        now = self._hashes()
        for name, hashes in self.hashes.items():
            if now[name] != hashes:
                raise UserError(
                    f"{name} changed while stage {self.stage.name} read them",
                    where=self.data.captures(self.scene.name) if name == "captures" else self.data.root,
                    do="wait until nothing writes there, then run the same command again",
                )

    def frames(self) -> int:
        """How many frames the imports have that are read."""
        import pyarrow.parquet as pq

        files = [folder / "frames.parquet" for _, stage, folder in self.sources if stage == "import"]
        return sum(pq.read_metadata(file).num_rows for file in files if file.is_file())

    def simulated(self) -> bool:
        """Whether any capture behind this run is simulated, or exported from a simulated scene, as import saw it."""
        if self.stage.reads_captures:
            return are_simulated(capture_files(self.data.captures(self.scene.name)))
        leaves = self.data.leaves(self.scene)
        return any(load_manifest(self.data.run(self.profile, leaf, "import"))["simulated"] for leaf in leaves)

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Hold them against being replaced. Captures, too, are read by many stages, and are another profile's to
        simulate or remove. UserError where an input is being made, or isn't there."""
        with contextlib.ExitStack() as locks:
            for leaf in self.data.leaves(self.scene):
                if (captures := self.data.captures(leaf)).is_dir():
                    locks.enter_context(locked(captures, shared=True))
            for scene, stage, folder in self.sources:
                if not (folder / MANIFEST).is_file():
                    raise missing_stage(folder, stage, scene)
                locks.enter_context(locked(folder, shared=True))
            self.hashes = self._hashes()
            yield

    def _hashes(self) -> dict[str, Any]:
        hashes: dict[str, Any] = {}
        if self.stage.reads_captures:
            hashes["captures"] = self._hash_of_captures()
        for scene, stage, folder in self.sources:
            hashes[f"{scene}/{stage}"] = load_manifest(folder)["outputs"]
        for name in self.stage.reads_shipped:
            hashes[f"data/{name}"] = {file: sha256_of(path) for file, path in self.data.files(name).items()}
        if files := tuple(self.stage.files(self.settings)):
            hashes["files"] = hashes_of_named(files, self.scene.name, self.data)
        return hashes

    def _hash_of_captures(self) -> dict[str, int | str]:
        captures = self.data.captures(self.scene.name)
        self.captures_state = state_of_files(_walk(captures))
        made = read_json(self.data.run(self.profile, self.scene.name, self.stage.name) / MANIFEST)
        known = made.get("inputs", {}).get("captures")
        if self.captures_state and made.get("captures_state") == self.captures_state and isinstance(known, dict):
            return known
        # Not links to nothing, or to themselves.
        hashes = hash_files(captures, (path for path in capture_files(captures) if path.is_file()))
        if not hashes:
            raise no_captures(self.scene.name, captures, self.profile)
        return {"files": len(hashes), "sha256": hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()}

    @cached_property
    def sources(self) -> list[tuple[str, str, Path]]:
        """Scene, stage and folder of every artefact that is read."""
        stages = (*self.stage.needs, *self.stage.wants)
        named = [(leaf, stage) for leaf in self.data.leaves(self.scene) for stage in stages]
        if self.scene.is_group:
            for group in (*self.scene.members, self.scene.name):
                config = self.data.scene(group)[0]
                if config.is_group:
                    named += [(group, stage) for stage in stages if stage in config.stages]
        found = [(scene, stage, self.data.run(self.profile, scene, stage)) for scene, stage in named]
        return [
            (scene, stage, folder)
            for scene, stage, folder in found
            if stage in self.stage.needs or ((folder / MANIFEST).is_file() and not self._replaced_input(scene, stage))
        ]

    def _replaced_input(self, scene: str, stage: str) -> Replaced | None:
        def manifest_of(scene: str, stage: str) -> dict[str, Any]:
            return read_json(self.data.run(self.profile, scene, stage) / MANIFEST)

        return replaced_input(manifest_of, scene, stage)


@contextlib.contextmanager
def held(data: DataRoot, profile: str, scenes: Iterable[str], stages: Iterable[str]) -> Iterator[Callable[[], None]]:
    """Captures of scenes, and the artefacts of stages that are finished, locked against being replaced or removed.

    Yields a function that raises UserError where an artefact isn't any more what it was, as no lock stops other
    programs.
    """
    with contextlib.ExitStack() as locks:
        folders = []
        for scene in dict.fromkeys(scenes):
            if (captures := data.captures(scene)).is_dir():
                locks.enter_context(locked(captures, shared=True))
            for folder in (data.run(profile, scene, stage) for stage in stages):
                if (folder / MANIFEST).is_file():
                    locks.enter_context(locked(folder, shared=True))
                    folders.append(folder)
        outputs = {folder: load_verified(folder)["outputs"] for folder in folders}

        def refuse_changed() -> None:
            for folder in folders:
                if load_verified(folder)["outputs"] != outputs[folder]:
                    raise UserError(
                        f"artefact {folder.name} changed while it was read",
                        where=folder,
                        do="wait until nothing writes there, then run the same command again",
                    )

        yield refuse_changed


def hashes_of_named(files: Iterable[str], scene: str, data: DataRoot) -> dict[str, str]:
    """sha256 of the files that a scene's settings name, relative to the data folder; UserError where one can't be
    read."""
    hashes = {}
    for name in files:
        try:
            hashes[name] = sha256_of(data.root / name)
        except OSError as error:
            raise UserError(
                f"a file that the settings of scene {scene} name can't be read",
                where=data.root / name,
                found=error.strerror,
                do="put it there, or correct its path, which is relative to the data folder",
            ) from None
    return hashes


def no_captures(scene: str, captures: Path, profile: str) -> UserError:
    """The error for a scene without a file that import may read."""
    found, do = "nothing", link_command(captures, profile)
    others = f"; or correct the scene's name: {groundwalk_command()} scenes lists those that there are"
    if links := sorted(path.name for path in captures.glob("*") if path.is_symlink() and path.is_dir()):
        found = f"links to folders, which import doesn't follow: {', '.join(links)}"
        do = f"copy what they point to there; or move this folder away and link one that holds it: {do}"
        others = ""
    what, expected = f"scene {scene} has no captures", "a folder of phone captures"
    return UserError(what, where=captures, expected=expected, found=found, do=do + others)


def capture_files(captures: Path) -> list[Path]:
    """The files of a capture folder that import may read: not those which hold the simulator's truth or notes."""
    return [*map(Path, _walk(captures))]


def has_capture_files(captures: Path) -> bool:
    """Whether there are any `capture_files`."""
    return any(True for _ in _walk(captures))


def _walk(captures: Path) -> Iterator[str]:
    for base, folders, names in os.walk(captures, followlinks=False):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        hidden = TRUTH_FILES if Path(base) == captures else ()
        yield from (f"{base}/{name}" for name in sorted(names) if not name.startswith(".") and name not in hidden)
