"""The paper's test of a prediction (section III-A): does it move as odometry does from the prediction before?"""

from typing import Literal

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.odometry import OdometryOptions
from groundwalk.geometry.poses import Array, quaternion_angle, tq_from_pose
from groundwalk.scoring.errors import relative_error


class PairOptions(OdometryOptions):
    d_th_m: float = Field(0.4, ge=0, description="d_th: largest relative position error of a consistent pair")
    o_th_deg: float = Field(4.0, ge=0, description="o_th: largest relative orientation error of a consistent pair")
    rotation_step: Literal["scalar_part", "norm"] = Field(
        "scalar_part", description="what arccos is taken of; the norm, as printed, makes every rotation step 0"
    )
    pair_check: Literal["lengths", "se3"] = Field(
        "lengths", description="compare the lengths of the steps, or the whole relative poses"
    )
    comparison: Literal["<=", "<"] = Field("<=", description="how an error compares with d_th and o_th")
    interval_s: float = Field(1.0, gt=0, description="time between consecutive predictions")
    interval_tolerance_s: float = Field(0.5, gt=0, description="a pair further off this interval isn't consecutive")

    @property
    def gates(self) -> dict[str, float]:
        return {"rpe_m": self.d_th_m, "roe_deg": self.o_th_deg}


def are_consecutive(seconds: float | Array, options: PairOptions) -> Array:
    """Whether frames that lie `seconds` apart, a number or (N,), are one prediction interval apart."""
    return np.asarray(np.abs(seconds - options.interval_s) <= options.interval_tolerance_s)


def are_consistent(rpe_m: float | Array, roe_deg: float | Array, options: PairOptions) -> Array:
    """Whether pairs' errors, numbers or (N,), are within d_th and o_th."""
    if options.comparison == "<":
        return np.asarray((rpe_m < options.d_th_m) & (roe_deg < options.o_th_deg))
    return np.asarray((rpe_m <= options.d_th_m) & (roe_deg <= options.o_th_deg))


def pair_errors(map_T_cam: Array, vio_T_cam: Array, options: PairOptions) -> tuple[Array, Array]:
    """RPE in metres and ROE in degrees, both (N-1,), of predictions against odometry over frames (N, 4, 4).

    The paper's compare the lengths of the steps; `se3` compares the relative poses.
    """
    if options.pair_check == "se3":
        return relative_error(map_T_cam, vio_T_cam)
    return length_errors(tq_from_pose(map_T_cam), tq_from_pose(vio_T_cam), options)


def length_errors(apr: tuple[Array, Array], vio: tuple[Array, Array], options: PairOptions) -> tuple[Array, Array]:
    """The paper's RPE and ROE from positions (N, 3) and quaternions (N, 4), `groundwalk.scoring.errors.rpe_roe`, for
    a caller that has use for the quaternions elsewhere."""
    apr_m, vio_m = (np.linalg.norm(np.diff(xyz, axis=0), axis=1) for xyz, _ in (apr, vio))
    apr_rad, vio_rad = (quaternion_angle(q[1:], q[:-1]) for _, q in (apr, vio))
    roe_deg = np.degrees(np.abs(apr_rad - vio_rad))
    return np.abs(apr_m - vio_m), np.zeros_like(roe_deg) if options.rotation_step == "norm" else roe_deg
