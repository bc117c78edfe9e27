"""What stages meet in a folder and on a disk: links and mounts where folders belong, errors of every number, closed
streams; settings of another type, paths in tables that lead out, and texts of captures and profiles that are markup,
paths or escape codes. Drawn from the stages, their tables and their settings, whatever these are."""

import errno
import json
import os
import pkgutil
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

import pyarrow as pa
import pyarrow.parquet as pq
from numpy.random import Generator

from benchmarks.faults.artefacts import readers
from benchmarks.faults.case import DONE, REFUSED, Case
from benchmarks.faults.machine import can_mount, mount_at, unmade
from benchmarks.faults.names import NAMES
from benchmarks.faults.sandbox import PROFILE, SCENE, Sandbox, arguments, rewritable, stage_case
from groundwalk.cli import stages
from groundwalk.store.files import old_folder, partial_folder, sha256_of
from groundwalk.store.locks import lock_file
from groundwalk.store.manifests import MANIFEST
from groundwalk.store.schemas import TableSchema, stage_tables
from groundwalk.store.simulated import SIMULATED_MARKER

CALLS = ("os.open", "os.fsync", "fcntl.flock", *(f"pathlib.Path.{name}" for name in ("rename", "replace", "mkdir")))
# Of what a Python program itself does wrong; and the end of a pipe, which ends the program.
_NOT_THE_DISKS = {errno.EPIPE, errno.EAGAIN, errno.EINTR, errno.EINPROGRESS, errno.ECHILD}
_PLACES = {"lock": lock_file, "partial folder": partial_folder, "old folder": old_folder, "folder": lambda final: final}
# What each plain type is not: strict settings take none of these for it.
_OTHERS = {bool: ("1", '"yes"'), int: ("true", '"1"', "1.5"), float: ("true", '"1.0"', "nan"), str: ("1", "true")}


