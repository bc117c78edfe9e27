"""How much the paper's rule depends on its thresholds: many settings over the same walks.

`around` changes one threshold at a time, for the sensitivity figure; `grid` has every combination.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import product, repeat
from multiprocessing import get_context
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.fusion.evaluation.fuse import pose_errors
from groundwalk.fusion.evaluation.summary import figures
from groundwalk.fusion.methods.decide import Decisions, RuleWalk
from groundwalk.fusion.methods.localiser import Status
from groundwalk.fusion.methods.mobilearloc import MobileARLocOptions
from groundwalk.fusion.walk import Flags, Walk, known
from groundwalk.geometry.poses import Array

# The paper's values are among them.
VALUES: dict[str, tuple[float, ...]] = {
    "n": (1, 2, 3, 4, 5),
    "d_th_m": (0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2),
    "o_th_deg": (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0),
    "gamma": (0.9, 0.95, 0.98, 0.99, 0.995, 0.999),
}


@dataclass(frozen=True)
class Setting:
    """Options of the rule; `varied` names the threshold that differs from the others, "" where several do."""

    options: MobileARLocOptions
    varied: str = ""


def around(options: MobileARLocOptions, values: dict[str, tuple[float, ...]] = VALUES) -> list[Setting]:
    """One threshold at a time, from the given options."""
    base = options.model_dump()
    return [
        Setting(MobileARLocOptions(**base | {name: value}), name) for name, tried in values.items() for value in tried
    ]


def grid(options: MobileARLocOptions, values: dict[str, tuple[float, ...]] = VALUES) -> list[Setting]:
    """Every combination of the values."""
    base = options.model_dump()
    combinations = (dict(zip(values, chosen, strict=True)) for chosen in product(*values.values()))
    return [Setting(MobileARLocOptions(**base | chosen)) for chosen in combinations]


Walks = Mapping[tuple[str, str], Sequence[Walk]]
"""Walks by scene and model."""


def sweep(walks: Walks, settings: Sequence[Setting], processes: int = 1) -> pd.DataFrame:
    """Table fuse.sweep: the figures of each setting over the walks of each scene and model."""
    if processes == 1:
        return pd.DataFrame([row for key, part in walks.items() for row in _rows(key, part, settings)])
    # The longest first, so that no process is left with one at the end.
    order = sorted(walks, key=lambda key: -sum(len(w) for w in walks[key]))
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        rows = dict(zip(order, pool.map(_rows, order, [walks[k] for k in order], repeat(settings)), strict=True))
    return pd.DataFrame([row for key in walks for row in rows[key]])


def _rows(key: tuple[str, str], walks: Sequence[Walk], settings: Sequence[Setting]) -> list[dict[str, Any]]:
    prepared = [_Prepared(walk) for walk in walks]
    total = sum(int(p.scored.sum()) for p in prepared)
    rows = []
    for setting in settings:
        decisions = [(p, p.rule.decide(setting.options)) for p in prepared]
        name = dict(zip(("scene", "model"), key, strict=True)) | {"varied": setting.varied}
        name |= {threshold: getattr(setting.options, threshold) for threshold in VALUES}
        for subset, position_m, rotation_deg, sure in _subsets(decisions):
            rows.append(name | {"subset": subset} | figures(position_m, rotation_deg, sure, total))
    return rows


class _Prepared:
    """A walk ready for any number of settings: the rule's own preparation, and the errors of predictions."""

    def __init__(self, walk: Walk) -> None:
        self.walk = walk
        self.rule = RuleWalk(walk)
        self.scored = known(walk.map_T_cam)
        self.sure = walk.sure
        self.apr_position_m, self.apr_rotation_deg = pose_errors(walk.map_T_cam_apr, walk.map_T_cam)

    def errors(self, poses: Array, passed: Flags) -> tuple[Array, Array]:
        """Errors (N,) of poses (N, 4, 4), which are predictions where `passed`."""
        position_m, rotation_deg = self.apr_position_m.copy(), self.apr_rotation_deg.copy()
        others = ~passed
        position_m[others], rotation_deg[others] = pose_errors(poses[others], self.walk.map_T_cam[others])
        return position_m, rotation_deg


def _subsets(decisions: Iterable[tuple[_Prepared, Decisions]]) -> Iterator[tuple[str, Array, Array, Flags]]:
    """Subset, errors in metres and in degrees, and whether the ground truth is sure enough for the accuracy levels:
    the paper's rp+opt, and all frames in time."""
    parts: dict[str, list[tuple[Array, Array, Flags]]] = {"rp+opt": [], "all": []}
    for prepared, decided in decisions:
        for subset, status, poses in (
            ("rp+opt", decided.status, decided.map_T_cam),
            ("all", decided.live_status, decided.live_map_T_cam),
        ):
            reliable = status == str(Status.RELIABLE)
            counted = prepared.scored.copy()
            if subset == "rp+opt":
                counted &= reliable | (status == str(Status.OPTIMISED))
            position_m, rotation_deg = prepared.errors(poses, reliable | (status == str(Status.PREDICTED)))
            parts[subset].append((position_m[counted], rotation_deg[counted], prepared.sure[counted]))
    for subset, errors in parts.items():
        position_m, rotation_deg, sure = (np.concatenate(e) for e in zip(*errors, strict=True))
        yield subset, position_m, rotation_deg, sure
