"""From verified pairs to selected models, mapped anew and adjusted robustly; and frames of new walks registered into
finished models, whose frames and points stay where they are."""

import itertools
import shutil
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import pycolmap
from scipy.linalg import LinAlgError

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import is_large
from groundwalk.sfm.cameras.model_adjustment import CameraLog, Held, save_adjusted, with_lenses_of
from groundwalk.sfm.database import image_names, read_keypoints
from groundwalk.sfm.mapping.held_out import Matches, VerifiedPairs, read_matches, write_mapping_input
from groundwalk.sfm.mapping.mappers import continued, from_poses, with_all_matches
from groundwalk.sfm.mapping.misplaced import adjust_without_misplaced
from groundwalk.sfm.mapping.stated import StatedCheck, check_stated
from groundwalk.sfm.mapping.thinning import write_thinned
from groundwalk.sfm.model import BuiltModel, add_image, renumbered, write_built
from groundwalk.sfm.plugins import MAPPERS, MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report
from groundwalk.store.memory import give_back_freed_memory

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
    start_T_cam: Array | None = None,
) -> None:
    """Map verified pairs; `output` then holds what `read_built` reads and the folders that it names.

    Mapping begins with a pair of images or, where they are given, with the poses `start_T_cam` (N, 4, 4; NaN for none).
    Of many frames it has some matches of each pair (module `thinning`); selected models get the points of all.
    Where the largest of the models lacks images, a second mapping continues from it with fewer inliers needed to
    register one, and a third one where that found some. The largest of all is selected, and of the others those that
    have ten or more frames that no larger one has; a frame stays in the largest that has it. Each is adjusted once more
    as a whole, with the cameras of phones and robustly: a few per cent of wrong observations would otherwise weigh more
    than all right ones. Frames whose verified matches contradict their poses are taken out (module `misplaced`). A
    model that its images don't determine isn't selected. The largest comes first, and its lenses are the prior of the
    others'. A stated lens is held unless the images deny it (module `stated`).
    """
    work, count = _begun(verified, source, output), len(verified.frames)
    is_thinned = start_T_cam is None and is_large(count)
    first = replace(source, database=work / "thinned.db") if is_thinned else source
    if is_thinned:
        write_thinned(source.database, first.database, source.seed)
    built = _map(report, first, count, settings.mapper, start_T_cam, work)
    give_back_freed_memory()
    # Not before, for memory.
    matches, keypoints = _matches_and_keypoints(verified, source)
    assigned: set[int] = set()
    names = itertools.chain(["model"], (f"model_{number}" for number in itertools.count(2)))
    for index in sorted(range(len(built)), key=lambda i: _size(built[i]), reverse=True):
        entry, model = built[index]
        if len(set(model.reg_frame_ids()) - assigned) < _MIN_COMPONENT_FRAMES and assigned:
            continue
        for other in set(model.reg_frame_ids()) & assigned:
            model.deregister_frame(other)
        if is_thinned:
            (folder := work / f"all_matches_{index}").mkdir()
            model = with_all_matches(source, model, folder)
        try:
            log = log.at_middle_rows(model)
            log, checks = check_stated(model, matches, keypoints, log, settings, Held())
            adjusted, rows, misplaced = adjust_without_misplaced(model, matches, keypoints, log, settings, Held())
        except LinAlgError as error:
            print(f"{entry.model_id}: not selected, as its images don't determine it: {error}")  # into the log
            continue
        if model.num_reg_frames() < _MIN_COMPONENT_FRAMES and assigned:
            continue
        assigned |= set(model.reg_frame_ids())
        name = next(names)
        log = with_lenses_of(log, adjusted, rows)
        save_adjusted(work / f"{name}.npz", adjusted, rows)
        model.extract_colors_for_all_images(source.images)
        (work / name).mkdir()
        model.write_binary(work / name)
        one = BuiltModel.of(entry.mapping, entry.number, model)
        built[index] = (replace(one, misplaced=misplaced, stated=[*map(asdict, checks)], folder=name), model)
    _finish(work, [entry for entry, _ in built], output)


def _begun(verified: VerifiedPairs, source: MappingInput, output: Path) -> Path:
    """The folder, still empty, that becomes the output; the mapper's database is written."""
    work = output.with_name(output.name + ".partial")
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    write_mapping_input(verified, source.database, source.seed)
    return work


def _matches_and_keypoints(verified: VerifiedPairs, source: MappingInput) -> tuple[Matches, list[Array]]:
    """The matches that are mapped and held out, and all frames' keypoints as extracted."""
    return read_matches(source.database), read_keypoints(verified.features, len(verified.frames))


def _finish(work: Path, built: Sequence[BuiltModel], output: Path) -> None:
    write_built(work, built)
    shutil.rmtree(output, ignore_errors=True)
    work.rename(output)


def _map(
    report: Report, source: MappingInput, frames: int, mapper: str, start_T_cam: Array | None, work: Path
) -> list[Built]:
    """All models of the mapper, or that of the poses that are given, and, where the largest lacks images, of continuing
    from it."""
    registered = itertools.count(1)

    def report_one() -> None:
        report(min(next(registered), frames))

    (work / mapper).mkdir()
    if start_T_cam is not None:
        mapper, models = "posed", [from_poses(source, start_T_cam, work / mapper)]
    else:
        with MAPPERS.guard(mapper):
            models = MAPPERS.find(mapper).run(source, work / mapper, report_one)
    built = [(BuiltModel.of(mapper, number, model), model) for number, model in enumerate(models)]
    for number in range(_MAX_CONTINUED):
        largest = max(built, key=_size, default=None)
        if largest is None or largest[0].images == frames:
            break
        models = continued(source, largest[1], work / f"continued_{number}", report_one)
        more = [(BuiltModel.of("continued", number, model), model) for model in models]
        built += more
        if max(map(_size, more), default=(0, 0)) <= _size(largest):
            break
    return built


def _size(built: Built) -> tuple[int, int]:
    return built[0].images, built[0].observations


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
    work = _begun(verified, source, output)
    matches, keypoints = _matches_and_keypoints(verified, source)
    built, taken, registered = [], set[int](), itertools.count(1)
    for number, one in enumerate(finished[1]):
        model = renumbered(finished[0] / one.folder, image_names(verified.frames))
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
    _finish(work, built, output)


def _attach(model: pycolmap.Reconstruction, mapped: pycolmap.Reconstruction, added: Sequence[int]) -> None:
    """Add frames that `mapped`, which goes on from `model`, has registered, and what they see."""
    for i in added:
        add_image(model, mapped, i, i)
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
