"""Stages that are stopped at random moments, with damaged checkpoints too, and continued; and two commands at once."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.random import Generator

from benchmarks.faults.artefacts import DAMAGES
from benchmarks.faults.case import DONE, REFUSED, SIGNAL_CODES, Case, Outcome, differing, nothing
from benchmarks.faults.sandbox import SECONDS, Sandbox, arguments, digest, run_apart, unlike
from groundwalk.store.errors import UserError
from groundwalk.store.files import partial_folder
from groundwalk.store.manifests import MANIFEST, load_manifest, load_verified
from groundwalk.store.settings import STAGES

_SIGNALS = ((signal.SIGKILL, True), (signal.SIGTERM, False), (signal.SIGKILL, False), (signal.SIGINT, True))
_START_S = 4.0
HANGS = -99  # the exit status of what didn't end by itself


def _start(sandbox: Sandbox, stage: str, *more: str) -> subprocess.Popen[str]:
    output = (sandbox.folder.with_name(f"{sandbox.folder.name}.{stage}.output")).open("w+")
    return subprocess.Popen(
        [sys.executable, "-m", "groundwalk", *arguments(stage, *more)],
        cwd=sandbox.folder,
        stdout=output,
        stderr=output,
        text=True,
        start_new_session=True,
    )


def _text(sandbox: Sandbox, stage: str) -> str:
    path = sandbox.folder.with_name(f"{sandbox.folder.name}.{stage}.output")
    text = path.read_text(errors="replace")
    path.unlink()
    return text


def _others(sandbox: Sandbox, stage: str) -> dict[str, str]:
    final = sandbox.run_of(stage)
    of_stage = (f"{final.relative_to(sandbox.folder)}/", f"{partial_folder(final).relative_to(sandbox.folder)}/")
    return {name: state for name, state in sandbox.state().items() if not name.startswith(of_stage)}


def _broken(final: Path) -> list[str]:
    """What an artefact that looks finished lacks."""
    if not (final / MANIFEST).is_file():
        return []
    try:
        load_verified(final)
    except UserError as error:
        return [str(error)]
    return []


def stops(base: Sandbox, folder: Path, stage: str, count: int, seed: int) -> Iterator[Outcome]:
    """One outcome a stop of the stage, and one of the run that ends, which is like the undisturbed one."""
    rng = np.random.default_rng([seed, digest(stage)])
    sandbox = base.copy_to(folder)
    final = sandbox.run_of(stage)
    shutil.rmtree(final)
    others = _others(sandbox, stage)
    seconds = sum(load_manifest(base.run_of(stage))["seconds"].values())
    try:
        for number in range(count):
            which, of_group = _SIGNALS[number % len(_SIGNALS)]
            after_rename = number % 5 == 4
            wait = _START_S + rng.uniform(0, seconds)
            process = _start(sandbox, stage)
            moment = "after the rename" if after_rename else f"after {wait:.1f} s"
            _wait(process, final / MANIFEST if after_rename else None, SECONDS if after_rename else wait)
            status = _stop(process, which, of_group)
            words = f"{stage}: {which.name} to {'the group' if of_group else 'the parent'} {moment}"
            case = Case("stopped", words, nothing, (), (DONE, *SIGNAL_CODES), stage)
            changed = differing(others, _others(sandbox, stage)) + _broken(final)
            yield Outcome(case, words, status, _text(sandbox, stage), 0, changed)
            if number % 3 == 2 and not final.exists():
                yield _with_damaged_checkpoint(sandbox, stage, rng)
            if final.exists():
                shutil.rmtree(final)
        case = Case("stopped, then continued", stage, nothing, (), (DONE,), stage)
        status, text, peak = run_apart([*arguments(stage)], sandbox.folder)
        changed = unlike(final, base.run_of(stage)) if status == DONE else []
        yield Outcome(case, "run to its end", status, text, peak, changed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _with_damaged_checkpoint(sandbox: Sandbox, stage: str, rng: Generator) -> Outcome:
    """A file of the partial folder is damaged; the run that follows must get by, or say what is wrong."""
    files = [p for p in sorted(partial_folder(sandbox.run_of(stage)).rglob("*")) if p.is_file() and not p.is_symlink()]
    words = f"{stage}: no checkpoint yet"
    if files:
        path = files[int(rng.integers(len(files)))]
        damage = DAMAGES[int(rng.integers(len(DAMAGES)))]
        damage(path, rng)
        words = f"{stage}: {damage.__name__} {path.name} in its partial folder"
    status, text, peak = run_apart([*arguments(stage)], sandbox.folder)
    case = Case("checkpoint damaged", words, nothing, (), (DONE,), stage)
    return Outcome(case, words, status, text, peak, _broken(sandbox.run_of(stage)))


def _wait(process: subprocess.Popen[str], path: Path | None, seconds: float) -> None:
    end = time.monotonic() + seconds
    while process.poll() is None and time.monotonic() < end and not (path is not None and path.exists()):
        time.sleep(0.002 if path is not None else 0.02)


def _stop(process: subprocess.Popen[str], which: signal.Signals, of_group: bool) -> int:
    if process.poll() is None:
        if of_group:
            os.killpg(process.pid, which)
        else:
            process.send_signal(which)
    try:
        status = process.wait(60)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        return HANGS
    # Children that outlive their parent end, too: they notice, or did what was left.
    for _ in range(200):
        try:
            os.killpg(process.pid, 0)
        except ProcessLookupError:
            return status
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    return HANGS


def pairs(base: Sandbox, folder: Path, first: str) -> Iterator[Outcome]:
    """While a stage is made anew, every stage and `clean` on the same scene: none may disturb what it reads or
    makes."""
    sandbox = base.copy_to(folder)
    try:
        for second in (*STAGES, "clean"):
            shutil.rmtree(partial_folder(sandbox.run_of(first)), ignore_errors=True)
            process = _start(sandbox, first, "--force")
            _wait(process, partial_folder(sandbox.run_of(first)), 60)
            before = _others(sandbox, first)
            status, text, peak = run_apart([*arguments(second)], sandbox.folder)
            words = f"{second} while {first} is made"
            case = Case("two at once", words, nothing, (), (DONE, REFUSED), second)
            ended = process.poll() is not None
            # `clean` may remove all once the stage is done.
            changed = [] if ended and second == "clean" else differing(before, _others(sandbox, first))
            _stop(process, signal.SIGKILL, True)
            said = _text(sandbox, first)
            changed += [f"{first} ended: {said.strip()[-200:]}"] if ended and process.returncode not in (0, 2) else []
            yield Outcome(case, words, status, text, peak, changed)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
