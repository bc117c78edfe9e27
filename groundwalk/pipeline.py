"""A scene from captures to report: which commands it takes, and running them in order."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from groundwalk.store.child import Report, Task, in_child
from groundwalk.store.errors import UserError
from groundwalk.store.inputs import capture_files, hashes_of_named, no_captures
from groundwalk.store.manifests import MANIFEST
from groundwalk.store.progress import console
from groundwalk.store.settings import STAGES, DataRoot, resolve_settings
from groundwalk.store.signals import Stopped, signals_held
from groundwalk.store.simulated import marker_of


@dataclass(frozen=True)
class Step:
    """One command of a scene: a stage, or `simulate`."""

    command: str
    scene: str


def steps(data: DataRoot, profile: str, scene: str, until: str = STAGES[-1]) -> list[Step]:
    """The commands that make a scene up to the stage `until`, in order; of a group of scenes its members' first.

    Each does nothing where it is up to date. UserError for a profile or stage that there isn't, and for a group of
    scenes that is a member of itself.
    """
    if until not in STAGES:
        raise UserError(f"there is no stage {until!r}", expected=f"one of {', '.join(STAGES)}")
    data.profile(profile)
    config = data.scene(scene)[0]
    wanted = STAGES[: STAGES.index(until) + 1]
    if config.is_group:
        data.leaves(config)
        members = [step for member in config.members for step in steps(data, profile, member, until)]
        return [*dict.fromkeys(members), *(Step(stage, scene) for stage in wanted if stage in config.stages)]
    simulated = config.can_simulate and _may_simulate(data.captures(scene), profile)
    return [Step(command, scene) for command in (*(["simulate"] if simulated else []), *wanted)]


def _may_simulate(captures: Path, profile: str) -> bool:
    """Whether no captures are there but those that were simulated for this profile. Those that were simulated for
    another profile are used as they are, as profiles share captures."""
    marker = marker_of(captures)
    return marker.get("profile") == profile if marker else not capture_files(captures)


def run_steps(commands: list[Step], profile: str, data: DataRoot) -> None:
    """Run the commands, each in a process of its own, so that one stage's libraries and memory aren't the next one's.

    A scene's first stages that are up to date are skipped, found so in one process, as libraries take seconds to load.
    Captures and settings of all commands are checked before the first one runs. Exits with the status of the first
    command that fails, which has said why. UserError where a check fails, and where a signal ended a command.
    """
    checked = False
    for _, group in groupby(commands, key=lambda step: (step.scene, step.command in STAGES)):
        steps_of_scene = list(group)
        current = _count_current(steps_of_scene, profile, data)
        for step in steps_of_scene[:current]:
            console.print(f"{step.command} · {step.scene} · {profile}: up to date")
        left = steps_of_scene[current:]
        if left and not checked:
            task = Task(_check, (commands, profile, data), len(commands))
            in_child("checking settings", Path(os.devnull), "", task)
            checked = True
        _run(left, profile, data)


def _count_current(commands: list[Step], profile: str, data: DataRoot) -> int:
    """How many of the first commands are stages that are up to date."""
    first = commands[0]
    if first.command not in STAGES or not (data.run(profile, first.scene, first.command) / MANIFEST).is_file():
        return 0
    log, text = Path(os.devnull), f"checking what is up to date of {first.scene}"
    try:
        return int(in_child(text, log, "", Task(_first_outdated, (commands, profile, data), len(commands))))
    except UserError:
        return 0


def _first_outdated(report: Report, commands: list[Step], profile: str, data: DataRoot) -> int:
    from groundwalk.cli import stage_of
    from groundwalk.store.stage import is_up_to_date

    for done, step in enumerate(commands):
        report(done)
        try:
            if not is_up_to_date(stage_of(step.command), step.scene, profile, data):
                return done
        except UserError:  # the command itself says why
            return done
    return len(commands)


def _check(report: Report, commands: list[Step], profile: str, data: DataRoot) -> None:
    """UserError where a command lacks captures or files, or has a wrong setting: better now than hours later."""
    from groundwalk.cli import stage_of
    from groundwalk.simulation.settings import SimulateSettings

    for done, step in enumerate(commands):
        report(done)
        captures = data.captures(step.scene)
        if step.command == "simulate":
            resolve_settings(SimulateSettings, step.command, data, profile, step.scene, [])
        elif step.command in STAGES:
            stage = stage_of(step.command)
            settings = resolve_settings(stage.settings, step.command, data, profile, step.scene, [])
            hashes_of_named(stage.files(settings), step.scene, data)
            if stage.reads_captures and Step("simulate", step.scene) not in commands and not capture_files(captures):
                raise no_captures(step.scene, captures, profile)


def _run(commands: list[Step], profile: str, data: DataRoot) -> None:
    for step in commands:
        arguments = ["--scene", step.scene, "--profile", profile, "--data", str(data.root)]
        with signals_held():
            process = subprocess.Popen([sys.executable, "-m", "groundwalk", step.command, *arguments])
        try:
            status = process.wait()
        except Stopped as stopped:
            process.terminate()
            process.wait()
            sys.exit(stopped.exit_code)
        if status < 0:
            raise UserError(
                f"{step.command} of scene {step.scene} was ended by {signal.Signals(-status).name}",
                do="see that enough memory is free (SIGKILL often means that none was), then run the same command "
                "again: it resumes from the last checkpoint",
            )
        if status:
            sys.exit(status)
