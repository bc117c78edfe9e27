"""What stages meet in a folder and on a disk: links where folders belong, errors of every number, closed streams; and
settings of another type. Drawn from the stages and their settings, whatever these are."""

import errno
import os
import pkgutil
import shutil
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_args, get_origin

from numpy.random import Generator

from benchmarks.faults.artefacts import arguments
from benchmarks.faults.case import DONE, REFUSED, Case
from benchmarks.faults.sandbox import Sandbox
from groundwalk.cli import stages
from groundwalk.store.files import old_folder, partial_folder
from groundwalk.store.locks import lock_file

CALLS = (
    "os.open",
    "os.fsync",
    "fcntl.flock",
    "pathlib.Path.rename",
    "pathlib.Path.replace",
    "pathlib.Path.mkdir",
)
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


def _without(folder: Path, _: Generator, stage: str) -> str:
    shutil.rmtree(Sandbox(folder).run_of(stage), ignore_errors=True)
    return f"{stage} isn't there"


def _link(folder: Path, _: Generator, stage: str, place: str, target: str) -> str:
    final = Sandbox(folder).run_of(stage)
    path = _PLACES[place](final)
    shutil.rmtree(final, ignore_errors=True)
    path.symlink_to(folder / target, target_is_directory=True)
    return f"the {place} of {stage} is a link to {target}"


def _plain_type(annotation: Any) -> Any:
    """The one type of a setting whose value is plain; None of others."""
    if get_origin(annotation) in (Union, UnionType):
        others = [one for one in get_args(annotation) if one is not type(None)]
        return _plain_type(others[0]) if len(others) == 1 else None
    return annotation if annotation in _OTHERS else None


def cases() -> Iterator[Case]:
    """Every stage with every link and with each setting of another type; every error, in a stage and a call in turn."""
    numbers = sorted({*errno.errorcode} - _NOT_THE_DISKS)
    all_stages = stages()
    for turn, stage in enumerate(all_stages):
        missing = partial(_without, stage=stage.name)
        for place in _PLACES:
            for target in ("outside", "nowhere"):
                yield Case(
                    "link in place of a folder",
                    f"{stage.name}, {place} → {target}",
                    partial(_link, stage=stage.name, place=place, target=target),
                    arguments(stage.name),
                    (DONE, REFUSED),
                    stage.name,
                )
        for at, number in enumerate(numbers[turn :: len(all_stages)]):
            call = CALLS[at % len(CALLS)]
            words = f"{stage.name}, {errno.errorcode[number]} in {call}"
            before = partial(fail_with, call, number)
            yield Case("error of a disk", words, missing, arguments(stage.name), (REFUSED,), stage.name, before=before)
        yield Case(
            "closed streams", stage.name, missing, arguments(stage.name), (DONE,), stage.name, before=close_streams
        )
        for name, info in stage.settings.model_fields.items():
            for value in _OTHERS.get(_plain_type(info.annotation), ()):
                setting = f"{name}={value}"
                yield Case(
                    "setting of another type",
                    f"{stage.name} {setting}",
                    missing,
                    arguments(stage.name, "--set", setting),
                    (REFUSED,),
                )
