"""COLMAP: `sparse/0` with cameras, images and points in the map, `images/`, and lists of image names by split; and the
layouts of hloc and kapture, which have COLMAP's cameras.

Format: https://colmap.github.io/format.html (world-to-camera poses, quaternions w first in text; pixel centres at 0.5,
as ours). The world is the map: metric, +y up. Each of SfM's models without a common view with the others has a separate
folder: `sparse/1`, ... Cameras are PINHOLE, OPENCV, or FULL_OPENCV with k3; equal ones of one device are one camera,
with a rig of its own alone. Observations of points are without the effect of a rolling shutter, so they may lie pixels
from the images' features; where images are undistorted, observations are, too.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote, unquote

import numpy as np
import pycolmap

from groundwalk.export.dataset import Dataset, Images, SfmModel, numbers, write_lines
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import inverse, tq_from_pose
from groundwalk.store import UserError
from groundwalk.store.hints import setting_of

# Of OpenCV's coefficients, in its order, as in FULL_OPENCV.
DISTORTION = 8
_VERSION = "# kapture format: 1.1"


def write_colmap(dataset: Dataset, folder: Path, images: Images, *, text: bool = False) -> list[str]:
    """Write the layout; returns the frames' image paths. Frames without ground truth aren't in the model. Where the
    map's place on earth is given out, `geo_registration.txt` has each image's latitude, longitude and altitude, as
    `model_aligner --ref_is_gps 1` reads them."""
    names = dataset.image_names
    for index, sfm_model in enumerate(dataset.models):
        write_model(model_in_map(dataset, sfm_model, names), folder / "sparse" / str(index), text=text)
    write_splits(dataset, folder, names)
    if dataset.georeference is not None:
        _, _, geodetic = dataset.georeference.places(dataset.map_T_cam[:, :3, 3])
        # A place without altitude is on the ellipsoid to COLMAP.
        rows = zip(names, np.nan_to_num(geodetic), strict=True)
        write_lines(folder / "geo_registration.txt", [f"{name} {numbers(*place)}" for name, place in rows])
    return place_images(dataset, folder, names, images)


def write_splits(dataset: Dataset, folder: Path, names: Sequence[str]) -> None:
    """Write the names of each split's images, "" being none."""
    for split in ("train", "val", "test"):
        named = zip(names, dataset.frames["split"], strict=True)
        write_lines(folder / f"{split}.txt", [name for name, of in named if name and of == split])


def place_images(dataset: Dataset, folder: Path, names: Sequence[str], images: Images) -> list[str]:
    """Write the images that have a name into `images/`; returns the paths, "" for the others."""
    for source, name in zip(dataset.images, names, strict=True):
        if name:
            source.place(folder / "images" / name, images)
    return [f"images/{name}" if name else "" for name in names]


def model_in_map(dataset: Dataset, sfm_model: SfmModel, names: Sequence[str]) -> pycolmap.Reconstruction:
    """One of SfM's models in the map, with the frames that it names alone, under their `names` and with the dataset's
    cameras. Of images that are undistorted, observations beyond the image are left out, and points that have two at
    most with them. UserError where SfM's model lacks one of the frames."""
    if not sfm_model.folder.is_dir():
        raise UserError("a SfM model is missing", where=sfm_model.folder, do="run the sfm stage again")
    found = pycolmap.Reconstruction(sfm_model.folder)
    to_map = sfm_model.map_S_sfm
    found.transform(pycolmap.Sim3d(to_map.scale, pycolmap.Rotation3d(to_map.rotation), to_map.translation))
    by_frame = {unquote(str(Path(image.name).with_suffix(""))): image for image in found.images.values()}
    if missing := set(sfm_model.frame_ids) - by_frame.keys():
        raise UserError(
            "a SfM model lacks frames that have ground truth",
            where=sfm_model.folder,
            found=f"{len(missing)} missing, such as {min(missing)}",
            do="run the sfm and align stages again",
        )
    for frame_id in by_frame.keys() - set(sfm_model.frame_ids):
        found.deregister_frame(by_frame[frame_id].frame_id)
    rows = dataset.rows_of(sfm_model.frame_ids)
    listed = [by_frame[frame_id] for frame_id in sfm_model.frame_ids]
    model, ids = pycolmap.Reconstruction(), dict[tuple[str, Camera], int]()
    cameras, devices = dataset.cameras, dataset.devices
    pixels = []
    for row, image in zip(rows, listed, strict=True):
        key = (devices[row], cameras[row])
        if key not in ids:
            ids[key] = len(ids) + 1
            name, parameters = colmap_camera(cameras[row])
            size = {"width": cameras[row].width, "height": cameras[row].height}
            camera = pycolmap.Camera(camera_id=ids[key], model=name, params=parameters, **size)
            model.add_camera_with_trivial_rig(camera)
        at = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        if dataset.images[row].undistorted is not None:
            at = cameras[row].project(found.camera(image.camera_id).cam_from_img(at))
            inside = ((at >= 0) & (at <= [cameras[row].width, cameras[row].height])).all(axis=1)
            for index in np.flatnonzero(~inside):
                if image.points2D[index].has_point3D():
                    found.delete_observation(image.image_id, int(index))
        pixels.append(at)
    for row, image, at in zip(rows, listed, pixels, strict=True):
        points = [pycolmap.Point2D(xy, of.point3D_id) for xy, of in zip(at, image.points2D, strict=True)]
        copy = pycolmap.Image(
            name=names[row],
            points2D=pycolmap.Point2DList(points),
            camera_id=ids[devices[row], cameras[row]],
            image_id=image.image_id,
        )
        model.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point_id, point in found.points3D.items():
        model.add_point3D_with_id(point_id, point)
    return model


