"""How far VIO moves away from ground truth, in the measures that the literature uses, each named by its definition.

docs/explanation/consistency.md lists the definitions. Paths here are poses (N, 4, 4) of the same frames in order of
time; the ground truth is metric and VIO as the phone gives it, so a wrong scale of VIO is drift.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
import pandas as pd

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_se3, fit_sim3, fit_yaw
from groundwalk.geometry.poses import Array, heading, inverse, path_length, relative, rotation_angle, transform
from groundwalk.store.choices import DriftDefinition, DriftInterval
from groundwalk.store.schemas import schema

DISTANCES_M = (5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
# Of a walk that is shorter than all of these.
SHORT_DISTANCES_M = (0.25, 0.5, 1.0, 2.0)
# What counts as one second: the frame nearest to a second later, if it lies within these.
_SECOND_S = (0.5, 1.5)
# Over less time or path the rate of yaw would be noise.
_MIN_YAW_S = 10.0
_MIN_YAW_M = 5.0

ALL = "all"


class DriftSamples(NamedTuple):
    """Samples `found` (M,) of one measure over one interval."""

    definition: DriftDefinition
    interval: float | None
    interval_unit: DriftInterval
    unit: str
    found: Array


def measure_drift(
    t_ns: np.ndarray, map_T_cam: Array, vio_T_cam: Array, *, is_upright: bool = True
) -> list[DriftSamples]:
    """All measures of one segment: times (N,), ground truth and VIO poses (N, 4, 4) of the same frames; those of yaw
    where both are `is_upright`."""
    if len(t_ns) < 2:
        return []
    return [
        *_steps(t_ns, map_T_cam, vio_T_cam),
        *_distances(map_T_cam, vio_T_cam),
        *(_yaw(t_ns, map_T_cam, vio_T_cam) if is_upright else ()),
        *_trajectory(map_T_cam[:, :3, 3], vio_T_cam[:, :3, 3], is_upright=is_upright),
    ]


def drift_table(by_session: Mapping[str, Sequence[DriftSamples]]) -> pd.DataFrame:
    """The align.drift table: each session's rows, then those of all sessions together; of measures with a sample."""
    rows = []
    for session_id, samples in (*by_session.items(), (ALL, [s for each in by_session.values() for s in each])):
        values: dict[tuple[object, ...], list[float]] = {}
        for sample in samples:
            values.setdefault(sample[:4], []).extend(sample.found.tolist())
        for key, v in ((key, np.array(numbers)) for key, numbers in values.items() if numbers):
            statistics = len(v), v.mean(), np.median(v), np.sqrt(np.mean(v**2)), np.percentile(v, 95), v.max()
            rows.append((session_id, *key, *statistics))
    return pd.DataFrame(rows, columns=schema("align", "drift").column_names).astype({"interval": float})


