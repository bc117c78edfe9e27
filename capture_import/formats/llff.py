"""LLFF: `poses_bounds.npy` beside `images/` (or smaller copies of them, `images_4/`), with poses from SfM.

https://github.com/Fyusion/LLFF#using-your-own-poses-without-running-colmap. A row is a 3x5 matrix in row order, and two
depths, which aren't read. The matrix is camera to world with camera axes down, right and backward: a reference without
unit or up; its last column is height, width and focal length in pixels of the images in `images/`, whose principal
point is their middle. Rows have no names: they are in the order of the images' names as text (`10.jpg` before `2.jpg`).
"""

from pathlib import Path
from tokenize import TokenError

import numpy as np

from groundwalk.capture_import import parsing
from groundwalk.capture_import.capture import Intrinsics, Limits, Recording
from groundwalk.capture_import.data_sets import read_reference
from groundwalk.capture_import.formats import Format
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store import UserError

_FILE = "poses_bounds.npy"
_NUMBERS = 17
# What NumPy raises of a damaged header, which it reads as Python.
_BROKEN = (ValueError, OSError, EOFError, SyntaxError, TokenError, TypeError, OverflowError, RecursionError)


def read(path: Path, limits: Limits) -> Recording:
    file = path / _FILE
    try:
        # Mapped: a header may claim any number of rows.
        stored = np.load(file, mmap_mode="r", allow_pickle=False)
        if stored.dtype.kind != "f" or stored.shape[1:] != (_NUMBERS,) or len(stored) > limits.max_rows:
            raise ValueError(f"{stored.dtype} of shape {stored.shape}")
    except _BROKEN as error:
        found, expected = str(error).split("\n")[0][:200], f"an array of {_NUMBERS} numbers for each image"
        raise UserError("a log can't be read", where=file, found=found, expected=expected) from None
    folders = [path / "images", *parsing.in_order(path.glob("images_*/"))]
    images_of = {folder: parsing.images_in(folder) for folder in folders}
    images = next((images for images in images_of.values() if len(images) == len(stored)), None)
    if images is None:
        raise UserError(
            f"the images can't be joined to the rows of {_FILE}, which have no names",
            where=path,
            expected=f"{len(stored)} images, as many as rows",
            found=", ".join(f"{len(images)} in {folder.name}/" for folder, images in images_of.items()),
            do="copy the data set again, with all its images",
        )
    in_text_order = sorted(images, key=lambda image: image.name)
    rows = [(f"{_FILE} row {i}", image, np.array(stored[i], float)) for i, image in enumerate(in_text_order)]
    return read_reference(path, path, rows, lambda _, row: _row(row), set(), [])


def _row(row: Array) -> tuple[Array, Intrinsics]:
    matrix = row[:15].reshape(3, 5)
    if not (np.abs(matrix) < 1e100).all():
        raise parsing.BadRow("row has a value that isn't finite or is too large")
    down, right, back, position, size = matrix.T
    height, width, f = size.tolist()
    camera = Intrinsics(f, f, width / 2, height / 2, parsing.to_pixels(width), parsing.to_pixels(height))
    return make_pose(np.column_stack([right, down, -back]), position), camera


FORMAT = Format(
    id="llff",
    label="LLFF",
    meaning="images, reference poses",
    files=(_FILE, "images/|images_*/"),
    read=read,
    yields_to=("colmap", "nerfstudio"),  # which have each image's name and the lens
    yields_to_all=True,
)
