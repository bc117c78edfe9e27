"""`python -m benchmarks.regressor_errors.fit`: matches the model of regressors' errors to published PN and MS-T.

For each scene and regressor the sizes are fitted to Tables II and III: mean and median errors and the accuracy levels
of the raw predictions, over all frames and over the frames that the paper's rule replaced, and the share of frames that
passed its check of consecutive pairs. The paper's fused rows play no part; they are for checking the model
(`python -m benchmarks.fusion`).
"""

from dataclasses import MISSING, Field, dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.pose_walks import pose_walks
from benchmarks.regressor_errors.model import FIT_FILE, AprModel, StandardErrors, apr_errors, apr_seeds, standard_errors
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import ACCURACY_LEVELS, step_lengths
from groundwalk.simulation.scenes import NAMES
from groundwalk.store.cli import new_app
from groundwalk.store.progress import track
from groundwalk.store.settings import SHIPPED_DATA

REGRESSORS = ("PN", "MS-T")
_STEP = 0.1  # of the fit's numbers, to see which way is better
PAIR_M, PAIR_DEG = 0.4, 4.0  # the paper's d_th and o_th

_LEVEL_COLUMNS = ["high_pct_0.25m_2deg", "medium_pct_0.5m_5deg", "low_pct_5m_10deg"]
_HEADER = (
    "# Written by `python -m benchmarks.regressor_errors.fit`: regressors' errors for\n"
    "# benchmarks/regressor_errors/model.py, matched to published tables. Nothing here was measured.\n"
)
_FITTED = [f for f in fields(AprModel) if f.default is MISSING]
# Where the search begins; sizes begin at the published medians, and lengths short and long.
_START = {
    "position_spread": 0.8,
    "rotation_spread": 0.8,
    "spread_correlation": 0.5,
    "position_noise": 0.12,
    "rotation_noise": 0.12,
    "tail": 3.0,
}
_BOUNDS = {"bias_length_deg": (15.0, 120.0), "tail": (2.05, 20.0)}
# A bias that is the same all over the map is no error of a regressor: training would have removed it.
_LONGEST_BIAS = 0.2  # of the extent of the walks
_MEDIAN_M, _MEDIAN_DEG = 1.3, 1.1  # median length of an error vector with axes of spread 1


@dataclass(frozen=True, eq=False)
class Figures:
    """The published kind of figures: mean and median in metres, then in degrees, then three levels in percent, over all
    frames and over the frames that fail the pair check; and the share in percent that passes it."""

    every: Array
    failing: Array
    passing_pct: float

    def residuals(self, target: "Figures") -> Array:
        """How far these are from `target`, in units of what is near enough: 10 % of an error, 3 points of a level,
        1 point of the share; half as strict over the failing frames."""
        off = []
        for ours, theirs, near in ((self.every, target.every, 1.0), (self.failing, target.failing, 2.0)):
            off.append(np.log(np.maximum(ours[:4], 1e-3) / theirs[:4]) / (0.1 * near))
            off.append((ours[4:] - theirs[4:]) / (3.0 * near))
        return np.append(np.concatenate(off), self.passing_pct - target.passing_pct)


def published(scene: str, regressor: str, folder: Path = SHIPPED_DATA / "published") -> Figures:
    """A regressor's figures in Tables II and III."""
    errors = pd.read_csv(folder / "table2_pose_errors.csv").set_index(["scene", "subset", "method", "statistic"])
    levels = pd.read_csv(folder / "table3_accuracy_levels.csv").set_index(["scene", "subset", "method"])

    def row(subset: str) -> Array:
        sizes = [
            errors.loc[(scene, subset, regressor, s), ["translation_m", "rotation_deg"]] for s in ("mean", "median")
        ]
        return np.array([*np.transpose(sizes).ravel(), *levels.loc[(scene, subset, regressor), _LEVEL_COLUMNS]], float)

    shares = levels["frames_pct"].astype(float)
    reliable, replaced = (shares[scene, subset, f"{regressor}+VIO"] for subset in ("rp", "opt"))
    return Figures(row("rp+opt"), row("opt"), 100 * reliable / (reliable + replaced))


