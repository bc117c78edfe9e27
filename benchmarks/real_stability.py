"""Whether a capture keeps its outcome when it is resampled: copies with fewer images, other rates, orders and seeds."""

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.real_figures import Run, run_stages
from benchmarks.results import markdown_table, write_page
from groundwalk.store.checkout import git_revision
from groundwalk.store.files import link_or_copy

_HEADER = """# Real captures, resampled

Written by `make bench-real stability=1` (`python -m benchmarks.real --stability`), not to be edited. Profile demo.
Images are left out of a copy of the capture, its log of poses stays whole; 1, 2 and 5 Hz are import's `rate_hz`, with
`min_frames=0`.
"""
_WHOLE = "whole"
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
    Resampling(_WHOLE),
    Resampling("every image", settings=_ALL),
    Resampling("every 2nd image", lambda n: np.arange(0, n, 2), _ALL),
    Resampling("every 3rd image", lambda n: np.arange(0, n, 3), _ALL),
    Resampling("first half", lambda n: np.arange(n // 2)),
    Resampling("second half", lambda n: np.arange(n // 2, n)),
    *(Resampling(f"{rate} Hz", settings=(f"rate_hz={rate}", "min_frames=0")) for rate in (1, 2, 5)),
    Resampling("files in another order", np.arange, shuffled=True),
    *(Resampling(f"seed {seed}", seed=seed) for seed in (1, 2)),
)


def stability_of(name: str, capture: Path, settings: tuple[str, ...], folder: Path) -> pd.DataFrame:
    """Run every resampling of a capture below `folder`, which is emptied: a row each, and whether its outcome agrees
    with the whole's."""
    shutil.rmtree(folder, ignore_errors=True)
    rows = []
    for number, resampling in enumerate(RESAMPLINGS):
        source, into = capture.resolve(), folder / str(number)
        if resampling.keep is not None:
            source = into / "capture"
            _copy(capture.resolve(), source, resampling.keep, 0 if resampling.shuffled else None)
        run = run_stages(name, source, into, (*settings, *resampling.settings), resampling.seed)
        rows.append({"case": name, "resampling": resampling.name, **_outcome(run), "revision": git_revision()})
        print(f"  {name}, {resampling.name}: {run.outcome}", flush=True)
    table = pd.DataFrame(rows)
    return table.assign(agrees=table["outcome"].str.split().str[0] == table["outcome"].iloc[0].split()[0])


def write_stability(folder: Path, resampled: pd.DataFrame) -> None:
    """Write real-stability.md into the folder."""
    rows = [["case", "resampling", "images", "outcome", "frames with ground truth", "A, B, C", "agrees with the whole"]]
    rows[0].append("revision")
    for row in resampled.to_dict("records"):
        same = "" if row["resampling"] == _WHOLE else "yes" if row["agrees"] else "**no**"
        truth, classes = ("" if pd.isna(row[name]) else row[name] for name in ("with_ground_truth", "classes"))
        truth = truth if truth == "" else f"{truth:.0f}"
        resampling = [row["case"], row["resampling"], str(row["images"])]
        rows.append([*resampling, row["outcome"], truth, classes, same, row["revision"]])
    others = resampled.loc[resampled["resampling"] != _WHOLE, "agrees"]
    share = f"{others.sum()} of {len(others)} resamplings have the whole's outcome; 95 % to reach."
    write_page(folder, "real-stability", [f"{_HEADER}\n{share}", markdown_table(rows)])


def _outcome(run: Run) -> dict[str, object]:
    align = run.manifest("align")["figures"] if run.has("align") else {}
    return {
        "images": len(run.table("import", "frames")) if run.has("import") else 0,
        "outcome": run.outcome,
        "with_ground_truth": align.get("with_ground_truth"),
        "classes": ", ".join(str(align[f"quality_{quality}"]) for quality in "ABC") if align else None,
    }


def _copy(source: Path, target: Path, keep: Callable[[int], np.ndarray], order_seed: int | None) -> None:
    """A capture folder with some of the images of each of its folders, in the order of their names; its files hard
    links where the disk allows it. With a seed, files are written in a random order."""
    paths = sorted(path for path in source.rglob("*") if path.is_file())
    images = pd.DataFrame({"path": [p for p in paths if p.suffix.lower() in (".jpg", ".jpeg", ".png", ".heic")]})
    left_out: set[Path] = set()
    for _, of_folder in images.groupby(images["path"].map(lambda path: str(path.parent)))["path"]:
        left_out |= set(of_folder) - set(of_folder.iloc[keep(len(of_folder))])
    if order_seed is not None:
        paths = [paths[i] for i in np.random.default_rng(order_seed).permutation(len(paths))]
    for path in (path for path in paths if path not in left_out):
        inside = target / path.relative_to(source)
        inside.parent.mkdir(parents=True, exist_ok=True)
        link_or_copy(path.resolve(), inside)
