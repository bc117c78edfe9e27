"""Where images show rulers: corners of printed boards and tags by OpenCV, points of distances as the settings say; in
import's pixel convention."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.rulers.measurement import RulerDetections
from groundwalk.alignment.settings import AprilTagRuler, CharucoRuler, DistanceRuler, Ruler, dictionaries, dictionary
from groundwalk.geometry.cameras import CENTRE_OF_FIRST_PIXEL
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rulers import Corners
from groundwalk.store import UserError
from groundwalk.store.images import read_grey_image
from groundwalk.store.parallel import in_parallel

Grey = NDArray[np.uint8]
BoardRuler = CharucoRuler | AprilTagRuler

_TAG_CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
# Where nothing is detected, so many images, evenly spread, are searched for another board or print.
_SEARCHED = 12
# Every dictionary is tried on so many of these.
_SEARCHED_FOR_DICTIONARY = 3
_MIN_MARKERS = 4
# Half the side of the window in which a corner is refined: as a fraction of the nearest marker's distance, and its
# smallest and largest size, pixels. Then iterations and their end.
_WINDOW_FRACTION = 0.75
_WINDOW_PX = (2, 8)
_REFINE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-4)


@dataclass(frozen=True)
class Detection:
    """Corners in one image: indices (K,) into the ruler's nominal corners, pixels (K, 2)."""

    corner: NDArray[np.int64]
    xy: Array


def find_rulers(rulers: list[Ruler], frames: pd.DataFrame, image_path: Callable[[str], Path]) -> list[RulerDetections]:
    """Look for rulers in all images of import's table `frames`; distances are where the settings say.

    Raises UserError for an image that can't be read, a distance's frame that doesn't exist, or a pixel outside of it.
    """
    boards = [ruler for ruler in rulers if not isinstance(ruler, DistanceRuler)]
    paths = [image_path(image) for image in frames["image"]] if boards else []

    def detect_in(path: Path) -> list[Detection]:
        image = read_grey_image(path)
        return [detect(ruler, image) for ruler in boards]

    by_image = list(in_parallel(detect_in, paths))
    return [
        _read_off(ruler, frames)
        if isinstance(ruler, DistanceRuler)
        else _detections(ruler, [of_image[boards.index(ruler)] for of_image in by_image], paths)
        for ruler in rulers
    ]


def _detections(ruler: BoardRuler, by_image: Sequence[Detection], paths: Sequence[Path]) -> RulerDetections:
    """A board's detections, one an image of these paths, together."""
    seen = [(row, d) for row, d in enumerate(by_image) if len(d.corner)]
    corners = nominal_corners(ruler)
    corner = np.concatenate([np.empty(0, dtype=np.int64), *(d.corner for _, d in seen)])
    row = np.repeat([row for row, _ in seen], [len(d.corner) for _, d in seen]).astype(np.int64)
    xy = np.concatenate([np.empty((0, 2)), *(d.xy for _, d in seen)])
    held_out, absence = held_out_corners(ruler, corners, corner), "" if seen else explain_absence(ruler, paths)
    return RulerDetections(ruler, corners, held_out, row, corner, xy, absence)


def _read_off(ruler: DistanceRuler, frames: pd.DataFrame) -> RulerDetections:
    lines = [(i, point.name, o.frame, *o.xy) for i, point in enumerate(ruler.points) for o in point.observations]
    seen = pd.DataFrame(lines, columns=["corner", "point", "frame", "x_px", "y_px"])
    row = rows_read_off(seen, frames, f"[[ruler]] {ruler.name!r} of the scene's file")
    corners = Corners(np.array([[0.0, 0.0, 0.0], [ruler.length_m, 0.0, 0.0]]), np.zeros(2, dtype=np.int64))
    xy_px = seen[["x_px", "y_px"]].to_numpy(float)
    return RulerDetections(ruler, corners, np.zeros(2, dtype=bool), row, seen["corner"].to_numpy(), xy_px)


