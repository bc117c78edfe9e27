"""The compact map `Map`: which points it keeps, what it knows of each, and its file (docs/reference/map-format.md)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.geometry.vlad import k_means, nearest_centres
from groundwalk.localisation.frames import Lens
from groundwalk.localisation.localiser_settings import MapSettings, StructureSettings
from groundwalk.localisation.map_file import Sections, packed, read_sections, write_sections
from groundwalk.localisation.matching import unit
from groundwalk.localisation.pose import Priors
from groundwalk.localisation.selection import covering_points
from groundwalk.localisation.structure import Structure
from groundwalk.store.errors import UserError

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]

# Principal components kept of each descriptor, one byte each: with 28,000 points the demo's map has 2 MB.
_DIMENSIONS = 40
_GRID = 6
_BYTE = 127.0
_LARGEST_COMPONENT = 0.6


@dataclass(frozen=True)
class Calibration:
    """What held-out training frames say of the answers: inliers below which one is refused; by which factor covariances
    grow, and what is added to them, standard deviations in m and rad."""

    min_inliers: int
    covariance_factor: float
    position_floor_m: float
    rotation_floor_rad: float


@dataclass(frozen=True)
class CompactMap:
    """P points xyz (P, 3) in the map, sorted by word, with unit descriptors (P, D); W words (W, D), the points of
    word w are rows word_bounds[w] to word_bounds[w + 1]; V training frames' poses (V, 4, 4), which saw the points
    seen[seen_bounds[v] : seen_bounds[v + 1]]; and how SIFT's descriptors are projected: (d - mean) @ basis, to unit
    length.
    """

    scene: str
    xyz: Array
    descriptors: Floats
    words: Floats
    word_bounds: Ints
    map_T_view: Array
    seen: Ints
    seen_bounds: Ints
    mean: Floats
    basis: Floats
    lenses: tuple[Lens, ...]
    priors: Priors
    calibration: Calibration
    max_features: int
    max_side: int

    def projected(self, sift: NDArray[np.uint8]) -> Floats:
        """Unit descriptors (K, D) of RootSIFT descriptors (K, 128)."""
        return unit((unit(sift) - self.mean) @ self.basis)


def compact_map(
    scene: str,
    structure: Structure,
    lenses: tuple[Lens, ...],
    priors: Priors,
    calibration: Calibration,
    settings: MapSettings,
    extraction: StructureSettings,
) -> CompactMap:
    """The map of a structure's most useful points, as many as the settings say; `extraction` is that of features."""
    points = structure.points
    sift = _mean_descriptors(structure)
    chosen = covering_points(points.point, _cells(structure), _quality(structure), settings.max_points)
    mean = sift.mean(axis=0)
    basis = np.linalg.eigh(np.cov((sift - mean).T))[1][:, : -_DIMENSIONS - 1 : -1].astype(np.float32)
    basis, mean = basis.astype(np.float16).astype(np.float32), mean.astype(np.float16).astype(np.float32)
    descriptors = unit((sift[chosen] - mean) @ basis)
    rng = np.random.default_rng(0)
    words = k_means(descriptors, max(1, round(np.sqrt(len(chosen)))), rng)
    words = _from_bytes(_to_bytes(unit(words)))
    word = nearest_centres(descriptors, words)
    order = np.argsort(word, kind="stable")
    chosen = chosen[order]
    row = np.full(len(points.xyz), -1)
    row[chosen] = np.arange(len(chosen))
    observed, view = row[points.point], structure.view[points.feature]
    kept = observed >= 0
    by_view = np.lexsort((observed[kept], view[kept]))
    used = np.unique(view[kept])
    return CompactMap(
        scene=scene,
        xyz=points.xyz[chosen],
        descriptors=descriptors[order],
        words=words,
        word_bounds=np.searchsorted(word[order], np.arange(len(words) + 1)),
        map_T_view=structure.views.map_T_cam[used],
        seen=observed[kept][by_view],
        seen_bounds=np.r_[0, np.cumsum(np.bincount(view[kept], minlength=len(structure.views))[used])],
        mean=mean,
        basis=basis,
        lenses=lenses,
        priors=priors,
        calibration=calibration,
        max_features=extraction.max_features,
        max_side=extraction.max_side,
    )


