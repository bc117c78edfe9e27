"""What the stage works on: images, VIO, features, and cameras before a model adjusts them."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.lenses import started, with_lenses, write_lens_database
from groundwalk.sfm.cameras.model_adjustment import CameraLog, camera_log
from groundwalk.sfm.cameras.starts import ESTIMATED_SD, estimate_focal_lengths, sample_unstated, start_lenses
from groundwalk.sfm.database import (
    Workspace,
    copy_features,
    copy_matches,
    create_database,
    extract_features,
    features_name,
    image_names,
    is_sound,
    keypoint_counts,
)
from groundwalk.sfm.mapping.attempts import settings_of_size
from groundwalk.sfm.pairs.candidates import unique_pairs
from groundwalk.sfm.pairs.odometry import Odometry, odometry
from groundwalk.sfm.pairs.selection import pairs_within_sessions
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.child import Task
from groundwalk.store.choices import UNTRACKED, CameraOrigin
from groundwalk.store.files import write_json, written_aside
from groundwalk.store.hints import run_command
from groundwalk.store.manifests import BLURRED, FEATURES
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, read_table

_MIN_FRAMES = 3
_LENSES = "estimated_lenses.json"
# Import blurs a fifth more on each side of a box; where that ends is an edge that moves with whoever is behind it.
_BLURRED_MORE = 0.3
_STATED_SIGMAS = 3.0  # beyond which the focal length that EXIF states is told to be wrong
_FEW_SIGMAS = 7.0  # so far off EXIF's it counts of a camera with one or two photos: of a facade they are off by 25 %


def linked_images(r: StageRun[SfmSettings], frames: pd.DataFrame) -> Workspace:
    """Links give COLMAP one image folder, and its model names that mean the same on every machine."""
    if len(frames) < _MIN_FRAMES:
        raise UserError(
            "too few frames for a model",
            where=r.folder("import") / "frames.parquet",
            expected=f"at least {_MIN_FRAMES}",
            found=len(frames),
            do="capture more, or let import keep more (its table rejects says what was left out and why)",
        )
    names = image_names(frames)
    for frame_id, image, name in zip(frames["frame_id"], frames["image"], names, strict=True):
        source = r.image_path(image)
        if not source.is_file():
            hint = run_command(r.data.run(r.profile, r.scene.name, "import"))
            raise UserError(f"the image of frame {frame_id} is missing", where=source, do=hint)
        link = r.scratch / "images" / name
        if not link.is_symlink():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(source.absolute())
    return Workspace(r.scratch / "images", names, r.scratch, _blurred(r.folder("import") / BLURRED, frames, names))


def _blurred(file: Path, frames: pd.DataFrame, names: Sequence[str]) -> dict[str, Array]:
    """The boxes that a workspace has, by import's table of what it blurred, where it wrote one."""
    if not file.is_file():
        return {}
    table = pd.read_csv(file).dropna(subset=["kind"])
    corner, size = table[["x", "y"]].to_numpy(float), table[["width", "height"]].to_numpy(float)
    boxes = np.hstack([corner - _BLURRED_MORE * size, corner + (1 + _BLURRED_MORE) * size])
    name_of = dict(zip(frames["frame_id"], names, strict=True))
    return {name_of[frame_id]: boxes[rows] for frame_id, rows in table.groupby("frame_id").indices.items()}


def with_focal_lengths(r: StageRun[SfmSettings], frames: pd.DataFrame, work: Workspace) -> pd.DataFrame:
    """The frames table with estimates of the focal lengths that cameras don't log."""
    rows = sample_unstated(frames)
    if not len(rows) or r.settings.refine_cameras == "never":
        return frames
    path = work.scratch / "focal_lengths.json"
    if not path.is_file():
        with r.step("focal lengths"):
            some = frames.iloc[rows].reset_index(drop=True)
            of_some = replace(work, names=[work.names[row] for row in rows], scratch=work.scratch / "focal_lengths")
            arguments = (some, of_some, r.settings, r.seed)
            count = len(rows) * (len(rows) - 1) // 2
            focal_px, k1_k2 = work.in_child("estimating focal lengths", Task(estimate_focal_lengths, arguments, count))
            write_json(work.scratch / _LENSES, k1_k2)
            write_json(path, focal_px)
    found: dict[str, float] = json.loads(path.read_text())
    for session_id in frames.loc[frames["focal_sd"] >= ESTIMATED_SD, "session_id"].unique():
        of_session = frames["session_id"] == session_id
        before_px = float(frames.loc[of_session, "fx"].median())
        if (focal_px := found.get(session_id)) is None:
            r.say(f"session {session_id}: no model tells its focal length: {before_px:.0f} px, by EXIF or a guess")
            continue
        stated_sd = float(frames.loc[of_session, "focal_sd"].median())
        sigmas = abs(np.log(focal_px / before_px)) / stated_sd
        if stated_sd <= ESTIMATED_SD and np.count_nonzero(of_session) < _MIN_FRAMES and sigmas < _FEW_SIGMAS:
            continue
        if sigmas > _STATED_SIGMAS:
            r.say(
                f"warning: session {session_id}: EXIF states a focal length of {before_px:.0f} px, images fit "
                f"{focal_px:.0f} px, which is used: were they cropped, or edited?"
            )
        frames = frames.copy()
        frames.loc[of_session, ["fx", "fy"]] *= focal_px / before_px
        frames.loc[of_session, "focal_sd"] = ESTIMATED_SD
    return frames


