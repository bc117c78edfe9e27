"""The exported data: the frames that have ground truth, with their images, and SfM's model brought into the map."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import cv2
import numpy as np
import pandas as pd

from groundwalk.geometry import GeometryError
from groundwalk.geometry.cameras import Camera, pinhole_within
from groundwalk.geometry.fits import Sim3, similarity_of_poses
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store import DataRoot, UserError, tables
from groundwalk.store.choices import MapUnit, QualityClass, VerticalSource
from groundwalk.store.files import read_json
from groundwalk.store.georeference import FILE, Georeference, read_georeference
from groundwalk.store.hints import run_command, setting_of
from groundwalk.store.images import exif_orientation, image_file, verify_images, without_metadata
from groundwalk.store.manifests import MANIFEST, load_verified, missing_stage
from groundwalk.store.undistortion import undistorted_image

Images = Literal["link", "copy", "none"]

JPEG_QUALITY = 95
# From +y up to +z up: a quarter turn about x.
WORLD_T_MAP = make_pose([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]], np.zeros(3))
# An estimated lens that moves no pixel further is none.
_MAX_SHIFT_PX = 0.1
# Cameras of one device and lens are one where it moves no corner of an image further than a feature is off.
MAX_APART_PX = 0.5
# Frames of one device and lens are seen by one pinhole where none of them loses more of its width to it.
_MAX_CROP = 0.05
_OF_GROUND_TRUTH = [
    *("frame_id", "quality", "reason", "component", "scale_source", "vertical_source"),
    *("covariance", "position_sd_m", "rotation_sd_deg"),
]


@dataclass(frozen=True)
class SfmModel:
    """One of SfM's models: its folder, the frames with ground truth that are in it, and map_S_sfm."""

    folder: Path
    frame_ids: list[str]
    map_S_sfm: Sim3