def rows_named(names: "pd.Series[str]", frames: pd.DataFrame) -> NDArray[np.int64]:
    """Rows of the frames table that people name: by frame_id, or by the name of the image's file, in any case, where
    one frame alone has it; -1 where none has."""
    file = frames["image"].str.rsplit("/", n=1).str[-1].str.lower()
    rows = pd.Series(np.arange(len(frames)), index=file)[~file.duplicated(keep=False).to_numpy()]
    by_id = pd.Index(frames["frame_id"]).get_indexer(pd.Index(names))
    by_file = rows.reindex(names.str.lower(), fill_value=-1).to_numpy()
    return np.where(by_id >= 0, by_id, by_file).astype(np.int64)


def rows_read_off(seen: pd.DataFrame, frames: pd.DataFrame, where: object) -> NDArray[np.int64]:
    """Rows of the frames table in which a person has read off points, whose `frame`, `point`, `x_px` and `y_px` the
    table `seen` has; `where` they are written. UserError for a frame that doesn't exist, or a pixel outside of it."""
    row = rows_named(seen["frame"], frames)
    if (row < 0).any():
        line = seen.iloc[int(np.argmin(row))]
        raise UserError(
            f"point {line['point']!r} is seen in a frame that doesn't exist",
            where=where,
            found=line["frame"],
            expected=f"a frame_id of import.frames, such as {frames['frame_id'].iloc[0]}, or its image's file, such as "
            f"{Path(frames['image'].iloc[0]).name}",
            do="name a frame of import.frames; sampling drops images",
        )
    xy, size = seen[["x_px", "y_px"]].to_numpy(float), frames[["width", "height"]].to_numpy(float)[row]
    outside = np.flatnonzero(~((xy >= 0) & (xy <= size)).all(axis=1))
    if len(outside):
        line = seen.iloc[outside[0]]
        raise UserError(
            f"point {line['point']!r} is outside of its image",
            where=f"{where}, frame {line['frame']}",
            found="({:g}, {:g})".format(*xy[outside[0]]),
            expected="pixels of the image as stored, (0, 0) to ({:g}, {:g})".format(*size[outside[0]]),
            do="read the pixel off the image at its full size, as import.frames has it",
        )
    return row


def nominal_corners(ruler: BoardRuler) -> Corners:
    """A board's inner chessboard corners row by row, or all four corners of every tag of the dictionary."""
    if isinstance(ruler, CharucoRuler):
        xyz_m = 1e-3 * np.asarray(_board(ruler).getChessboardCorners(), dtype=float)
        return Corners(xyz_m, np.zeros(len(xyz_m), dtype=np.int64))
    count = len(dictionary(ruler.dictionary).bytesList)
    return Corners(np.tile(1e-3 * ruler.tag_mm * _TAG_CORNERS, (count, 1)), np.repeat(np.arange(count), 4))


