"""How the Map's query time and bytes grow with training frames: part of `python -m benchmarks.localise`."""

import math
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array
from groundwalk.geometry.vlad import k_means, nearest_centres
from groundwalk.localisation.build import build_map
from groundwalk.localisation.compact import CompactMap, read_map, write_map
from groundwalk.localisation.features import unit
from groundwalk.localisation.frames import subset
from groundwalk.localisation.localiser_settings import MapSettings, StructureSettings
from groundwalk.localisation.prepared import Training, prepare
from groundwalk.localisation.query import MapLocaliser

PARTS = (8, 4, 2, 1)
# Church's in Table I.
TABLE_FRAMES = 1643
_APART_M = 200.0
Rows = NDArray[np.int64]
Asked = Sequence[tuple[NDArray[np.uint8], Camera, Array | None]]


def growth(
    training: Training, asked: Asked, extraction: StructureSettings, settings: MapSettings
) -> Iterator[tuple[str, float, str]]:
    """Figures (name, value, unit) of maps of every eighth, fourth, second and each training frame, and of one filled up
    to Table I's frames; `asked` are the queries: image, camera, gravity."""
    frames, ms, size = [], [], []
    for part in PARTS:
        some = _every(training, part)
        bytes_, localiser = _kept(build_map(prepare("growth", some, extraction), settings))
        frames.append(len(some.views))
        ms.append(_query_ms(localiser, asked))
        size.append(bytes_)
        yield f"{frames[-1]} training frames: time, processor, median", ms[-1], "ms"
        yield f"{frames[-1]} training frames: file", size[-1] / 1e6, "MB"
    for name, values in (("query time", ms), ("bytes", size)):
        slope = float(np.polyfit(np.log(frames), np.log(values), 1)[0])
        yield f"exponent of {name} against training frames", slope, ""
    times = math.ceil(TABLE_FRAMES / frames[-1])
    bytes_, localiser = _kept(filled(localiser.map, times))
    many_ms = _query_ms(localiser, asked)
    yield "filled up to Table I's frames: training frames", float(times * frames[-1]), ""
    yield "filled up to Table I's frames: points", float(len(localiser.xyz)), ""
    yield "filled up to Table I's frames: time, processor, median", many_ms, "ms"
    yield "filled up to Table I's frames: file", bytes_ / 1e6, "MB"
    yield "filled up to Table I's frames: time by the demo's", many_ms / ms[-1], ""


def filled(content: CompactMap, times: int) -> CompactMap:
    """A map of `times` as many frames and points: the map, and copies of it further away, whose descriptors are turned
    by a random rotation of their space, so that they look like none of the first."""
    rng = np.random.default_rng(0)
    dimensions = content.descriptors.shape[1]
    turns = [np.eye(dimensions)]
    turns += [np.linalg.qr(rng.standard_normal((dimensions, dimensions)))[0] for _ in range(times - 1)]
    points = len(content.xyz)
    shift = np.arange(times)[:, None] * [_APART_M, 0.0, 0.0]
    xyz = (content.xyz + shift[:, None]).reshape(-1, 3)
    descriptors = np.concatenate([unit(content.descriptors @ turn) for turn in turns])
    words = k_means(descriptors, round(np.sqrt(len(xyz))), rng)
    word = nearest_centres(descriptors, words)
    order = np.argsort(word, kind="stable")
    row = np.argsort(order)
    views = np.tile(content.map_T_view, (times, 1, 1))
    views[:, :3, 3] += np.repeat(shift, len(content.map_T_view), axis=0)
    seen = (content.seen + points * np.arange(times)[:, None]).ravel()
    return replace(
        content,
        xyz=xyz[order],
        descriptors=descriptors[order].astype(np.float32),
        words=unit(words),
        word_bounds=np.searchsorted(word[order], np.arange(len(words) + 1)),
        map_T_view=views,
        seen=row[seen],
        seen_bounds=np.r_[0, np.cumsum(np.tile(np.diff(content.seen_bounds), times))],
    )


def _every(training: Training, part: int) -> Training:
    rows = np.arange(0, len(training.views), part)
    return Training(
        subset(training.views, rows),
        tuple(training.logged[row] for row in rows.tolist()),
        training.gravity[rows],
        tuple(training.features[row] for row in rows.tolist()),
    )


def _query_ms(localiser: MapLocaliser, asked: Asked) -> float:
    """Median milliseconds of the processor from a decoded image to its pose."""
    costs = []
    for image, camera, gravity in asked:
        start = time.process_time()
        localiser.localise(image, camera, gravity)
        costs.append(1000 * (time.process_time() - start))
    return float(np.median(costs))


def _kept(content: CompactMap) -> tuple[int, MapLocaliser]:
    """The bytes of a map's file, and the localiser out of it."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.gwm"
        write_map(file, content)
        return file.stat().st_size, MapLocaliser(read_map(file))
