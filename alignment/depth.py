"""A depth sensor against the map, at the points of SfM, in scale and over distance; it gives nothing to the map.

Depth images are as import has them: 16-bit PNG, millimetres along the camera's z axis, with the field of view of the
image; their confidence is 0, 1, 2 or 0, 127, 255.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pandas as pd
import pycolmap

from groundwalk.alignment.checks.results import CheckResult, Failure, Quantity, Subject, evaluate
from groundwalk.alignment.components import PlacedComponent
from groundwalk.consistency.decisions import Status
from groundwalk.geometry.depth_images import ratio_statistics, sample_depth
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.store import UserError
from groundwalk.store.choices import CheckName, FailureCause
from groundwalk.store.files import sha256_of
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of

# Phones' sensors reach 5 m: beyond, depth is interpolated.
MAX_RANGE_M = 5.0
_BINS_M = (0.0, 0.5, 1.0, 2.0, 3.0, MAX_RANGE_M, np.inf)
HIGH_CONFIDENCE = 2
# A point that two frames see may be a wrong match.
_MIN_TRACK = 3
# Phones' depth sensors are off by some per cent: more says that map or sensor is wrong.
_MAX_SCALE_ERROR, _MAX_SPREAD = 0.05, 0.05
# Fewer samples or frames decide nothing.
_MIN_SAMPLES, _MIN_FRAMES = 100, 3
_PUT_BACK = "put it back, or import the scene again"
_COLUMNS = ["session_id", "component", "frame", "map_m", "sensor_m", "confidence"]


def read_depth(path: Path, confidence: Path | None, sha256: str) -> tuple[Array, np.ndarray]:
    """A depth image in metres (H, W), 0 where there is none, and its confidence 0 to 2 (H, W), -1 where unknown.
    UserError where it isn't the file that import saw, of which `sha256` is the hash."""
    if not path.is_file() or sha256_of(path) != sha256:
        found = "another sha256 than in import.frames" if path.is_file() else "no such file"
        raise UserError("a depth image isn't as import saw it", where=path, found=found, do=_PUT_BACK)
    millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if millimetres is None:
        raise UserError("a depth image can't be read", where=path, do="import the scene again")
    metres = np.asarray(millimetres, dtype=float) / 1000
    if confidence is None:
        return metres, np.full(metres.shape, -1)
    levels = cv2.imread(str(confidence), cv2.IMREAD_UNCHANGED)
    if levels is None or levels.shape != metres.shape:
        found = "no image that can be read" if levels is None else f"{levels.shape}, of a depth image {metres.shape}"
        what = "the confidence of a depth image isn't as import saw it"
        raise UserError(what, where=confidence, found=found, do=_PUT_BACK)
    level = np.asarray(levels, dtype=np.int64)
    return metres, np.where(level > HIGH_CONFIDENCE, (level + 1) // 127, level).clip(0, HIGH_CONFIDENCE)


def sample_frames(
    frames: pd.DataFrame,
    images: pd.DataFrame,
    used: np.ndarray,
    placed: Sequence[PlacedComponent],
    model_folder: Callable[[str], Path],
    image_path: Callable[[str], Path],
) -> pd.DataFrame:
    """Points of SfM's models where frames (import's table) with ground truth (`used`) and depth see them: session_id,
    component, `frame` (row of the frames table), depth by the map and by the sensor in metres, confidence 0 to 2 (-1:
    unknown).

    `images` are SfM's in the order of `frames`; `model_folder` gives the folder of a model's id, `image_path` the file
    of an entry in frames.
    """
    row_of = {f: i for i, f in enumerate(frames["frame_id"]) if used[i] and _is_path(frames["depth"].iloc[i])}
    sfm_T_cam = poses_of(images, "sfm_cam")
    samples = [pd.DataFrame(columns=_COLUMNS)]
    for each in placed if row_of else []:
        model = pycolmap.Reconstruction(model_folder(each.component.model_id))
        points = {i: p.xyz for i, p in model.points3D.items() if p.track.length() >= _MIN_TRACK}
        for image in model.images.values():
            row = row_of.get(unquote(str(Path(image.name).with_suffix(""))))
            seen = [(p.xy, points[p.point3D_id]) for p in image.points2D if p.point3D_id in points]
            if row is None or not seen:
                continue
            xy, xyz = (np.array(column) for column in zip(*seen, strict=True))
            frame = frames.iloc[row]
            levels = image_path(frame["depth_confidence"]) if _is_path(frame["depth_confidence"]) else None
            depth, confidence = read_depth(image_path(frame["depth"]), levels, frame["depth_sha256"])
            sensor_m, nearest = sample_depth(depth, xy, (int(frame["width"]), int(frame["height"])))
            map_m = each.map_S_sfm.scale * transform(inverse(sfm_T_cam[row]), xyz)[:, 2]
            columns = {"frame": row, "map_m": map_m, "sensor_m": sensor_m, "confidence": confidence[tuple(nearest.T)]}
            sample = pd.DataFrame({"session_id": frame["session_id"], "component": each.component.index, **columns})
            samples.append(sample[sample["sensor_m"].notna() & (sample["map_m"] > 0)])
    return pd.concat(samples[1:] or samples, ignore_index=True)


def agreement_table(samples: pd.DataFrame, seed: int) -> pd.DataFrame:
    """The align.depth_agreement table: each session and model by distance and confidence, and within reach in all. A
    ratio above 1 says that the map is too small, or that the sensor measures long."""
    rng = np.random.default_rng(seed)
    rows = []
    for (session_id, component), of_session in samples.groupby(["session_id", "component"]):
        for confidence in (None, *range(HIGH_CONFIDENCE + 1)):
            selected = of_session if confidence is None else of_session[of_session["confidence"] == confidence]
            for near, far in ((0.0, MAX_RANGE_M), *pairwise(_BINS_M)):
                inside = selected[(selected["map_m"] >= near) & (selected["map_m"] < far)]
                if not len(inside):
                    continue
                frame = inside["frame"].to_numpy(np.int64)
                statistics = ratio_statistics((inside["sensor_m"] / inside["map_m"]).to_numpy(float), frame, rng)
                rows.append(
                    {
                        "session_id": session_id,
                        "component": component,
                        "near_m": near,
                        "far_m": far if np.isfinite(far) else None,
                        "confidence": confidence,
                        "frames": len(np.unique(frame)),
                        "samples": len(inside),
                        "median_ratio": statistics.median,
                        "mad": statistics.mad,
                        "median_ratio_se": statistics.se,
                    }
                )
    table = pd.DataFrame(rows, columns=schema("align", "depth_agreement").column_names)
    return table.astype({"confidence": "Int64", "far_m": float})


def check_depth(agreement: pd.DataFrame, scale_sd: Mapping[int, float]) -> tuple[list[CheckResult], list[str]]:
    """Checks of each session's scale and geometry by its depth (the align.depth_agreement table), and lines for the
    user; `scale_sd`: standard error of each model's scale, as a fraction. A failure excludes no frame: map or sensor
    may be what is wrong."""
    results, lines = list[CheckResult](), []
    sessions = agreement[["session_id", "component"]].drop_duplicates()
    for session_id, component in sessions.itertuples(index=False, name=None):
        of_session = agreement[(agreement["session_id"] == session_id) & (agreement["component"] == component)]
        # High confidence where the phone states any.
        confidence, has_levels = of_session["confidence"], of_session["confidence"].notna().any()
        rows = of_session[confidence == HIGH_CONFIDENCE if has_levels else confidence.isna()]
        rows = rows[(rows["samples"] >= _MIN_SAMPLES) & (rows["frames"] >= _MIN_FRAMES)]
        is_whole = (rows["near_m"] == 0.0) & (rows["far_m"] == MAX_RANGE_M)
        if not is_whole.any():
            reason = f"too little depth within {MAX_RANGE_M:g} m to check the map by"
            lines.append(f"{session_id}: {reason}")
            subject, open_ = Subject(int(of_session["frames"].max()), session_id, int(component)), Status.UNDECIDED
            name, limit = CheckName.SESSION_DEPTH_SCALE, _MAX_SCALE_ERROR
            results.append(evaluate(name, subject, Quantity(), limit, _failure(reason), open_))
            continue
        whole, bins = rows[is_whole].iloc[0], rows[~is_whole & (rows["far_m"] <= MAX_RANGE_M)]
        subject = Subject(int(whole["frames"]), session_id, int(component))
        error, sd = float(whole["median_ratio"]) - 1, float(np.hypot(whole["median_ratio_se"], scale_sd[component]))
        reason = (
            f"the sensor's depth is {abs(error):.2%} {'more' if error > 0 else 'less'} than the map's "
            f"(± {sd:.2%}, {whole['samples']} points in {whole['frames']} frames)"
        )
        lines.append(f"{session_id}: {reason}")
        estimate = Quantity(abs(error), sd)
        results.append(evaluate(CheckName.SESSION_DEPTH_SCALE, subject, estimate, _MAX_SCALE_ERROR, _failure(reason)))
        if len(bins) > 1:
            # The largest difference between the ratios of two distances.
            ordered = bins.sort_values("median_ratio")
            low, high = ordered.iloc[0], ordered.iloc[-1]
            sd = float(np.hypot(low["median_ratio_se"], high["median_ratio_se"]))
            estimate = Quantity(float(high["median_ratio"] - low["median_ratio"]), sd)
            failure = _failure(
                f"depth by the sensor over depth by the map differs with distance: {low['median_ratio']:.3f} from "
                f"{low['near_m']:g} m, {high['median_ratio']:.3f} from {high['near_m']:g} m"
            )
            results.append(evaluate(CheckName.SESSION_DEPTH_BY_DISTANCE, subject, estimate, _MAX_SPREAD, failure))
    return results, lines


def _failure(reason: str) -> Failure:
    return Failure(cause=FailureCause.DEPTH_INCONSISTENT, reason=reason)


def _is_path(entry: object) -> bool:
    return isinstance(entry, str) and bool(entry)
