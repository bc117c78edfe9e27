"""A finished scene that faults are tried on copies of, and commands that run in a process of their own."""

import hashlib
import json
import multiprocessing
import os
import shutil
import sys
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from benchmarks.faults.case import DONE, REFUSED, Case, Outcome, Spoil, differing
from groundwalk.cli import all_commands, app
from groundwalk.store.cores import usable_cores
from groundwalk.store.files import old_folder, partial_folder
from groundwalk.store.manifests import output_hashes
from groundwalk.store.memory import PeakMemory
from groundwalk.store.settings import STAGES, DataRoot

SCENE, PROFILE = "Church", "faults"
SECONDS = 900
# What a pipeline needs to run to its end; its numbers mean nothing.
_PROFILE = """
description = "for faults: the smallest pipeline"
[simulate]
width = 320
train_sessions = 2
test_sessions = 1
frame_fraction = 0.02
texel_m = 0.05
[sfm]
max_features = 1024
retrieval_pairs = 5
[train]
resize = 40
crop = 32
[train.regressors.PN]
epochs = 2
batch = 16
weights = "scratch"
[train.regressors.MS-T]
epochs = 2
batch = 16
weights = "scratch"
layers = 1
"""


@dataclass(frozen=True)
class Sandbox:
    """A folder with `data` and, beside it, files that no command may touch."""

    folder: Path

    @property
    def data(self) -> DataRoot:
        return DataRoot(self.folder / "data")

    def run_of(self, stage: str) -> Path:
        return self.data.run(PROFILE, SCENE, stage)

    def copy_to(self, folder: Path) -> "Sandbox":
        """A copy whose files are hard links, to be replaced and not written into; `rewritable` makes one a file."""
        locks = shutil.ignore_patterns("*.lock")
        shutil.copytree(self.folder, folder, copy_function=os.link, symlinks=True, ignore=locks)
        return Sandbox(folder)

    def state(self) -> dict[str, str]:
        """Every file by its path: its size and inode, which no reading changes; without locks, and without the page of
        all runs, which is made anew whatever a stage's end."""
        names, page = {}, self.data.root / "runs" / "index.html"
        for base, folders, files in os.walk(self.folder):
            for name in (*files, *(f for f in folders if (Path(base) / f).is_symlink())):
                path = Path(base) / name
                if not name.endswith(".lock") and path.with_name(name.removesuffix(".partial")) != page:
                    status = path.lstat()
                    content = path.readlink() if path.is_symlink() else f"{status.st_size} {status.st_ino}"
                    names[path.relative_to(self.folder).as_posix()] = str(content)
        return names


def arguments(stage: str, *more: str) -> tuple[str, ...]:
    """The command that runs a stage in a sandbox."""
    return (stage, "--scene", SCENE, "--profile", PROFILE, "--data", "data", *more)


def stage_case(
    kind: str, name: str, spoil: Spoil, stage: str, exit_codes: tuple[int, ...] = (REFUSED,), **more: Any
) -> Case:
    """A fault that a stage, which is run, meets."""
    return Case(kind, name, spoil, arguments(stage), exit_codes, stage, **more)


def rewritable(path: Path) -> Path:
    """The same file with an inode of its own, to be written into."""
    content = path.read_bytes()
    path.unlink()
    path.write_bytes(content)
    return path


def make_sandbox(folder: Path, commands: Sequence[str] = ("simulate", *STAGES)) -> Sandbox:
    """The undisturbed run; takes minutes where it isn't there yet."""
    sandbox = Sandbox(folder)
    profile = folder / "data" / "profiles" / f"{PROFILE}.toml"
    profile.parent.mkdir(parents=True, exist_ok=True)
    profile.write_text(_PROFILE, encoding="utf-8")
    (folder / "outside").mkdir(exist_ok=True)
    (folder / "outside" / "diary.txt").write_text("nobody's business", encoding="utf-8")
    for command in commands:
        arguments = [command, "--scene", SCENE, "--profile", PROFILE, "--data", str(sandbox.data.root)]
        status, text, _ = run_apart(arguments, folder)
        if status != DONE:
            raise RuntimeError(f"the undisturbed run failed in {command}:\n{text}")
    return sandbox


