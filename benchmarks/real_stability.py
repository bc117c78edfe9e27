"""Whether a capture keeps its verdict when it is resampled: copies with fewer images, other rates, orders and seeds."""

import json
import os
import shutil
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.real_cases import PROFILE, Case, run_stages
from benchmarks.real_figures import PASSED, Finished, Verdict
from groundwalk.store import DataRoot
from groundwalk.store.checkout import git_revision

WHOLE = "whole"
_ALL = ('sampling="all"',)


@dataclass(frozen=True)
class Resampling:
    """A way to look at a capture again: which of a session's n images are kept (None: the folder as it is), import's
    settings, the seed, and whether its files are written in another order."""

    name: str
    keep: Callable[[int], np.ndarray] | None = None
    settings: tuple[str, ...] = ()
    seed: int = 0
    shuffled: bool = False


RESAMPLINGS = (
    Resampling(WHOLE),
    Resampling("every image", settings=_ALL),
    Resampling("every 2nd image", lambda n: np.arange(0, n, 2), _ALL),
    Resampling("every 3rd image", lambda n: np.arange(0, n, 3), _ALL),
    Resampling("first half", lambda n: np.arange(n // 2)),
    Resampling("second half", lambda n: np.arange(n // 2, n)),
    *(Resampling(f"{rate} Hz", settings=(f"rate_hz={rate}", "min_frames=0")) for rate in (1, 2, 5)),
    Resampling("files in another order", np.arange, shuffled=True),
    *(Resampling(f"seed {seed}", seed=seed) for seed in (1, 2)),
)


@dataclass(frozen=True)
class Tried:
    """A resampling of a case and what came of it; `whole` is the outcome of the case as it is."""

    case: str
    resampling: str
    images: int
    verdict: Verdict
    whole: str
    revision: str
    with_ground_truth: int | None = None
    classes: dict[str, int] | None = None

    @property
    def is_whole(self) -> bool:
        """It is what the others are held against."""
        return self.resampling == WHOLE

    @property
    def agrees(self) -> bool:
        """The outcome is the whole's."""
        return self.verdict.outcome == self.whole


def agreeing(stability: Iterable[Tried]) -> tuple[int, int]:
    """How many resamplings have the whole's verdict, of how many."""
    others = [tried for tried in stability if not tried.is_whole]
    return sum(tried.agrees for tried in others), len(others)


def left_out(frames: pd.DataFrame, keep: Callable[[int], np.ndarray]) -> set[str]:
    """The image files (column `image`) that a resampling leaves out, session by session in time."""
    dropped = set[str]()
    for _, rows in frames.groupby("session_id", sort=True):
        images = rows.sort_values("t_ns", kind="stable")["image"].to_numpy(str)
        kept = np.zeros(len(images), bool)
        kept[keep(len(images))] = True
        dropped |= set(images[~kept])
    return dropped


def copy_without(source: Path, target: Path, dropped: set[str], order_seed: int | None) -> None:
    """A capture folder without some files (paths relative to `source`), its files hard links where the disk allows it.
    With a seed, files are written in a random order."""
    paths = sorted(path for path in source.rglob("*") if path.is_file())
    if order_seed is not None:
        paths = [paths[i] for i in np.random.default_rng(order_seed).permutation(len(paths))]
    for path in paths:
        inside = path.relative_to(source)
        if inside.as_posix() in dropped:
            continue
        (target / inside).parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path.resolve(), target / inside)
        except OSError:
            shutil.copyfile(path, target / inside)


def stability_of(case: Case, out: Path) -> list[Tried]:
    """Run every resampling of a case below `out`/<case>, which is emptied."""
    folder = out / case.name
    shutil.rmtree(folder, ignore_errors=True)
    frames = _all_images(case, folder / "images")
    tried = list[Tried]()
    for number, resampling in enumerate(RESAMPLINGS):
        if resampling.keep is not None and frames is None:
            print(f"  {case.name}, {resampling.name}: left out: its images aren't files of the capture folder")
            continue
        tried.append(_try(case, resampling, frames, folder / str(number), tried[0] if tried else None))
        print(f"  {case.name}, {resampling.name}: {tried[-1].verdict}", flush=True)
    return tried


def _all_images(case: Case, folder: Path) -> pd.DataFrame | None:
    """import.frames with every sound image; None where they aren't image files of the capture (a video, an archive)."""
    root = DataRoot(folder)
    root.root.mkdir(parents=True)
    costs, verdict = run_stages(case, root, _ALL, only=("import",))
    if verdict.outcome != PASSED:
        return None
    frames = Finished(case.name, PROFILE, root, folder, costs, verdict).table("import", "frames")
    is_file = [(case.folder / image).is_file() for image in frames["image"]]
    return frames if all(is_file) else None


def _try(case: Case, resampling: Resampling, frames: pd.DataFrame | None, folder: Path, whole: Tried | None) -> Tried:
    root = DataRoot(folder / "data")
    root.root.mkdir(parents=True)
    if resampling.keep is not None and frames is not None:
        copy = folder / "capture"
        copy_without(case.folder.resolve(), copy, left_out(frames, resampling.keep), 0 if resampling.shuffled else None)
        case = replace(case, folder=copy)
    costs, verdict = run_stages(case, root, resampling.settings, resampling.seed)
    run = Finished(case.name, PROFILE, root, folder, costs, verdict)
    align = run.figures("align")
    return Tried(
        case.name,
        resampling.name,
        len(run.table("import", "frames")) if run.has("import") else 0,
        verdict,
        whole.verdict.outcome if whole else verdict.outcome,
        git_revision(),
        int(align["with_ground_truth"]) if align else None,
        {name: int(align[f"quality_{name}"]) for name in "ABC"} if align else None,
    )


def save(tried: list[Tried], path: Path) -> None:
    """Write a case's resamplings as JSON."""
    path.write_text(json.dumps([asdict(one) for one in tried], indent=1), encoding="utf-8")


def load(path: Path) -> list[Tried]:
    """What `save` wrote."""
    rows = json.loads(path.read_text(encoding="utf-8"))
    return [Tried(**{**row, "verdict": Verdict(**row["verdict"])}) for row in rows]
