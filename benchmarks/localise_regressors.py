"""The regressors of a finished train stage, asked the queries of benchmarks/localise.py."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from groundwalk.export.phone.inputs import PhoneInputs
from groundwalk.export.regressor import TrainedRegressor, load_regressor
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.localisation.results import NOTHING_SEEN, QueryResult
from groundwalk.runtime.bundle import matrix_of
from groundwalk.store import DataRoot
from groundwalk.store.schemas import schema
from groundwalk.store.tables import read_table


def trained_regressors(data: DataRoot, profile: str, scene: str) -> Iterator[TrainedRegressor]:
    """Those of a scene's train stage; none where that hasn't been run."""
    models = data.run(profile, scene, "train") / "models.parquet"
    if models.is_file():
        for model in read_table(models, schema("train", "models"))["model"]:
            yield load_regressor(data, profile, scene, model)


def answers_of(regressor: TrainedRegressor, files: Mapping[str, Path]) -> list[QueryResult]:
    """What it says of frames, by id, in their order, with these files for their images."""
    frames = regressor.frames.set_index("frame_id", drop=False)
    frames.loc[list(files), "file"] = np.array([*files.values()], object)
    inputs = PhoneInputs(replace(regressor, frames=frames))
    row_of = {frame_id: row for row, frame_id in enumerate(frames.index)}
    return [QueryResult(_pose(inputs, row_of[frame_id]), None, None, "", 0, 0, NOTHING_SEEN) for frame_id in files]


def _pose(inputs: PhoneInputs, row: int) -> Array:
    with torch.inference_mode():
        poses = inputs.regressor.trained.model(torch.from_numpy(inputs.tensor_as_trained(row)))
    seen = matrix_of(poses.quaternion_B4[0].double().numpy())
    rotation = inputs.preprocessing.camera_rotation(seen, inputs.query(row).gravity)
    return make_pose(rotation, poses.position_B3[0].double().numpy())
