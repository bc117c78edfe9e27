"""What limits `drift_aware`: `python -m benchmarks.fusion_bound --predictions FOLDER --tables GROUP`.

Walks of published predictions of real regressors (benchmarks/real_predictions.py), and groups of walks as
benchmarks/fusion_tables.py lays them. The method as it is stands beside itself told of its regressor's true errors,
beside later answers, and beside the best rigid alignment of odometry. How often predictions in a row agree on a wrong
heading says how many have to agree before odometry is disbelieved. Writes docs/results/fusion_bound.md.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from benchmarks.fusion_inputs import Case
from benchmarks.real_predictions import DEVELOPMENT, real_cases
from benchmarks.results import circumstances, markdown_table
from groundwalk.fusion.evaluation.fuse import Run, fuse, pose_errors
from groundwalk.fusion.evaluation.leaderboard import RULE, cases_in, within_bounds
from groundwalk.fusion.methods import METHODS, resolve_options
from groundwalk.fusion.methods.drift_aware import DriftAware
from groundwalk.fusion.methods.error_map import ErrorMap
from groundwalk.fusion.methods.error_map import errors_of as errors_in_map
from groundwalk.fusion.methods.estimator.error_covariance import Prior
from groundwalk.fusion.methods.estimator.fit import DIMENSIONS, DOF, Belief
from groundwalk.fusion.methods.localiser import Stepping
from groundwalk.fusion.methods.offline import Offline
from groundwalk.fusion.methods.smoother import Smoother, SmootherOptions
from groundwalk.fusion.methods.vio_oracle import VioOracle
from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import pose_error
from groundwalk.store import UserError
from groundwalk.store.cli import new_app
from groundwalk.store.files import written_aside
from groundwalk.store.progress import track

app = new_app(__doc__ or "")

_CERTAIN = 1e9  # predictions that what is told counts as
_QUANTITIES = ("position", "rotation")
_RIGHT = 0.85, 0.99  # of errors within their 95 % bounds
_LATE_S = 5.0
_IN_A_ROW = (2, 3, 4, 5, 10)
_FAR_DEG, _ALIKE_DEG, _APART_S = 15.0, 10.0, 0.95


class Told(DriftAware):
    """`drift_aware` that is told the covariance (6, 6) of its regressor's errors, in camera axes, and doesn't learn
    it."""

    def __init__(self, covariance: Array, lag_s: float = 0.0) -> None:
        super().__init__(lag_s=lag_s)
        self._usual_sizes = np.sqrt(covariance.diagonal())
        shape = covariance / np.outer(self._usual_sizes, self._usual_sizes)
        self._prior = Prior(shape, _CERTAIN, _CERTAIN, 0.0)
        self._forget()

    @property
    def _belief(self) -> Belief:
        return super()._belief._replace(prior=self._prior)  # without the sizes that show beside odometry's quality


class ToldLate(Smoother):
    """`Told`, answering some seconds late."""

    def __init__(self, covariance: Array, lag_s: float) -> None:
        super().__init__(SmootherOptions(lag_s=lag_s))
        self._covariance = covariance

    def causal(self, lag_s: float) -> DriftAware:
        return Told(self._covariance, lag_s=lag_s)


def errors_of(walks: Sequence[Walk]) -> Array:
    """The predictions' errors (N, 6): rotation (rad) before position (m), in the true cameras' axes."""
    true, predicted = (np.concatenate([getattr(w, of) for w in walks]) for of in ("map_T_cam", "map_T_cam_apr"))
    parts = pose_error(predicted, true).reshape(-1, 2, 3)
    return np.asarray((parts @ true[:, :3, :3]).reshape(-1, 6))


def squared(errors: Array, covariance: Array) -> Array:
    """Squared lengths (N,) of errors (N, 6) in units of a covariance."""
    return np.asarray(np.einsum("ni,in->n", errors, np.linalg.solve(covariance, errors.T)))


def covariance_of(errors: Array) -> Array:
    """The scatter matrix (6, 6) of errors (N, 6) about zero under Student's t, as the method learns it."""
    covariance = np.diag((1.4826 * np.median(np.abs(errors), axis=0)) ** 2)
    for _ in range(100):
        weights = (DOF + DIMENSIONS) / (DOF + squared(errors, covariance))
        covariance = (errors * weights[:, None]).T @ errors / len(errors)
    return covariance


