"""COLMAP: `sparse/0` with cameras, images and points in the map, `images/`, and lists of image names by split.

Each of SfM's models without a common view with the others has a separate folder: `sparse/1`, ...

Format: https://colmap.github.io/format.html (world-to-camera poses, quaternions w first in text; pixel centres at 0.5,
as ours). The world is the map: metric, +y up. Cameras are SfM's, one a frame, with its lens (OPENCV, or FULL_OPENCV
where it has k3). Observations of points are without the effect of a rolling shutter, so they may lie pixels from the
images' features; the images are as the phone took them. Where the map's place on earth is given out,
`geo_registration.txt` has each image's latitude, longitude and altitude, as `model_aligner --ref_is_gps 1` reads them.
"""

from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pycolmap

from groundwalk.export.dataset import Dataset, Images, SfmModel, number
from groundwalk.store import UserError


def write_colmap(dataset: Dataset, folder: Path, images: Images, *, text: bool = False) -> list[str]:
    """Write the layout; returns the frames' image paths. Frames without ground truth aren't in the model."""
    names: dict[str, str] = {}
    for index, sfm_model in enumerate(dataset.models):
        model = model_in_map(sfm_model)
        write_model(model, folder / "sparse" / str(index), text=text)
        names |= names_by_frame(model)
    ordered = [names[frame_id] for frame_id in dataset.frames["frame_id"]]
    for split in ("train", "val", "test"):
        named = zip(ordered, dataset.frames["split"], strict=True)
        (folder / f"{split}.txt").write_text(
            "".join(f"{name}\n" for name, of in named if of == split), encoding="utf-8"
        )
    if dataset.georeference is not None:
        _, _, geodetic = dataset.georeference.places(dataset.map_T_cam[:, :3, 3])
        # A place without altitude is on the ellipsoid to COLMAP.
        rows = zip(ordered, np.nan_to_num(geodetic), strict=True)
        lines = [" ".join([name, *map(number, place)]) + "\n" for name, place in rows]
        (folder / "geo_registration.txt").write_text("".join(lines), encoding="utf-8")
    for source, name in zip(dataset.images, ordered, strict=True):
        source.place(folder / "images" / name, images)
    return [f"images/{name}" for name in ordered]


def model_in_map(sfm_model: SfmModel) -> pycolmap.Reconstruction:
    """One of SfM's models in the map, with the frames that it names alone. UserError where it lacks one of them."""
    if not sfm_model.folder.is_dir():
        raise UserError("a SfM model is missing", where=sfm_model.folder, do="run the sfm stage again")
    model = pycolmap.Reconstruction(sfm_model.folder)
    to_map = sfm_model.map_S_sfm
    model.transform(pycolmap.Sim3d(to_map.scale, pycolmap.Rotation3d(to_map.rotation), to_map.translation))
    by_frame, exported = {_frame_id(image): image for image in model.images.values()}, set(sfm_model.frame_ids)
    if missing := exported - by_frame.keys():
        raise UserError(
            "a SfM model lacks frames that have ground truth",
            where=sfm_model.folder,
            found=f"{len(missing)} missing, such as {min(missing)}",
            do="run the sfm and align stages again",
        )
    for frame_id, image in by_frame.items():
        if frame_id not in exported:
            model.deregister_frame(image.frame_id)
    return model


def write_model(model: pycolmap.Reconstruction, folder: Path, *, text: bool = False) -> None:
    """Write a model into a new folder."""
    folder.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(folder)


def names_by_frame(model: pycolmap.Reconstruction) -> dict[str, str]:
    """The names of a model's registered images, by frame."""
    return {_frame_id(model.image(image_id)): model.image(image_id).name for image_id in model.reg_image_ids()}


def _frame_id(image: pycolmap.Image) -> str:
    return unquote(str(Path(image.name).with_suffix("")))