class Walks:
    """A scene's test walks with several draws of a regressor's errors."""

    def __init__(self, scene: str, regressor: str, draws: int) -> None:
        walks = pose_walks(scene)
        self.extent_m = float(np.linalg.norm(np.ptp(np.concatenate([w.map_T_cam[:, :3, 3] for w in walks]), axis=0)))
        self._truths = [(w.map_T_cam, *step_lengths(w.map_T_cam)) for w in walks] * draws
        self._seeds = [apr_seeds(scene, regressor, draw, w.name) for draw in range(draws) for w in walks]
        self._drawn: tuple[tuple[float, ...], list[StandardErrors]] = ((), [])

    def figures(self, model: AprModel) -> Figures:
        """The figures of errors of these sizes."""
        position_m, rotation_deg, passing = [], [], []
        for (truth, true_m, true_deg), standard in zip(self._truths, self._standard(model), strict=True):
            position, rotation = apr_errors(standard, model)
            steps = np.linalg.norm(np.diff(truth[:, :3, 3] + position, axis=0), axis=1)
            predicted = Rotation.from_rotvec(rotation) * Rotation.from_matrix(truth[:, :3, :3])
            turns = np.degrees((predicted[:-1].inv() * predicted[1:]).magnitude())
            position_m.append(np.linalg.norm(position, axis=1))
            rotation_deg.append(np.degrees(np.linalg.norm(rotation, axis=1)))
            alike = (np.abs(steps - true_m) <= PAIR_M) & (np.abs(turns - true_deg) <= PAIR_DEG)
            passing.append(np.append(False, alike))
        p, a, ok = (np.concatenate(part) for part in (position_m, rotation_deg, passing))
        return Figures(_row(p, a), _row(p[~ok], a[~ok]), 100 * float(ok.mean()))

    def _standard(self, model: AprModel) -> list[StandardErrors]:
        """The draws, made again only where a model changes more than their sizes."""
        key = (model.bias_length_m, model.bias_length_deg, model.tail)
        if self._drawn[0] != key:
            pairs = zip(self._truths, self._seeds, strict=True)
            self._drawn = key, [standard_errors(truth[0], model, *seeds) for truth, seeds in pairs]
        return self._drawn[1]


def _row(position_m: Array, rotation_deg: Array) -> Array:
    levels = [100 * np.mean((position_m <= m) & (rotation_deg <= deg)) for m, deg in ACCURACY_LEVELS.values()]
    sizes = [f(errors) for errors in (position_m, rotation_deg) for f in (np.mean, np.median)]
    return np.array([*sizes, *levels])


def fit(target: Figures, walks: Walks) -> AprModel:
    """The model whose figures over these walks are nearest to the target's."""
    bounds = _BOUNDS | {"bias_length_m": (0.3, _LONGEST_BIAS * walks.extent_m)}
    sizes = {"position_m": target.every[1] / _MEDIAN_M, "rotation_deg": target.every[3] / _MEDIAN_DEG}
    starts = [
        _START | sizes | {"bias_length_m": share * bounds["bias_length_m"][1], "bias_length_deg": deg}
        for share, deg in ((0.4, 45.0), (0.8, 90.0))
    ]

    def limits(f: Field[float]) -> tuple[float, float]:
        return bounds.get(f.name, f.metadata["range"])

    def model(free: Array) -> AprModel:
        return AprModel(**{f.name: _bounded(float(v), *limits(f)) for f, v in zip(_FITTED, free, strict=True)})

    def residuals(free: Array) -> Array:
        return walks.figures(model(free)).residuals(target)

    def slopes(free: Array) -> Array:
        # Counts of frames are no smooth function: a step has to move many of them.
        here = residuals(free)
        return np.stack([(residuals(free + step) - here) / _STEP for step in _STEP * np.eye(len(free))], axis=1)

    firsts = [np.array([_free(start[f.name], *limits(f)) for f in _FITTED]) for start in starts]
    fits = [least_squares(residuals, first, slopes, max_nfev=15) for first in firsts]
    return model(min(fits, key=lambda f: f.cost).x)


def _bounded(free: float, low: float, high: float) -> float:
    """A number within limits from one without."""
    if np.isinf(high):
        return float(np.exp(free))
    return float(low + (high - low) / (1 + np.exp(-free)))


def _free(value: float, low: float, high: float) -> float:
    return float(np.log(value) if np.isinf(high) else np.log((value - low) / (high - value)))


def to_toml(models: dict[tuple[str, str], AprModel]) -> str:
    """The fitted numbers, to three digits."""
    parts = [_HEADER]
    for (scene, regressor), model in models.items():
        parts.append(f"\n[{scene}.{regressor}]\n")
        for f in _FITTED:
            parts.append(f"{f.name} = {getattr(model, f.name):.3g}  # {f.metadata['unit']}: {f.metadata['meaning']}\n")
    return "".join(parts)


def _show(rows: list[tuple[str, str, Figures, Figures]]) -> None:
    """Published figures over the model's."""
    print("scene   regressor frames    source     mean m  median  mean deg  median   high  medium   low %  passing %")
    for scene, regressor, target, ours in rows:
        for frames in ("every", "failing"):
            for source, fits in (("published", target), ("model", ours)):
                numbers = "".join(f"{v:8.2f}" for v in getattr(fits, frames))
                share = f"{fits.passing_pct:9.1f}" if frames == "every" else ""
                print(f"{scene:8}{regressor:10}{frames:10}{source:9}{numbers}{share}")


app = new_app(__doc__ or "")


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="TOML file to write.")] = FIT_FILE,
    draws: Annotated[int, typer.Option(min=1, help="Draws of each regressor that the fit is over.")] = 3,
) -> None:
    """Fit, print the figures beside the published ones, and write the TOML file."""
    models, rows = {}, []
    for scene, regressor in track([(s, r) for s in NAMES for r in REGRESSORS], "fitting"):
        walks, target = Walks(scene, regressor, draws), published(scene, regressor)
        models[scene, regressor] = fit(target, walks)
        rows.append((scene, regressor, target, walks.figures(models[scene, regressor])))
    _show(rows)
    out.write_text(to_toml(models), encoding="utf-8")


if __name__ == "__main__":
    app()