def fail_with(call: str, number: int) -> None:
    """Before a command: a function of the system fails with this error."""
    owner, _, name = call.rpartition(".")

    def fail(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    setattr(pkgutil.resolve_name(owner), name, fail)


def close_streams() -> None:
    """Before a command: standard input and output are closed."""
    os.close(0)
    os.close(1)


def _link(folder: Path, _: Generator, stage: str, place: str, target: str) -> str:
    final = Sandbox(folder).run_of(stage)
    path = _PLACES[place](final)
    shutil.rmtree(final, ignore_errors=True)
    path.symlink_to(folder / target, target_is_directory=True)
    return f"the {place} of {stage} is a link to {target}"


def _mount_place(stage: str, place: str) -> None:
    mount_at(_PLACES[place](Sandbox(Path.cwd()).run_of(stage)))


def _plain_type(annotation: Any) -> Any:
    """The one type of a setting whose value is plain; None of others."""
    if get_origin(annotation) in (Union, UnionType):
        others = [one for one in get_args(annotation) if one is not type(None)]
        return _plain_type(others[0]) if len(others) == 1 else None
    return annotation if annotation in _OTHERS else None


def _path_in_table(folder: Path, _: Generator, table: TableSchema, column: str, path: str, reader: str) -> str:
    """The table as somebody who wrote it on purpose hands it on: the manifest has its hash."""
    sandbox = Sandbox(folder)
    run = sandbox.run_of(table.stage)
    file = rewritable(run / f"{table.name}.parquet")
    content = pq.read_table(file)
    at = content.column_names.index(column)
    values = content[column].to_pylist()
    values[0] = path
    field = content.schema.field(at)
    pq.write_table(content.set_column(at, field, pa.array(values, field.type)), file)
    manifest = json.loads(rewritable(run / MANIFEST).read_text())
    manifest["outputs"][file.name] = sha256_of(file)
    (run / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
    shutil.rmtree(sandbox.run_of(reader), ignore_errors=True)
    return f"{column} of {table.stage}.{table.name} is {path}"


def _paths_in_tables(base: Sandbox) -> Iterator[Case]:
    for stage in stages():
        for table in stage_tables(stage.name):
            file = base.run_of(stage.name) / f"{table.name}.parquet"
            if not file.exists() or not pq.read_metadata(file).num_rows:
                continue
            for column in (c.name for c in table.columns if c.is_path and c.dtype == "string"):
                for number, path in enumerate(("../../outside/diary.txt", "/etc/passwd")):
                    for reader in (one.name for one in readers(stage.name)[number::2]):
                        spoil = partial(_path_in_table, table=table, column=column, path=path, reader=reader)
                        words = f"{table.stage}.{table.name}.{column}, read by {reader}"
                        # A stage that doesn't read this table may end well; nothing outside is written in any case.
                        yield stage_case("path in a table", words, spoil, reader, (DONE, REFUSED))


def _text(folder: Path, _: Generator, file: str, text: str) -> str:
    """`text` wherever the marker of simulated captures, or a profile, has one."""
    path = rewritable(folder / file)
    if path.suffix == ".json":
        path.write_text(json.dumps(_with_text(json.loads(path.read_text()), text)), encoding="utf-8")
    else:
        path.write_text(f"description = {json.dumps(text)}\n{path.read_text().split(chr(10), 2)[2]}", encoding="utf-8")
    return f"texts of {file} are {text!r:.80}"


def _with_text(content: Any, text: str) -> Any:
    if isinstance(content, dict):
        return {key: _with_text(value, text) for key, value in content.items()}
    return [_with_text(value, text) for value in content] if isinstance(content, list) else text


def _texts(base: Sandbox) -> Iterator[Case]:
    # With what each may write.
    commands: tuple[tuple[tuple[str, ...], str | None], ...] = (
        (("scenes", "--data", "data"), None),
        (("inspect", f"data/captures/{SCENE}"), None),
        (arguments("import"), "import"),
        (arguments("clean"), "data/"),
    )
    files = (f"data/captures/{SCENE}/{SIMULATED_MARKER}", f"data/profiles/{PROFILE}.toml")
    for file in (file for file in files if (base.folder / file).exists()):
        for number, text in enumerate(("[/x]", *NAMES)):
            command, writes = commands[number % len(commands)]
            spoil = partial(_text, file=file, text=text)
            words = f"{command[0]}, {Path(file).name}, {text!r:.80}"
            yield Case("text of a capture or profile", words, spoil, command, writes=writes)


def cases(base: Sandbox) -> Iterator[Case]:
    """Every stage with every link and with each setting of another type; every error, in a stage and a call in turn;
    every column that is a path; every text that names are tried with."""
    yield from _paths_in_tables(base)
    yield from _texts(base)
    numbers = sorted({*errno.errorcode} - _NOT_THE_DISKS)
    all_stages = stages()
    for turn, stage in enumerate(all_stages):
        missing = partial(unmade, stage=stage.name)
        for place in _PLACES:
            for target in ("outside", "nowhere"):
                words, link = (
                    f"{stage.name}, {place} → {target}",
                    partial(_link, stage=stage.name, place=place, target=target),
                )
                yield stage_case("link in place of a folder", words, link, stage.name, (DONE, REFUSED))
            if place != "lock" and can_mount():
                before, words = partial(_mount_place, stage.name, place), f"{stage.name}, {place}"
                yield stage_case("mount point", words, missing, stage.name, (DONE, REFUSED), before=before)
        for at, number in enumerate(numbers[turn :: len(all_stages)]):
            call = CALLS[at % len(CALLS)]
            words = f"{stage.name}, {errno.errorcode[number]} in {call}"
            before = partial(fail_with, call, number)
            yield stage_case("error of a disk", words, missing, stage.name, before=before)
        yield stage_case("closed streams", stage.name, missing, stage.name, (DONE,), before=close_streams)
        for name, info in stage.settings.model_fields.items():
            for value in _OTHERS.get(_plain_type(info.annotation), ()):
                words, run = f"{stage.name} {name}={value}", arguments(stage.name, "--set", f"{name}={value}")
                yield Case("setting of another type", words, missing, run, (REFUSED,))
