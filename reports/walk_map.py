"""The walk seen from above, frame by frame: an inline drawing, and the data that the page's script shows of a frame."""

import base64
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from markupsafe import escape

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.style import model_colours
from groundwalk.reports.verdict import Verdict
from groundwalk.store.images import small_jpeg
from groundwalk.store.progress import track
from groundwalk.store.tables import poses_of

_WIDTH = 1000.0
_MIN_HEIGHT, _MAX_HEIGHT = 240.0, 760.0
_MARGIN = 45.0
_THUMBNAIL_PX = 176
_PLACES = ("xyz", ("vio_x", "vio_y", "vio_z"))
MAX_THUMBNAILS = 800
"""Frames whose image is in the page, spread evenly over the capture: some 4 MB."""


@dataclass(frozen=True)
class Plan:
    """Map positions (N, 3), +y up, seen from above, as picture coordinates: their long side lies level, as a map's
    heading is arbitrary and a page is wide."""

    level: Array
    low: Array
    scale: float
    origin: Array
    size: Array

    def drawn(self, xyz_N3: Array) -> Array:
        return self.origin + self.scale * (_from_above(xyz_N3) @ self.level - self.low)


def plan_of(frames: pd.DataFrame) -> Plan | None:
    """The plan on which all of a verdict's `frames` and VIO's path find room; None where no frame has a place."""
    truth, vio = (frames[list(xyz)].to_numpy(float) for xyz in _PLACES)
    level = _long_side_level(_from_above(truth))
    known = _from_above(np.concatenate([truth, vio])) @ level
    known = known[np.isfinite(known).all(axis=1)]
    if not len(known):
        return None
    low, extent = known.min(axis=0), np.maximum(np.ptp(known, axis=0), 1e-3)
    scale = min((_WIDTH - 2 * _MARGIN) / extent[0], (_MAX_HEIGHT - 2 * _MARGIN) / extent[1])
    size = np.array([_WIDTH, max(_MIN_HEIGHT, scale * extent[1] + 2 * _MARGIN)])
    return Plan(level, low, scale, (size - scale * extent) / 2, size)


def _from_above(xyz_N3: Array) -> Array:
    return xyz_N3[:, [0, 2]] * [1, -1]


def _long_side_level(xy_N2: Array) -> Array:
    """The rotation (2, 2), for rows from the right, and the picture's y, which is downwards."""
    known = xy_N2[np.isfinite(xy_N2).all(axis=1)]
    if len(known) < 2:
        return np.diag([1.0, -1.0])
    long_side = np.linalg.svd(known - known.mean(axis=0))[2][0]
    x, y = long_side if long_side[0] >= 0 else -long_side
    return np.array([[x, y], [y, -x]])


def draw(name: str, unit: str, frames: pd.DataFrame) -> str:
    """The map as SVG: VIO's path, the ground truth's, and a mark a frame, whose class is its quality and whose title
    its `meaning`; frames without ground truth stand where VIO has them. Empty where no frame has a place."""
    plan = plan_of(frames)
    if plan is None:
        return ""
    truth, vio = (plan.drawn(frames[list(xyz)].to_numpy(float)) for xyz in _PLACES)
    (width, height), radius = plan.size, float(np.clip(130 / math.sqrt(len(frames)), 4.5, 11))
    label = f"{name} from above: {len(frames)} frames"
    parts = [f'<svg class="walk" viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">']
    for kind, path in (("vio", vio), ("truth", truth)):
        for rows in frames.groupby("session_id").indices.values():
            parts += [f'<polyline class="{kind}" points="{line}"/>' for line in _lines(path[rows])]
    parts.append('<path class="answers"/>')
    for row, (x, y) in enumerate(np.where(np.isnan(truth), vio, truth)):
        if math.isfinite(x):
            frame_id, meaning, quality = (frames[column][row] for column in ("frame_id", "meaning", "quality"))
            title = escape(f"{frame_id}: {meaning}")
            mark = f'class="q-{quality}" data-row="{row}" cx="{x:.1f}" cy="{y:.1f}" r="{radius:.1f}"'
            parts.append(f"<circle {mark}><title>{title}</title></circle>")
    most = (width - 2 * _MARGIN) / plan.scale / 4
    power = 10.0 ** np.floor(np.log10(most))
    length = float(max(m * power for m in (1, 2, 5) if m * power <= most))  # round, of the scale bar
    right, bottom = width - 12, height - 12
    parts.append(f'<path class="bar" d="M{right - plan.scale * length:.1f} {bottom:.1f}H{right:.1f}"/>')
    parts.append(f'<text x="{right:.1f}" y="{bottom - 8:.1f}">{length:g} {unit}</text></svg>')
    return "".join(parts)


