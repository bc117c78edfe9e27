"""A scene as the stage works on it: its frames, their cameras, VIO, and the files that COLMAP reads."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.sfm.cameras.calibration import (
    Calibration,
    CalibrationImages,
    calibrate,
    with_lenses,
    write_calibrated_database,
)
from groundwalk.sfm.cameras.model_adjustment import CameraLog, camera_log
from groundwalk.sfm.cameras.motion import motion_by_vio
from groundwalk.sfm.database import create_database, image_name, keypoint_counts
from groundwalk.sfm.pairs.candidates import unique_pairs
from groundwalk.sfm.pairs.features import extract_features, features_name
from groundwalk.sfm.pairs.floor import FloorSource
from groundwalk.sfm.pairs.odometry import Odometry, odometry
from groundwalk.sfm.pairs.selection import pairs_of_untimed, pairs_within_sessions
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.child import Task, in_child, preload
from groundwalk.store.choices import Tracking
from groundwalk.store.hints import run_command, setting_of
from groundwalk.store.tables import poses_of

MIN_FRAMES = 3
_OF_TASKS = ("groundwalk.sfm.cameras.calibration", "groundwalk.sfm.mapping.build", "groundwalk.sfm.pairs.features")
MEMORY_HINT = f"too little memory needs a smaller max_features or {setting_of('sfm', 'max_image_size')}"


@dataclass(frozen=True, kw_only=True)
class SceneInput:
    """The frames with their lenses, VIO, and the files that COLMAP works on."""

    frames: pd.DataFrame
    cameras: CameraLog
    recording_N: NDArray[np.object_]
    vio: Odometry
    names: Sequence[str]
    images: Path
    scratch: Path
    log: Path

    def in_child(self, text: str, task: Task) -> None:
        """Run a task in a child process: an error on one of COLMAP's threads aborts the process that it runs in."""
        in_child(text, self.log, MEMORY_HINT, task)

    def features_file(self, settings: SfmSettings) -> Path:
        """The database with the features as extracted."""
        return self.scratch / f"features{features_name(settings)}.db"

    def floor_source(self, settings: SfmSettings) -> FloorSource:
        """What floor features are made from."""
        calibration, motion = self.cameras.calibration, self.cameras.motion
        return FloorSource(self.features_file(settings), self.images, self.names, self.frames, calibration, motion)


def prepare_scene(r: StageRun[SfmSettings]) -> SceneInput:
    """The scene with its images in one folder, and its lenses and readout times as estimated from pairs of images."""
    frames, sessions = r.read("import", "frames"), r.read("import", "sessions").set_index("session_id")
    if len(frames) < MIN_FRAMES:
        raise UserError(
            "too few frames for a model",
            where=r.folder("import") / "frames.parquet",
            expected=f"at least {MIN_FRAMES}",
            found=len(frames),
            do="capture more, or let import keep more (its table rejects says what was left out and why)",
        )
    log = r.scratch / "colmap.log"
    preload(*_OF_TASKS)
    devices = dict(zip(sessions.index, sessions["device"], strict=True))
    jumps = r.read("import", "jumps")
    cameras = camera_log(frames, devices, r.read("import", "vio"), jumps, r.settings)
    scene = SceneInput(
        frames=with_lenses(frames, cameras.calibration),
        cameras=cameras,
        recording_N=frames["session_id"].map(sessions["recording"]).to_numpy(),
        vio=_odometry(frames, jumps),
        names=_link_images(r, frames),
        images=r.scratch / "images",
        scratch=r.scratch,
        log=log,
    )
    return scene if r.settings.refine_cameras == "never" else _calibrated(r, scene)


def extracted_features(r: StageRun[SfmSettings], scene: SceneInput, settings: SfmSettings) -> Path:
    """The database with the features as extracted; UserError where hardly any image has some."""
    database = scene.features_file(settings)
    if not database.is_file():
        partial = database.with_suffix(".partial.db")
        create_database(partial, scene.frames, scene.names)
        with r.step("features"):
            task = Task(extract_features, (partial, scene.images, scene.names, settings), len(scene.names))
            scene.in_child("extracting features", task)
        partial.replace(database)
    with_features = np.count_nonzero(keypoint_counts(database, len(scene.names)))
    if with_features < MIN_FRAMES:
        raise UserError(
            "the images have hardly any features",
            expected=f"at least {MIN_FRAMES} images with features",
            found=f"{with_features} of {len(scene.names)}",
            do=f"look at the images of scene {r.scene.name}: blank, black or all blurred ones can't be placed",
        )
    return database


def calibrated_features(r: StageRun[SfmSettings], scene: SceneInput, settings: SfmSettings) -> Path:
    """The database with lenses, and features without the effect of rolling shutter."""
    database = scene.scratch / f"database{features_name(settings)}.db"
    features = extracted_features(r, scene, settings)
    with r.step("features"):
        if not database.is_file():
            cameras = (scene.cameras.calibration, scene.cameras.motion)
            write_calibrated_database(features, database, scene.frames, scene.names, *cameras)
    return database


def _link_images(r: StageRun[SfmSettings], frames: pd.DataFrame) -> list[str]:
    """Links give COLMAP one image folder, and its model names that mean the same on every machine."""
    names = []
    for frame_id, image in zip(frames["frame_id"], frames["image"], strict=True):
        source, name = r.image_path(image), image_name(frame_id, image)
        if not source.is_file():
            hint = run_command(r.data.run(r.profile, r.scene.name, "import"))
            raise UserError(f"the image of frame {frame_id} is missing", where=source, do=hint)
        link = r.scratch / "images" / name
        if not link.is_symlink():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(source.absolute())
        names.append(name)
    return names


def _odometry(frames: pd.DataFrame, jumps: pd.DataFrame) -> Odometry:
    vio_T_cam = poses_of(frames, "vio_cam")
    # A pose that the phone itself calls limited or lost may stand still while the phone moves.
    vio_T_cam[frames["tracking"].isin([Tracking.LIMITED, Tracking.LOST]).to_numpy()] = np.nan
    return odometry(
        frames["session_id"].to_numpy(object),
        frames["t_ns"].to_numpy(np.int64),
        vio_T_cam,
        frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan),
        zip(
            jumps["session_id"].to_numpy(str),
            jumps["t_ns"].to_numpy(np.int64),
            jumps["jump_m"].to_numpy(float),
            np.radians(jumps["jump_deg"].to_numpy(float)),
            strict=True,
        ),
    )


def _calibrated(r: StageRun[SfmSettings], scene: SceneInput) -> SceneInput:
    path = scene.scratch / "calibration.json"
    if not path.is_file():
        database = extracted_features(r, scene, r.settings)
        with r.step("calibration"):
            proposals = pairs_within_sessions(r.settings, scene.frames, scene.recording_N, scene.vio)
            untimed = pairs_of_untimed(r.settings, scene.frames, scene.recording_N, database, r.seed)
            pairs = unique_pairs(np.concatenate([untimed, *(pairs for _, pairs in proposals)]))
            images = CalibrationImages(database, scene.frames, scene.names, scene.cameras.motion)
            arguments = (images, pairs, scene.cameras.calibration, r.settings, r.seed, path)
            scene.in_child("calibrating lenses", Task(calibrate, arguments, None))
    calibration = Calibration.load(path)
    frames = with_lenses(scene.frames, calibration)
    log, jumps = r.read("import", "vio"), r.read("import", "jumps")
    motion = motion_by_vio(frames, log, jumps, calibration.time_offset_s[calibration.lens])
    return replace(scene, frames=frames, cameras=replace(scene.cameras, calibration=calibration, motion=motion))
