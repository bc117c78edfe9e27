"""How repeatable the errors of regressors are from walk to walk: `python -m benchmarks.regressor_errors.repeatability`.

The mean product of the errors of two predictions from nearly the same place, of two walks, over that of one walk: 1
where an error is the same whenever the place is seen again, and 0 where a walk has errors of its own. Published
predictions (`--predictions`, laid out as HR-APR's) beside the simulated regressors, which are to be about as repeatable
(`AprModel.position_repeatability`). Writes docs/results/regressor_repeatability.md.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.spatial.distance import cdist

from benchmarks.fusion_inputs import SIMULATED, Case, simulated_case
from benchmarks.real_predictions import DEVELOPMENT, STRIDES, real_cases
from benchmarks.regressor_errors.fit import REGRESSORS
from benchmarks.results import circumstances, markdown_table
from groundwalk.fusion.methods.error_map import errors_of
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.poses import Array
from groundwalk.simulation.scenes import NAMES
from groundwalk.store.cli import new_app
from groundwalk.store.files import written_aside

app = new_app(__doc__ or "")

_STRIDES = {**STRIDES, "7Scenes": 6}  # five frames a second
_NEAR, _NEAR_DEG = 0.02, 10.0  # of the extent of the walks, and of direction: distances that a weight falls over
_HEAD = ("predictions", "scene", "regressor", "walks", "frames", "position", "yaw")


def repeatability(walks: Sequence[Walk]) -> tuple[int, float, float]:
    """How many frames have a prediction, and the mean product of errors of nearby predictions of two walks over that of
    one walk, in position and in yaw."""
    apr, true = (np.concatenate([getattr(w, name) for w in walks]) for name in ("map_T_cam_apr", "map_T_cam"))
    walk = np.repeat(np.arange(len(walks)), [len(w) for w in walks])
    there = known(apr) & known(true)
    apr, true, walk = apr[there], true[there], walk[there]
    error, _ = errors_of(apr, true)
    near = _nearness(true)
    same = walk[:, None] == walk
    alike = [_bounded(error[:, columns]) for columns in ([1, 2, 3], [0])]
    products = [e @ e.T for e in alike]
    position, yaw = (_mean(p, near * ~same) / _mean(p, near * same) for p in products)
    return len(error), position, yaw


def _nearness(map_T_cam: Array) -> Array:
    """Weights (N, N) of pairs of cameras (N, 4, 4), by how near they are; 0 for a camera and itself."""
    position = map_T_cam[:, :3, 3]
    scale = _NEAR * float(np.linalg.norm(np.ptp(position, axis=0)))
    where = np.hstack([position / scale, map_T_cam[:, :3, 2] / np.radians(_NEAR_DEG)])
    weight = np.exp(-cdist(where, where, "sqeuclidean") / 2)
    np.fill_diagonal(weight, 0.0)
    return np.asarray(weight)


def _bounded(error: Array) -> Array:
    """Errors (N, D) at most 1 long, so that the few gross ones don't stand for all: half as long at the median."""
    length = np.linalg.norm(error, axis=1, keepdims=True)
    return np.asarray(error / (length + np.median(length)))


def _mean(value: Array, weight: Array) -> float:
    return float((weight * value).sum() / weight.sum())


def rows_of(what: str, cases: Sequence[Case]) -> Iterator[tuple[list[str], tuple[float, float]]]:
    """Cells and shares of each case."""
    for case in cases:
        frames, position, yaw = repeatability(case.walks)
        cells = [what, case.scene, case.model, str(len(case.walks)), str(frames), f"{position:.2f}", f"{yaw:.2f}"]
        yield cells, (position, yaw)


@app.command()
def main(
    predictions: Annotated[Path | None, typer.Option(help="Folder of published predictions.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for regressor_repeatability.md.")] = Path("docs/results"),
) -> None:
    """Compare errors within and between walks, and write the page."""
    published = [] if predictions is None else real_cases(predictions, DEVELOPMENT, [0], _STRIDES)
    simulated = [simulated_case(SIMULATED, scene, model, [0]) for scene in NAMES for model in REGRESSORS]
    lines: list[Sequence[str]] = [_HEAD]
    for what, cases in (("published", published), ("simulated", simulated)):
        if not cases:
            continue
        cells, shares = zip(*rows_of(what, cases), strict=True)
        middle = np.nanmedian(np.array(shares), axis=0)
        lines += [*cells, [what, "median", "", "", "", *(f"**{value:.2f}**" for value in middle)]]
    text = f"""# How repeatable regressors' errors are from walk to walk

Written by `python -m benchmarks.regressor_errors.repeatability`; not to be edited. Mean product of the errors of two
predictions from nearly the same place ({100 * _NEAR:g} % of the walks' extent, {_NEAR_DEG:g} degrees), of two walks,
over that of one walk: 1 where errors are the same on each walk, 0 where they are a walk's own. Gross errors count
little more than usual ones. Published: github.com/lck666666/HR-APR, 7-Scenes with five frames a second. Simulated:
test walks of the six scenes, seed 0, with the errors of `benchmarks/regressor_errors`.

{circumstances()}

{markdown_table(lines)}
"""
    out.mkdir(parents=True, exist_ok=True)
    with written_aside(out / "regressor_repeatability.md") as partial_file:
        partial_file.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    app()
