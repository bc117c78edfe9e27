"""From verified pairs to the models that are kept: mapping, going on from it, and a robust adjustment of each."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pycolmap

from groundwalk.artefacts.child import Report
from groundwalk.sfm.database import read_keypoints
from groundwalk.sfm.extensions import MAPPERS
from groundwalk.sfm.mappers import MappingInput, continued
from groundwalk.sfm.mapping_input import write_mapping_input
from groundwalk.sfm.model_adjustment import CameraLog, adjust_model, save_adjusted, with_lenses_of
from groundwalk.sfm.settings import SfmSettings

_EASIER_MIN_INLIERS = 15
_BUILT = "built.json"


@dataclass(frozen=True)
class BuiltModel:
    """A model that mapping built: by what, its number there, its size, and, where it was kept, the folder that it's in;
    beside it `<folder>.npz` has what `groundwalk.sfm.model_adjustment.load_adjusted` reads."""

    mapping: str
    number: int
    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_px: float
    folder: str = ""

    @property
    def model_id(self) -> str:
        return f"{self.mapping}/{self.number}"


def map_verified(
    report: Report,
    verified: tuple[Any, ...],
    given: MappingInput,
    features: Path,
    log: CameraLog,
    settings: SfmSettings,
    output: Path,
) -> None:
    """`write_mapping_input` with the arguments `verified`, then `build_models` from what it wrote."""
    write_mapping_input(*verified)
    build_models(report, given, features, log, settings, output)


def build_models(
    report: Report, given: MappingInput, features: Path, log: CameraLog, settings: SfmSettings, output: Path
) -> None:
    """Map the database's verified pairs; `output` then holds what `read_built` reads and the folders that it names.

    `features` is the database with the keypoints as they were found. Where the largest of the models that come out
    lacks images, a second mapping goes on from it with a lower bar for registering one. The largest of all is kept, and
    of the others those that have `component_frames` or more frames that no larger one has; a frame stays in the largest
    that has it. Each is adjusted once more as a whole, with the cameras as phones have them and robustly: a few per
    cent of wrong observations would otherwise weigh more than all right ones. The largest comes first, and the others
    take its lenses as they came out for a prior.
    """
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    with pycolmap.Database.open(given.database) as opened:
        wanted = opened.num_images()
    registered = 0

    def count() -> None:
        nonlocal registered
        registered += 1
        report(min(registered, wanted))

    def folder(name: str) -> Path:
        (work / name).mkdir(parents=True)
        return work / name

    mapper = settings.mapper
    with MAPPERS.guard(mapper):
        built = list(_described(mapper, MAPPERS.find(mapper).run(given, folder(mapper), count)))
    if built and (largest := max(built, key=_size)[1]).num_reg_images() < wanted:
        more = continued(given, largest, _EASIER_MIN_INLIERS, folder("continued"), count)
        built += _described("continued", more)

    keypoints = read_keypoints(features, wanted)
    taken: set[int] = set()
    kept = 0
    for index in sorted(range(len(built)), key=lambda i: _size(built[i]), reverse=True):
        told, model = built[index]
        own = set(model.reg_frame_ids()) - taken
        if len(own) < settings.component_frames and kept:
            continue
        kept += 1
        name = "model" if kept == 1 else f"model_{kept}"
        for other in set(model.reg_frame_ids()) & taken:
            model.deregister_frame(other)
        taken |= own
        adjusted, rows = adjust_model(model, keypoints, log, settings)
        log = with_lenses_of(log, adjusted, rows)
        save_adjusted(work / f"{name}.npz", adjusted, rows)
        model.extract_colors_for_all_images(given.images)
        model.write_binary(folder(name))
        built[index] = (replace(_describe(told.mapping, told.number, model), folder=name), model)
    (work / _BUILT).write_text(json.dumps([asdict(told) for told, _ in built]), encoding="utf-8")
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def read_built(output: Path) -> list[BuiltModel]:
    """The models that `build_models` built, in the order in which it did."""
    return [BuiltModel(**entry) for entry in json.loads((output / _BUILT).read_text(encoding="utf-8"))]


def kept_models(built: Sequence[BuiltModel]) -> list[BuiltModel]:
    """Those that were kept, the largest first."""
    return sorted((told for told in built if told.folder), key=lambda told: (len(told.folder), told.folder))


def _size(built: tuple[BuiltModel, pycolmap.Reconstruction]) -> tuple[int, int]:
    return built[0].images, built[0].observations


def _described(mapping: str, models: list[pycolmap.Reconstruction]) -> list[tuple[BuiltModel, pycolmap.Reconstruction]]:
    return [(_describe(mapping, number, model), model) for number, model in enumerate(models)]


def _describe(mapping: str, number: int, model: pycolmap.Reconstruction) -> BuiltModel:
    return BuiltModel(
        mapping,
        number,
        model.num_reg_images(),
        model.num_points3D(),
        model.compute_num_observations(),
        model.compute_mean_track_length(),
        model.compute_mean_reprojection_error(),
    )
