"""Published errors on public data sets, ours beside: `python -m benchmarks.datasets`.

Reads shipped/published/datasets.csv and what finished runs of the data sets' scenes predicted for their test frames; a
cell of a scene that hasn't been run is empty. Writes docs/results/datasets.md. `--captures` names a folder with the
scenes as they are unpacked, and runs those first that are there: the same command goes on where it was stopped.
"""

import subprocess
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer

from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import MANIFEST, load_verified
from groundwalk.store.settings import SHIPPED_DATA
from groundwalk.store.tables import poses_of, table_of

app = new_app(__doc__ or "")

PREFIXES = {"7-Scenes": "7scenes", "Cambridge Landmarks": "cambridge"}
_HEAD = """# Public data sets

Written by `python -m benchmarks.datasets`. Median position and rotation errors; published ones from
`shipped/published/datasets.csv`, which names the source and leaves out what we have none for. Ours are of finished
runs, against the data set's own poses and over all test frames that were imported, an unanswered one as infinitely far
off; empty where a scene hasn't been run. [The how-to](../how-to/public-datasets.md) says what differs from the
published protocol. PoseNet's rotations are those of later printings: the first one (ICCV 2015) states about half of
them, 5° indoors, and isn't to be compared with."""


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="data root with runs of the data sets' scenes")] = Path("data"),
    profile: Annotated[str, typer.Option(help="profile of the runs")] = "paper",
    captures: Annotated[
        Path | None, typer.Option(help="folder with chess, KingsCollege, ... in it or a level down: run those first")
    ] = None,
    sequence: Annotated[
        str, typer.Option(help="scene of a single sequence, split in time; run to localise or train")
    ] = "",
    sequence_profile: Annotated[str, typer.Option(help="profile of its run")] = "standard",
    out: Annotated[Path, typer.Option(help="folder for datasets.md")] = Path("docs/results"),
) -> None:
    """Put published errors and ours into one table a data set."""
    published = pd.read_csv(SHIPPED_DATA / "published" / "datasets.csv")
    failed = [] if captures is None else run_scenes(captures, published, DataRoot(data), profile)
    sections = [_HEAD, f"{circumstances()} Profile {profile}."]
    for dataset, rows in published.groupby("dataset", sort=False):
        scenes = [scene for scene in rows["scene"].unique() if scene != "average"]
        ours = {scene: errors_of(DataRoot(data), profile, f"{PREFIXES[str(dataset)]}-{scene}") for scene in scenes}
        sections += [f"## {dataset}", markdown_table(_table(rows, [*scenes, "average"], ours))]
    if sequence:
        sections += _of_sequence(DataRoot(data), sequence_profile, sequence)
    write_page(out, "datasets", sections)
    if failed:
        print(f"failed, as said above: {', '.join(failed)}")
        raise typer.Exit(1)


def run_scenes(captures: Path, published: pd.DataFrame, data: DataRoot, profile: str) -> list[str]:
    """Run the scenes whose folders are there up to train, one after the other; those that failed. UserError where there
    is none."""
    if not captures.is_dir():
        raise UserError("there is no such folder", where=captures)
    folders = {path.name.lower(): path for path in [*captures.glob("*/*/"), *captures.glob("*/")]}
    of_scenes = published.loc[published["scene"] != "average", ["dataset", "scene"]].drop_duplicates()
    there = [(f"{PREFIXES[d]}-{s}", folders[s.lower()]) for d, s in of_scenes.to_numpy() if s.lower() in folders]
    if not there:
        names = ", ".join(of_scenes["scene"])
        raise UserError("no scene of a public data set is there", where=captures, expected=f"folders named {names}")
    failed = []
    for scene, folder in there:
        print(f"{scene}: {folder}", flush=True)
        options = ["--scene", scene, "--captures", folder, "--profile", profile, "--data", data.root]
        options += ["--until", "train"]
        if subprocess.run([sys.executable, "-P", "-m", "groundwalk", "run", *map(str, options)]).returncode:
            failed.append(scene)
    return failed


