"""Regressors beside each other: `python -m benchmarks.regressors`.

Trains each regressor alone, on the ground truth of finished runs (import, sfm, align), once a seed, and holds its
answers to the test frames against it: errors, how honest its covariances are, and processor time. What was trained
stays in the folder `work`, so that a run that was stopped goes on. Writes docs/results/regressors.md and .csv; there a
case that isn't trained anew keeps its rows, with their revision.
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from numpy.typing import NDArray
from scipy.stats import spearmanr

from benchmarks.cost import measure
from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.scoring.errors import position_error, rotation_error_deg, within_bounds
from groundwalk.store import DataRoot, UserError
from groundwalk.store.checkout import git_revision
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import MANIFEST
from groundwalk.store.tables import poses_of, table_of

app = new_app(__doc__ or "")

MODELS = ("PN", "MS-T", "PN-Lite")
_NEEDED = ("import", "align")
_DRAWS = 100
FIGURES = {
    "position mean": "m",
    "position median": "m",
    "position p95": "m",
    "rotation mean": "deg",
    "rotation median": "deg",
    "rotation p95": "deg",
    "position in bounds": "%",
    "rotation in bounds": "%",
    "position rank correlation": "",
    "rotation rank correlation": "",
    "position rank correlation, drawn": "",
    "rotation rank correlation, drawn": "",
    "training": "processor s",
}


@dataclass(frozen=True)
class Training:
    """Figures of one training, by name, with the seed and the revision of the code that trained."""

    seed: int
    revision: str
    figures: Mapping[str, float]


# Of each table, the trainings of each of its cases.
Results = dict[str, dict[str, list[Training]]]


def error_figures(errors: Mapping[str, NDArray[np.float64]]) -> dict[str, float]:
    """Mean, median and 95th percentile of errors (N,), by what they are of."""
    figures: dict[str, float] = {}
    for name, error in errors.items():
        figures |= {f"{name} mean": float(error.mean()), f"{name} median": float(np.median(error))}
        figures[f"{name} p95"] = float(np.percentile(error, 95))
    return figures


def errors_and_honesty(predictions: pd.DataFrame, truth: pd.DataFrame) -> dict[str, float]:
    """The figures of a regressor's answers to test frames; those of covariances only where it states them."""
    test = predictions[predictions["split"] == "test"]
    both = test.merge(truth[["frame_id"]], on="frame_id")
    known = truth.set_index("frame_id").loc[both["frame_id"]].reset_index()
    estimated, true = poses_of(both, "map_cam"), poses_of(known, "map_cam")
    usable = np.isfinite(true).all(axis=(1, 2))
    estimated, true = estimated[usable], true[usable]
    errors = {"position": position_error(estimated, true), "rotation": rotation_error_deg(estimated, true)}
    figures = error_figures(errors)
    if both["covariance"].notna().all():
        covariance = np.stack(both["covariance"].tolist()).reshape(-1, 6, 6)[usable]
        inside = 100 * within_bounds(estimated, true, covariance).mean(axis=0)
        figures |= {"position in bounds": float(inside[0]), "rotation in bounds": float(inside[1])}
        for name, block in (("rotation", slice(0, 3)), ("position", slice(3, 6))):
            size = np.trace(covariance[:, block, block], axis1=1, axis2=2)
            figures[f"{name} rank correlation"] = float(spearmanr(size, errors[name])[0])
            figures[f"{name} rank correlation, drawn"] = drawn_rank_correlation(covariance[:, block, block])
    return figures


def drawn_rank_correlation(covariance: NDArray[np.float64]) -> float:
    """Spearman's of sizes of covariances (N, 3, 3) and of sizes of errors that are drawn from them: of covariances that
    are right, however little they differ from frame to frame."""
    rng = np.random.default_rng(0)
    root = np.linalg.cholesky(covariance)
    drawn = np.linalg.norm(np.einsum("nij,dnj->dni", root, rng.normal(size=(_DRAWS, *covariance.shape[:2]))), axis=2)
    size = np.trace(covariance, axis1=1, axis2=2)
    return float(np.mean([spearmanr(size, of_one)[0] for of_one in drawn]))


def trained(work: Path, data: DataRoot, scene: str, profile: str, seed: int, settings: Sequence[str]) -> Training:
    """Train as the settings say in a data folder of its own below `work`, and score the answers."""
    run = DataRoot(work).run(profile, scene)
    run.mkdir(parents=True, exist_ok=True)
    for stage in _NEEDED:
        link(run / stage, data.run(profile, scene, stage))
    (work / "captures").mkdir(exist_ok=True)
    link(work / "captures" / scene, data.captures(scene))
    scores = work / f"{scene}.json"
    if not scores.exists():
        sets = [word for setting in settings for word in ("--set", setting)]
        options = ["--scene", scene, "--profile", profile, "--data", str(work), "--seed", str(seed), *sets]
        cost = measure([sys.executable, "-m", "groundwalk.training", *options], run / "train")
        predictions, truth = table_of(run, "train", "predictions"), table_of(run, "align", "ground_truth")
        figures = errors_and_honesty(predictions, truth) | {"training": cost.cpu_s}
        scores.write_text(json.dumps({"revision": git_revision(), "figures": figures}))
    content = json.loads(scores.read_text())
    return Training(seed, content["revision"], content["figures"])


