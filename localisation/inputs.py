"""What the localisers read of a scene's run: frames with ground truth, their cameras and motion."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.geometry import GeometryError
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.fits import sim3_between
from groundwalk.geometry.poses import Array
from groundwalk.localisation.frames import Views, subset
from groundwalk.localisation.prepared import Training
from groundwalk.store.choices import QualityClass, Split
from groundwalk.store.tables import GUESS_SD, camera_of, dataset_frames, poses_of, table_of, with_gravity_of_map


@dataclass(frozen=True)
class Inputs:
    """Frames of a scene's dataset that have ground truth: their rows of import.frames, with `split` as imported; the
    cameras that go with the poses, and as queries are asked with: as the phone logged them, where it did; views;
    gravity (N, 3) in the camera, NaN where none."""

    frames: pd.DataFrame
    logged: tuple[Camera, ...]
    views: Views
    gravity: Array


def read_inputs(run: Path) -> Inputs:
    """From the folder of a scene's run, with the stages import, sfm and align finished."""
    frames = table_of(run, "import", "frames")
    truth = table_of(run, "align", "ground_truth")
    images = table_of(run, "sfm", "images")
    truth = truth[(truth["quality"] != "none").to_numpy()]
    truth = truth[truth["frame_id"].isin(dataset_frames(frames)["frame_id"])]
    frames = with_gravity_of_map(frames, truth)
    frames = frames.set_index("frame_id", drop=False).loc[truth["frame_id"]].reset_index(drop=True)
    placed = frames.assign(**{name: truth[name].to_numpy() for name in ("fx", "fy", "cx", "cy", "distortion")})
    images = images.set_index("frame_id").loc[truth["frame_id"]]
    # Pose, lens, readout time and motion go together: sfm took the motion at the time offset, where it uses one.
    map_T_cam = poses_of(truth, "map_cam")
    angular, velocity = (images[[f"{name}_{a}" for a in "xyz"]].to_numpy(float) for name in ("angular", "velocity"))
    # The length of a frame's sfm unit in the map (N,), as align placed its model; 0 for a model with one place.
    units, component_N, sfm_T_cam = np.zeros(len(truth)), truth["component"].to_numpy(int), poses_of(images, "sfm_cam")
    for component in np.unique(component_N):
        rows = component_N == component
        with suppress(GeometryError):
            units[rows] = sim3_between(map_T_cam[rows], sfm_T_cam[rows]).scale
    cameras, readout_s = tuple(map(camera_of, placed.itertuples())), images["readout_s"].to_numpy(float)
    views = Views(map_T_cam, cameras, readout_s, angular, units[:, None] * velocity)
    gravity = frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan)
    return Inputs(frames, tuple(map(camera_of, with_found_focal(frames, run).itertuples())), views, gravity)


def with_found_focal(frames: pd.DataFrame, run: Path) -> pd.DataFrame:
    """Rows of import.frames; a focal length that is a guess is the median of those that sfm found for the training
    frames of the same device and image size, of whatever orientation, where there are any."""
    is_guess = (frames["focal_sd"] >= GUESS_SD).to_numpy()
    if not is_guess.any():
        return frames
    sessions = table_of(run, "import", "sessions")
    every = dataset_frames(table_of(run, "import", "frames"))
    truth = table_of(run, "align", "ground_truth")
    truth = truth[((truth["split"] == Split.TRAIN) & (truth["quality"] != QualityClass.NONE)).to_numpy()]
    trained = every[["frame_id", "session_id", "width", "height"]].merge(truth[["frame_id", "fx", "fy"]], on="frame_id")
    device_of = dict(zip(sessions["session_id"], sessions["device"], strict=True))

    def lenses(rows: pd.DataFrame) -> list[str]:
        sizes = np.sort(rows[["width", "height"]].to_numpy(int), axis=1).tolist()
        return [f"{device_of.get(of) or of} {size}" for of, size in zip(rows["session_id"], sizes, strict=True)]

    found = trained.groupby(np.array(lenses(trained), object))[["fx", "fy"]].median().reindex(lenses(frames))
    is_found = is_guess & found["fx"].notna().to_numpy()
    return frames.assign(**{name: np.where(is_found, found[name], frames[name]) for name in ("fx", "fy")})


def training_of(inputs: Inputs, rows: NDArray[np.int64], features: Sequence[Features]) -> Training:
    """Some rows as training frames, with their features."""
    logged = tuple(inputs.logged[row] for row in rows.tolist())
    return Training(subset(inputs.views, rows), logged, inputs.gravity[rows], tuple(features))
