"""Records of the models that mapping built, beside them in a file."""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pycolmap

_FILE = "built.json"


@dataclass(frozen=True)
class BuiltModel:
    """A model that mapping built: by which mapping, its number there, its size, the rows of frames that were taken out
    as misplaced, what its images say of stated lenses (`mapping.stated.StatedCheck`), and, where it was selected, its
    folder; beside that `<folder>.npz` has what `groundwalk.sfm.cameras.model_adjustment.load_adjusted` reads."""

    mapping: str
    number: int
    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_px: float
    misplaced: Sequence[int] = ()
    folder: str = ""
    stated: Sequence[dict[str, Any]] = ()

    @property
    def model_id(self) -> str:
        return f"{self.mapping}/{self.number}"

    @staticmethod
    def of(mapping: str, number: int, model: pycolmap.Reconstruction) -> "BuiltModel":
        """The record of a model, which isn't selected."""
        sizes = model.num_reg_images(), model.num_points3D(), model.compute_num_observations()
        means = model.compute_mean_track_length(), model.compute_mean_reprojection_error()
        return BuiltModel(mapping, number, *sizes, *means)


def write_built(folder: Path, built: Sequence[BuiltModel]) -> None:
    (folder / _FILE).write_text(json.dumps([asdict(one) for one in built]), encoding="utf-8")


def read_built(output: Path) -> list[BuiltModel]:
    """The models in the order in which they were built."""
    return [BuiltModel(**entry) for entry in json.loads((output / _FILE).read_text(encoding="utf-8"))]


def selected_models(built: Sequence[BuiltModel]) -> list[BuiltModel]:
    """The models that were selected, the largest first."""
    return sorted((entry for entry in built if entry.folder), key=lambda entry: (len(entry.folder), entry.folder))