def odometry_of(frames: pd.DataFrame, jumps: pd.DataFrame, sessions: pd.DataFrame) -> Odometry:
    """VIO of all frames, from tables import.frames, import.jumps and import.sessions."""
    vio_T_cam = poses_of(frames, "vio_cam")
    vio_T_cam[frames["tracking"].isin(UNTRACKED).to_numpy()] = np.nan
    return odometry(
        frames["session_id"].to_numpy(object),
        frames["session_id"].map(sessions.set_index("session_id")["recording"]).to_numpy(object),
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


def extracted_features(r: StageRun[SfmSettings], frames: pd.DataFrame, work: Workspace, settings: SfmSettings) -> Path:
    """The database with the features as extracted; UserError where hardly any image has some."""
    database = work.scratch / f"features{features_name(settings)}.db"
    if not database.is_file():
        partial = database.with_suffix(".partial.db")
        is_begun = partial.is_file()
        create_database(partial, frames, work.names)
        with r.step("features"):
            if not is_begun and (kept := kept_features(r, settings)):
                copy_features(kept, partial)
            task = Task(extract_features, (partial, work, settings), len(frames))
            work.in_child("extracting features", task)
        partial.replace(database)
    with_features = np.count_nonzero(keypoint_counts(database, len(frames)))
    if with_features < _MIN_FRAMES:
        raise UserError(
            "the images have hardly any features",
            expected=f"at least {_MIN_FRAMES} images with features",
            found=f"{with_features} of {len(frames)}",
            do=f"look at the images of scene {r.scene.name}: blank, black or all blurred ones can't be placed",
        )
    return database


def logged_cameras(r: StageRun[SfmSettings], frames: pd.DataFrame, sessions: pd.DataFrame) -> CameraLog:
    devices = dict(zip(sessions["session_id"], sessions["device"], strict=True))
    return camera_log(frames, devices, r.read("import", "vio"), r.read("import", "jumps"), r.settings)


def with_start_lenses(
    r: StageRun[SfmSettings], frames: pd.DataFrame, vio: Odometry, work: Workspace, cameras: CameraLog
) -> CameraLog:
    if r.settings.refine_cameras == "never":
        return cameras
    path = work.scratch / "start_lenses.json"
    if not path.is_file():
        settings = first_settings(r, frames)
        database = extracted_features(r, with_lenses(frames, cameras.lenses), work, settings)
        with r.step("lenses"):
            pairs = np.concatenate([pairs for _, pairs in pairs_within_sessions(settings, frames, vio)])
            arguments = (database, cameras.lenses, unique_pairs(pairs), r.seed)
            write_json(path, work.in_child("trying lenses", Task(start_lenses, arguments)))
    starts = [np.array(start) for start in json.loads(path.read_text())]
    # Thirty images together tell a lens better than their pairs, which of flat ground tell none.
    estimated = work.scratch / _LENSES
    for session_id, k1_k2 in (json.loads(estimated.read_text()) if estimated.is_file() else {}).items():
        lens = cameras.lenses.lens[np.argmax(frames["session_id"] == session_id)]
        if cameras.lenses.priors[lens].origin != CameraOrigin.STATED:
            starts[lens] = np.r_[k1_k2, np.zeros(6)]
    priors = zip(cameras.lenses.priors, starts, strict=True)
    return cameras.with_priors({number: started(*one) for number, one in enumerate(priors)})


def features_of_cameras(
    r: StageRun[SfmSettings], frames: pd.DataFrame, cameras: CameraLog, work: Workspace, settings: SfmSettings
) -> Path:
    """The database with lenses, and features without the effect of rolling shutter."""
    features = extracted_features(r, frames, work, settings)
    database = work.scratch / f"database{features_name(settings)}.db"
    with r.step("features"):
        if not database.is_file():
            write_lens_database(features, database, frames, work.names, cameras.lenses, cameras.motion)
            if kept := kept_features(r, settings):
                copy_matches(kept, database)
    return database


def kept_settings(r: StageRun[SfmSettings]) -> SfmSettings:
    """The settings of the features that the run before this one has kept."""
    assert r.before is not None
    attempts = read_table(r.before / "attempts.parquet", schema("sfm", "attempts"))
    selected = attempts[attempts["selected"]].iloc[-1]
    taken = {name: int(selected[name]) for name in ("max_features", "max_image_size")}
    return r.settings.model_copy(update=taken)


def first_settings(r: StageRun[SfmSettings], frames: pd.DataFrame) -> SfmSettings:
    """Of the first attempt: of frames that are added those of what is there already."""
    return kept_settings(r) if r.before is not None and r.holds else settings_of_size(r.settings, len(frames))


def kept_features(r: StageRun[SfmSettings], settings: SfmSettings) -> Path | None:
    """A copy of the features and matches that the run before this one has kept, where they are by these settings."""
    if r.before is None or features_name(settings) != features_name(kept_settings(r)):
        return None
    path, copy = r.before / FEATURES, r.scratch / "kept.db"
    if path.is_file() and not copy.is_file():
        with written_aside(copy) as partial:  # SQLite writes beside any database that it opens
            shutil.copyfile(path, partial)
    return copy if copy.is_file() and is_sound(copy) else None


def keep_features(r: StageRun[SfmSettings], work: Workspace, settings: SfmSettings) -> None:
    """Leave the features by these settings, and all matches, for runs that add recordings or take some out."""
    name = features_name(settings)
    with written_aside(r.work / FEATURES) as partial:
        shutil.copyfile(work.scratch / f"features{name}.db", partial)
        copy_matches(work.scratch / f"database{name}.db", partial)
