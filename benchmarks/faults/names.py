"""Names and texts that are paths, commands, options, markup or escape codes, wherever a user may give one."""

import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from numpy.random import Generator

from benchmarks.faults.case import REFUSED, Case, nothing
from benchmarks.faults.sandbox import PROFILE, SCENE, Sandbox, arguments
from groundwalk.cli import stages

NAMES = (
    *("", ".", "..", "../captures", "../../outside", "/etc", "~", "-rf", "--help", "a/b", "a\\b", "a b"),
    *("`touch hacked`", "$(touch hacked)", "$$(touch hacked)", "; touch hacked", "| touch hacked", "&& touch hacked"),
    *("\n touch hacked", "%s%n", "*", "con", "x" * 255, "x" * 5000, "é", "\u202eexe.txt", "\x1b[2J", "\x07"),
    *("<script>alert(1)</script>", "{{7*7}}", "\\input{/etc/passwd}", "{'a': 1}", "NUL", "0"),
)


def _session(folder: Path, _: Generator, name: str) -> str:
    captures = Sandbox(folder).data.captures(SCENE)
    walk = sorted(path for path in captures.iterdir() if path.is_dir())[0]
    walk.rename(captures / name)
    return f"session named {name!r}"


def _device(folder: Path, _: Generator, name: str) -> str:
    captures = Sandbox(folder).data.captures(SCENE)
    for path in list(captures.rglob("info.json")):
        content = json.loads(path.read_text())
        path.unlink()
        path.write_text(json.dumps({**content, "device": name, "title": name}))
    return f"device named {name!r}"


def cases() -> Iterator[Case]:
    """Every name as scene, profile, setting, session and device."""
    commands = [stage.name for stage in stages()]
    for number, name in enumerate(NAMES):
        command = commands[number % len(commands)]
        for what, options in (
            ("scene", ("--scene", name, "--profile", PROFILE)),
            ("profile", ("--scene", SCENE, "--profile", name)),
            ("setting", ("--scene", SCENE, "--profile", PROFILE, "--set", f"{name}=1")),
        ):
            for verb in dict.fromkeys((command, "clean" if what != "setting" else command)):
                call = (verb, *options, "--data", "data")
                yield Case(f"name of a {what}", f"{verb} {name!r:.80}", nothing, call, (REFUSED,))
        if name.strip("./") and "/" not in name and "\x00" not in name and len(name.encode()) <= 255:
            for kind, of_capture in (("name of a session", _session), ("name of a device", _device)):
                spoil, words = partial(of_capture, name=name), f"import {name!r:.80}"
                yield Case(kind, words, spoil, arguments("import"), writes="import", max_memory_bytes=1 << 30)
                yield Case(kind, f"inspect {name!r:.80}", spoil, ("inspect", f"data/captures/{SCENE}"))
