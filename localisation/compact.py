"""The compact map `Map`: what it knows of its points, and its file (docs/reference/map-format.md)."""

import io
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.localisation.frames import Lens
from groundwalk.localisation.matching import unit
from groundwalk.localisation.pose import Priors
from groundwalk.store.errors import UserError
from groundwalk.store.files import written_aside

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]

_BYTE = 127.0
_LARGEST_COMPONENT = 0.6
_VERSION = 3


@dataclass(frozen=True)
class Calibration:
    """What held-out training frames say of the answers: inliers below which one is refused; by which factor covariances
    grow, and what is added to them, standard deviations in m and rad."""

    min_inliers: int
    covariance_factor: float
    position_floor_m: float
    rotation_floor_rad: float

    def grown(self, covariance: Array) -> Array:
        """The covariance (6, 6) of an answer whose keypoints' scatter gives this one."""
        floor = np.repeat([self.rotation_floor_rad, self.position_floor_m], 3)
        return np.asarray(self.covariance_factor**2 * covariance + np.diag(floor**2))


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

    def views_by_point(self) -> tuple[Ints, Ints]:
        """Training frames by the points that they saw, and where each point's begin and the last one's end (P + 1,)."""
        view = np.repeat(np.arange(len(self.map_T_view)), np.diff(self.seen_bounds))
        order = np.argsort(self.seen, kind="stable")
        return view[order], np.searchsorted(self.seen[order], np.arange(len(self.xyz) + 1))


def point_covariances(content: CompactMap) -> Array:
    """Covariances (P, 3, 3), m^2, of the map's points, by from where its frames saw them."""
    view, ends = content.views_by_point()
    offset = np.repeat(content.xyz, np.diff(ends), axis=0) - content.map_T_view[view, :3, 3]
    squared = np.sum(offset**2, axis=1)
    # A ray measures what is across it, the better the nearer: (I - d d^T) / distance^2.
    outer = np.einsum("oi,oj->oij", offset, offset) / squared[:, None, None]
    across = ((np.eye(3) - outer) / squared[:, None, None]).reshape(-1, 9)
    sums = np.concatenate([np.zeros((1, 9)), np.cumsum(across, axis=0)])
    information = (sums[ends[1:]] - sums[ends[:-1]]).reshape(-1, 3, 3)
    ridge = (1e-9 + 1e-6 * np.trace(information, axis1=1, axis2=2))[:, None, None] * np.eye(3)
    return np.asarray(content.priors.point_sd**2 * np.linalg.inv(information + ridge))


def write_map(path: Path, content: CompactMap) -> None:
    """Write the map's file, the same bytes for the same content."""
    with written_aside(path) as partial:
        partial.write_bytes(_packed(_to_sections(content)))


def bytes_by_section(content: CompactMap) -> dict[str, int]:
    """The sizes of the arrays of the map's file, and of what else is in it."""
    arrays = _to_sections(content)
    sizes = {name: array.nbytes for name, array in arrays.items()}
    return sizes | {"container": len(_packed(arrays)) - sum(sizes.values())}


def _packed(arrays: dict[str, NDArray[Any]]) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)  # type: ignore[arg-type]
    return file.getvalue()


def _to_sections(content: CompactMap) -> dict[str, NDArray[Any]]:
    origin = np.floor(content.xyz.min(axis=0))
    extent = float((content.xyz - origin).max())
    small = extent < 65.0
    step = 0.001 if small else 0.0005
    arrays: dict[str, NDArray[Any]] = {
        "xyz": np.rint((content.xyz - origin) / step).astype(np.uint16 if small else np.uint32),
        "descriptors": to_bytes(content.descriptors),
        "words": to_bytes(content.words),
        "word_bounds": content.word_bounds.astype(np.uint32),
        "views": content.map_T_view[:, :3].astype(np.float32),
        "seen": content.seen.astype(np.uint16 if len(content.xyz) < 65536 else np.uint32),
        "seen_bounds": content.seen_bounds.astype(np.uint32),
        "mean": content.mean.astype(np.float16),
        "basis": content.basis.astype(np.float16),
    }
    metadata = {
        "version": _VERSION,
        "scene": content.scene,
        "origin_m": origin.tolist(),
        "step_m": step,
        "lenses": [vars(lens) for lens in content.lenses],
        "priors": vars(content.priors),
        "calibration": vars(content.calibration),
        "max_features": content.max_features,
        "max_side": content.max_side,
    }
    text = json.dumps(metadata, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return arrays | {"metadata": np.frombuffer(text.encode(), np.uint8)}


def read_map(path: Path) -> CompactMap:
    """A map from its file; UserError where that isn't one, is damaged or of another version."""
    try:
        with np.load(path) as file:
            a = {name: file[name] for name in file.files}
        m = json.loads(bytes(a["metadata"]))
        version = m["version"]
    except (OSError, EOFError, KeyError, TypeError, ValueError, zipfile.BadZipFile) as error:
        raise UserError("a map can't be read", where=path, found=error, do="build it again") from error
    if version != _VERSION:
        do = "update groundwalk, or build the map again"
        raise UserError("a map has another version", where=path, expected=_VERSION, found=version, do=do)
    try:
        views = np.tile(np.eye(4), (len(a["views"]), 1, 1))
        views[:, :3] = a["views"]
        return CompactMap(
            scene=str(m["scene"]),
            xyz=a["xyz"].astype(float) * m["step_m"] + m["origin_m"],
            descriptors=unit(a["descriptors"]),
            words=unit(a["words"]),
            word_bounds=a["word_bounds"].astype(np.int64),
            map_T_view=views,
            seen=a["seen"].astype(np.int64),
            seen_bounds=a["seen_bounds"].astype(np.int64),
            mean=a["mean"].astype(np.float32),
            basis=a["basis"].astype(np.float32),
            lenses=tuple(
                Lens(x["focal"], tuple(x["distortion"]), x["readout_s"], (x["centre"][0], x["centre"][1]))
                for x in m["lenses"]
            ),
            priors=Priors(**m["priors"]),
            calibration=Calibration(**m["calibration"]),
            max_features=int(m["max_features"]),
            max_side=int(m["max_side"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError("a map lacks a section, or has one of another type", where=path, found=error) from error


def to_bytes(descriptors: Floats) -> NDArray[np.int8]:
    """Unit descriptors as the file has them; `unit` gives them back."""
    return np.clip(np.rint(descriptors * (_BYTE / _LARGEST_COMPONENT)), -_BYTE, _BYTE).astype(np.int8)
