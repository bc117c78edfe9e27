"""Hugging Face: Parquet files of 500 MB at most with the images inside, a dataset card `README.md`, Croissant metadata.

Formats: https://huggingface.co/docs/datasets/image_dataset#parquet, https://huggingface.co/docs/hub/datasets-cards,
https://docs.mlcommons.org/croissant/docs/croissant-spec-1.0.html with its extension for responsible AI. Images are as
the phone took them, without EXIF, or as import blurred them; lens, covariance and quality class are columns.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from groundwalk.export.dataset import Dataset, Images, ImageSource
from groundwalk.export.dataset_card import card, croissant
from groundwalk.geometry.poses import tq_from_pose
from groundwalk.store import UserError
from groundwalk.store.files import write_json
from groundwalk.store.images import without_metadata

SPLITS = {"train": "train", "val": "validation", "test": "test"}
COLUMNS = {
    "frame_id": "session and number of the frame",
    "session_id": "capture session",
    "t_ns": "capture time on the session's clock, nanoseconds",
    "clock": "what t_ns counts from; name_order: images have no times, and it is their order, a second apart",
    "width": "image width, pixels",
    "height": "image height, pixels",
    "fx": "focal length, x, pixels",
    "fy": "focal length, y, pixels",
    "cx": "principal point, x, pixels; the first pixel's outer corner is 0",
    "cy": "principal point, y, pixels; the first pixel's outer corner is 0",
    "distortion": "OpenCV's k1, k2, p1, p2, k3, ...",
    "position": "camera centre x, y, z in the map (map_T_cam; camera axes x right, y down, z ahead)",
    "quaternion": "rotation of map_T_cam, x, y, z, w",
    "covariance": "6x6, row-major, of (rotation, position) in the map: rad, and the map's unit; empty where unknown",
    "position_sd_m": "standard error of the position in its least certain axis, without scale and vertical, map's unit",
    "rotation_sd_deg": "standard error of the rotation about its least certain axis, without vertical, degrees",
    "quality": "quality class A, B or C of the pose",
    "reason": "why quality isn't A",
}
# Rows that are in memory at a time, with their images.
_ROWS = 64
# As the hub shards a split.
_MAX_SHARD_BYTES = 500_000_000
# More than a row takes without its image.
_ROW_BYTES = 2_000


def write_huggingface(dataset: Dataset, folder: Path, images: Images) -> list[str]:
    """Write the layout; returns the Parquet file of each frame's image."""
    if not dataset.licence:
        raise UserError(
            "a data set without a licence can't be used by anyone",
            where="--licence",
            expected="an identifier of https://huggingface.co/docs/hub/repositories-licenses, such as cc-by-4.0",
            do="add --licence cc-by-4.0, or the one that you have the right to give",
        )
    (folder / "data").mkdir()
    position, quaternion = tq_from_pose(dataset.map_T_cam)
    table = dataset.frames.assign(position=list(position), quaternion=list(quaternion))
    table["covariance"] = [[] if c is None else list(c) for c in table["covariance"]]
    columns = pa.Table.from_pandas(table[list(COLUMNS)], preserve_index=False)
    fields = columns.schema.remove_metadata()
    if images != "none":
        fields = fields.append(pa.field("image", pa.struct([("bytes", pa.binary()), ("path", pa.string())])))
    features = {"info": {"features": {field.name: _feature(field) for field in fields}}}
    fields = fields.with_metadata({"huggingface": json.dumps(features)})
    placed, files = [""] * len(table), dict[str, int]()
    for split, name in SPLITS.items():
        rows = np.flatnonzero(table["split"] == split)
        if not len(rows):
            continue
        shards = _shards(rows, dataset.images if images != "none" else [])
        for number, shard in enumerate(shards):
            path = f"data/{name}-{number:05d}-of-{len(shards):05d}.parquet"
            files[path] = len(shard)
            # No two images are the same, so a dictionary of them is nothing but work.
            with pq.ParquetWriter(folder / path, fields, use_dictionary=False) as writer:
                for some in np.array_split(shard, -(-len(shard) // _ROWS)):
                    part = columns.take(pa.array(some))
                    if images != "none":
                        encoded = [_encoded(dataset.images[row], dataset.frames["frame_id"].iloc[row]) for row in some]
                        part = part.append_column(fields.field("image"), pa.array(encoded, fields.field("image").type))
                    writer.write_table(part.cast(fields))
            if images != "none":
                for row in shard:
                    placed[row] = path
    described = COLUMNS | ({"image": "the image as captured, or as blurred"} if images != "none" else {})
    (folder / "README.md").write_text(card(dataset, files, described), encoding="utf-8")
    write_json(folder / "croissant.json", croissant(dataset, folder, files, described))
    return placed


def _shards(rows: NDArray[np.int64], images: Sequence[ImageSource]) -> list[NDArray[np.int64]]:
    """The rows in parts, in order, each of which takes 500 MB at most as Parquet unless a single image takes more."""
    sizes = np.array([_ROW_BYTES + (images[row].existing().stat().st_size if images else 0) for row in rows])
    before = np.cumsum(sizes) - sizes
    room = max(_MAX_SHARD_BYTES - sizes.max(), 1)
    _, starts = np.unique(before // room, return_index=True)
    return np.split(rows, starts[1:])


def _encoded(source: ImageSource, frame_id: str) -> dict[str, bytes | str]:
    return {"bytes": without_metadata(source.file.read_bytes()), "path": f"{frame_id}{source.suffix}"}


def _feature(field: pa.Field) -> dict[str, Any]:
    """A column's type as the library `datasets` names it."""
    if pa.types.is_struct(field.type):
        return {"_type": "Image"}
    if pa.types.is_list(field.type):
        return {"feature": _feature(field.type.value_field), "_type": "List"}
    return {"dtype": "float64" if pa.types.is_float64(field.type) else str(field.type), "_type": "Value"}
