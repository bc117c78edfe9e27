"""The fusion benchmark's walks as tables in a folder, for `python -m benchmarks.leaderboard`.

`python -m benchmarks.fusion_tables OUT` writes simulated walks; with `--predictions FOLDER` also published predictions
of real regressors (benchmarks/real_predictions.py) at each number of frames a second that `--every` names, and with
`--trained FOLDER` predictions of what `python -m benchmarks.regressors` trained there, each seed a scene."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from benchmarks import fusion_inputs as inputs
from benchmarks.fusion_inputs import Case
from benchmarks.real_predictions import DEVELOPMENT, STRIDES, real_cases
from benchmarks.regressor_errors.model import REGRESSORS
from groundwalk.fusion.walk import Walk
from groundwalk.simulation.scenes import NAMES
from groundwalk.store import UserError
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import MANIFEST
from groundwalk.store.tables import pose_frame, table_of

KINDS = (inputs.SIMULATED, *inputs.BAD_ODOMETRY, inputs.KIDNAPPED)
app = new_app(__doc__ or "")


@app.command()
def main(
    out: Annotated[Path, typer.Argument(help="Folder to write; a folder a group of walks in it.")],
    predictions: Annotated[Path | None, typer.Option(help="Folder of published predictions.")] = None,
    published_scenes: Annotated[str, typer.Option(help="Their scenes, joined by commas.")] = ",".join(DEVELOPMENT),
    every: Annotated[str, typer.Option(help="Frames of 7-Scenes that are a second, joined by commas.")] = "30,10",
    trained: Annotated[Path | None, typer.Option(help="Folder of trainings (build/regressors).")] = None,
    models: Annotated[str, typer.Option(help="Regressors trained there, joined by commas.")] = "PN,MS-T",
    kinds: Annotated[str, typer.Option(help="Kinds of simulated walks, joined by commas.")] = ",".join(KINDS),
    seeds: Annotated[int, typer.Option(min=1, help="Draws of odometry's drift for published predictions.")] = 3,
) -> None:
    """Write the tables."""
    lines = []
    if predictions is not None:
        for stride in map(int, every.split(",")):
            group = f"real predictions, 7-Scenes' {stride} frames a second"
            strides = STRIDES | {"7Scenes": stride}
            write_cases(out / group, real_cases(predictions, published_scenes.split(","), range(seeds), strides))
        lines.append(
            f"real predictions: github.com/lck666666/HR-APR, scenes {published_scenes.replace(',', ', ')}; odometry is "
            f"simulated from the true poses with the fitted drift, seeds 0 to {seeds - 1}; the method was tuned on them"
        )
    if trained is not None:
        names = write_trained(out / f"trained {models.replace(',', ' and ')}", trained, models.split(","))
        lines.append(f"trained regressors: in simulated scenes, {', '.join(names)}")
    for kind in filter(None, kinds.split(",")):
        draws = [inputs.simulated_case(kind, scene, model) for scene in NAMES for model in REGRESSORS]
        write_cases(out / kind, draws)
    lines.append(
        "other groups: simulated walks, odometry and predictions (as wrong as the published PN and MS-T), seed 0"
    )
    (out / "about.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_cases(folder: Path, cases: Sequence[Case]) -> None:
    """The three tables of each scene: its models' cases have the same walks."""
    for scene in dict.fromkeys(case.scene for case in cases):
        of_scene = [case for case in cases if case.scene == scene]
        walks = of_scene[0].walks
        frames = [_keys(w).join([pose_frame("vio_cam", w.vio_T_cam), _gravity(w)]) for w in walks]
        truth = [_keys(w).join(pose_frame("map_cam", w.map_T_cam)) for w in walks]
        predicted = [
            _keys(w).join(pose_frame("map_cam", w.map_T_cam_predicted)).assign(model=case.model)
            for case in of_scene
            for w in case.walks
        ]
        place = folder / scene
        place.mkdir(parents=True, exist_ok=True)
        for name, parts in (("frames", frames), ("ground_truth", truth), ("predictions", predicted)):
            pd.concat(parts, ignore_index=True).to_parquet(place / f"{name}.parquet", index=False)


def write_trained(folder: Path, trained: Path, models: Sequence[str]) -> list[str]:
    """The tables of each scene and seed that all of the models were trained with, and their names; UserError where
    there is none."""
    names = []
    for first in sorted(trained.glob(f"{models[0]}-[0-9]*/runs/*/*/train")):
        profile, scene, seed = first.parts[-3], first.parts[-2], first.parts[-5].removeprefix(f"{models[0]}-")
        runs = [trained / f"{model}-{seed}" / "runs" / profile / scene for model in models]
        if not all((run / "train" / MANIFEST).is_file() for run in runs):
            continue
        names.append(f"{scene} seed {seed}")
        place = folder / names[-1]
        place.mkdir(parents=True, exist_ok=True)
        shutil.copy(runs[0] / "import" / "frames.parquet", place)
        shutil.copy(runs[0] / "align" / "ground_truth.parquet", place)
        predicted = [table_of(run, "train", "predictions") for run in runs]
        pd.concat(predicted, ignore_index=True).to_parquet(place / "predictions.parquet", index=False)
    if not names:
        raise UserError("nothing was trained there", where=trained, do="run python -m benchmarks.regressors first")
    return names


def _keys(walk: Walk) -> pd.DataFrame:
    return pd.DataFrame(
        {"frame_id": walk.frame_id, "session_id": walk.session_id, "split": walk.split, "t_ns": walk.t_ns}
    )


def _gravity(walk: Walk) -> pd.DataFrame:
    return pd.DataFrame(walk.gravity, columns=["gravity_x", "gravity_y", "gravity_z"])


if __name__ == "__main__":
    app()