def _lines(xy_N2: Array) -> list[str]:
    """The pieces of a path between unknown positions, as an SVG polyline's points."""
    known = np.isfinite(xy_N2).all(axis=1)
    pieces = np.split(xy_N2, np.flatnonzero(~known))
    lines = (" ".join(f"{x:.1f},{y:.1f}" for x, y in piece[np.isfinite(piece).all(axis=1)]) for piece in pieces)
    return [line for line in lines if " " in line]


def frame_data(scene: SceneInputs, verdict: Verdict, image_path: Callable[[str], Path]) -> str:
    """What the script shows of each row of `verdict.frames`, and colours the map by, as JSON that can stand in HTML.

    UserError where an image can't be read any more.
    """
    frames = verdict.frames
    shots = scene.frames.set_index("frame_id").loc[frames["frame_id"]]
    unit = scene.unit.symbol
    truth = scene.ground_truth.set_index("frame_id").reindex(frames["frame_id"])
    refusals: dict[str, list[str]] = {}
    figures: dict[str, pd.Series] = {
        f"sigma, position ({unit})": frames["position_sd"],
        "sigma, rotation (°)": frames["rotation_sd_deg"],
        f"VIO from ground truth ({unit})": frames["vio_error"],
        f"ground truth from the truth ({unit})": frames["true_error"],
    }
    answers: dict[str, list[list[float | None]]] = {}
    recall: list[dict[str, Any]] = []
    colours, row_of = model_colours(scene), {frame_id: row for row, frame_id in enumerate(frames["frame_id"])}

    def add(name: str, model: str, errors: pd.DataFrame, column: str, poses: pd.DataFrame, group: str) -> None:
        errors = errors.set_index("frame_id")
        figures[name] = errors[column].reindex(frames["frame_id"])
        tested = [row_of[frame_id] for frame_id in errors.index[errors["split"] == "test"]]
        recall.append({"name": name, "colour": colours[model], "fused": group != "map_cam", "rows": tested})
        poses = poses.drop_duplicates("frame_id").set_index("frame_id").reindex(frames["frame_id"])
        if plan := plan_of(frames):
            answers[name] = [_numbers(axis) for axis in plan.drawn(poses_of(poses, group)[:, :3, 3]).T]

    for model in scene.models:
        best, label = scene.best(model), scene.label(model)
        predicted = scene.predictions[scene.predictions["model"] == model]
        add(f"{label} alone ({unit})", model, scene.raw_errors(model), "raw_position_m", predicted, "map_cam")
        if best and best not in scene.raw_methods:
            name = f"{label}{scene.method_labels[best]} in time ({unit})"
            poses = scene.poses[(scene.poses["model"] == model) & (scene.poses["method"] == best)]
            add(name, model, scene.frame_errors(model, best), "live_position_m", poses, "live_map_cam")
        if model in set(scene.localisers["model"]):
            said = predicted.set_index("frame_id").reindex(frames["frame_id"])
            figures[f"{label}, inliers"] = said["inliers"]
            refusals[label] = said["reason"].fillna("").tolist()
    shown = set(evenly(len(frames), MAX_THUMBNAILS))
    images = [
        thumbnail(image_path(image), x, y) if row in shown else ""
        for row, (image, x, y) in enumerate(
            track(list(zip(shots["image"], shots["gravity_x"], shots["gravity_y"], strict=True)), "reading images")
        )
    ]
    content = {
        "unit": unit,
        "id": frames["frame_id"].tolist(),
        "session": frames["session_id"].tolist(),
        "split": frames["split"].tolist(),
        "class": frames["quality"].astype(str).tolist(),
        "reason": frames["reason"].tolist(),
        "time": _numbers(frames["seconds"]),
        "place": [_numbers(frames[axis]) for axis in "xyz"],
        "rotation": [_numbers(truth[f"map_cam_{axis}"]) for axis in ("qw", "qx", "qy", "qz")],
        "figures": {name: _numbers(values) for name, values in figures.items() if values.notna().any()},
        "answers": answers,
        "recall": recall,
        "compared": [row_of[frame_id] for frame_id in scene.compared["frame_id"].unique()],
        "refusals": refusals,
        "image": images,
    }
    return json.dumps(content, ensure_ascii=True, separators=(",", ":")).replace("<", "\\u003c")


def _numbers(values: Any) -> list[float | None]:
    return [float(f"{v:.4g}") if math.isfinite(v) else None for v in np.asarray(values, dtype=float)]


def thumbnail(path: Path, gravity_x: float, gravity_y: float) -> str:
    """A small upright JPEG of an image as a data address."""
    return data_address("jpeg", small_jpeg(path, _THUMBNAIL_PX, gravity_x, gravity_y))


def data_address(kind: str, content: bytes) -> str:
    """A picture as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"
