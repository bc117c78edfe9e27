"""Which points a map keeps: pure functions on arrays."""

import heapq

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


def covering_points(point_O: Ints, cell_O: Ints, quality_P: NDArray[np.float64], count: int) -> Ints:
    """`count` points (rows, sorted) that cover the cells of all frames' images evenly; all where there are no more.

    `point_O` and `cell_O` say which points (sorted) were seen in which cells of which frames. A point's gain is the sum
    over its cells of 1 / (1 + points that the cell has), times its quality: the greedy solution of weighted K-cover
    (Li et al., "Location recognition using prioritized feature matching", ECCV 2010) with diminishing returns.
    """
    points = len(quality_P)
    if count >= points:
        return np.arange(points)
    bounds = np.searchsorted(point_O, np.arange(points + 1))
    covered = np.zeros(int(cell_O.max(initial=-1)) + 1)

    def gain(point: int) -> float:
        return float(quality_P[point] * (1 / (1 + covered[cell_O[bounds[point] : bounds[point + 1]]])).sum())

    # Gains only fall: one that is still the largest after it's computed anew is the largest of all.
    heap = [(-gain(point), point) for point in range(points)]
    heapq.heapify(heap)
    chosen: list[int] = []
    while len(chosen) < count:
        _, point = heapq.heappop(heap)
        now = gain(point)
        if heap and -now > heap[0][0]:
            heapq.heappush(heap, (-now, point))
            continue
        chosen.append(point)
        np.add.at(covered, cell_O[bounds[point] : bounds[point + 1]], 1)
    return np.sort(np.array(chosen, np.int64))
