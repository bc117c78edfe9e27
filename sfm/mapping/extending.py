"""Frames of new walks registered into finished models, whose frames and points stay where they are."""

import itertools
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pycolmap

from groundwalk.sfm.cameras.model_adjustment import CameraLog, Held, save_adjusted
from groundwalk.sfm.database import image_names, read_keypoints
from groundwalk.sfm.mapping.built import BuiltModel, write_built
from groundwalk.sfm.mapping.held_out import VerifiedPairs, read_matches, write_mapping_input
from groundwalk.sfm.mapping.mappers import continued
from groundwalk.sfm.mapping.misplaced import adjust_without_misplaced
from groundwalk.sfm.mapping.stated import StatedCheck, check_stated
from groundwalk.sfm.model import renumbered
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report


def extend_models(
    report: Report,
    finished: tuple[Path, Sequence[BuiltModel]],
    verified: VerifiedPairs,
    source: MappingInput,
    log: CameraLog,
    settings: SfmSettings,
    output: Path,
) -> None:
    """Register frames by verified pairs, each of which has a frame that no model has, in the largest model that takes
    them, of those of a `finished` artefact; `output` then holds what `build_models` leaves.

    COLMAP finds the poses. Of its adjustments, which move points, only these are kept, with which features are of one
    point; then the new frames and points are adjusted, the others held, and misplaced frames taken out.
    """
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    frames = verified.frames
    write_mapping_input(verified, source.database, source.seed)
    matches, keypoints = read_matches(source.database), read_keypoints(verified.features, len(frames))
    built, taken, registered = [], set[int](), itertools.count(1)
    for number, one in enumerate(finished[1]):
        model = renumbered(finished[0] / one.folder, image_names(frames))
        held = Held(frozenset(model.reg_frame_ids()), frozenset(model.points3D))
        mapped: list[pycolmap.Reconstruction] = []
        if len(verified.pairs):  # without one there is nothing to add
            folder = work / f"continued_{number}"
            mapped = continued(source, model, folder, lambda: report(next(registered)), held=True)
        added = set(mapped[0].reg_frame_ids()) - held.frames - taken if mapped else set[int]()
        misplaced, checks = list[int](), list[StatedCheck]()
        if added:
            _attach(model, mapped[0], sorted(added))
            log, checks = check_stated(model, matches, keypoints, log, settings, held)
            adjusted, rows, misplaced = adjust_without_misplaced(model, matches, keypoints, log, settings, held)
            added = set(model.reg_frame_ids()) - held.frames
        if added:
            save_adjusted(work / f"{one.folder}.npz", adjusted, rows)
            taken |= added
            for i in sorted(added):
                model.extract_colors_for_image(i, source.images)
        (work / one.folder).mkdir()
        model.write_binary(work / one.folder)
        grown = BuiltModel.of(one.mapping, one.number, model)
        built.append(replace(grown, misplaced=misplaced, stated=[*map(asdict, checks)], folder=one.folder))
    write_built(work, built)
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def _attach(model: pycolmap.Reconstruction, mapped: pycolmap.Reconstruction, added: Sequence[int]) -> None:
    """Add frames that `mapped`, which goes on from `model`, has registered, and what they see."""
    for i in added:
        image = mapped.image(i)
        model.add_camera_with_trivial_rig(mapped.camera(image.camera_id))
        keypoints = np.array([p.xy for p in image.points2D]).reshape(-1, 2)
        copied = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=image.camera_id, image_id=i)
        model.add_image_with_trivial_frame(copied, image.cam_from_world())
    new = set(added)
    for point in mapped.points3D.values():
        elements = [(e.image_id, e.point2D_idx) for e in point.track.elements if model.exists_image(e.image_id)]
        seen_by_new = [element for element in elements if element[0] in new]
        known = Counter(
            p.point3D_id for i, f in elements if i not in new and (p := model.image(i).point2D(f)).has_point3D()
        )
        if seen_by_new and known:
            for element in seen_by_new:
                model.add_observation(known.most_common(1)[0][0], pycolmap.TrackElement(*element))
        elif seen_by_new and len({i for i, _ in elements}) > 1:
            model.add_point3D(point.xyz, pycolmap.Track([pycolmap.TrackElement(*element) for element in elements]))
