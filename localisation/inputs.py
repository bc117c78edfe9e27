"""What the localisers read of a scene's run: frames with ground truth, their cameras and motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.artefacts.images import image_file, read_image
from groundwalk.artefacts.parallel import in_parallel
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.tables import camera_of, poses_of, read_table
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rates import rates_at
from groundwalk.localisation.build import Training
from groundwalk.localisation.features import Features, extract
from groundwalk.localisation.frames import Views, subset
from groundwalk.localisation.settings import MapSettings

_MAX_GAP_S = 0.3


@dataclass(frozen=True)
class Inputs:
    """Frames of a scene's dataset that have ground truth: their rows of import.frames, with `split` as imported; the
    cameras that go with the poses, and as the phone logged them; views; gravity (N, 3) in the camera, NaN where
    none."""

    frames: pd.DataFrame
    logged: tuple[Camera, ...]
    views: Views
    covariance: Array
    gravity: Array


def read_inputs(run: Path) -> Inputs:
    """From the folder of a scene's run, with the stages import, sfm and align finished."""
    frames = read_table(run / "import" / "frames.parquet", schema("import", "frames"))
    truth = read_table(run / "align" / "ground_truth.parquet", schema("align", "ground_truth"))
    images = read_table(run / "sfm" / "images.parquet", schema("sfm", "images"))
    log = read_table(run / "import" / "vio.parquet", schema("import", "vio"))
    truth = truth[(truth["quality"] != "none").to_numpy()]
    frames = frames.set_index("frame_id", drop=False).loc[truth["frame_id"]].reset_index(drop=True)
    placed = frames.assign(**{name: truth[name].to_numpy() for name in ("fx", "fy", "cx", "cy", "distortion")})
    readout = images.set_index("frame_id").loc[truth["frame_id"], "readout_s"].to_numpy(float, na_value=0.0)
    angular, velocity = motion(frames, log)
    views = Views(
        poses_of(truth, "map_cam"),
        tuple(map(camera_of, placed.itertuples())),
        np.nan_to_num(readout),
        angular,
        velocity,
    )
    covariance = np.stack([np.full(36, np.nan) if c is None else np.asarray(c, float) for c in truth["covariance"]])
    gravity = frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan)
    return Inputs(frames, tuple(map(camera_of, frames.itertuples())), views, covariance.reshape(-1, 6, 6), gravity)


def motion(frames: pd.DataFrame, log: pd.DataFrame) -> tuple[Array, Array]:
    """Angular velocity and velocity (N, 3) of each frame's camera by its session's VIO, 0 where that has no poses."""
    angular, velocity = np.zeros((len(frames), 3)), np.zeros((len(frames), 3))
    session, t_ns = frames["session_id"].to_numpy(str), frames["t_ns"].to_numpy(np.int64)
    for name, poses in log.groupby("session_id"):
        rows, poses = np.flatnonzero(session == name), poses.sort_values("t_ns")
        rates = rates_at(t_ns[rows], poses["t_ns"].to_numpy(np.int64), poses_of(poses, "vio_cam"), _MAX_GAP_S)
        known = np.isfinite(rates.angular).all(axis=1)
        angular[rows[known]], velocity[rows[known]] = rates.angular[known], rates.velocity[known]
    return angular, velocity


def read_features(
    inputs: Inputs, rows: NDArray[np.int64], captures: Path, imported: Path, settings: MapSettings
) -> list[Features]:
    """Features of the images of some rows; `captures` is the scene's capture folder, `imported` import's artefact."""
    return list(
        in_parallel(
            lambda name: extract(grey(image_file(name, captures, imported)), settings.max_features, settings.max_side),
            inputs.frames["image"].iloc[rows],
        )
    )


def grey(path: Path) -> NDArray[np.uint8]:
    """An image file in grey, as the sensor has it; UserError where it can't be read."""
    return np.asarray(cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY), np.uint8)


def training_of(inputs: Inputs, rows: NDArray[np.int64], features: Sequence[Features]) -> Training:
    """Some rows as training frames, with their features."""
    return Training(
        subset(inputs.views, rows),
        tuple(inputs.logged[row] for row in rows.tolist()),
        inputs.gravity[rows],
        tuple(features),
    )
