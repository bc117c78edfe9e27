"""The sfm stage: import's frames in, one COLMAP model over all sessions out."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from artefacts import Stage, StageRun, UserError
from artefacts.child import Task, in_child
from artefacts.tables import poses_of
from geometry.poses import Array
from sfm.covariance import pose_covariance
from sfm.database import create_database, image_name, keypoint_counts, read_descriptors, read_pair_results
from sfm.features import extract_features
from sfm.mapping import BuiltModel, build_models, final_model, read_built
from sfm.matching import ONE_THREAD, MatchedPairs, match_pairs
from sfm.model import Model, load_model
from sfm.pairs import (
    Pairs,
    first_origins,
    sequence_pairs,
    strongest_pairs,
    transitive_pairs,
    unique_pairs,
    vio_pairs,
    within_vio_limits,
)
from sfm.recording import write_recording
from sfm.retrieval import retrieval_pairs, vlad
from sfm.settings import SfmSettings
from sfm.tables import images_table, models_table, pairs_table, points_table

_FEWEST_FRAMES = 3


# An error on one of COLMAP's threads aborts the process that it runs in, hence child processes.
_TOO_LITTLE = "too little memory needs a smaller sfm.max_image_size or sfm.max_features"


@dataclass(frozen=True)
class _Scene:
    """The frames and the files that COLMAP works on."""

    frames: pd.DataFrame
    recording_N: NDArray[np.object_]
    vio_T_cam: Array
    names: list[str]
    images: Path
    database: Path
    mapping: Path
    log: Path


def run(r: StageRun[SfmSettings]) -> None:
    scene = _prepare(r)
    with r.step("features"):
        arguments = (scene.database, scene.images, scene.names, r.settings)
        in_child("extracting features", scene.log, _TOO_LITTLE, Task(extract_features, arguments, len(scene.names)))
        keypoints = keypoint_counts(scene.database, len(scene.names))
        _require_features(r, keypoints)
    with r.step("pairs"):
        proposals = _propose(r, scene)
    with r.step("matching"):
        matched = _match(r, scene, proposals)
    with r.step("mapping"):
        built = _map(r, scene, matched)
    with r.step("quality"):
        chosen = next(told for told in built if told.chosen)
        folder = final_model(scene.mapping)
        model = load_model(folder, len(scene.names))
        covariance = _covariance(r, scene.frames, model, chosen.loss_px)

    frame_ids = list(scene.frames["frame_id"])
    r.write("images", images_table(frame_ids, model, chosen.model_id, keypoints, covariance))
    r.write("models", models_table(built))
    r.write("pairs", pairs_table(frame_ids, matched))
    r.write("points", points_table(model))
    shutil.copytree(folder, r.work / "model", dirs_exist_ok=True)
    with r.step("recording"):
        write_recording(r, scene.frames, model, matched)
    r.figure("frames", len(scene.frames))
    r.figure("registered", chosen.images)
    r.figure("pairs", len(matched.pairs))
    r.figure("verified_pairs", int(matched.verified.sum()))
    r.figure("points", chosen.points)
    r.figure("mean_track_length", chosen.mean_track_length)
    r.figure("mean_reprojection_px", chosen.mean_reprojection_px)
    r.say(
        f"{chosen.images} of {len(scene.frames)} frames in one model, {chosen.points} points, "
        f"{chosen.mean_reprojection_px:.2f} px mean reprojection error"
    )


def _prepare(r: StageRun[SfmSettings]) -> _Scene:
    frames = r.read("import", "frames")
    if len(frames) < _FEWEST_FRAMES:
        raise UserError(
            "too few frames for a model",
            where=r.folder("import") / "frames.parquet",
            expected=f"at least {_FEWEST_FRAMES}",
            found=len(frames),
            do="capture more, or let import keep more (its table rejects says what was left out and why)",
        )
    recordings = r.read("import", "sessions").set_index("session_id")["recording"]
    images = r.scratch / "images"
    names = []
    for frame_id, image in zip(frames["frame_id"], frames["image"], strict=True):
        # Links give COLMAP one image folder, and its model names that mean the same on every machine.
        source, name = r.image_path(image), image_name(frame_id, image)
        if not source.is_file():
            raise UserError(
                f"frame {frame_id} has lost its image", where=source, do=f"make scene={r.scene.name} import"
            )
        link = images / name
        if not link.is_symlink():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(source.absolute())
        names.append(name)
    database = r.scratch / "database.db"
    create_database(database, frames, names)
    return _Scene(
        frames,
        frames["session_id"].map(recordings).to_numpy(),
        poses_of(frames, "vio_cam"),
        names,
        images,
        database,
        r.scratch / "mapping",
        r.scratch / "colmap.log",
    )


def _require_features(r: StageRun[SfmSettings], keypoints_N: NDArray[np.int64]) -> None:
    if np.count_nonzero(keypoints_N) < _FEWEST_FRAMES:
        raise UserError(
            "the images have hardly any features",
            expected=f"at least {_FEWEST_FRAMES} images with features",
            found=f"{np.count_nonzero(keypoints_N)} of {len(keypoints_N)}",
            do=f"look at the images of scene {r.scene.name}: blank, black or all blurred ones can't be placed",
        )


def _propose(r: StageRun[SfmSettings], scene: _Scene) -> list[tuple[str, Pairs]]:
    s, frames = r.settings, scene.frames
    session = frames["session_id"].to_numpy()
    following = sequence_pairs(scene.recording_N, frames["t_ns"], s.sequence_pairs)
    # The next frame is always tried: that is what ties a recording together where VIO jumped.
    next_one = sequence_pairs(scene.recording_N, frames["t_ns"], 1)
    near = vio_pairs(
        session,
        scene.vio_T_cam,
        frames[["fx", "fy", "cx", "cy"]].to_numpy(float),
        frames[["width", "height"]].to_numpy(float),
        s.vio_max_distance_m,
        s.vio_max_angle_deg,
        s.vio_pairs,
    )
    alike = unique_pairs([])
    if s.retrieval_pairs and len(set(session)) > 1:
        descriptors = read_descriptors(scene.database, len(frames))
        alike = retrieval_pairs(vlad(descriptors, s.retrieval_words, r.seed), session, s.retrieval_pairs)
    return [
        ("sequence", unique_pairs(np.concatenate([next_one, following[_limits(r, scene, following)]]))),
        ("vio", near),
        ("retrieval", alike),
    ]


def _match(r: StageRun[SfmSettings], scene: _Scene, proposals: list[tuple[str, Pairs]]) -> MatchedPairs:
    def match(text: str) -> MatchedPairs:
        pairs, origin = first_origins(proposals, len(scene.names))
        arguments = (scene.database, scene.names, pairs, r.settings, r.seed)
        in_child(text, scene.log, _TOO_LITTLE, Task(match_pairs, arguments, len(pairs), ONE_THREAD))
        return MatchedPairs(pairs, origin, *read_pair_results(scene.database, pairs), r.settings.min_inliers)

    matched = match("matching pairs")
    if r.settings.transitive_pairs:
        pairs, strength = transitive_pairs(matched.pairs, matched.inliers, len(scene.names))
        allowed = _limits(r, scene, pairs)
        more = strongest_pairs(pairs[allowed], strength[allowed], r.settings.transitive_pairs)
        proposals = [*proposals, ("transitive", more)]
        matched = match("matching pairs that share a partner")
    return matched


def _limits(r: StageRun[SfmSettings], scene: _Scene, pairs: Pairs) -> NDArray[np.bool_]:
    s = r.settings
    session = scene.frames["session_id"].to_numpy()
    return within_vio_limits(pairs, session, scene.vio_T_cam, s.vio_max_distance_m, s.vio_max_angle_deg)


def _map(r: StageRun[SfmSettings], scene: _Scene, matched: MatchedPairs) -> list[BuiltModel]:
    """What was built; the final model is large enough."""
    frames = len(scene.names)
    if not scene.mapping.is_dir():
        arguments = (scene.database, scene.images, scene.mapping, r.settings, r.seed)
        in_child("mapping", scene.log, _TOO_LITTLE, Task(build_models, arguments, frames))
    built = read_built(scene.mapping)
    verified = f"{int(matched.verified.sum())} of {len(matched.pairs)} proposed pairs verified"
    remedy = (
        "look at the images: neighbours need to overlap by half and to be sharp; a larger sfm.max_features or "
        "sfm.max_image_size, or sfm.first_octave=-1, finds more in hard images"
    )
    if not built:
        raise UserError("no model came out of mapping", expected="one over all frames", found=verified, do=remedy)
    chosen = next(told for told in built if told.chosen)
    if chosen.images < r.settings.min_registered * frames:
        sizes = ", ".join(f"{told.images} ({told.model_id})" for told in built)
        raise UserError(
            "the model holds too few of the frames",
            expected=f"at least {r.settings.min_registered:.0%} of {frames} frames (sfm.min_registered)",
            found=f"models of {sizes} frames; {verified}",
            do=remedy,
        )
    return built


def _covariance(r: StageRun[SfmSettings], frames: pd.DataFrame, model: Model, loss_px: float) -> Array | None:
    """(N, 6, 6), NaN for frames that aren't registered; None where it can't be had."""
    known = model.registered
    if known.sum() > r.settings.covariance_max_images:
        r.say(f"no covariances: more than {r.settings.covariance_max_images} frames (sfm.covariance_max_images)")
        return None
    row = np.cumsum(known) - 1
    blocks = pose_covariance(
        model.sfm_T_cam[known],
        frames[["fx", "fy"]].to_numpy(float)[known],
        model.xyz,
        row[model.frame],
        model.point,
        model.residual_px,
        loss_px,
        r.settings.common_px,
    )
    if blocks is None:
        r.say("no covariances: the model has too few points to tell")
        return None
    covariance = np.full((len(known), 6, 6), np.nan)
    covariance[known] = blocks
    return covariance


STAGE = Stage(
    name="sfm",
    version=2,
    settings=SfmSettings,
    needs=("import",),
    run=run,
    help="Structure from motion: features, pairs from time, VIO and looks, one model over all sessions, its quality.",
)