def _of_sequence(data: DataRoot, profile: str, scene: str) -> list[str]:
    """What structure localisers, and regressors where they were trained, say of the last part of a sequence by the
    rest of it."""
    stages = ["import", "align", "localise"]
    if (data.run(profile, scene, "train") / MANIFEST).is_file():
        stages.append("train")
    run = data.run(profile, scene)
    for stage in stages:
        load_verified(run / stage)
    frames = table_of(run, "import", "frames")
    truth = table_of(run, "align", "ground_truth").set_index("frame_id")
    own = table_of(run, "import", "reference").set_index("frame_id")
    predictions = pd.concat(table_of(run, stage, "predictions") for stage in stages[2:])
    tested = predictions[predictions["split"] == "test"]
    rows = [
        ["localiser", "test frames", "refused", "against our ground truth, median", "worst", "against its own poses"]
    ]
    for model, of_model in tested.groupby("model"):
        answers = of_model.dropna(subset=["map_cam_tx"])
        judged = answers[truth.loc[answers["frame_id"], "map_cam_tx"].notna().to_numpy()]
        cells = [str(model), str(len(of_model)), str(len(of_model) - len(answers))]
        by_truth = _errors(judged, truth.loc[judged["frame_id"]])
        by_own = _errors(answers, own.loc[answers["frame_id"]])
        medians, worst = by_truth.median(axis=0), by_truth.max(axis=0)
        rows.append([*cells, *(f"{m:.3f} m, {deg:.2f}°" for m, deg in (medians, worst, by_own.median(axis=0)))])
    counts = frames["split"].value_counts()
    classes = truth.loc[frames["frame_id"], "quality"].value_counts()
    return [
        f"## One sequence: {scene}",
        f"Measured. Profile {profile}; {len(frames)} frames, split in time: the first "
        f"{counts['train'] + counts['val']} make the map, as far as they have ground truth, and the last "
        f"{counts['test']} test. Not the published protocol, which tests on other sequences: what is tested here was "
        "filmed seconds after what made the map, and our ground truth adjusts all frames together. By it there are "
        f"{', '.join(f'{n} frames of class {name}' for name, n in classes.items())} (none: no ground truth); the last "
        "column compares with the data set's poses, those of its depth camera by KinectFusion. [What was "
        "run](../how-to/public-datasets.md#one-sequence).",
        markdown_table(rows),
    ]


def _errors(found: pd.DataFrame, true: pd.DataFrame) -> pd.DataFrame:
    """Position and rotation errors, a row a frame."""
    poses = poses_of(found, "map_cam"), poses_of(true, "map_cam")
    return pd.DataFrame({"m": position_error(*poses), "deg": rotation_error_deg(*poses)})


def errors_of(data: DataRoot, profile: str, scene: str) -> dict[str, tuple[float, float]]:
    """Median position and rotation errors against the data set's own poses on all of the scene's test frames, an image
    without an answer as an infinite one, by regressor and map localiser; {} where it hasn't been run."""
    run = data.run(profile, scene)
    stages = [stage for stage in ("localise", "train") if (run / stage / MANIFEST).is_file()]
    if not stages:
        return {}
    for stage in ("import", *stages):
        load_verified(run / stage)
    reference = table_of(run, "import", "reference").set_index("frame_id")
    errors = {}
    for stage in stages:
        predictions = table_of(run, stage, "predictions")
        for model, rows in predictions[predictions["split"] == "test"].groupby("model"):
            medians = _errors(rows, reference.loc[rows["frame_id"]]).fillna(np.inf).median()
            errors[str(model)] = float(medians["m"]), float(medians["deg"])
    return errors


def _table(paper: pd.DataFrame, scenes: list[str], ours: dict[str, dict[str, tuple[float, float]]]) -> list[list[str]]:
    rows = [["method", *scenes]]
    for method, printed in paper.groupby("method", sort=False):
        errors = printed.set_index("scene")[["median_position_m", "median_rotation_deg"]].dropna()
        by_scene = {str(scene): f"{m:.2f} m, {deg:.3g}°" for scene, m, deg in errors.itertuples()}
        rows.append([f"{method}, published", *(by_scene.get(scene, "") for scene in scenes)])
    for model in sorted({"PN", "MS-T", "Map", "HLoc"} | {model for of_scene in ours.values() for model in of_scene}):
        given = [ours.get(scene, {}).get(model) for scene in scenes]
        rows.append([f"{model}, ours", *("" if e is None else f"{e[0]:.2f} m, {e[1]:.3g}°" for e in given)])
    return rows


if __name__ == "__main__":
    app()
