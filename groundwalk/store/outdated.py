"""Whether a stage has anything to do: what its output depends on, and whether that is what there is."""

import contextlib
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from groundwalk.store.definition import Stage
from groundwalk.store.errors import UserError
from groundwalk.store.files import finish_interrupted_swap, read_json
from groundwalk.store.inputs import Inputs
from groundwalk.store.locks import locked
from groundwalk.store.manifests import MANIFEST, is_whole, listed_files, load_verified
from groundwalk.store.settings import DataRoot, Settings, resolve_settings

S = TypeVar("S", bound=Settings)


@dataclass(frozen=True)
class Prepared(Generic[S]):
    """A stage of a scene that may run: its settings, inputs and folder. `key` is a hash of `parts`, everything that the
    output depends on."""

    settings: S
    inputs: Inputs
    final: Path
    key: str
    parts: dict[str, Any]

    def is_current(self) -> bool:
        """Whether what the stage would make is there, whole."""
        return is_whole(self.final, self.key)


@contextlib.contextmanager
def prepared(
    stage: Stage[S], scene_name: str, profile: str, data: DataRoot, overrides: Sequence[str] = (), seed: int = 0
) -> Iterator[Prepared[S]]:
    """A stage with its inputs and folder held against other runs. UserError where one isn't there, is outdated or held
    by another run, for a setting that doesn't fit, and for a group of scenes that doesn't have the stage."""
    scene = data.scene(scene_name)[0]
    if scene.is_group and stage.name not in scene.stages:
        members = ", ".join(data.leaves(scene))
        raise UserError(
            f"{scene_name} is a group of scenes and has no stage {stage.name}",
            expected=f"one of {', '.join(scene.stages)}, or one of its scenes: {members}",
        )
    settings = resolve_settings(stage.settings, stage.name, data, profile, scene_name, overrides)
    final, inputs = data.run(profile, scene_name, stage.name), Inputs(stage, scene, profile, data, settings)
    with inputs.lock(), locked(final):
        finish_interrupted_swap(final, MANIFEST, listed_files)
        inputs.refuse_outdated()
        parts: dict[str, Any] = {
            "stage": stage.name,
            "version": stage.version,
            "scene": scene.model_dump(mode="json"),
            "profile": profile,
            "settings": settings.model_dump(mode="json"),
            "seed": seed,
            "inputs": inputs.hashes,
            **({"plugins": plugins} if (plugins := dict(stage.plugins(settings))) else {}),
        }
        # What was made by extending an artefact that is gone is current as long as the rest is the same.
        there = read_json(final / MANIFEST)
        if data.before and data.holds:
            parts["extends"] = load_verified(data.before / stage.name)["outputs"]
        elif there.get("key") == _key_of(extended := parts | {"extends": there.get("extends")}):
            parts = extended
        yield Prepared(settings, inputs, final, _key_of(parts), parts)


def _key_of(parts: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def is_up_to_date(stage: Stage[Any], scene: str, profile: str, data: DataRoot) -> bool:
    """Whether `execute` without overrides, seed and force would do nothing. UserError as it raises it."""
    with prepared(stage, scene, profile, data) as job:
        return job.is_current()
