"""Visual-localisation datasets from phone captures.

The packages lie at the top of the repository (`sfm/`, `fusion/`, ...) and have one name each, `groundwalk.sfm`,
`groundwalk.fusion`, ...: a wheel puts them into `groundwalk/`, and in a checkout they are found beside it.
"""

from pathlib import Path


def _checkout() -> Path | None:
    root = Path(__file__).resolve().parent.parent
    try:
        lines = (root / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return root if 'name = "groundwalk"' in lines else None


CHECKOUT = _checkout()
"""The repository's folder; None where groundwalk was installed from a wheel."""
if CHECKOUT is not None:
    __path__.append(str(CHECKOUT))
