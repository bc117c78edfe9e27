"""What a model exporter is given: a trained regressor with the frames that it was trained and tested on."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.export.dataset import read_finished, world_of
from groundwalk.geometry import Array
from groundwalk.store import DataRoot, UserError, tables
from groundwalk.store.choices import MapUnit
from groundwalk.store.hints import scene_file, setting_of
from groundwalk.store.images import image_file, verify_images
from groundwalk.training.build import Trained, load_trained


@dataclass(frozen=True, eq=False)
class TrainedRegressor:
    """A regressor of a finished train stage.

    `card` is its row of train.models. `frames` are all frames that it predicted, N rows: import.frames with the split
    that training used, the scene and which was picked, the image's `file`, the camera of the ground truth and, as
    stated_fx, the stated focal length. `map_T_cam` (N, 4, 4) is the ground truth, `predicted` (N, 4, 4) what it
    answered in training and `covariance` (N, 6, 6) of its error, NaN where there is none. `worlds` says of each scene's
    map its unit and axes, `units` its unit.
    """

    model: str
    profile: str
    scenes: tuple[str, ...]
    card: dict[str, Any]
    trained: Trained
    frames: pd.DataFrame
    map_T_cam: Array
    predicted: Array
    covariance: Array
    worlds: dict[str, str]
    units: dict[str, MapUnit]
    simulated: bool

    def rows(self, split: str) -> NDArray[np.int64]:
        """Rows of a split that have ground truth."""
        known = np.isfinite(self.map_T_cam).all(axis=(1, 2))
        return np.flatnonzero((self.frames["split"] == split).to_numpy(bool) & known).astype(np.int64)


def load_regressor(data: DataRoot, profile: str, scene: str, model: str) -> TrainedRegressor:
    """Read a regressor of a scene's, or a group's, finished train stage.

    UserError where the stage hasn't been run, is damaged or was made from other frames or images than are there, and
    where it has no such regressor, or only imported predictions of it.
    """
    folder, manifest = read_finished(data, profile, scene, "train")
    cards = tables.table_of(folder.parent, "train", "models")
    if model not in set(cards["model"]):
        raise UserError(
            f"scene {scene} has no regressor {model!r}",
            where=folder,
            expected=f"one of {', '.join(cards['model'])}",
            do=f"add it to {setting_of('train', 'models', scene_file(data, scene))} and run the stage train again",
        )
    card = {str(name): value for name, value in cards[cards["model"] == model].iloc[0].items()}
    if not card["file"]:
        raise UserError(f"only predictions of {model} were imported, not the network", where=folder)
    trained = load_trained(folder / card["file"])
    predictions = tables.table_of(folder.parent, "train", "predictions")
    predictions = predictions[predictions["model"] == model]
    parts, worlds, units = [], {}, {}
    for leaf in trained.scenes:
        frames, worlds[leaf], units[leaf] = _frames(data, profile, leaf, manifest)
        parts.append(frames)
    columns = ["scene", "frame_id", "split", "picked_scene", "covariance", *tables.pose_columns("map_cam")]
    answers = predictions[columns].rename(columns=lambda c: c.replace("map_cam_", "predicted_"))
    frames = pd.concat(parts, ignore_index=True).drop(columns="split")
    frames = frames.merge(answers, on=["scene", "frame_id"], how="left", validate="1:1")
    given = [np.full((6, 6), np.nan) if c is None else np.reshape(c, (6, 6)) for c in frames["covariance"]]
    poses = tables.poses_of(frames, "map_cam"), tables.poses_of(frames, "predicted"), np.array(given, float)
    of_map = worlds, units, bool(manifest["simulated"])
    return TrainedRegressor(model, profile, tuple(trained.scenes), card, trained, frames, *poses, *of_map)


def _frames(data: DataRoot, profile: str, scene: str, train: dict[str, Any]) -> tuple[pd.DataFrame, str, MapUnit]:
    """A scene's frames with their files, cameras and ground truth, unit and axes of its map, and the unit."""
    imported, _ = read_finished(data, profile, scene, "import", train)
    read_finished(data, profile, scene, "align", train)
    frames = tables.dataset_frames(tables.table_of(imported.parent, "import", "frames"))
    truth = tables.table_of(imported.parent, "align", "ground_truth")
    logged, is_guess = frames["fx"].to_numpy(), (frames["focal_sd"] >= tables.GUESS_SD).to_numpy()
    frames = tables.with_gravity_of_map(frames, truth)
    poses = ["frame_id", *tables.pose_columns("map_cam")]
    frames = tables.with_cameras(frames, truth).merge(truth[poses], on="frame_id", validate="1:1")
    # Nobody will state import's guess of a photo without one: who asks knows it, or takes what sfm found.
    stated = np.where(is_guess, frames["fx"], logged)
    captures = data.captures(scene)
    verify_images(captures, imported)
    files = [image_file(image, captures, imported) for image in frames["image"]]
    frames = frames.assign(scene=scene, file=pd.Series(files, dtype=object), stated_fx=stated)
    return frames, world_of(truth), tables.map_unit(truth)