def point_covariances(content: CompactMap) -> Array:
    """Covariances (P, 3, 3), m^2, of the map's points, by from where its frames saw them."""
    view = np.repeat(np.arange(len(content.map_T_view)), np.diff(content.seen_bounds))
    order = np.argsort(content.seen, kind="stable")
    offset = content.xyz[content.seen[order]] - content.map_T_view[view[order], :3, 3]
    squared = np.sum(offset**2, axis=1)
    # A ray measures what is across it, the better the nearer: (I - d d^T) / distance^2.
    outer = np.einsum("oi,oj->oij", offset, offset) / squared[:, None, None]
    across = ((np.eye(3) - outer) / squared[:, None, None]).reshape(-1, 9)
    ends = np.searchsorted(content.seen[order], np.arange(len(content.xyz) + 1))
    sums = np.concatenate([np.zeros((1, 9)), np.cumsum(across, axis=0)])
    information = (sums[ends[1:]] - sums[ends[:-1]]).reshape(-1, 3, 3)
    ridge = (1e-9 + 1e-6 * np.trace(information, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return np.asarray(content.priors.point_sd**2 * np.linalg.inv(information + ridge))


def write_map(path: Path, content: CompactMap) -> None:
    """Write the map's file."""
    write_sections(path, *_to_sections(content))


def bytes_by_section(content: CompactMap) -> dict[str, int]:
    """The sizes of the sections of the map's file, and of what holds them."""
    arrays, metadata = _to_sections(content)
    sizes = {name: array.nbytes for name, array in arrays.items()}
    return sizes | {"metadata and container": len(packed(arrays, metadata)) - sum(sizes.values())}


def _to_sections(content: CompactMap) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    origin = np.floor(content.xyz.min(axis=0))
    extent = float((content.xyz - origin).max())
    small = extent < 65.0
    step = 0.001 if small else 0.0005
    arrays: dict[str, NDArray[Any]] = {
        "xyz": np.rint((content.xyz - origin) / step).astype(np.uint16 if small else np.uint32),
        "descriptors": _to_bytes(content.descriptors),
        "words": _to_bytes(content.words),
        "word_bounds": content.word_bounds.astype(np.uint32),
        "views": content.map_T_view[:, :3].astype(np.float32),
        "seen": content.seen.astype(np.uint16 if len(content.xyz) < 65536 else np.uint32),
        "seen_bounds": content.seen_bounds.astype(np.uint32),
        "mean": content.mean.astype(np.float16),
        "basis": content.basis.astype(np.float16),
    }
    metadata = {
        "scene": content.scene,
        "origin_m": origin.tolist(),
        "step_m": step,
        "lenses": [vars(lens) for lens in content.lenses],
        "priors": vars(content.priors),
        "calibration": vars(content.calibration),
        "max_features": content.max_features,
        "max_side": content.max_side,
    }
    return arrays, metadata


def read_map(path: Path) -> CompactMap:
    """A map from its file; UserError where that isn't one, or is damaged."""
    sections = read_sections(path)
    try:
        return _from_sections(sections)
    except (KeyError, TypeError, ValueError) as error:
        raise UserError("a map lacks a section, or has one of another type", where=path, found=error) from error


def _from_sections(sections: Sections) -> CompactMap:
    a, m = sections.arrays, sections.metadata
    views = np.tile(np.eye(4), (len(a["views"]), 1, 1))
    views[:, :3] = a["views"]
    return CompactMap(
        scene=str(m["scene"]),
        xyz=a["xyz"].astype(float) * m["step_m"] + m["origin_m"],
        descriptors=_from_bytes(a["descriptors"]),
        words=_from_bytes(a["words"]),
        word_bounds=a["word_bounds"].astype(np.int64),
        map_T_view=views,
        seen=a["seen"].astype(np.int64),
        seen_bounds=a["seen_bounds"].astype(np.int64),
        mean=a["mean"].astype(np.float32),
        basis=a["basis"].astype(np.float32),
        lenses=tuple(Lens(x["focal"], tuple(x["distortion"]), x["readout_s"]) for x in m["lenses"]),
        priors=Priors(**m["priors"]),
        calibration=Calibration(**m["calibration"]),
        max_features=int(m["max_features"]),
        max_side=int(m["max_side"]),
    )


def _mean_descriptors(structure: Structure) -> Floats:
    """Unit mean (P, 128) of the unit descriptors of each point's observations."""
    points = structure.points
    descriptors = unit(structure.descriptors[points.feature])
    starts = np.searchsorted(points.point, np.arange(len(points.xyz)))
    return unit(np.add.reduceat(descriptors, starts, axis=0))


def _cells(structure: Structure) -> Ints:
    """The cell (O,) of each observation in its frame's image, numbered over all frames."""
    points = structure.points
    view = structure.view[points.feature]
    size = np.array([[c.width, c.height] for c in structure.views.cameras])[view]
    at = np.clip((structure.px[points.feature] / size * _GRID).astype(np.int64), 0, _GRID - 1)
    return (view * _GRID + at[:, 1]) * _GRID + at[:, 0]


def _quality(structure: Structure) -> Array:
    """What a point (P,) is worth a frame: less where its position is less sure than what a query measures, from the
    frames that saw it."""
    points = structure.points
    covariance = np.linalg.inv(points.information + 1e-12 * np.eye(3))
    view = structure.view[points.feature]
    offset = points.xyz[points.point] - structure.views.map_T_cam[view, :3, 3]
    distance = np.linalg.norm(offset, axis=1)
    across = (
        np.trace(covariance, axis1=1, axis2=2)[points.point]
        - np.einsum("oi,oij,oj->o", offset, covariance[points.point], offset) / np.maximum(distance, 1e-9) ** 2
    )
    focal = np.array([(c.fx + c.fy) / 2 for c in structure.views.cameras])[view]
    variance_px = np.bincount(points.point, focal**2 * across / np.maximum(distance, 1e-3) ** 2, len(points.xyz))
    return np.asarray(1 / (1 + variance_px / np.bincount(points.point, minlength=len(points.xyz))))


def _to_bytes(descriptors: Floats) -> NDArray[np.int8]:
    return np.clip(np.rint(descriptors * (_BYTE / _LARGEST_COMPONENT)), -_BYTE, _BYTE).astype(np.int8)


def _from_bytes(numbers: NDArray[np.int8]) -> Floats:
    return unit(numbers)