def write_model(model: pycolmap.Reconstruction, folder: Path, *, text: bool = False) -> None:
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(folder)


def colmap_camera(camera: Camera) -> tuple[str, list[float]]:
    """COLMAP's model and its parameters."""
    lens = list(np.trim_zeros(camera.distortion, "b"))
    model, count = ("PINHOLE", 0) if not lens else ("OPENCV", 4) if len(lens) <= 4 else ("FULL_OPENCV", DISTORTION)
    return model, [camera.fx, camera.fy, camera.cx, camera.cy, *lens, *[0.0] * (count - len(lens))]


def camera_fields(camera: Camera) -> list[str]:
    """COLMAP's model, size and parameters, as text."""
    model, parameters = colmap_camera(camera)
    return [model, str(camera.width), str(camera.height), *map(numbers, parameters)]


def write_hloc(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """What hloc's scripts of localising take: in `reference/` the model of the frames that aren't for testing,
    `queries_with_intrinsics.txt` of test images, and `queries_poses.txt`, as its results have them. Returns the frames'
    image paths, "" for those outside of the largest of SfM's models, which is the only one that hloc takes. UserError
    where all of its frames are for testing, or none is.

    Format: https://github.com/cvg/Hierarchical-Localization (names without blanks; poses are world to camera,
    quaternion w first).
    """
    largest, in_test = dataset.models[0], set(dataset.frames["frame_id"][dataset.in_test])
    queries = [frame_id for frame_id in largest.frame_ids if frame_id in in_test]
    reference = [frame_id for frame_id in largest.frame_ids if frame_id not in in_test]
    if not queries or not reference:
        raise UserError(
            "hloc localises test frames in a map of the others",
            found=f"{len(queries)} test frames and {len(reference)} others in the largest model",
            do=f"split the scene: {setting_of('import', 'split_by')}",
        )
    names = dataset.image_names
    write_model(model_in_map(dataset, replace(largest, frame_ids=reference), names), folder / "reference")
    cameras, poses, all_cameras = list[str](), list[str](), dataset.cameras
    position, quaternion = tq_from_pose(inverse(dataset.map_T_cam))
    for row in dataset.rows_of(queries):
        cameras.append(" ".join([names[row], *camera_fields(all_cameras[row])]))
        poses.append(f"{names[row]} {numbers(*np.roll(quaternion[row], 1), *position[row])}")
    write_lines(folder / "queries_with_intrinsics.txt", cameras)
    write_lines(folder / "queries_poses.txt", poses)
    of_largest = dataset.frames["frame_id"].isin(largest.frame_ids)
    listed = [name if is_in else "" for name, is_in in zip(names, of_largest, strict=True)]
    return place_images(dataset, folder, listed, images)


def write_kapture(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """kapture 1.1: `mapping/` and, of test frames, `query/`, each with `sensors/`, which has the images in
    `records_data/`; returns the frames' image paths.

    Format: https://github.com/naver/kapture/blob/main/kapture_format.adoc (world-to-camera poses, quaternion w first;
    names without commas). A timestamp is a frame's row among those exported, as clocks of sessions have different
    starts and kapture's are of 32 bits; `frames.csv` has the capture times.
    """
    frames, placed = dataset.frames, [""] * len(dataset.frames)
    cameras, names = [", ".join(camera_fields(camera)) for camera in dataset.cameras], dataset.image_names
    position, quaternion = tq_from_pose(inverse(dataset.map_T_cam))
    for name, in_part in (("mapping", ~dataset.in_test), ("query", dataset.in_test)):
        rows, sensors, poses, records = np.flatnonzero(in_part), dict[str, str](), list[str](), list[str]()
        for row in rows:
            session_id = frames["session_id"].iloc[row]
            # Frames share a camera where focus and lens stayed the same; merges keep one camera of an id.
            unused = f"{name}-{quote(session_id, safe='')}-{len(sensors)}"
            device = sensors.setdefault(f"{session_id}\n{cameras[row]}", unused)
            poses.append(f"{row}, {device}, {numbers(*np.roll(quaternion[row], 1), *position[row], separator=', ')}")
            records.append(f"{row}, {device}, {names[row]}")
            placed[row] = f"{name}/sensors/records_data/{names[row]}"
            dataset.images[row].place(folder / placed[row], images)
        if not len(rows):
            continue
        listed = [f"{device}, , camera, {key.partition(chr(10))[2]}" for key, device in sensors.items()]
        world = f"# world: the map, {dataset.world}"
        for file, head, lines in (
            ("sensors", ["# sensor_device_id, name, sensor_type, [sensor_params]+"], listed),
            ("trajectories", [world, "# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz"], poses),
            ("records_camera", ["# timestamp, device_id, image_path"], records),
        ):
            write_lines(folder / name / "sensors" / f"{file}.txt", [_VERSION, *head, *lines])
    return placed