def second_pairs(t_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Index pairs (M,), (M,) of frames about a second apart: for each frame the one nearest to a second later."""
    seconds = (t_ns - t_ns[0]) * 1e-9
    after = np.searchsorted(seconds, seconds + 1.0)
    before = np.maximum(after - 1, 0)
    inside = np.minimum(after, len(seconds) - 1)
    nearer = np.abs(seconds[inside] - seconds - 1.0) < np.abs(seconds[before] - seconds - 1.0)
    later = np.where(nearer, inside, before)
    gap = seconds[later] - seconds
    good = (gap >= _SECOND_S[0]) & (gap <= _SECOND_S[1])
    return np.flatnonzero(good), later[good]


def distance_pairs(xyz: Array, distance_m: float) -> tuple[np.ndarray, np.ndarray, Array]:
    """Index pairs (M,), (M,): each frame and the first one that lies `distance_m` or more further along the path, and
    how far it does, metres (M,)."""
    travelled = path_length(xyz)
    last = np.searchsorted(travelled, travelled + distance_m)
    first = np.flatnonzero(last < len(travelled))
    return first, last[first], travelled[last[first]] - travelled[first]


def _steps(t_ns: np.ndarray, map_T_cam: Array, vio_T_cam: Array) -> Iterator[DriftSamples]:
    """The paper's RPE and ROE (eq. 4 and 5), and the whole relative pose, per pair of frames and per second."""
    consecutive = (np.arange(len(t_ns) - 1), np.arange(1, len(t_ns)))
    for (first, last), unit in ((consecutive, DriftInterval.PAIR), (second_pairs(t_ns), DriftInterval.SECONDS)):
        step, vio_step = relative(map_T_cam[first], map_T_cam[last]), relative(vio_T_cam[first], vio_T_cam[last])
        (length, angle), (vio_length, vio_angle) = _motion(step), _motion(vio_step)
        yield DriftSamples(DriftDefinition.PAPER_RPE, 1.0, unit, "m", np.abs(length - vio_length))
        yield DriftSamples(DriftDefinition.PAPER_ROE, 1.0, unit, "deg", np.abs(angle - vio_angle))
        error_m, error_deg = _motion(inverse(step) @ vio_step)
        yield DriftSamples(DriftDefinition.RELATIVE_POSITION, 1.0, unit, "m", error_m)
        yield DriftSamples(DriftDefinition.RELATIVE_ROTATION, 1.0, unit, "deg", error_deg)


def _distances(map_T_cam: Array, vio_T_cam: Array) -> Iterator[DriftSamples]:
    """KITTI's odometry error (Geiger et al., CVPR 2012): relative motion over fixed travelled distances, divided by the
    distance between the frames, since these may be a metre apart."""
    travelled_m = float(path_length(map_T_cam[:, :3, 3])[-1])
    for distance_m in DISTANCES_M if travelled_m >= DISTANCES_M[0] else SHORT_DISTANCES_M:
        first, last, path_m = distance_pairs(map_T_cam[:, :3, 3], distance_m)
        step, vio_step = relative(map_T_cam[first], map_T_cam[last]), relative(vio_T_cam[first], vio_T_cam[last])
        error_m, error_deg = _motion(inverse(step) @ vio_step)
        metres = DriftInterval.METRES
        yield DriftSamples(DriftDefinition.DISTANCE_POSITION, distance_m, metres, "%", 100 * error_m / path_m)
        yield DriftSamples(DriftDefinition.DISTANCE_ROTATION, distance_m, metres, "deg/m", error_deg / path_m)


def _motion(a_T_b: Array) -> tuple[Array, Array]:
    """Lengths in metres and angles in degrees (N,) of motions (N, 4, 4)."""
    return np.linalg.norm(a_T_b[:, :3, 3], axis=1), np.degrees(rotation_angle(a_T_b[:, :3, :3]))


def _yaw(t_ns: np.ndarray, map_T_cam: Array, vio_T_cam: Array) -> Iterator[DriftSamples]:
    """The steady rate of VIO's yaw error, by least squares over the whole segment; its size, not its sign."""
    map_R_vio = map_T_cam[:, :3, :3] @ np.swapaxes(vio_T_cam[:, :3, :3], 1, 2)
    yaw_deg = np.degrees(np.unwrap(heading(map_R_vio)))
    minutes, travelled = (t_ns - t_ns[0]) / 60e9, path_length(map_T_cam[:, :3, 3])
    spans = (minutes, _MIN_YAW_S / 60, "deg/min"), (travelled / 100, _MIN_YAW_M / 100, "deg/100m")
    for along, shortest, unit in spans:
        if along[-1] >= shortest:
            rate = np.abs(np.polyfit(along, yaw_deg, 1)[:1])
            yield DriftSamples(DriftDefinition.YAW_RATE, None, DriftInterval.PATH, unit, rate)


def _trajectory(map_xyz: Array, vio_xyz: Array, *, is_upright: bool) -> Iterator[DriftSamples]:
    """ATE: position errors after a least-squares fit of the whole path (Zhang and Scaramuzza, IROS 2018)."""

    def ate(definition: DriftDefinition, aligned_xyz: Array) -> DriftSamples:
        errors_m = np.linalg.norm(map_xyz - aligned_xyz, axis=1)
        return DriftSamples(definition, None, DriftInterval.PATH, "m", errors_m)

    # Too few frames, or a path so straight that positions leave the fit open: this segment has no ATE.
    with suppress(GeometryError):
        yield ate(DriftDefinition.ATE_SE3, transform(fit_se3(map_xyz, vio_xyz), vio_xyz))
        if is_upright:
            yield ate(DriftDefinition.ATE_YAW, transform(fit_yaw(map_xyz, vio_xyz), vio_xyz))
        yield ate(DriftDefinition.ATE_SIM3, fit_sim3(map_xyz, vio_xyz).points(vio_xyz))