def _other_sequences(case: Case, walk: Walk) -> Told:
    sequence = walk.session_id.split("~")[0]
    return Told(covariance_of(errors_of([w for w in case.walks if w.session_id.split("~")[0] != sequence])))


def _map_of(case: Case, walk: Walk) -> ErrorMap | None:
    return next(m for w, m in zip(case.walks, case.error_maps, strict=True) if w is walk)


Make = Callable[[Case, Walk], Stepping | Offline]
# What each row's method is told, and how it is made for a walk of a case.
ROWS: dict[str, Make] = {
    "1. `drift_aware` as it is": lambda case, walk: DriftAware(None, _map_of(case, walk)),
    "2. told one covariance of this regressor's errors in this scene, in calibration": lambda case, walk: Told(
        covariance_of(errors_of(case.walks))
    ),
    "3. told the covariance of the errors in the scene's other sequences, as of an earlier walk": _other_sequences,
    "4. `smoother`: told the rest of the walk": lambda case, walk: Smoother(None, _map_of(case, walk)),
    "5. `vio_oracle`: odometry laid on the true poses, rigidly": lambda case, walk: VioOracle(),
    f"6. as 1, {_LATE_S:g} s late": lambda case, walk: Smoother(SmootherOptions(lag_s=_LATE_S), _map_of(case, walk)),
    f"7. as 2, {_LATE_S:g} s late": lambda case, walk: ToldLate(covariance_of(errors_of(case.walks)), _LATE_S),
}
_OTHERS = ("window30", "error_state", "pose_graph", "last_good")


def by_id(name: str) -> Make:
    """How a method is made that is told nothing."""
    return lambda case, walk: METHODS[name].localiser(resolve_options(name), None)


class Outcome(NamedTuple):
    """Of position and of rotation, over the past frames of all walks: mean errors (2,), and the shares (2,) within
    the 95 % bounds, NaN for a method without."""

    errors: Array
    inside: Array


def outcome(case: Case, make: Make) -> Outcome:
    """What a method that is made for each of a case's walks has for it."""
    fused = [fuse(Run("", "", case.model), walk, make(case, walk)) for walk in case.walks]
    errors = np.hstack([pose_errors(f.live_map_T_cam, f.walk.map_T_cam) for f in fused])
    inside = np.vstack([within_bounds(f) for f in fused])
    return Outcome(np.nanmean(errors, axis=1), inside.mean(axis=0) if len(inside) else np.full(2, np.nan))


def table(cases: Sequence[Case], what: str) -> list[list[str]]:
    """The rows' mean errors over the paper's rule's and over those of the best of the other causal methods, and in how
    many cases the share within the bounds is what it should be."""
    rule = np.array([outcome(case, by_id(RULE)).errors for case in cases])
    others = np.array([[outcome(case, by_id(name)).errors for case in cases] for name in _OTHERS]).min(axis=0)
    heads = [f"{of} {over}" for over in ("/rule", "worst", "/next best", "worst /next best") for of in _QUANTITIES]
    rows = [["", *heads, *(f"{of} in bounds: cases below, at, above" for of in _QUANTITIES)]]
    for name in track(list(ROWS), what):
        outcomes = [outcome(case, ROWS[name]) for case in cases]
        errors, inside = (np.array(part) for part in zip(*outcomes, strict=True))
        figures = [f for ratio in (errors / rule, errors / others) for f in (_geometric_mean(ratio), ratio.max(axis=0))]
        rows.append([name, *(f"{value:.3f}" for value in np.concatenate(figures)), *map(_counted, inside.T)])
    return rows


def _counted(inside: Array) -> str:
    """How many cases have too small a share within their bounds, the right one, and too large a one."""
    if np.isnan(inside).any():
        return ""
    least, most = _RIGHT
    return f"{(inside < least).sum()}, {((inside >= least) & (inside <= most)).sum()}, {(inside > most).sum()}"


def _geometric_mean(ratio: Array) -> Array:
    return np.asarray(np.exp(np.log(ratio).mean(axis=0)))


