"""Artefacts that are cut short, emptied, zeroed, flipped in a bit, swapped or gone, before a stage that reads them."""

import json
import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from numpy.random import Generator

from benchmarks.faults.case import DONE, Case
from benchmarks.faults.sandbox import SCENE, Sandbox, rewritable, stage_case
from groundwalk.cli import stages
from groundwalk.store.definition import Stage
from groundwalk.store.manifests import MANIFEST

Damage = Callable[[Path, Generator], None]


def cut(path: Path, rng: Generator) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(rng.integers(0, max(len(content), 1)))])


def empty(path: Path, _: Generator) -> None:
    path.write_bytes(b"")


def zero(path: Path, rng: Generator) -> None:
    content = bytearray(path.read_bytes())
    at = int(rng.integers(0, max(len(content), 1)))
    content[at : at + 4096] = bytes(len(content[at : at + 4096]))
    path.write_bytes(bytes(content) if any(path.read_bytes()[at : at + 4096]) else b"\x01")


def flip(path: Path, rng: Generator) -> None:
    content = bytearray(path.read_bytes())
    if content:
        content[int(rng.integers(len(content)))] ^= 1 << int(rng.integers(8))
    path.write_bytes(content or b"\x01")


def remove(path: Path, _: Generator) -> None:
    path.unlink()


def folder_instead(path: Path, _: Generator) -> None:
    path.unlink()
    path.mkdir()


DAMAGES: tuple[Damage, ...] = (cut, empty, zero, flip, remove, folder_instead)
_OUTSIDE = '{"outputs": {"../../x": "0"}, "simulated": 1}'
_MANIFESTS = ("null", "[]", "{}", '""', "0", "\x00", '{"outputs": null}', _OUTSIDE)


def _damage(folder: Path, rng: Generator, stage: str, name: str, damage: Damage, reader: str) -> str:
    sandbox = Sandbox(folder)
    damage(rewritable(sandbox.run_of(stage) / name), rng)
    shutil.rmtree(sandbox.run_of(reader), ignore_errors=True)
    return f"{damage.__name__} {stage}/{name}"


def _manifest(folder: Path, _: Generator, stage: str, content: str, reader: str) -> str:
    sandbox = Sandbox(folder)
    rewritable(sandbox.run_of(stage) / MANIFEST).write_text(content, encoding="utf-8")
    shutil.rmtree(sandbox.run_of(reader), ignore_errors=True)
    return f"{stage}/{MANIFEST} is {content}"


def readers(stage: str) -> list[Stage]:
    """The stages that read a stage's artefact."""
    return [s for s in stages() if stage in s.needs]


def cases(base: Sandbox) -> Iterator[Case]:
    """Each output of each stage that another one reads, damaged in each way; and manifests that are none."""
    for stage in stages():
        after = readers(stage.name)
        if not after or not (base.run_of(stage.name) / MANIFEST).is_file():
            continue
        listed = json.loads((base.run_of(stage.name) / MANIFEST).read_text())["outputs"]
        for number, name in enumerate(sorted(listed)):
            for kind, damage in enumerate(DAMAGES):
                reader = after[(number + kind) % len(after)].name
                words = f"{stage.name}/{name}, {damage.__name__}, read by {reader}"
                spoil = partial(_damage, stage=stage.name, name=name, damage=damage, reader=reader)
                yield stage_case("artefact damaged", words, spoil, reader)
        for number, content in enumerate(_MANIFESTS):
            reader = after[number % len(after)].name
            spoil = partial(_manifest, stage=stage.name, content=content, reader=reader)
            yield stage_case("manifest damaged", f"{stage.name} {content!r}, read by {reader}", spoil, reader)


def _image(folder: Path, rng: Generator, damage: Damage, reader: str) -> str:
    sandbox = Sandbox(folder)
    images = sorted(sandbox.data.captures(SCENE).rglob("*.jpg"))
    path = images[int(rng.integers(len(images)))]
    damage(rewritable(path), rng)
    shutil.rmtree(sandbox.run_of(reader), ignore_errors=True)
    return f"{damage.__name__} {path.name}"


def image_cases() -> Iterator[Case]:
    """A captured image that has changed since import, before stages that read images with their default settings."""
    for stage in stages():
        if stage.reads_captures or not stage.reads_images(stage.settings()):
            continue
        for damage in DAMAGES:
            spoil = partial(_image, damage=damage, reader=stage.name)
            yield stage_case("image damaged", f"{damage.__name__}, read by {stage.name}", spoil, stage.name)


def _damage_output(folder: Path, rng: Generator, stage: str, damage: Damage) -> str:
    run = Sandbox(folder).run_of(stage)
    listed = sorted(json.loads((run / MANIFEST).read_text())["outputs"])
    name = listed[int(rng.integers(len(listed)))]
    damage(rewritable(run / name), rng)
    return f"{damage.__name__} {stage}/{name}"


def output_cases() -> Iterator[Case]:
    """A stage's own artefact is damaged: the stage notices, and makes the same one again."""
    for number, stage in enumerate(stages()):
        damage = DAMAGES[number % len(DAMAGES)]
        spoil, words = partial(_damage_output, stage=stage.name, damage=damage), f"{stage.name}, {damage.__name__}"
        yield stage_case("own artefact damaged", words, spoil, stage.name, (DONE,), is_same=True)
