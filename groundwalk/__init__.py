"""Visual-localisation datasets from phone captures.

`groundwalk.open("Church")` reads a run; docs/reference/python.md describes what it gives.

The stages lie at the top of the repository (`sfm/`, `fusion/`, ...) and are linked here, so that each has one name,
`groundwalk.sfm`, `groundwalk.fusion`, ...; a wheel has them in `groundwalk/` itself.
"""

from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

    from groundwalk.run import Run, pose_array
    from groundwalk.runtime.bundle import open_bundle
    from groundwalk.store.errors import UserError

__all__ = ["Run", "UserError", "open", "open_bundle", "pose_array", "runs"]


def open(scene_or_folder: str | PathLike[str], *, profile: str = "demo", data: str | PathLike[str] = "data") -> "Run":
    """Open what the stages wrote for a scene.

    A str that can be a scene's name is one, in data/runs/<profile>; anything else (a `Path`, "./Church") is a run's
    folder. Its images are looked for in <data>/captures; of a folder <data>/runs/<profile>/<scene> beside it, first.

    Raises UserError for a run that isn't there, that no stage has finished, or a folder that is something else.
    """
    from groundwalk.opening import open_run

    return open_run(scene_or_folder, profile, Path(data))


def runs(data: str | PathLike[str] = "data") -> "pd.DataFrame":
    """The runs below a data folder, one row each: scene, profile, simulated, stages, outdated, verdict, folder."""
    import pandas as pd

    from groundwalk.store.runs import runs_in
    from groundwalk.store.settings import DataRoot

    rows = [
        (*run.name, run.simulated, run.finished, run.outdated, run.verdict.get("verdict"), run.folder)
        for run in runs_in(DataRoot(Path(data)))
    ]
    return pd.DataFrame(rows, columns=["scene", "profile", "simulated", "stages", "outdated", "verdict", "folder"])


_MODULES = {"Run": "run", "UserError": "store.errors", "open_bundle": "runtime.bundle", "pose_array": "run"}


def __getattr__(name: str) -> Any:
    """Each name is loaded when it's asked for, as pandas takes longer to load than most commands take to run."""
    if name == "__version__":
        from importlib.metadata import version

        return version("groundwalk")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
