"""From verified pairs to selected models: mapping, continuing from the largest, and a robust adjustment of each."""

import json
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path

import pycolmap
from scipy.linalg import LinAlgError

from groundwalk.sfm.cameras.model_adjustment import (
    CameraLog,
    adjust_model,
    save_adjusted,
    with_lenses_of,
)
from groundwalk.sfm.database import read_keypoints
from groundwalk.sfm.extensions import MAPPERS
from groundwalk.sfm.mapping.mappers import MIN_MODEL_FRAMES, MappingInput, continued
from groundwalk.sfm.mapping.misplaced import MatchCheck
from groundwalk.sfm.mapping.source import VerifiedPairs, read_matches, write_mapping_input
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report

_CONTINUED_MIN_INLIERS = 15
_MAX_CONTINUED = 2
_BUILT = "built.json"


@dataclass(frozen=True)
class BuiltModel:
    """A model that mapping built: by which mapping, its number there, its size, the rows of frames that were taken out
    as misplaced, and, where it was selected, its folder; beside that `<folder>.npz` has what
    `groundwalk.sfm.cameras.model_adjustment.load_adjusted` reads."""

    mapping: str
    number: int
    images: int
    points: int
    observations: int
    mean_track_length: float
    mean_reprojection_px: float
    misplaced: Sequence[int] = ()
    folder: str = ""

    @property
    def model_id(self) -> str:
        return f"{self.mapping}/{self.number}"


Built = tuple[BuiltModel, pycolmap.Reconstruction]


def build_models(
    report: Report,
    verified: VerifiedPairs,
    source: MappingInput,
    log: CameraLog,
    settings: SfmSettings,
    output: Path,
) -> None:
    """Map verified pairs; `output` then holds what `read_built` reads and the folders that it names.

    Frames whose verified matches deny their poses are taken out (module `misplaced`). Where the largest of the models
    lacks images, a second mapping continues from it with fewer inliers needed to register one, and a third one where
    that found some. The largest of all is selected, and of the others those that have `min_component_frames` or more
    frames that no larger one has; a frame stays in the largest that has it. Each is adjusted once more as a whole, with
    the cameras of phones and robustly: a few per cent of wrong observations would otherwise weigh more than all right
    ones. One that its images don't determine isn't selected. The largest comes first, and its lenses are the prior of
    the others'.
    """
    write_mapping_input(verified, source.database, settings.held_out_fraction, source.seed)
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    keypoints = read_keypoints(verified.features, len(verified.frames))
    check = MatchCheck(read_matches(source.database), keypoints, log, settings)
    built = _map(report, source, check, settings.mapper, work)
    assigned: set[int] = set()
    names = _folder_names()
    for index in sorted(range(len(built)), key=lambda i: _size(built[i]), reverse=True):
        entry, model = built[index]
        new = set(model.reg_frame_ids()) - assigned
        if len(new) < settings.min_component_frames and assigned:
            continue
        for other in set(model.reg_frame_ids()) & assigned:
            model.deregister_frame(other)
        try:
            adjusted, rows = adjust_model(model, keypoints, log, settings)
        except LinAlgError as error:
            print(f"{entry.model_id}: not selected, as its images don't determine it: {error}")  # into the log
            continue
        if model.num_reg_frames() < settings.min_component_frames and assigned:
            continue
        assigned |= set(model.reg_frame_ids())
        name = next(names)
        log = with_lenses_of(log, adjusted, rows)
        save_adjusted(work / f"{name}.npz", adjusted, rows)
        model.extract_colors_for_all_images(source.images)
        model.write_binary(_new_folder(work / name))
        built[index] = (replace(_describe(entry.mapping, entry.number, model, entry.misplaced), folder=name), model)
    (work / _BUILT).write_text(json.dumps([asdict(entry) for entry, _ in built]), encoding="utf-8")
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def _map(report: Report, source: MappingInput, check: MatchCheck, mapper: str, work: Path) -> list[Built]:
    """All models of the mapper and, where the largest lacks images, of continuing from it; without misplaced frames."""
    images = len(check.log.t_s)
    registered = 0

    def report_one() -> None:
        nonlocal registered
        registered += 1
        report(min(registered, images))

    with MAPPERS.guard(mapper):
        models = MAPPERS.find(mapper).run(source, _new_folder(work / mapper), report_one)
    built = _described(mapper, models, check)
    for number in range(_MAX_CONTINUED):
        largest = max(built, key=_size, default=None)
        if largest is None or largest[0].images == images:
            break
        folder = _new_folder(work / f"continued_{number}")
        models = continued(source, largest[1], _CONTINUED_MIN_INLIERS, folder, report_one)
        more = _described("continued", models, check, number)
        built += more
        if max(map(_size, more), default=(0, 0)) <= _size(largest):
            break
    return built


def read_built(output: Path) -> list[BuiltModel]:
    """The models that `build_models` built, in the order in which it did."""
    return [BuiltModel(**entry) for entry in json.loads((output / _BUILT).read_text(encoding="utf-8"))]


def selected_models(built: Sequence[BuiltModel]) -> list[BuiltModel]:
    """The models that were selected, the largest first."""
    return sorted((entry for entry in built if entry.folder), key=lambda entry: (len(entry.folder), entry.folder))


def _new_folder(path: Path) -> Path:
    path.mkdir(parents=True)
    return path


def _folder_names() -> Iterator[str]:
    yield "model"
    yield from (f"model_{number}" for number in count(2))


def _size(built: Built) -> tuple[int, int]:
    return built[0].images, built[0].observations


def _described(
    mapping: str, models: list[pycolmap.Reconstruction], check: MatchCheck, first_number: int = 0
) -> list[Built]:
    """The models, without misplaced frames, that still have frames enough."""
    described = []
    for number, model in enumerate(models, first_number):
        misplaced = check.deregister_misplaced(model)
        if model.num_reg_images() >= MIN_MODEL_FRAMES:
            described.append((_describe(mapping, number, model, misplaced), model))
    return described


def _describe(mapping: str, number: int, model: pycolmap.Reconstruction, misplaced: Sequence[int]) -> BuiltModel:
    return BuiltModel(
        mapping,
        number,
        model.num_reg_images(),
        model.num_points3D(),
        model.compute_num_observations(),
        model.compute_mean_track_length(),
        model.compute_mean_reprojection_error(),
        misplaced,
    )
