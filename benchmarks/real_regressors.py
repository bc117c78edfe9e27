"""Regressors on real phone captures: `python -m benchmarks.real_regressors`.

Trains regressors on the ground truth of finished runs (import, sfm, align) of real captures, whose test frames are of a
later time or of another session, and holds their answers to these. Writes docs/results/real_regressors.md.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from numpy.typing import NDArray

from benchmarks.regressors import errors_and_honesty, trained
from benchmarks.results import circumstances, markdown_table
from groundwalk.geometry import Array
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table

app = new_app(__doc__ or "")

# A test frame is near training where a training frame is within both.
NEAR_M, NEAR_DEG = 1.0, 30.0
_SHOWN = {"position mean": "m", "position median": "m", "rotation mean": "deg", "rotation median": "deg"}
_BOUNDS = ("position in bounds", "rotation in bounds")
_HEAD = """# Regressors on real captures

Written by `python -m benchmarks.real_regressors`. Real phone captures, not simulated, through the normal pipeline
(import, sfm, align, train). Test frames are of a later time of the same walk, or of another session, and took no part
in training.

**What differs from published protocols.** Ground truth is our own SfM with VIO's scale, not a second sensor's. There
are tens of training images, not thousands. A walk that is split in time tests where the phone went last; test frames
with a training frame within {near_m:g} m and {near_deg:g} degrees are counted, and their errors given apart. One seed,
profile `{profile}`. In bounds: of the stated covariances, 95 %."""


@app.command()
def main(
    data: Annotated[Path, typer.Option(help="data root with finished runs of the captures")] = Path("data"),
    scenes: Annotated[str, typer.Option(help="captures, separated by commas")] = "corridor,charuco",
    profile: Annotated[str, typer.Option(help="profile of the runs")] = "demo",
    models: Annotated[str, typer.Option(help="regressors, separated by commas")] = "PN-Lite,PN",
    work: Annotated[Path, typer.Option(help="folder for what is trained")] = Path("build/real_regressors"),
    out: Annotated[Path, typer.Option(help="folder for real_regressors.md")] = Path("docs/results"),
) -> None:
    """Train, score, and write the page."""
    sections = [_HEAD.format(near_m=NEAR_M, near_deg=NEAR_DEG, profile=profile), circumstances()]
    for scene in scenes.split(","):
        truth = frames_with_truth(DataRoot(data), profile, scene)
        near = near_training(truth)
        rows = [_row("training pose in the middle", middle_pose(truth), truth, near, None)]
        for model in models.split(","):
            folder = work / model
            folder.mkdir(parents=True, exist_ok=True)
            training = trained(folder, DataRoot(data), scene, profile, 0, [f'models=["{model}"]'])
            answers = read_table(
                DataRoot(folder).run(profile, scene, "train") / "predictions.parquet", schema("train", "predictions")
            )
            rows.append(_row(model, answers, truth, near, training.figures["training"]))
        units = [f"{name} ({unit})" for name, unit in _SHOWN.items()]
        head = ["regressor", *units, *(f"near: {unit}" for unit in units), *_BOUNDS, "training (processor s)"]
        sections += [f"## {scene}", _counts(truth, near), markdown_table([head, *rows])]
    out.mkdir(parents=True, exist_ok=True)
    (out / "real_regressors.md").write_text("\n\n".join(sections) + "\n", encoding="utf-8")


def frames_with_truth(data: DataRoot, profile: str, scene: str) -> pd.DataFrame:
    """import.frames' session, split and time, with the poses of the ground truth, of frames that have one."""
    frames = read_table(data.run(profile, scene, "import") / "frames.parquet", schema("import", "frames"))
    truth = read_table(data.run(profile, scene, "align") / "ground_truth.parquet", schema("align", "ground_truth"))
    known = truth.dropna(subset=["map_cam_tx"])
    poses = [str(column) for column in known if str(column).startswith("map_cam_")]
    return frames[["frame_id", "session_id", "split", "t_ns"]].merge(known[["frame_id", *poses]], on="frame_id")


def near_training(truth: pd.DataFrame) -> "pd.Series[bool]":
    """Of each test frame, by its id: whether a training frame is near."""
    training, tested = (truth[truth["split"] == split] for split in ("train", "test"))
    known = poses_of(training, "map_cam")
    near = []
    for pose in poses_of(tested, "map_cam"):
        same = np.broadcast_to(pose, known.shape)
        near.append(bool(((position_error(same, known) < NEAR_M) & (rotation_error_deg(same, known) < NEAR_DEG)).any()))
    return pd.Series(near, index=tested["frame_id"].to_numpy(), dtype=bool)


def middle_pose(truth: pd.DataFrame) -> pd.DataFrame:
    """What any regressor has to beat: always the pose of the training frame nearest to the mean position."""
    training = truth[truth["split"] == "train"]
    position = poses_of(training, "map_cam")[:, :3, 3]
    middle: int = int(np.linalg.norm(position - position.mean(axis=0), axis=1).argmin())
    columns = [str(column) for column in training if str(column).startswith("map_cam_")]
    tested = truth.loc[truth["split"] == "test", ["frame_id", "split"]]
    pose = {column: float(training[column].iloc[middle]) for column in columns}
    return tested.assign(**pose, covariance=None)


def _row(
    title: str, answers: pd.DataFrame, truth: pd.DataFrame, near: "pd.Series[bool]", seconds: float | None
) -> list[str]:
    of_near = answers[answers["frame_id"].isin(near[near].index)]
    everywhere = errors_and_honesty(answers, truth)
    nearby = errors_and_honesty(of_near, truth) if near.any() else {}
    cells = [_cell(everywhere.get(name)) for name in _SHOWN] + [_cell(nearby.get(name)) for name in _SHOWN]
    return [title, *cells, *(_cell(everywhere.get(name)) for name in _BOUNDS), _cell(seconds)]


def _cell(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"


def _counts(truth: pd.DataFrame, near: "pd.Series[bool]") -> str:
    count = truth["split"].value_counts()
    sessions = {split: ", ".join(sorted(set(rows["session_id"]))) for split, rows in truth.groupby("split")}
    by_time = sessions["train"] == sessions["test"]
    how = (
        f"{sessions['train']}, split by time"
        if by_time
        else f"trained on {sessions['train']}, tested on {sessions['test']}"
    )
    extent = poses_of(truth, "map_cam")[:, :3, 3]
    return (
        f"Real; {how}: {count['train']} frames of training, {count.get('val', 0)} held out, {count['test']} of test, "
        f"{int(near.sum())} of these near training. Cameras spread over {_spread(extent)}."
    )


def _spread(position: Array) -> str:
    sides: NDArray[np.float64] = np.ptp(position, axis=0)
    return " x ".join(f"{side:.2g}" for side in sorted(sides, reverse=True)[:2]) + " m"


if __name__ == "__main__":
    app()