def run_case(case: Case, base: Sandbox, folder: Path, seed: int) -> Outcome:
    """The case tried on a copy of `base` in `folder`, which is removed again."""
    sandbox = base.copy_to(folder)
    try:
        words = case.spoil(sandbox.folder, np.random.default_rng(seed))
        before = sandbox.state()
        status, text, peak = run_apart([*case.arguments], sandbox.folder, case.before)
        touched = differing(before, sandbox.state())
        outside = [name for name in touched if not name.startswith("data/")]
        changed = [name for name in touched if name not in outside and not _may_change(name, case, status, sandbox)]
        if status == DONE and case.is_same and case.writes:
            changed += unlike(sandbox.run_of(case.writes), base.run_of(case.writes))
        return Outcome(case, words, status, text, peak, changed, outside)
    finally:
        _remove(folder)


def _may_change(name: str, case: Case, status: int, sandbox: Sandbox) -> bool:
    """A stage may write its partial folder, drop its old one, and replace its artefact when it ends well; so may what
    writes a folder."""
    if case.writes is None:
        return False
    final = sandbox.folder / case.writes if "/" in case.writes else sandbox.run_of(case.writes)
    places = [partial_folder(final), old_folder(final), *([final] if status == DONE else [])]
    return any((sandbox.folder / name).is_relative_to(place) for place in places)


def unlike(folder: Path, other: Path) -> list[str]:
    """Outputs of an artefact that aren't those of another run, but for the times that it took."""
    names = differing(output_hashes(folder), output_hashes(other))
    return [f"{folder.name}/{name}, unlike undisturbed" for name in names if not _alike(folder / name, other / name)]


def _alike(table: Path, other: Path) -> bool:
    if table.suffix != ".parquet" or not (table.exists() and other.exists()):
        return False
    untimed = []
    for path in (table, other):
        content = pq.read_table(path)
        untimed.append(content.select([n for n in content.column_names if not n.endswith(("seconds", "_ms"))]))
    # As text, in which NaN is like NaN.
    return repr(untimed[0].to_pydict()) == repr(untimed[1].to_pydict())


def _remove(folder: Path) -> None:
    for base, _, _ in os.walk(folder):
        Path(base).chmod(0o700)
    shutil.rmtree(folder, ignore_errors=True)


def run_apart(arguments: list[str], cwd: Path, before: Callable[[], None] | None = None) -> tuple[int, str, int]:
    """Exit status, all that was printed, and peak memory in bytes of a groundwalk command in a process of its own,
    forked from one that has the libraries loaded."""
    output, memory = cwd.with_name(f"{cwd.name}.output"), cwd.with_name(f"{cwd.name}.memory")
    process = _CONTEXT.Process(target=_command, args=(arguments, cwd, output, memory, before))
    process.start()
    process.join(SECONDS)
    if process.is_alive():
        process.kill()
        process.join()
        text = f"hangs: not done after {SECONDS} s\nTraceback (most recent call last)"
    elif output.exists():
        text = output.read_text(encoding="utf-8", errors="replace")
    else:
        text = f"its process ended before it began: exit code {process.exitcode}"
    peak = json.loads(memory.read_text()) if memory.exists() else 0
    for path in (output, memory):
        path.unlink(missing_ok=True)
    return int(process.exitcode or 0), text, peak


def _command(arguments: list[str], cwd: Path, output: Path, memory: Path, before: Callable[[], None] | None) -> None:
    file = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(file, 1)
    os.dup2(file, 2)
    os.chdir(cwd)
    if before is not None:
        before()
    status = 1
    used = PeakMemory()
    try:
        with used:
            app(arguments)
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        memory.write_text(json.dumps(used.peak_bytes))
        os._exit(status)


def _context() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, *sorted({f"groundwalk.{c.module}" for c in all_commands()})])
    return context


_CONTEXT = _context()


def digest(text: str) -> int:
    """A seed from words, the same in every run."""
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:4], "little")


def workers() -> int:
    """How many cases run side by side."""
    return max(1, usable_cores())
