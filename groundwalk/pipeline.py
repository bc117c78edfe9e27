"""A scene from captures to report: which commands it takes, and running them in order."""

import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass

from groundwalk.cli import stage_of
from groundwalk.simulation.existing import is_up_to_date as captures_are_up_to_date
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store.errors import UserError
from groundwalk.store.files import STOPPED, partial_folder, read_json
from groundwalk.store.hints import simulate_command
from groundwalk.store.inputs import has_capture_files, hashes_of_named, no_captures
from groundwalk.store.manifests import MANIFEST
from groundwalk.store.outdated import is_up_to_date
from groundwalk.store.progress import console
from groundwalk.store.settings import STAGES, DataRoot, resolve_settings
from groundwalk.store.signals import Stopped, signals_held
from groundwalk.store.simulated import marker_of

USER_ERROR = 2  # the exit status of a command that a user can do something about
_REPORT = STAGES[-1]
_SHOWN_AT_ONCE = ("align", "localise", "train")
"""Stages after which the report is written, though more follow: what they found needn't wait for hours of training."""
_DEMO_S = dict(zip(("simulate", *STAGES), (58, 6, 138, 6, 66, 284, 28, 5), strict=True))
"""Seconds of each command of simulated Church in profile demo on two cores, until a run has measured them here."""


@dataclass(frozen=True)
class Step:
    """One command of a scene: a stage, or `simulate`."""

    command: str
    scene: str


class Reported(SystemExit):
    """A stage ended with a message, and the report that was written then says so, too."""


def steps(data: DataRoot, profile: str, scene: str, until: str = STAGES[-1]) -> list[Step]:
    """The commands that make a scene up to the stage `until`, in order, and last a report of what there is; of a group
    of scenes its members' first.

    Each does nothing where it is up to date. UserError for a profile or stage that there isn't, and for a group of
    scenes that is a member of itself.
    """
    if until not in STAGES:
        raise UserError(f"there is no stage {until!r}", expected=f"one of {', '.join(STAGES)}")
    data.profile(profile)
    config = data.scene(scene)[0]
    wanted = (*STAGES[: STAGES.index(until) + 1], *([] if until == _REPORT else [_REPORT]))
    if config.is_group:
        data.leaves(config)
        members = [step for member in config.members for step in steps(data, profile, member, until)]
        return [*dict.fromkeys(members), *(Step(stage, scene) for stage in wanted if stage in config.stages)]
    # Captures that were simulated for another profile are used as they are, as profiles share captures.
    marker = marker_of(data.captures(scene))
    may_simulate = marker.get("profile") == profile if marker else not has_capture_files(data.captures(scene))
    return [Step(name, scene) for name in (*(["simulate"] if config.can_simulate and may_simulate else []), *wanted)]


def run_steps(commands: list[Step], profile: str, data: DataRoot) -> None:
    """Run the commands, each in a process of its own, so that one stage's libraries and memory aren't the next one's;
    those that are up to date are skipped without loading any.

    Captures and settings of all commands are checked before the first one runs. Exits with the status of the first
    command that fails, which has said why. UserError where a check fails, and where a signal ended a command.
    """
    for step in commands:
        check(step, Step("simulate", step.scene) in commands, profile, data)
    for scene in dict.fromkeys(step.scene for step in commands if step.command == STAGES[0]):
        if Step("simulate", scene) not in commands and (note := _of_another_profile(scene, profile, data)):
            console.print(note)
    usual_s: dict[Step, float | None] = {}
    for step in commands:
        last = read_json(data.run(profile, step.scene, step.command) / MANIFEST).get("total_seconds")
        is_demo = profile == "demo" and Step("simulate", step.scene) in commands
        usual_s[step] = last if isinstance(last, float | int) else _DEMO_S[step.command] if is_demo else None
    took_s: dict[Step, float] = {}
    for step, following in zip(commands, [*commands[1:], None], strict=True):
        if is_step_up_to_date(step, profile, data):
            console.print(f"{step.command} · {step.scene} · {profile}: up to date")
            (partial_folder(data.run(profile, step.scene, step.command)) / STOPPED).unlink(missing_ok=True)
            usual_s[step] = 0.0
            continue
        console.print(_how_far(step, usual_s, took_s))
        start, report = time.monotonic(), Step(_REPORT, step.scene)
        status = _run(step, profile, data)
        if status == USER_ERROR and report in commands and step.command in ("sfm", "align"):
            # It says what was refused; the reason lies in a partial folder, which is none of its inputs.
            raise Reported(status) if not _run(report, profile, data, "--force") else SystemExit(status)
        if not status and report in commands and following != report and step.command in _SHOWN_AT_ONCE:
            status = _run(report, profile, data)
        if status:
            sys.exit(status)
        took_s[step] = time.monotonic() - start


def _of_another_profile(scene: str, profile: str, data: DataRoot) -> str:
    """What to say of simulated captures that this profile would have made otherwise; empty where it wouldn't."""
    other = marker_of(data.captures(scene)).get("profile")
    is_simulated = other is not None and data.scene(scene)[0].can_simulate
    if not is_simulated or is_step_up_to_date(Step("simulate", scene), profile, data):
        return ""
    return (
        f"captures · {scene} · {profile}: simulated for profile {other} and used as they are; for those of {profile}, "
        f"which take their place: {simulate_command(data.captures(scene), profile)}"
    )


def _how_far(step: Step, usual_s: Mapping[Step, float | None], took_s: Mapping[Step, float]) -> str:
    """Which stage begins, and how long all that is ahead takes, by how quick those before were this time. `usual_s`:
    what each took the last time, or takes in a demo; None where neither is known."""
    commands = list(usual_s)
    stages = [other for other in commands if other.command != "simulate"]
    text = f"stage {stages.index(step) + 1} of {len(stages)}" if step in stages else "captures first"
    ahead = [usual_s[other] for other in commands[commands.index(step) :]]
    known = [seconds for seconds in ahead if seconds is not None]
    if len(known) < len(ahead):
        return text
    before = sum(usual_s[other] or 0.0 for other in took_s)
    left_s = sum(known) * (sum(took_s.values()) / before if before else 1.0)
    return f"{text} · about {max(1, round(left_s / 60))} min left"


def check(step: Step, is_simulated: bool, profile: str, data: DataRoot) -> None:
    """UserError where a command lacks captures or files, or has a wrong setting: better now than hours later."""
    if step.command == "simulate":
        resolve_settings(SimulateSettings, step.command, data, profile, step.scene)
        return
    stage, captures = stage_of(step.command), data.captures(step.scene)
    settings = resolve_settings(stage.settings, step.command, data, profile, step.scene)
    hashes_of_named(stage.files(settings), step.scene, data)
    if stage.reads_captures and not is_simulated and not has_capture_files(captures):
        raise no_captures(step.scene, captures, profile)


def is_step_up_to_date(step: Step, profile: str, data: DataRoot) -> bool:
    """Whether a command would do nothing; not so where it would fail."""
    try:
        if step.command == "simulate":
            return captures_are_up_to_date(step.scene, profile, data)
        return is_up_to_date(stage_of(step.command), step.scene, profile, data)
    except UserError:  # the command itself says why
        return False


def _run(step: Step, profile: str, data: DataRoot, *more: str) -> int:
    """The exit status of a command in a process of its own; UserError where a signal ended it."""
    arguments = ["--scene", step.scene, "--profile", profile, "--data", str(data.root), *more]
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
    return status
