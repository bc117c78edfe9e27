"""The answer of a map to one image from outside a run."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import tq_from_pose
from groundwalk.localisation.localisers import FileLocaliser
from groundwalk.localisation.results import QueryResult
from groundwalk.runtime.queries import Query
from groundwalk.store.parallel import one_thread


def ask(localiser: FileLocaliser, query: Query) -> QueryResult:
    """The localiser's answer."""
    with one_thread():
        return localiser.localise(_grey(query.image), query.camera, query.gravity, query.prior)


def row_of(answer: QueryResult) -> dict[str, Any]:
    """An answer as plain values: position, m, and quaternion x, y, z, w of map_T_cam, and its covariance (36 numbers);
    or null, with the refusal and its reason."""
    row: dict[str, Any] = dict.fromkeys(("position_m", "quaternion", "covariance"))
    if answer.map_T_cam is not None:
        position, quaternion = tq_from_pose(answer.map_T_cam[None])
        row |= {"position_m": position[0].tolist(), "quaternion": quaternion[0].tolist()}
        row["covariance"] = None if answer.covariance is None else answer.covariance.ravel().tolist()
    counts = {"inliers": answer.inliers, "candidates": answer.candidates}
    return row | counts | {"refusal": answer.refusal, "reason": answer.reason or None}


def _grey(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return pixels if pixels.ndim == 2 else np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8)
