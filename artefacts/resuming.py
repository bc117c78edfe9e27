"""Runs that resume from checkpoints, and start anew where those are damaged."""

import shutil
from collections.abc import Callable
from pathlib import Path

from groundwalk.artefacts import progress
from groundwalk.artefacts.damage import as_user_error, may_be_damage
from groundwalk.artefacts.files import KEY_FILE, read_json, write_json


def run_resumable(work: Path, key: str, title: str, force: bool, attempt: Callable[[], None]) -> bool:
    """Call `attempt`, which writes into `work`; returns whether it resumed from a stopped run's checkpoints.

    `work` stays where it was begun with the same key, and is made anew otherwise. Where a resumed attempt fails for a
    reason that neither the user nor the machine caused, the checkpoints are taken for damaged: they are dropped, with a
    line, and the attempt is made once more. An error that the machine caused is raised as UserError.
    """
    resumed = not force and read_json(work / KEY_FILE).get("key") == key
    progress.console.print(f"{title}{': resuming from its checkpoints' if resumed else ''}", markup=False, style="bold")
    if resumed:
        try:
            _once(work, attempt)
            return True
        except Exception as error:
            if not may_be_damage(error):
                raise
            cause = (
                f"{type(error).__name__}: {str(error).splitlines()[0][:200]}" if str(error) else type(error).__name__
            )
            progress.console.print(f"  the checkpoints are damaged ({cause}): dropped, starting anew", markup=False)
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    write_json(work / KEY_FILE, {"key": key})
    _once(work, attempt)
    return False


def _once(work: Path, attempt: Callable[[], None]) -> None:
    try:
        attempt()
    except Exception as error:
        if caused_by_machine := as_user_error(error, work):
            raise caused_by_machine from error
        raise