def wrong_alike(walks: Sequence[Walk], count: int) -> float:
    """The share, in per cent, of predictions at least _APART_S apart that begin so many in a row whose headings are
    wrong by over _FAR_DEG in the median, and all within _ALIKE_DEG of that."""
    is_wrong: list[bool] = []
    for walk in walks:
        rows: list[int] = []
        for row, t_ns in enumerate(walk.t_ns):
            if not rows or t_ns - walk.t_ns[rows[-1]] >= _APART_S * 1e9:
                rows.append(row)
        yaw = np.degrees(errors_in_map(walk.map_T_cam_apr[rows], walk.map_T_cam[rows])[0][:, 0])
        for start in range(len(yaw) - count + 1):
            part = yaw[start : start + count]
            middle = np.median(part)
            is_wrong.append(bool(abs(middle) > _FAR_DEG and (np.abs(part - middle) < _ALIKE_DEG).all()))
    return 100 * float(np.mean(is_wrong))


@app.command()
def main(
    predictions: Annotated[Path | None, typer.Option(help="Folder of published predictions.")] = None,
    tables: Annotated[
        list[Path] | None, typer.Option(help="Folder of a group of walks, a scene each; may be repeated.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for fusion_bound.md.")] = Path("docs/results"),
    seeds: Annotated[int, typer.Option(min=1, help="Draws of odometry's drift.")] = 3,
) -> None:
    """Run all rows, and write what came out."""
    parts = []
    wrong: list[list[str]] = [["predictions", "walks", *(f"{count} in a row" for count in _IN_A_ROW)]]
    if predictions is not None:
        cases = real_cases(predictions, DEVELOPMENT, range(seeds))
        about = (
            f"Published regressors (github.com/lck666666/HR-APR) in {', '.join(DEVELOPMENT)}; odometry is simulated "
            f"from the true poses with the fitted drift, seeds 0 to {seeds - 1}."
        )
        parts.append(_part("Real predictions", about, cases))
        wrong.append(_wrong_row("real predictions", [w for c in cases for w in c.walks if w.session_id.endswith("~0")]))
    for folder in tables or []:
        cases = [Case("", c.scene, c.model, tuple(c.walks), (c.error_map,) * len(c.walks)) for c in cases_in(folder)[0]]
        models, scenes = (", ".join(dict.fromkeys(getattr(c, of) for c in cases)) for of in ("model", "scene"))
        parts.append(_part(folder.name, f"Simulated scenes; {models} in {scenes}.", cases))
        wrong.append(_wrong_row(folder.name, [w for c in cases for w in c.walks]))
    if not parts:
        raise UserError("there is nothing to measure", expected="--predictions or --tables")
    text = f"""# What limits drift_aware

Written by `python -m benchmarks.fusion_bound`; not to be edited. `/rule` is a mean error over the paper's rule's in the
same scene with the same model, `/next best` over that of the best of {", ".join(_OTHERS)} there; geometric means over
the cases. In bounds: in how many cases fewer than {_RIGHT[0]:.0%} of the errors are within their 95 % bounds, from
these to {_RIGHT[1]:.0%}, and more.

Rows 2, 3, 5 and 7 are told of true errors and rows 4 and 5 answer after the walk, so no causal method can have them.
A covariance is of rotation and position together, in camera axes, under Student's t, and stays as it is told.

{circumstances()}

{"".join(parts)}## Predictions that are wrong alike

Of all predictions a second apart, the share, in per cent, that begin so many in a row whose headings are wrong by over
{_FAR_DEG:g} degrees in the median, and all within {_ALIKE_DEG:g} degrees of that. To a fusion method they look like a
turn of odometry's axes that odometry doesn't report.

{markdown_table(wrong)}
"""
    out.mkdir(parents=True, exist_ok=True)
    with written_aside(out / "fusion_bound.md") as partial_file:
        partial_file.write_text(text, encoding="utf-8")
    print(text)


def _part(title: str, about: str, cases: Sequence[Case]) -> str:
    walks = sum(len(case.walks) for case in cases)
    return f"## {title}\n\n{about} {len(cases)} cases, {walks} walks.\n\n{markdown_table(table(cases, title))}\n\n"


def _wrong_row(what: str, walks: Sequence[Walk]) -> list[str]:
    return [what, str(len(walks)), *(f"{wrong_alike(walks, count):.2f}" for count in _IN_A_ROW)]


if __name__ == "__main__":
    app()
