"""The regressors that the paper cites beside PN: `python -m benchmarks.cited_regressors`.

Trains each once, all with PN's settings of the profile but for the same number of epochs, and holds its answers to the
test frames against the ground truth of a finished run (import, sfm, align). What was trained stays in the folder
`work`. Writes docs/results/cited-regressors.md and .csv.
"""

import json
import tomllib
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.regressors import FIGURES, cell, error_figures, trained
from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.fusion.evaluation.evaluate import evaluate
from groundwalk.fusion.files.walks import Inputs
from groundwalk.fusion.settings import FuseSettings
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.schemas import schema
from groundwalk.store.tables import dataset_frames, read_table

app = new_app(__doc__ or "")

MODELS = ("PN", "PN-Bayesian", "CoordiNet", "AD-PoseNet", "MapNet")
GRAPH = "MapNet"
# Megabytes of weights that the paper prints.
PUBLISHED_MB = {"PN": 85}
Figures = dict[str, float]


def settings_of(model: str, profile: str, epochs: int) -> list[str]:
    """PN's section of a shipped profile for the model, with so many epochs."""
    config = tomllib.loads(Path(f"shipped/profiles/{profile}.toml").read_text(encoding="utf-8"))
    section = config["train"]["regressors"]["PN"] | {"epochs": epochs}
    # JSON's numbers and texts are TOML's.
    return [f'models=["{model}"]', *(f"regressors.{model}.{key}={json.dumps(value)}" for key, value in section.items())]


def pose_graph_figures(train: Path, scene: str) -> Figures:
    """Errors of fusion method pose_graph on a trained model's predictions, odometry between them."""
    tables = {}
    for stage, name in (("import", "frames"), ("align", "ground_truth"), ("train", "predictions")):
        tables[name] = read_table(train.parent / stage / f"{name}.parquet", schema(stage, name))
    frames = dataset_frames(tables["frames"])
    model = str(tables["predictions"]["model"].iloc[0])
    inputs = Inputs(scene, frames, tables["ground_truth"], tables["predictions"], frozenset([model]))
    errors = evaluate([inputs], FuseSettings(methods=["pose_graph"])).tables["errors"]
    errors = errors[errors["method"] == "pose_graph"].dropna(subset=["position_m"])
    columns = {"position": "position_m", "rotation": "rotation_deg"}
    return error_figures({name: errors[column].to_numpy(float) for name, column in columns.items()})


def sizes(train: Path) -> Figures:
    """Parameters, bytes and the epoch that was chosen, off the model card."""
    card = read_table(train / "models.parquet", schema("train", "models")).iloc[0]
    return {name: float(card[name]) for name in ("best_epoch", "parameters", "bytes")}


def table(rows: dict[str, Figures]) -> str:
    """A row a case."""
    heads = [*FIGURES, "chosen epoch", "parameters", "bytes"]
    units = FIGURES | {"chosen epoch": "", "parameters": "millions", "bytes": "MB; published"}
    lines = [["case", *(f"{name} ({units[name]})" if units[name] else name for name in heads)]]
    for case, figures in rows.items():
        cells = [cell(np.array([figures[name]] if name in figures else [])) for name in FIGURES]
        of_size = ["-", "-", "-"]
        if "bytes" in figures:
            published = f"{PUBLISHED_MB[case]}" if case in PUBLISHED_MB else "none"
            size = f"{figures['parameters'] / 1e6:.2f}", f"{figures['bytes'] / 2**20:.1f}; {published}"
            of_size = [f"{figures['best_epoch']:.0f}", *size]
        lines.append([case, *cells, *of_size])
    return markdown_table(lines)


def write(out: Path, run: tuple[str, str, int], rows: dict[str, Figures], revisions: dict[str, str]) -> None:
    """cited-regressors.md and .csv. run: scene, profile and epochs. revisions: of the code that trained each."""
    scene, profile, epochs = run
    head = (
        f"Written by `make bench-cited`. Scene {scene}, profile `{profile}`, seed 0: each "
        f"regressor is trained once with PN's settings of the profile, but for {epochs} epochs, fewer than any needs: "
        "rows compare them at equal epochs and say nothing of how good each can become. MapNet's batches have three "
        "frames for each of PN's. Scenes without captures of their own are "
        "simulated. MapNet + PGO is fusion method `pose_graph` on MapNet's predictions, with odometry between them. In "
        "bounds: of the stated covariances, 95 %; the rank correlation is Spearman's of the stated deviation and the "
        "true error. Processor seconds are of the whole stage: reading images, training and predicting. MB are 2^20 "
        "bytes of float32 weights, beside what the paper prints of PN's."
    )
    trained_by = "Trained by revision: " + ", ".join(f"{name} {one}" for name, one in revisions.items()) + "."
    parts = ["# Regressors that the paper cites", head, circumstances(), trained_by, table(rows)]
    figures: list[tuple[object, ...]] = [("case", "epochs", "figure", "value", "unit")]
    for case, of_case in rows.items():
        figures += [(case, epochs, name, f"{value:.6g}", FIGURES.get(name, "")) for name, value in of_case.items()]
    write_page(out, "cited-regressors", parts, figures)


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="data root with a finished run of the scene")] = Path("data"),
    scene: Annotated[str, typer.Option(help="the scene")] = "Church",
    profile: Annotated[str, typer.Option(help="profile of the run")] = "demo",
    models: Annotated[str, typer.Option(help="regressors, separated by commas")] = ",".join(MODELS),
    epochs: Annotated[int, typer.Option(help="epochs of each", min=1)] = 10,
    work: Annotated[Path, typer.Option(help="folder for what is trained")] = Path("build/cited"),
    out: Annotated[Path, typer.Option(help="folder for the page and its table")] = Path("docs/results"),
) -> None:
    """Train, score, and write the table."""
    root, rows, revisions = DataRoot(data), {}, {}
    for model in models.split(","):
        folder = work / f"{model}-{epochs}"
        train = DataRoot(folder).run(profile, scene, "train")
        training = trained(folder, root, scene, profile, 0, settings_of(model, profile, epochs))
        rows[model] = {**training.figures, **sizes(train)}
        revisions[model] = training.revision
        typer.echo(f"{model}: {rows[model]}")
        if model == GRAPH:
            rows[f"{model} + PGO"] = pose_graph_figures(train, scene)
        write(out, (scene, profile, epochs), rows, revisions)


if __name__ == "__main__":
    app()