def link(path: Path, target: Path) -> None:
    """A link to a finished artefact; UserError where there is none."""
    if not target.exists() or (target.name in _NEEDED and not (target / MANIFEST).is_file()):
        raise UserError(
            "a scene has no ground truth yet", where=target, do="run import, sfm and align of the scene first"
        )
    if not path.is_symlink():
        path.symlink_to(target.resolve(), target_is_directory=True)


def table(cases: Mapping[str, Sequence[Training]]) -> str:
    """A row a case: each figure's mean over the seeds, with its range."""
    heads = [name for name in FIGURES if any(name in run.figures for runs in cases.values() for run in runs)]
    units = [f"{name} ({FIGURES[name]})" if FIGURES[name] else name for name in heads]
    lines = [["case", "seeds", *units, "revision"]]
    for case, runs in cases.items():
        cells = [cell(np.array([run.figures[name] for run in runs if name in run.figures])) for name in heads]
        lines.append([case, str(len(runs)), *cells, ", ".join(dict.fromkeys(run.revision for run in runs))])
    return markdown_table(lines)


def cell(values: NDArray[np.float64]) -> str:
    """Mean and range."""
    if not len(values):
        return "-"
    digits = 0 if abs(values.mean()) >= 100 else 1 if abs(values.mean()) >= 10 else 2
    text = f"{values.mean():.{digits}f}"
    return text if len(values) == 1 else f"{text} ({values.min():.{digits}f} to {values.max():.{digits}f})"


def earlier(file: Path) -> Results:
    """The trainings that an earlier regressors.csv has."""
    results: Results = {}
    if file.is_file():
        keys = ["table", "case", "seed", "revision"]
        for key, rows in pd.read_csv(file).groupby(keys, sort=False):
            title, case, seed, revision = map(str, key)
            figures = dict(zip(rows["figure"], rows["value"], strict=True))
            results.setdefault(title, {}).setdefault(case, []).append(Training(int(seed), revision, figures))
    return results


def together(before: Results, now: Results) -> Results:
    """All cases in the standard order: what was trained now, and where a case wasn't, what was trained before."""
    results: Results = {}
    for title in sorted({**now, **before}):
        cases = {**before.get(title, {}), **now.get(title, {})}
        results[title] = {case: cases[case] for case in sorted(cases, key=[*MODELS, *cases].index)}
    return results


def write(out: Path, profile: str, results: Results) -> None:
    """regressors.md and regressors.csv."""
    parts = [
        "# Regressors beside each other",
        "Written by `make bench-regressors`. Each regressor is trained alone, on one processor core, with the settings "
        f"of profile `{profile}`, and asked about the test frames. Scenes without captures of their own are simulated. "
        "Cells are means over the seeds, with their range. In bounds: of the stated covariances, 95 %; the rank "
        "correlation is Spearman's of the stated deviation and the true error; drawn: of errors drawn from the stated "
        "covariances, which is what covariances of these sizes have that are exactly right. Processor seconds are of "
        "the whole stage: reading images, training and predicting. The revision is that of the code that trained the "
        "row; the one below that of the code that wrote the page.",
        circumstances(),
    ]
    rows: list[tuple[object, ...]] = [("table", "case", "seed", "figure", "value", "unit", "revision")]
    for title, cases in results.items():
        parts += [f"## {title}", table(cases)]
        for case, runs in cases.items():
            for run in runs:
                rows += [
                    (title, case, run.seed, name, f"{value:.6g}", FIGURES[name], run.revision)
                    for name, value in run.figures.items()
                ]
    write_page(out, "regressors", parts, rows)


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="data root with finished runs of the scenes")] = Path("data"),
    scenes: Annotated[str, typer.Option(help="scenes, separated by commas")] = "Church,Office",
    profile: Annotated[str, typer.Option(help="profile of the runs")] = "demo",
    models: Annotated[str, typer.Option(help="regressors, separated by commas")] = ",".join(MODELS),
    seeds: Annotated[int, typer.Option(help="trainings of each case", min=1)] = 3,
    work: Annotated[Path, typer.Option(help="folder for what is trained")] = Path("build/regressors"),
    out: Annotated[Path, typer.Option(help="folder for regressors.md and .csv")] = Path("docs/results"),
    train: Annotated[bool, typer.Option(help="train what isn't in the folder of trainings yet")] = True,
) -> None:
    """Train, score, and write the tables."""
    root = DataRoot(data)
    results: Results = {}
    for scene in scenes.split(","):
        for model in models.split(","):
            for seed in range(seeds):
                folder = work / f"{model}-{seed}"
                if not train and not (folder / f"{scene}.json").exists():
                    continue
                folder.mkdir(parents=True, exist_ok=True)
                training = trained(folder, root, scene, profile, seed, [f'models=["{model}"]'])
                results.setdefault(scene, {}).setdefault(model, []).append(training)
                typer.echo(f"{scene}, {model}, seed {seed}: {json.dumps(training.figures)}")
    write(out, profile, together(earlier(out / "regressors.csv"), results))
    typer.echo(f"{out / 'regressors.md'}; load {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    app()
