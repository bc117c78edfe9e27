"""Where the repository is that this package lies in."""

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