def held_out_corners(ruler: BoardRuler, corners: Corners, seen: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(K,) every second corner, as the black squares of a chessboard lie; of tags every second id of the ruler's, or
    else of those that are seen: `seen` are corners."""
    index = np.arange(len(corners.xyz_m))
    if isinstance(ruler, CharucoRuler):
        columns = ruler.squares_x - 1
        return np.asarray((index // columns + index % columns) % 2 == 1)
    ids = sorted(set(ruler.ids or corners.part[seen].tolist()))
    return np.isin(corners.part, ids[1::2])


def detect(ruler: BoardRuler, image: Grey) -> Detection:
    """A ruler's corners in a grey image, refined to fractions of a pixel; none where it isn't seen."""
    if isinstance(ruler, CharucoRuler):
        xy, ids, _, _ = cv2.aruco.CharucoDetector(_board(ruler)).detectBoard(image)
        if ids is None or not len(ids):
            return Detection(np.empty(0, dtype=np.int64), np.empty((0, 2)))
        at = _refined(ruler, image, np.asarray(xy, dtype=np.float32).reshape(-1, 2)) + CENTRE_OF_FIRST_PIXEL
        return Detection(ids.ravel().astype(np.int64), at)
    tags = markers_in(ruler.dictionary, image)
    seen = [tag for tag, _ in tags]
    # An id that is seen twice is ambiguous.
    tags = [(tag, xy) for tag, xy in tags if seen.count(tag) == 1 and (not ruler.ids or tag in ruler.ids)]
    corner = np.array([4 * tag + k for tag, _ in tags for k in range(4)], dtype=np.int64)
    return Detection(corner, np.array([xy for _, xy in tags]).reshape(-1, 2) + CENTRE_OF_FIRST_PIXEL)


def explain_absence(ruler: BoardRuler, paths: Sequence[Path]) -> str:
    """Why a ruler isn't detected in any of these images, by searching a few of them for other boards, in words."""
    step = max(1, len(paths) // _SEARCHED)
    images = [read_grey_image(path) for path in paths[::step][:_SEARCHED]]

    def count_in(ruler: BoardRuler, images: Sequence[Grey]) -> int:
        return sum(len(detect(ruler, image).corner) > 0 for image in images)

    if count := count_in(ruler, [np.ascontiguousarray(image[:, ::-1]) for image in images]):
        return (
            f"mirrored: it is detected in {count} of {len(images)} images once these are mirrored; print it unmirrored"
        )
    if isinstance(ruler, CharucoRuler):
        swapped = {"squares_x": ruler.squares_y, "squares_y": ruler.squares_x}
        legacy = {"legacy": not ruler.legacy}
        for change in (legacy, swapped, swapped | legacy):
            if count := count_in(ruler.model_copy(update=change), images):
                stated = ", ".join(f"{key} = {str(value).lower()}" for key, value in change.items())
                return f"another layout: with {stated} it is detected in {count} of {len(images)} images"
    markers = max(len(markers_in(ruler.dictionary, image)) for image in images)
    if markers >= _MIN_MARKERS and isinstance(ruler, CharucoRuler):
        return (
            f"another layout: up to {markers} markers of {ruler.dictionary} in an image, but not {ruler.squares_x} x "
            f"{ruler.squares_y} squares of them; count the squares"
        )
    # Most markers in an image; of dictionaries that hold them all, the smallest.
    few = images[:: max(1, len(images) // _SEARCHED_FOR_DICTIONARY)]
    counts = {name: max(len(markers_in(name, image)) for image in few) for name in dictionaries()}
    best = min(counts, key=lambda name: (-counts[name], len(dictionary(name).bytesList)))
    if counts[best] >= _MIN_MARKERS:
        return f"another dictionary: up to {counts[best]} markers of {best} in an image, none of {ruler.dictionary}"
    return f"no marker of {ruler.dictionary}, or of any other dictionary, in {len(images)} images"


def _board(ruler: CharucoRuler) -> cv2.aruco.CharucoBoard:
    squares, sizes_mm = (ruler.squares_x, ruler.squares_y), (ruler.square_mm, ruler.marker_mm)
    board = cv2.aruco.CharucoBoard(squares, *sizes_mm, dictionary(ruler.dictionary))
    board.setLegacyPattern(ruler.legacy)
    return board


def _refined(ruler: CharucoRuler, image: Grey, xy: NDArray[np.float32]) -> Array:
    """Corners (K, 2) to a fraction of a pixel, in windows that no marker reaches into: in OpenCV's wider ones markers
    pull corners by up to half a pixel."""
    if len(xy) < 2:
        return xy.astype(float)
    apart = np.linalg.norm(xy[:, None] - xy, axis=2)
    np.fill_diagonal(apart, np.inf)
    margin = _WINDOW_FRACTION * 0.5 * (1 - ruler.marker_mm / ruler.square_mm)
    windows = np.clip(margin * apart.min(axis=1), *_WINDOW_PX).astype(int)
    result = xy.copy()
    for window in np.unique(windows):
        same = windows == window
        result[same] = cv2.cornerSubPix(image, np.ascontiguousarray(xy[same]), (int(window),) * 2, (-1, -1), _REFINE)
    return result.astype(float)


def markers_in(name: str, image: Grey) -> list[tuple[int, Array]]:
    """Ids and corners (4, 2), in OpenCV's pixels, of a dictionary's markers in an image."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary(name), parameters).detectMarkers(image)
    found = () if ids is None else zip(ids.ravel(), corners, strict=True)
    return [(int(tag), np.asarray(xy, dtype=float)[0]) for tag, xy in found]
