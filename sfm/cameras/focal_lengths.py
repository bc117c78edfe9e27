"""Focal lengths that no camera logs, as of photos and videos: by COLMAP's own mapping of some of their images.

Everything after, pairs' essential matrices and lenses by pairs, needs them to some per cent; the adjustment of the
whole model then finds them as it finds others, from a wider prior.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap

from groundwalk.sfm.cameras.lenses import PHONE_K1_K2
from groundwalk.sfm.database import Ints, create_database, image_id
from groundwalk.sfm.mapping.mappers import pipeline_options
from groundwalk.sfm.pairs.features import extract_features
from groundwalk.sfm.pairs.matching import match_pairs
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report

ESTIMATED_SD = 0.05
"""Of such a focal length, as a fraction: round one object, or of few images, it comes out some per cent off. So ones
that are known better aren't estimated."""
# As many images that follow each other, all pairs of which are matched.
_MAX_IMAGES = 30
# Where nothing is stated: what mapping starts from, in longer sides of the image. Phones' main cameras, and others.
_STARTS, _GUESS_SD = (0.75, 1.2), 0.2
_MIN_IMAGES = 3


def sample_unstated(frames: pd.DataFrame) -> Ints:
    """Rows of the frames table whose focal lengths nothing states well, of each session those of its most usual size,
    of either orientation: all, or so many from the middle of their order."""
    sides = frames[["width", "height"]]
    size = sides.max(axis=1).astype(str) + "x" + sides.min(axis=1).astype(str)
    usual = size.groupby(frames["session_id"]).transform(lambda of_session: of_session.mode().iloc[0])
    rows = np.flatnonzero((frames["focal_sd"] >= ESTIMATED_SD) & (size == usual))
    first = max(0, (len(rows) - _MAX_IMAGES) // 2)
    return rows[first : first + _MAX_IMAGES]


def estimate_focal_lengths(
    report: Report,
    frames: pd.DataFrame,
    images: Path,
    names: Sequence[str],
    settings: SfmSettings,
    seed: int,
    work: Path,
) -> dict[str, float]:
    """The focal length in pixels of each session of these frames, by the largest model of them; of none where there is
    no model."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    database = work / "pairs.db"
    create_database(database, frames, names, _shared_cameras(frames, _STARTS[0]))
    extract_features(lambda done, note="": None, database, images, names, settings)
    _turn_alike(database, frames)
    # Of cameras without a prior by their fundamental matrices, whatever the focal length that they start from.
    match_pairs(report, database, np.stack(np.triu_indices(len(frames), 1), axis=1), seed)
    found: tuple[tuple[int, int], dict[str, float]] = (0, 0), {}
    is_guess = bool((frames["focal_sd"] > _GUESS_SD).any())
    for number, start in enumerate(_STARTS if is_guess else _STARTS[:1]):
        cameras = _shared_cameras(frames, start)
        with pycolmap.Database.open(database) as opened:
            for camera in cameras.values():
                opened.update_camera(camera)
        options = pipeline_options(MappingInput(database, images, seed))
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = True
        folder = work / f"models_{number}"
        folder.mkdir()
        for model in pycolmap.incremental_mapping(database, images, folder, options).values():
            size = model.num_reg_images(), model.compute_num_observations()
            if size > found[0] and size[0] >= _MIN_IMAGES:
                seen = {image.camera_id for image in model.images.values() if image.has_pose}
                focal = {
                    s: model.camera(c.camera_id).mean_focal_length() for s, c in cameras.items() if c.camera_id in seen
                }
                found = size, focal
    return found[1]


def _turn_alike(database: Path, frames: pd.DataFrame) -> None:
    """Turn the keypoints of images that lie across their session's first one: to a camera whose principal point is in
    the middle any quarter turn is the same."""
    width = frames["width"].to_numpy()
    lies_across = width != frames.groupby("session_id", sort=False)["width"].transform("first").to_numpy()
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for row in np.flatnonzero(lies_across).tolist():
            keypoints = opened.read_keypoints(image_id(row))[:, :2]
            turned = np.column_stack([keypoints[:, 1], width[row] - keypoints[:, 0]])
            opened.update_keypoints(image_id(row), turned.astype(np.float32))


def _shared_cameras(frames: pd.DataFrame, start: float) -> dict[str, pycolmap.Camera]:
    """A camera for each session with a phone's lens, of the stated focal length, or `start` of the longer side."""
    cameras = {}
    for number, (session_id, rows) in enumerate(frames.groupby("session_id", sort=False)):
        first = rows.iloc[0]
        width, height = int(first["width"]), int(first["height"])
        focal = float(first["fx"]) if first["focal_sd"] <= _GUESS_SD else start * max(width, height)
        cameras[str(session_id)] = pycolmap.Camera(
            camera_id=number + 1,
            model="RADIAL",
            width=width,
            height=height,
            params=[focal, width / 2, height / 2, *PHONE_K1_K2],
        )
    return cameras
