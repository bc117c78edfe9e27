"""How far VIO moves away from ground truth, in the measures that the literature uses, each named by its definition.

docs/explanation/ground-truth.md lists the definitions. Paths here are poses (N, 4, 4) of the same frames in order of
time; the ground truth is metric and VIO as the phone gives it, so a wrong scale of VIO is drift.
"""

from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass, field

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


@dataclass
class DriftSamples:
    """Samples of every definition, by (definition, interval, interval_unit, unit)."""

    samples: dict[tuple[DriftDefinition, float | None, DriftInterval, str], list[float]] = field(
        default_factory=lambda: defaultdict(list)
    )

    def add(
        self,
        definition: DriftDefinition,
        interval: float | None,
        interval_unit: DriftInterval,
        unit: str,
        values: Array,
    ) -> None:
        self.samples[definition, interval, interval_unit, unit].extend(np.asarray(values, dtype=float).tolist())

    def extend(self, other: "DriftSamples") -> None:
        for key, values in other.samples.items():
            self.samples[key].extend(values)

    def rows(self, session_id: str) -> list[dict[str, object]]:
        """Rows of align.drift; definitions without a sample have none."""
        rows = []
        for (definition, interval, interval_unit, unit), values in self.samples.items():
            if not values:
                continue
            v = np.array(values)
            rows.append(
                {
                    "session_id": session_id,
                    "definition": definition,
                    "interval": interval,
                    "interval_unit": interval_unit,
                    "unit": unit,
                    "samples": len(v),
                    "mean": v.mean(),
                    "median": np.median(v),
                    "rms": np.sqrt(np.mean(v**2)),
                    "p95": np.percentile(v, 95),
                    "max": v.max(),
                }
            )
        return rows


def measure_drift(t_ns: np.ndarray, map_T_cam: Array, vio_T_cam: Array, *, is_upright: bool = True) -> DriftSamples:
    """All measures of one segment: times (N,), ground truth and VIO poses (N, 4, 4) of the same frames; those of yaw
    where both are `is_upright`."""
    samples = DriftSamples()
    if len(t_ns) < 2:
        return samples
    _steps(samples, t_ns, map_T_cam, vio_T_cam)
    _distances(samples, map_T_cam, vio_T_cam)
    if is_upright:
        _yaw(samples, t_ns, map_T_cam, vio_T_cam)
    _trajectory(samples, map_T_cam[:, :3, 3], vio_T_cam[:, :3, 3], is_upright=is_upright)
    return samples


def drift_table(by_session: dict[str, DriftSamples]) -> pd.DataFrame:
    """The align.drift table: each session's rows, then those of all sessions together."""
    pooled = DriftSamples()
    rows = []
    for session_id, samples in by_session.items():
        rows += samples.rows(session_id)
        pooled.extend(samples)
    rows += pooled.rows(ALL)
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


def _steps(samples: DriftSamples, t_ns: np.ndarray, map_T_cam: Array, vio_T_cam: Array) -> None:
    """The paper's RPE and ROE (eq. 4 and 5), and the whole relative pose, per pair of frames and per second."""
    consecutive = (np.arange(len(t_ns) - 1), np.arange(1, len(t_ns)))
    for (first, last), unit in ((consecutive, DriftInterval.PAIR), (second_pairs(t_ns), DriftInterval.SECONDS)):
        step, vio_step = relative(map_T_cam[first], map_T_cam[last]), relative(vio_T_cam[first], vio_T_cam[last])
        (length, angle), (vio_length, vio_angle) = _motion(step), _motion(vio_step)
        samples.add(DriftDefinition.PAPER_RPE, 1.0, unit, "m", np.abs(length - vio_length))
        samples.add(DriftDefinition.PAPER_ROE, 1.0, unit, "deg", np.abs(angle - vio_angle))
        error_m, error_deg = _motion(inverse(step) @ vio_step)
        samples.add(DriftDefinition.RELATIVE_POSITION, 1.0, unit, "m", error_m)
        samples.add(DriftDefinition.RELATIVE_ROTATION, 1.0, unit, "deg", error_deg)


def _distances(samples: DriftSamples, map_T_cam: Array, vio_T_cam: Array) -> None:
    """KITTI's odometry error (Geiger et al., CVPR 2012): relative motion over fixed travelled distances, divided by the
    distance between the frames, since these may be a metre apart."""
    travelled_m = float(np.linalg.norm(np.diff(map_T_cam[:, :3, 3], axis=0), axis=1).sum())
    for distance_m in DISTANCES_M if travelled_m >= DISTANCES_M[0] else SHORT_DISTANCES_M:
        first, last, path_m = distance_pairs(map_T_cam[:, :3, 3], distance_m)
        step, vio_step = relative(map_T_cam[first], map_T_cam[last]), relative(vio_T_cam[first], vio_T_cam[last])
        error_m, error_deg = _motion(inverse(step) @ vio_step)
        metres = DriftInterval.METRES
        samples.add(DriftDefinition.DISTANCE_POSITION, distance_m, metres, "%", 100 * error_m / path_m)
        samples.add(DriftDefinition.DISTANCE_ROTATION, distance_m, metres, "deg/m", error_deg / path_m)


def _motion(a_T_b: Array) -> tuple[Array, Array]:
    """Lengths in metres and angles in degrees (N,) of motions (N, 4, 4)."""
    return np.linalg.norm(a_T_b[:, :3, 3], axis=1), np.degrees(rotation_angle(a_T_b[:, :3, :3]))


def _yaw(samples: DriftSamples, t_ns: np.ndarray, map_T_cam: Array, vio_T_cam: Array) -> None:
    """The steady rate of VIO's yaw error, by least squares over the whole segment; its size, not its sign."""
    map_R_vio = map_T_cam[:, :3, :3] @ np.swapaxes(vio_T_cam[:, :3, :3], 1, 2)
    yaw_deg = np.degrees(np.unwrap(heading(map_R_vio)))
    minutes = (t_ns - t_ns[0]) / 60e9
    travelled = path_length(map_T_cam[:, :3, 3])

    def rate_of(independent: Array) -> Array:
        return np.abs(np.polyfit(independent, yaw_deg, 1)[:1])

    if minutes[-1] >= _MIN_YAW_S / 60:
        samples.add(DriftDefinition.YAW_RATE, None, DriftInterval.PATH, "deg/min", rate_of(minutes))
    if travelled[-1] >= _MIN_YAW_M:
        samples.add(DriftDefinition.YAW_RATE, None, DriftInterval.PATH, "deg/100m", rate_of(travelled / 100))


def _trajectory(samples: DriftSamples, map_xyz: Array, vio_xyz: Array, *, is_upright: bool) -> None:
    """ATE: position errors after a least-squares fit of the whole path (Zhang and Scaramuzza, IROS 2018)."""

    def add(definition: DriftDefinition, aligned_xyz: Array) -> None:
        errors_m = np.linalg.norm(map_xyz - aligned_xyz, axis=1)
        samples.add(definition, None, DriftInterval.PATH, "m", errors_m)

    # Too few frames, or a path so straight that positions leave the fit open: this segment has no ATE.
    with suppress(GeometryError):
        add(DriftDefinition.ATE_SE3, transform(fit_se3(map_xyz, vio_xyz), vio_xyz))
        if is_upright:
            add(DriftDefinition.ATE_YAW, transform(fit_yaw(map_xyz, vio_xyz), vio_xyz))
        add(DriftDefinition.ATE_SIM3, fit_sim3(map_xyz, vio_xyz).points(vio_xyz))
