"""Rerun's viewer, in a window or in a browser.

Of itself Rerun listens on all addresses, and offers the files that it opens to whoever asks. Here it listens on the
loopback address, and reads recordings from a pipe.
"""

import contextlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

from groundwalk.store.errors import UserError
from groundwalk.store.files import RECORDING
from groundwalk.store.hints import run_command
from groundwalk.store.settings import STAGES

_IN_BROWSER = ("--web-viewer", "--web-viewer-port", "0")
# Rerun sends no telemetry where CI is set. It prints warnings, and where its page is.
_ENVIRONMENT = {"CI": "1", "RUST_LOG": "warn,re_sdk::web_viewer=info"}


def view_run(folder: Path, *, web: bool) -> int:
    """Show the recordings of a run's finished stages until the viewer is closed; its exit status. UserError where there
    is none."""
    files = [path for stage in STAGES if (path := folder / stage / RECORDING).is_file()]
    if not files:
        raise UserError("there is no recording to view", where=folder, do=run_command(folder / STAGES[-1]))
    program = Path(sys.executable).with_name("rerun")
    command = [program, "--bind", "127.0.0.1", "--port", "auto", *(_IN_BROWSER if web else ()), "-"]
    with subprocess.Popen(command, env=os.environ | _ENVIRONMENT, stdin=subprocess.PIPE) as rerun:
        assert rerun.stdin is not None
        try:
            with contextlib.suppress(BrokenPipeError), rerun.stdin:  # closed before all was read
                for path in files:
                    with path.open("rb") as file:
                        shutil.copyfileobj(file, rerun.stdin)
            return rerun.wait()
        finally:
            rerun.terminate()
