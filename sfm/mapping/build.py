"""From verified pairs to selected models: mapping, continuing from the largest, and a robust adjustment of each."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.linalg import LinAlgError

from groundwalk.sfm.cameras.model_adjustment import (
    CameraLog,
    adjust_model,
    cameras_of_frames,
    save_adjusted,
    with_lenses_of,
)
from groundwalk.sfm.database import image_id, read_keypoints
from groundwalk.sfm.mapping.built import BuiltModel, write_built
from groundwalk.sfm.mapping.held_out import VerifiedPairs, held_out_check, read_matches, write_mapping_input
from groundwalk.sfm.mapping.mappers import continued
from groundwalk.sfm.mapping.misplaced import misplaced_frames
from groundwalk.sfm.plugins import MAPPERS, MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report

_MAX_CONTINUED = 2
# Fewer frames, in no larger model, are as often wrong as right, and align can't tell: VIO's windows are longer.
_MIN_COMPONENT_FRAMES = 10


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

    Where the largest of the models lacks images, a second mapping continues from it with fewer inliers needed to
    register one, and a third one where that found some. The largest of all is selected, and of the others those that
    have ten or more frames that no larger one has; a frame stays in the largest that has it. Each is adjusted once more
    as a whole, with the cameras of phones and robustly: a few per cent of wrong observations would otherwise weigh more
    than all right ones. Frames whose verified matches contradict their poses are taken out (module `misplaced`). A
    model that its images don't determine isn't selected. The largest comes first, and its lenses are the prior of the
    others'.
    """
    write_mapping_input(verified, source.database, source.seed)
    matches, keypoints = read_matches(source.database), read_keypoints(verified.features, len(verified.frames))
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    built = _map(report, source, len(keypoints), settings.mapper, work)
    assigned: set[int] = set()
    selected = 0
    for index in sorted(range(len(built)), key=lambda i: _size(built[i]), reverse=True):
        entry, model = built[index]
        if len(set(model.reg_frame_ids()) - assigned) < _MIN_COMPONENT_FRAMES and assigned:
            continue
        for other in set(model.reg_frame_ids()) & assigned:
            model.deregister_frame(other)
        try:
            adjusted, rows = adjust_model(model, keypoints, log, settings)
            model_N, sfm_T_cam = np.full(len(keypoints), -1), np.full((len(keypoints), 4, 4), np.nan)
            model_N[rows], sfm_T_cam[rows] = 0, adjusted.bundle.sfm_T_cam
            cameras = cameras_of_frames(log, [(adjusted, rows)])
            if misplaced := misplaced_frames(held_out_check(matches, cameras, sfm_T_cam, model_N)):
                for row in misplaced:
                    model.deregister_frame(image_id(row))
                adjusted, rows = adjust_model(model, keypoints, log, settings)
        except LinAlgError as error:
            print(f"{entry.model_id}: not selected, as its images don't determine it: {error}")  # into the log
            continue
        if model.num_reg_frames() < _MIN_COMPONENT_FRAMES and assigned:
            continue
        assigned |= set(model.reg_frame_ids())
        selected += 1
        name = "model" if selected == 1 else f"model_{selected}"
        log = with_lenses_of(log, adjusted, rows)
        save_adjusted(work / f"{name}.npz", adjusted, rows)
        model.extract_colors_for_all_images(source.images)
        (work / name).mkdir()
        model.write_binary(work / name)
        one = described(entry.mapping, entry.number, model)
        built[index] = (replace(one, misplaced=misplaced, folder=name), model)
    write_built(work, [entry for entry, _ in built])
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def _map(report: Report, source: MappingInput, frames: int, mapper: str, work: Path) -> list[Built]:
    """All models of the mapper and, where the largest lacks images, of continuing from it."""
    registered = 0

    def report_one() -> None:
        nonlocal registered
        registered += 1
        report(min(registered, frames))

    (work / mapper).mkdir(parents=True)
    with MAPPERS.guard(mapper):
        models = MAPPERS.find(mapper).run(source, work / mapper, report_one)
    built = [(described(mapper, number, model), model) for number, model in enumerate(models)]
    for number in range(_MAX_CONTINUED):
        largest = max(built, key=_size, default=None)
        if largest is None or largest[0].images == frames:
            break
        folder = work / f"continued_{number}"
        folder.mkdir()
        more = [
            (described("continued", number, model), model)
            for model in continued(source, largest[1], folder, report_one)
        ]
        built += more
        if max(map(_size, more), default=(0, 0)) <= _size(largest):
            break
    return built


def _size(built: Built) -> tuple[int, int]:
    return built[0].images, built[0].observations


def described(mapping: str, number: int, model: pycolmap.Reconstruction) -> BuiltModel:
    return BuiltModel(
        mapping,
        number,
        model.num_reg_images(),
        model.num_points3D(),
        model.compute_num_observations(),
        model.compute_mean_track_length(),
        model.compute_mean_reprojection_error(),
    )
