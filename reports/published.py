"""The paper's printed numbers, from shipped/published/, in the shape that our own tables have too."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from groundwalk.store import DataRoot, UserError
from groundwalk.store.settings import SHIPPED_DATA

PUBLISHED = DataRoot(SHIPPED_DATA).files("published")
RAW_METHOD, PAPER_METHOD = "raw", "paper_rule"
"""The ids of the two methods that the paper's tables hold: the raw regressor, and its rule."""
_LEVEL_COLUMNS = {
    "high_pct_0.25m_2deg": "high",
    "medium_pct_0.5m_5deg": "medium",
    "low_pct_5m_10deg": "low",
    "frames_pct": "share",
}
_KEYS = ("subset", "method")
_LEVEL_TEXTS = {f"{printed}_text": f"{name}_text" for printed, name in _LEVEL_COLUMNS.items()}


@dataclass(frozen=True)
class PrintedTables:
    """Tables I to III as printed; numbers are percent, metres and degrees, those with a fraction as text, too
    (`<column>_text`): 87.0 isn't 87.

    dataset: environment, scene, train_images, test_images, extent_m, {hloc,pn,mst}_storage_mb, ..._runtime_ms.
    errors: environment, scene (or "average"), subset, model, method, over, statistic, translation_m, rotation_deg.
    levels: environment, scene, subset, model, method, over, high, medium, low, share.

    `method` is RAW_METHOD or PAPER_METHOD. `over` says which frames a row is over: "subset"
    (the frames of its subset) or "all" (all test frames: the paper's raw columns, but for its "only optimised" block).
    """

    dataset: pd.DataFrame
    errors: pd.DataFrame
    levels: pd.DataFrame


def load_published(files: Mapping[str, Path] = PUBLISHED) -> PrintedTables:
    """The paper's Tables I to III, from files by name. UserError where a file is missing or isn't what it should be."""
    dataset = _read(files, "table1_dataset.csv", "train_images", "test_images", "extent_m")
    errors = _read(files, "table2_pose_errors.csv", *_KEYS, "statistic", "translation_m", "rotation_deg")
    levels = _read(files, "table3_accuracy_levels.csv", *_KEYS, *_LEVEL_COLUMNS)
    levels = levels.rename(columns=_LEVEL_COLUMNS | _LEVEL_TEXTS)
    return PrintedTables(dataset, _split_method(errors), _split_method(levels))


def _read(files: Mapping[str, Path], name: str, *columns: str) -> pd.DataFrame:
    path = files.get(name)
    if path is None:
        raise UserError("a file of published numbers isn't there", where=f"shipped/published/{name}")
    try:
        frame, texts = pd.read_csv(path), pd.read_csv(path, dtype=str)
    except (OSError, ValueError) as error:
        raise UserError("a file of published numbers can't be read", where=path, found=error) from None
    if missing := [c for c in ("environment", "scene", *columns) if c not in frame.columns]:
        raise UserError("a file of published numbers lacks columns", where=path, found=f"no {', '.join(missing)}")
    return frame.assign(**{f"{c}_text": texts[c] for c in frame.select_dtypes("float")})


def _split_method(frame: pd.DataFrame) -> pd.DataFrame:
    fused = frame["method"].str.endswith("+VIO")
    return frame.assign(
        model=frame["method"].str.removesuffix("+VIO"),
        method=fused.map({True: PAPER_METHOD, False: RAW_METHOD}),
        over=(fused | (frame["subset"] == "opt")).map({True: "subset", False: "all"}),
    )
