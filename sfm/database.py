"""Where COLMAP works: links to the images, and its database of a scene, with a camera for each frame and the results of
extraction and matching."""

import contextlib
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from groundwalk.features.sift import Features, even_sift
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.child import Report, Task, in_child
from groundwalk.store.files import written_aside
from groundwalk.store.hints import setting_of
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel

Ints = NDArray[np.int64]
_MEMORY_HINT = f"too little memory needs a smaller max_features or {setting_of('sfm', 'max_image_size')}"
# Half of OpenCV's: what is fainter is noise, and what is between the two joins models where walls are blank.
_MIN_CONTRAST = 0.02


@dataclass(frozen=True)
class Workspace:
    """`images` holds a link to the image of each of N frames, by its name; `scratch` is for checkpoints; `blurred` has
    by name the boxes (B, 4) that get no features: left, top, right and bottom, px."""

    images: Path
    names: Sequence[str]
    scratch: Path
    blurred: Mapping[str, Array]

    def are_usable(self, row: int, px: NDArray[Any]) -> NDArray[np.bool_]:
        """Which keypoints (K, 2) of a row's image lie in none of its boxes, (K,)."""
        boxes = self.blurred.get(self.names[row], np.empty((0, 4)))
        is_inside = (px[:, None] > boxes[:, :2]) & (px[:, None] < boxes[:, 2:])
        return ~np.any(np.all(is_inside, axis=2), axis=1)

    def in_child(self, text: str, task: Task) -> Any:
        """The result of a task in a child process: an error on one of COLMAP's threads aborts the one it runs in."""
        return in_child(text, self.scratch / "colmap.log", _MEMORY_HINT, task)


def image_names(frames: pd.DataFrame) -> list[str]:
    """Names of frames in COLMAP: their ids with the file's suffix, without spaces, which separate names in lists."""
    pairs = zip(frames["frame_id"], frames["image"], strict=True)
    return [quote(frame_id, safe="/") + Path(image).suffix for frame_id, image in pairs]


def image_id(row: int) -> int:
    """COLMAP's id of the image, camera, rig and frame of a row of the frames table; COLMAP counts from 1."""
    return row + 1


def inverse_of(b_from_a: pycolmap.Rigid3d) -> Array:
    """a_T_b (4, 4)."""
    b_T_a = b_from_a.matrix()
    return inverse(make_pose(b_T_a[:, :3], b_T_a[:, 3]))


def pose_of(image: pycolmap.Image) -> Array:
    """sfm_T_cam (4, 4) of a registered image."""
    return inverse_of(image.cam_from_world())


def keypoints_px(opened: pycolmap.Database, row: int) -> Array:
    """The keypoints (K, 2) of a row's image, px."""
    return opened.read_keypoints(image_id(row))[:, :2].astype(float)


def camera_of(frame: Any, camera_id: int) -> pycolmap.Camera:
    """A row of the frames table as a COLMAP camera.

    PINHOLE without coefficients of distortion, otherwise the smaller of OPENCV and FULL_OPENCV that holds them.
    """
    distortion = [float(k) for k in frame.distortion][:8]
    model, count = ("OPENCV", 4) if len(distortion) <= 4 else ("FULL_OPENCV", 8)
    if not distortion:
        model, count = "PINHOLE", 0
    distortion += [0.0] * (count - len(distortion))
    params = [frame.fx, frame.fy, frame.cx, frame.cy, *distortion]
    width, height = int(frame.width), int(frame.height)
    camera = pycolmap.Camera(camera_id=camera_id, model=model, width=width, height=height, params=params)
    camera.has_prior_focal_length = True
    return camera


def create_database(
    path: Path, frames: pd.DataFrame, names: Sequence[str], shared: Mapping[str, pycolmap.Camera] | None = None
) -> None:
    """Write a database with one camera, rig, frame and image for each row of `frames`, unless it is there; or with
    the camera that each session's images are to share."""
    if path.is_file():
        return
    with (
        written_aside(path) as partial,
        pycolmap.Database.open(partial) as database,
        pycolmap.DatabaseTransaction(database),
    ):
        for row, frame in enumerate(frames.itertuples(index=False)):
            number = image_id(row)
            camera = camera_of(frame, number) if shared is None else shared[str(frame.session_id)]
            if not database.exists_camera(camera.camera_id):
                rig = pycolmap.Rig(rig_id=camera.camera_id)
                rig.add_ref_sensor(camera.sensor_id)
                database.write_camera(camera, use_camera_id=True)
                database.write_rig(rig, use_rig_id=True)
            image = pycolmap.Image(image_id=number, camera_id=camera.camera_id, name=names[row])
            colmap_frame = pycolmap.Frame(frame_id=number, rig_id=camera.camera_id)
            colmap_frame.add_data_id(image.data_id)
            image.frame_id = number
            database.write_frame(colmap_frame, use_frame_id=True)
            database.write_image(image, use_image_id=True)


