"""Runs that resume from checkpoints, and start anew where those are damaged."""

import contextlib
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from groundwalk.store import progress
from groundwalk.store.child import ProcessDied
from groundwalk.store.damage import as_user_error, causes, may_be_damage
from groundwalk.store.errors import UserError
from groundwalk.store.files import KEY_FILE, read_json, write_json
from groundwalk.store.signals import Stopped

_RESUMES = "the same command resumes from the last checkpoint"
_FORCED = "with --force the same command starts anew; without it, it resumes, unless the artefact is up to date"


def run_resumable(work: Path, key: str, title: str, force: bool, attempt: Callable[[], None]) -> bool:
    """Call `attempt`, which writes into `work`; returns whether it resumed from a stopped run's checkpoints.

    `work` stays where it was begun with the same key, and is made anew otherwise. Where a resumed attempt fails for a
    reason that neither the user nor the machine caused, the checkpoints are taken for damaged: they are dropped, with a
    line, and the attempt is made once more. An error that the machine caused is raised as UserError.
    """
    if work.is_symlink():
        work.unlink()  # of a run from elsewhere: nothing is written where it leads
    resumed = not force and read_json(work / KEY_FILE).get("key") == key
    again = _FORCED if force else _RESUMES
    progress.console.print(f"{title}{': resuming from its checkpoints' if resumed else ''}", style="bold")
    if resumed:
        try:
            with _what_the_same_command_does(work, again):
                attempt()
            return True
        except Exception as error:
            if not may_be_damage(error):
                raise
            cause = type(error).__name__ + (f": {str(error).splitlines()[0][:200]}" if str(error) else "")
            progress.console.print(f"  the checkpoints are damaged ({cause}): dropped, starting anew")
    with _what_the_same_command_does(work, again):
        shutil.rmtree(work, ignore_errors=True)
        work.mkdir(parents=True)
        write_json(work / KEY_FILE, {"key": key})
        attempt()
    return False


@contextlib.contextmanager
def _what_the_same_command_does(work: Path, again: str) -> Iterator[None]:
    """Said by what ends the block from outside."""
    try:
        yield
    except BaseException as error:
        if isinstance(error, Exception) and (caused_by_machine := as_user_error(error, work)):
            _add(again, caused_by_machine)
            raise caused_by_machine from error
        for cause in causes(error):
            if isinstance(cause, Stopped):
                cause.again = again
        if isinstance(error, ProcessDied):
            _add(again, error)
        raise


def _add(again: str, error: UserError) -> None:
    if advice := error.details["do"]:
        error.details["do"] = f"{advice}; {again}"
