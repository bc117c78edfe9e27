"""Where the repository is that this package lies in."""

import subprocess
from pathlib import Path


def _checkout() -> Path | None:
    root = Path(__file__).resolve().parents[2]
    try:
        lines = (root / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return root if 'name = "groundwalk"' in lines else None


CHECKOUT = _checkout()
"""The repository's folder; None where groundwalk was installed from a wheel."""


def git_revision() -> str:
    """The revision of this checkout, with `-dirty` where it has changes; `unknown` outside one."""
    if CHECKOUT is None:
        return "unknown"
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