def is_sound(path: Path) -> bool:
    """Whether SQLite can read a database."""
    try:
        with contextlib.closing(sqlite3.connect(f"file:{quote(str(path))}?mode=ro", uri=True)) as opened:
            return opened.execute("PRAGMA quick_check(1)").fetchone() == ("ok",)
    except sqlite3.DatabaseError:
        return False


def copy_features(source: Path, target: Path) -> None:
    """Copy keypoints and descriptors of images that have the same name in both databases."""
    with _opened(source, target) as (old, new, id_of):
        for old_id, new_id in id_of.items():
            new.write_keypoints(new_id, old.read_keypoints(old_id))
            new.write_descriptors(new_id, old.read_descriptors(old_id))


def copy_matches(source: Path, target: Path) -> None:
    """Copy the matches, verified or not, that `target` lacks of images that have the same name in both databases."""
    with _opened(source, target) as (old, new, id_of):
        for pair_id in old.read_num_matches()[0]:
            a, b = pycolmap.pair_id_to_image_pair(pair_id)
            if a in id_of and b in id_of and not new.exists_matches(id_of[a], id_of[b]):
                new.write_matches(id_of[a], id_of[b], old.read_matches(a, b))


@contextlib.contextmanager
def _opened(source: Path, target: Path) -> Iterator[tuple[pycolmap.Database, pycolmap.Database, dict[int, int]]]:
    """Both databases, and the ids in `target` of those images of `source` whose names it has."""
    with (
        pycolmap.Database.open(source) as old,
        pycolmap.Database.open(target) as new,
        pycolmap.DatabaseTransaction(new),
    ):
        id_of_name = {image.name: image.image_id for image in new.read_all_images()}
        ids = {image.image_id: id_of_name.get(image.name) for image in old.read_all_images()}
        yield old, new, {old_id: new_id for old_id, new_id in ids.items() if new_id is not None}


@contextlib.contextmanager
def descriptors_of(path: Path, count: int) -> Iterator[tuple[Callable[[int], NDArray[np.uint8]], Ints]]:
    """What reads SIFT's descriptors (M, 128) of a frame by its row, as those of thousands of frames take gigabytes, and
    how many each of the `count` frames has."""
    with pycolmap.Database.open(path) as database:
        counts = np.array([database.num_descriptors_for_image(image_id(row)) for row in range(count)])
        yield (lambda row: database.read_descriptors(image_id(row)).data), counts


def read_keypoints(path: Path, count: int) -> list[Array]:
    """The keypoints (K, 2) of each of the `count` frames, px."""
    with pycolmap.Database.open(path) as database:
        return [keypoints_px(database, row) for row in range(count)]


def keypoint_counts(path: Path, count: int) -> Ints:
    """How many keypoints each of the `count` frames has."""
    with pycolmap.Database.open(path) as database:
        return np.array([database.num_keypoints_for_image(image_id(row)) for row in range(count)])


def has_results(path: Path, pairs: Ints) -> NDArray[np.bool_]:
    """Which pairs of rows (P, 2) have been matched and verified, (P,)."""
    with pycolmap.Database.open(path) as database:
        return np.array([database.exists_two_view_geometry(image_id(a), image_id(b)) for a, b in pairs.tolist()], bool)


def read_pair_results(path: Path, pairs: Ints) -> tuple[Ints, Ints]:
    """Matches and verified inliers of pairs of rows (P, 2); both (P,)."""
    with pycolmap.Database.open(path) as database:
        match_counts = dict(zip(*database.read_num_matches(), strict=True))
        inlier_counts = dict(zip(*database.read_two_view_geometry_num_inliers(), strict=True))
    ids = [pycolmap.image_pair_to_pair_id(image_id(a), image_id(b)) for a, b in pairs.tolist()]
    return np.array([match_counts.get(i, 0) for i in ids], int), np.array([inlier_counts.get(i, 0) for i in ids], int)


def features_name(settings: SfmSettings) -> str:
    """Settings with the same name have the same features."""
    return f"_{settings.max_image_size}_{settings.max_features}"


def extract_features(report: Report, database: Path, work: Workspace, settings: SfmSettings) -> None:
    """Extract features of the named images, the database's rows in order, into it; images that have theirs are skipped.

    Images larger than max_image_size are shrunk first; keypoints are in pixels of the full image.
    """

    def features_of(row: int) -> Features:
        grey = read_grey_image(work.images / work.names[row])
        features = even_sift(grey, settings.max_features, settings.max_image_size, _MIN_CONTRAST)
        kept = work.are_usable(row, features.px)
        return Features(features.px[kept], features.size_px[kept], features.descriptors[kept])

    sift = pycolmap.FeatureExtractorType.SIFT
    with pycolmap.Database.open(database) as opened:
        rows = [row for row in range(len(work.names)) if not opened.exists_keypoints(image_id(row))]
        described = in_parallel(features_of, rows)
        for row, features in zip(rows, described, strict=True):
            with pycolmap.DatabaseTransaction(opened):
                opened.write_keypoints(image_id(row), features.px)
                descriptors = pycolmap.FeatureDescriptors(data=features.descriptors, type=sift)
                opened.write_descriptors(image_id(row), descriptors)
            report(row + 1)
