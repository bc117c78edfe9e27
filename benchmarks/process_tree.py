"""Run a command and wait for all that it starts: `python -m benchmarks.process_tree <command>`, with its exit status.

A process that children are forked from outlives the command by a moment and is nobody's child then, so that its seconds
would count nowhere. Here orphans become this process's children (Linux; elsewhere nothing is forked so).
"""

import ctypes
import os
import subprocess
import sys

_PR_SET_CHILD_SUBREAPER = 36


def main(command: list[str]) -> int:
    """The command's exit status, a signal's as a shell gives it, when all its processes have ended."""
    if sys.platform == "linux" and ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_CHILD_SUBREAPER)")
    status = subprocess.call(command)
    try:
        while True:
            os.wait()
    except ChildProcessError:
        return status if status >= 0 else 128 - status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