@dataclass(frozen=True)
class ImageSource:
    """Where an exported image comes from: its file and, where its lens's distortion is taken out of it, the camera that
    took it and the pinhole whose image is written."""

    file: Path
    undistorted: tuple[Camera, Camera] | None = None

    @property
    def suffix(self) -> str:
        """The exported file's: an undistorted image is written anew, as PNG where it was one, otherwise as JPEG."""
        if self.undistorted is None:
            return self.file.suffix
        return ".png" if self.file.suffix.lower() == ".png" else ".jpg"

    def existing(self) -> Path:
        """Its file; UserError where that is gone."""
        if not self.file.is_file():
            raise UserError("an image is missing", where=self.file, do="import the scene again")
        return self.file

    def place(self, target: Path, images: Images) -> None:
        """Link the image to `target`, or copy it without metadata, as one is that readers would turn by its EXIF;
        undistorted, or as the PNG that `target` asks for, it's written anew."""
        if images == "none":
            return
        self.existing()
        target.parent.mkdir(parents=True, exist_ok=True)
        if self.undistorted is None and (target.suffix == self.file.suffix or target.suffix != ".png"):
            if images == "link" and exif_orientation(self.file) == 1:
                target.symlink_to(self.file.resolve())
            else:
                target.write_bytes(without_metadata(self.file.read_bytes()))
            return
        # As stored: a viewer's turn isn't applied, since the intrinsics are the sensor's.
        pixels = cv2.imread(str(self.file), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if pixels is None:
            raise UserError("an image can't be decoded", where=self.file, do="import the scene again")
        if self.undistorted is not None:
            try:
                pixels = undistorted_image(np.asarray(pixels, np.uint8), *self.undistorted)
            except GeometryError as error:
                do = "import the scene again"
                raise UserError("an image can't be undistorted", where=self.file, found=error, do=do) from None
        options = [] if target.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
        if not cv2.imwrite(str(target), pixels, options):
            raise UserError("an image can't be written", where=target)


@dataclass(frozen=True)
class Dataset:
    """`frames` (N rows) have ground truth, `excluded` have none; both are import.frames with align's quality, reason
    and component, and the cameras that the poses go with. `images` are the N images, `map_T_cam` (N, 4, 4) their poses,
    `models` SfM's, largest first. `origin` is where the map's origin is in the coordinates that its reference poses
    were stated in; None where no reference gave the map, (0, 0, 0) where these are the map's. `sessions` is import's
    table, `split_by` what decided its splits; `licence` and `citation` are what the user gives it out with.
    `georeference` is where on earth the map is, where the user gives that out, too; `reads_gps`: import read phones'
    positions. `apart_px` is by how much cameras of one device and lens that stay one a frame differ, at most."""

    frames: pd.DataFrame
    excluded: pd.DataFrame
    map_T_cam: Array
    images: list[ImageSource]
    models: list[SfmModel]
    simulated: bool
    origin: tuple[float, float, float] | None = None
    scene: str = ""
    sessions: pd.DataFrame = field(default_factory=pd.DataFrame)
    split_by: str = ""
    licence: str = ""
    citation: str = ""
    georeference: Georeference | None = None
    reads_gps: bool = False
    apart_px: float = 0.0

    @property
    def world(self) -> str:
        """Unit, axes and origin of the map, in words."""
        moved = self.origin is not None and any(self.origin)
        origin = "; add map_origin to come back to the data set's own coordinates," if moved else ""
        return f"{world_of(self.frames)}{origin}"

    @property
    def in_test(self) -> np.ndarray:
        """(N,) for formats that know training and test alone: validation frames are part of the training walks."""
        return (self.frames["split"] == "test").to_numpy()

    def rows_of(self, frame_ids: Sequence[str]) -> list[int]:
        """Rows of frames with these ids."""
        row_of = {frame_id: row for row, frame_id in enumerate(self.frames["frame_id"])}
        return [row_of[frame_id] for frame_id in frame_ids]

    def sequences(self) -> list[tuple[bool, np.ndarray]]:
        """(for testing, rows in order of time) of each sequence, for formats in which one is wholly for training or for
        testing: a session, or its part in a split."""
        found = []
        for session_id in sorted(self.frames["session_id"].unique()):
            for test in (False, True):
                rows = np.flatnonzero((self.frames["session_id"] == session_id) & (self.in_test == test))
                if len(rows):
                    found.append((test, rows[np.argsort(self.frames["t_ns"].to_numpy()[rows], kind="stable")]))
        return found

    @property
    def cameras(self) -> list[Camera]:
        return [tables.camera_of(frame) for frame in self.frames.itertuples(index=False)]

    @property
    def devices(self) -> list[str]:
        """(N,) what took each frame: the device, or the session where nothing says which."""
        named = self.sessions.set_index("session_id")["device"].fillna("")
        return [str(named[session_id] or session_id) for session_id in self.frames["session_id"]]

    @property
    def image_names(self) -> list[str]:
        """(N,) `<session>/<number>` as file names."""
        return [quote(i, safe="/") + s.suffix for i, s in zip(self.frames["frame_id"], self.images, strict=True)]

    @property
    def undistorted(self) -> int:
        """How many images are written without distortion."""
        return sum(image.undistorted is not None for image in self.images)

    def without_distortion(self, max_coefficients: int = 0) -> "Dataset":
        """The dataset for a format that holds `max_coefficients` of distortion.

        Frames that have more become those of a pinhole of the same image size (`pinhole_within`), images and cameras
        alike; their poses stay. A lens that moves no corner of its image by 0.1 px is none. UserError where a frame's
        camera leaves no such pinhole.
        """
        images, cameras = list(self.images), self.cameras
        for row, camera in enumerate(cameras):
            if len(np.trim_zeros(camera.distortion, "b")) <= max_coefficients:
                continue
            pinhole = replace(camera, distortion=())
            if _apart_px(camera, pinhole) <= _MAX_SHIFT_PX:
                cameras[row] = pinhole
                continue
            cameras[row] = self._pinhole(row, camera)
            images[row] = replace(images[row], undistorted=(camera, cameras[row]))
        return self._with_cameras(cameras, images)

    def with_pinholes(self) -> "Dataset":
        """The dataset as centred pinholes took it, one a device, lens and image size: the shortest that sees nothing
        beyond any of these images. Where one of them would lose more than 5 % of its width to it, as by a zoom, each
        has its own. UserError where a frame's camera leaves no such pinhole."""
        images, cameras = list(self.images), self.cameras
        pinholes = [self._pinhole(row, camera) for row, camera in enumerate(cameras)]
        for rows in self._lenses(cameras):
            narrowest = max((pinholes[row] for row in rows), key=lambda pinhole: pinhole.fx)
            if narrowest.fx * (1 - _MAX_CROP) <= min(pinholes[row].fx for row in rows):
                for row in rows:
                    pinholes[row] = narrowest
        for row, (camera, pinhole) in enumerate(zip(cameras, pinholes, strict=True)):
            # A captured image that is the pinhole's already stays as it is.
            if _apart_px(camera, pinhole) > _MAX_SHIFT_PX:
                images[row] = replace(images[row], undistorted=(camera, pinhole))
        return self._with_cameras(pinholes, images)

    def with_shared_cameras(self) -> "Dataset":
        """Frames of one device, lens and image size get one camera, with the median focal lengths and principal point,
        where it is at most 0.5 px from each of theirs in every corner. Otherwise each keeps its own, and `apart_px`
        says how far they are apart."""
        cameras, apart_px = self.cameras, 0.0
        for rows in self._lenses(cameras):
            own = [cameras[row] for row in rows]
            fx, fy, cx, cy = np.median([(c.fx, c.fy, c.cx, c.cy) for c in own], axis=0).tolist()
            shared = replace(own[0], fx=fx, fy=fy, cx=cx, cy=cy)
            if (off_px := max(_apart_px(camera, shared) for camera in own)) > MAX_APART_PX:
                apart_px = max(apart_px, off_px)
                continue
            for row in rows:
                cameras[row] = shared
        return replace(self._with_cameras(cameras, self.images), apart_px=apart_px)

    def _lenses(self, cameras: list[Camera]) -> list[list[int]]:
        """Rows of frames of one device, lens and image size."""
        found: dict[Any, list[int]] = {}
        for row, (device, camera) in enumerate(zip(self.devices, cameras, strict=True)):
            found.setdefault((device, camera.width, camera.height, camera.distortion), []).append(row)
        return list(found.values())

    def _pinhole(self, row: int, camera: Camera) -> Camera:
        try:
            return pinhole_within(camera)
        except GeometryError as error:
            raise UserError(
                "an image can't be undistorted",
                where=self.frames["frame_id"].iloc[row],
                found=error,
                do="export as colmap, which holds the distortion, or check what the capture states of its lens",
            ) from None

    def _with_cameras(self, cameras: list[Camera], images: list[ImageSource]) -> "Dataset":
        columns = {name: [getattr(camera, name) for camera in cameras] for name in tables.CAMERA_COLUMNS}
        return replace(self, frames=self.frames.assign(**columns), images=images)


def _apart_px(camera: Camera, other: Camera) -> float:
    """How far from the corners of `other`'s image `camera` sees what is there, at most; inf where `other` sees none."""
    if camera == other:
        return 0.0
    corners = np.array([[x, y] for x in (0, other.width) for y in (0, other.height)], dtype=float)
    off_px = np.linalg.norm(camera.project(other.unproject(corners)) - corners, axis=1)
    return float(np.nan_to_num(off_px, nan=np.inf).max())


def world_of(truth: pd.DataFrame) -> str:
    """Unit and axes of a map in words, by the sources of its ground truth's scale and vertical."""
    unit = tables.map_unit(truth)
    scale = "" if unit is MapUnit.METRE else ", without a metric scale"
    axes = {
        VerticalSource.REFERENCE_UP_UNKNOWN: "a reference's axes, up unknown",
        VerticalSource.NONE: "axes of a phone's start, up unknown",
    }
    unknown = [axes[source] for source in axes if (truth["vertical_source"] == source).any()]
    return f"{unit}{scale}, {unknown[0] if unknown else '+y up'}"


def load_dataset(root: DataRoot, profile: str, scene: str, *, reads_images: bool = True) -> Dataset:
    """Read a scene's finished import, sfm and align stages.

    Raises UserError where one is missing, where align wasn't made from this sfm, where no frame has ground truth, or,
    for an export with images, where one of them isn't as import saw it.
    """
    run = root.run(profile, scene)
    align, aligned = read_finished(root, profile, scene, "align")
    imported, import_manifest = read_finished(root, profile, scene, "import", aligned)
    sfm, _ = read_finished(root, profile, scene, "sfm", aligned)
    if reads_images:
        verify_images(root.captures(scene), imported)
    ground_truth = tables.table_of(run, "align", "ground_truth")
    images = tables.table_of(run, "sfm", "images")
    frames = tables.dataset_frames(tables.table_of(run, "import", "frames")).merge(
        ground_truth[_OF_GROUND_TRUTH], on="frame_id", validate="one_to_one"
    )
    frames = tables.with_cameras(frames, ground_truth)
    has_pose = (frames["quality"] != QualityClass.NONE).to_numpy()
    if not has_pose.any():
        raise UserError("nothing to export: no frame has ground truth", where=align)
    ids = frames.loc[has_pose, "frame_id"]
    map_T_cam = tables.poses_of(ground_truth.set_index("frame_id").loc[ids], "map_cam")
    of_sfm = images.set_index("frame_id").loc[ids]
    sfm_T_cam = tables.poses_of(of_sfm, "sfm_cam")
    # Components are numbered by their frames, COLMAP's folders by the size of what was mapped: the same in most runs.
    folder_of = tables.table_of(run, "sfm", "models").set_index("model_id")["folder"]
    models, component = [], frames.loc[has_pose, "component"].to_numpy(int)
    for rows in (np.flatnonzero(component == index) for index in np.unique(component)):
        folder = sfm / folder_of[of_sfm["model_id"].iloc[rows[0]]]
        models.append(SfmModel(folder, ids.iloc[rows].tolist(), similarity_of_poses(map_T_cam[rows], sfm_T_cam[rows])))
    captures = root.captures(scene)
    x, y, z = (aligned["figures"].get(f"map_origin_{axis}") for axis in "xyz")
    return Dataset(
        frames[has_pose].reset_index(drop=True),
        frames[~has_pose].reset_index(drop=True),
        map_T_cam,
        [ImageSource(image_file(image, captures, imported)) for image in frames.loc[has_pose, "image"]],
        models,
        bool(aligned["simulated"]),
        None if x is None or y is None or z is None else (x, y, z),
        scene,
        tables.table_of(run, "import", "sessions"),
        str(import_manifest.get("figures", {}).get("split", "")),
        reads_gps=bool(import_manifest.get("settings", {}).get("gps", False)),
    )


def with_georeference(dataset: Dataset, align: Path) -> Dataset:
    """The dataset with where on earth its map is, of align's folder; UserError where it doesn't know."""
    found = read_georeference(align)
    if found is None:
        raise UserError(
            "nothing says where on earth the map is",
            where=align,
            found=str(read_json(align / FILE).get("refused", "no georeference was asked for")),
            do=f"{setting_of('import', 'gps = true')}, or survey points in WGS84 (docs/how-to/georeference.md), and "
            "run align; or leave --georeference out",
        )
    return replace(dataset, georeference=found)


def read_finished(
    root: DataRoot, profile: str, scene: str, stage: str, reader: dict[str, Any] | None = None
) -> tuple[Path, dict[str, Any]]:
    """Folder and verified manifest of a finished stage; UserError where it hasn't been run, or is another run than the
    one that a later stage, whose manifest is `reader`, was made from."""
    folder = root.run(profile, scene, stage)
    if not (folder / MANIFEST).is_file():
        raise missing_stage(folder, stage, scene)
    manifest = load_verified(folder)
    outputs = manifest["outputs"]
    if reader is not None and reader.get("inputs", {}).get(f"{scene}/{stage}", outputs) != outputs:
        later = root.run(profile, scene, str(reader.get("stage")))
        raise UserError(f"stage {later.name} read another run of stage {stage}", where=later, do=run_command(later))
    return folder, manifest


def numbers(*values: float, separator: str = " ") -> str:
    """Numbers as text that reads back the same."""
    return separator.join(repr(float(value)) for value in values)


def write_lines(file: Path, lines: Iterable[str]) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")
