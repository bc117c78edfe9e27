"""How a phone's visual-inertial odometry would have seen a walk: drift fitted to real recordings.

Drift is a smooth deformation of the walk, a function of the path walked: yaw and position errors are rates, in
degrees and metres a metre, that vary over `correlation_m`, and the recorded poses are the true relative motions
integrated with these errors. So two poses close by keep their relative pose and the error grows with distance.
Because it hangs on the path and not on the frames, one seed gives one drift whatever the frame rate.

`docs/explanation/vio-drift.md` says how each number was measured.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, inverse, make_pose, path_length, yaw_rotation

Times = NDArray[np.int64]

# Each effect has its own stream of random numbers, so that turning one off leaves the others as they were.
_SESSION, _YAW, _POSITION, _JITTER, _JUMPS, _INTERRUPTIONS = range(6)


@dataclass(frozen=True, kw_only=True)
class VioModel:
    """How large each error of the odometry is. A zero turns the error off; `correlation_m` is above zero, and the mean
    jump as long as the least or longer.

    Spreads are standard deviations. A random walk of w per sqrt(m) has a spread of w * sqrt(path) on paths much longer
    than `correlation_m`, and less on shorter ones. The defaults were measured on seven ARKit recordings;
    docs/results/vio-drift.md has each one's source, interval and samples.
    """

    scale_std: float = 0.00216  # relative scale error of a session, spread over sessions
    gravity_std_deg: float = 0.0365  # deg: tilt of a session's up axis about each horizontal axis, over sessions
    yaw_bias_deg_per_m: float = 0.047  # deg/m: constant part of a session's yaw drift, over sessions
    yaw_walk_deg_per_sqrt_m: float = 0.492  # deg/sqrt(m): random walk of yaw, root mean square over sessions
    yaw_session_spread: float = 0.681  # spread over sessions of the logarithm of both yaw drifts
    position_walk_m_per_sqrt_m: float = 0.0279  # m/sqrt(m): random walk of each horizontal coordinate
    height_walk_m_per_sqrt_m: float = 0.00467  # m/sqrt(m): random walk of height
    correlation_m: float = 1.59  # m: path over which the rates of the random walks forget themselves
    jitter_m: float = 0.000276  # m: white noise of a frame's position, each axis; it doesn't build up
    jitter_deg: float = 0.0103  # deg: white noise of a frame's rotation, each axis; it doesn't build up
    jumps_per_min: float = 10.6  # 1/min: corrections of position from one frame to the next; they stay
    jump_min_m: float = 0.006  # m: length that each of these jumps has at least
    jump_mean_m: float = 0.00889  # m: mean length of these jumps, exponential above the least
    interruptions_per_min: float = 0.0235  # 1/min: losses of tracking: the pose stands still, then starts anew
    interruption_s: float = 1.5  # s: how long the pose stands still


FITTED = VioModel()


def simulate_vio(
    t_ns: Times, world_T_cam: Array, seed: int, model: VioModel = FITTED
) -> tuple[Array, NDArray[np.bool_]]:
    """What odometry with the errors of `model` reports for the true walk world_T_cam (N, 4, 4), +y up, OpenCV camera
    axes, at rising times t_ns (N,). The same seed gives the same track.

    vio_T_cam (N, 4, 4): metric, +y up up to the session's tilt, OpenCV camera axes; the origin is the first camera and
    -z its heading. And where tracking is limited (N,); after a lost tracking the frame itself is a new one.
    """
    vio_T_cam = _with_jumps(t_ns, _drifted(world_T_cam, seed, model), seed, model)
    return _with_interruptions(t_ns, vio_T_cam @ _jitter(len(t_ns), seed, model), seed, model)


def start_frame(world_T_cam: Array) -> Array:
    """world_T_vio (4, 4) of a session that starts at world_T_cam (4, 4): its origin at the camera, +y up and -z the
    camera's heading, as ARKit's world alignment `gravity`."""
    forward = world_T_cam[:3, 2]
    if np.hypot(forward[0], forward[2]) < 1e-3:
        # Looking straight down (or up), the top (or bottom) of the image tells the heading.
        forward = world_T_cam[:3, 1] * np.sign(forward[1])
    return make_pose(yaw_rotation(np.arctan2(-forward[0], -forward[2])), world_T_cam[:3, 3])


def wander(rng: np.random.Generator, along_m: Array, correlation_m: float, columns: int) -> Array:
    """Random walks (N, columns) over the path along_m (N,), rising from 0: the integral of a stationary
    Ornstein-Uhlenbeck rate with this correlation length, of variance 1 a metre on long paths."""
    step = correlation_m / 10
    count = int(np.ceil(along_m[-1] / step)) + 2
    keep = np.exp(-step / correlation_m)
    white = rng.standard_normal((count, columns))
    white[1:] *= np.sqrt(1 - keep**2)
    rate = lfilter([1.0], [1.0, -keep], white, axis=0) / np.sqrt(2 * correlation_m)
    walked = np.concatenate([np.zeros((1, columns)), np.cumsum((rate[1:] + rate[:-1]) * (step / 2), axis=0)])
    grid = step * np.arange(count)
    return np.stack([np.interp(along_m, grid, walked[:, c]) for c in range(columns)], axis=-1)


def _drifted(truth: Array, seed: int, model: VioModel) -> Array:
    """The true walk (N, 4, 4) deformed by scale, gravity, yaw and position errors, in the session's frame."""
    true_T_cam = inverse(start_frame(truth[0])) @ truth
    steps = np.diff(true_T_cam[:, :3, 3], axis=0)
    along = path_length(true_T_cam[:, :3, 3])

    session = np.random.default_rng([seed, _SESSION])
    scale = np.exp(model.scale_std * session.standard_normal())
    tilt_x, tilt_z = np.radians(model.gravity_std_deg) * session.standard_normal(2)
    bias = model.yaw_bias_deg_per_m * session.standard_normal()
    # Sessions differ; the shift keeps the root mean square over sessions.
    spread = model.yaw_session_spread
    yaw_size = np.exp(spread * session.standard_normal() - spread**2)

    walk = wander(np.random.default_rng([seed, _YAW]), along, model.correlation_m, 1)[:, 0]
    yaw = np.radians(yaw_size * (bias * along + model.yaw_walk_deg_per_sqrt_m * walk))
    tilt = Rotation.from_rotvec([tilt_x, 0.0, tilt_z]).as_matrix()

    rotation = yaw_rotation(yaw) @ tilt @ true_T_cam[:, :3, :3]
    turned = scale * np.einsum("nij,nj->ni", yaw_rotation((yaw[1:] + yaw[:-1]) / 2) @ tilt, steps)
    level, height = model.position_walk_m_per_sqrt_m, model.height_walk_m_per_sqrt_m
    strayed = wander(np.random.default_rng([seed, _POSITION]), along, model.correlation_m, 3) * [level, height, level]
    position = strayed + np.concatenate([np.zeros((1, 3)), np.cumsum(turned, axis=0)])
    return make_pose(rotation, position)


def _with_jumps(times: Times, vio_T_cam: Array, seed: int, model: VioModel) -> Array:
    """The track with small lasting jumps of position."""
    rng = np.random.default_rng([seed, _JUMPS])
    starts = _poisson_frames(rng, times, model.jumps_per_min)
    length = model.jump_min_m + rng.exponential(model.jump_mean_m - model.jump_min_m, len(starts))
    direction = rng.standard_normal((len(starts), 3))
    jump = direction / np.linalg.norm(direction, axis=1, keepdims=True) * length[:, None]
    shift = np.zeros((len(times), 3))
    np.add.at(shift, starts, jump)
    moved = vio_T_cam.copy()
    moved[:, :3, 3] += np.cumsum(shift, axis=0)
    return moved


def _with_interruptions(times: Times, vio_T_cam: Array, seed: int, model: VioModel) -> tuple[Array, NDArray[np.bool_]]:
    """The track with lost tracking: the pose stands still while tracking is limited, then the session starts anew with
    its origin at the camera. Returns poses, and which frames are limited."""
    rng = np.random.default_rng([seed, _INTERRUPTIONS])
    limited = np.zeros(len(times), dtype=bool)
    out = vio_T_cam.copy()
    for first in _poisson_frames(rng, times, model.interruptions_per_min):
        if limited[first]:
            continue
        after = int(np.searchsorted(times, times[first] + round(model.interruption_s * 1e9)))
        limited[first:after] = True
        standing = out[first - 1].copy()
        if after < len(times):
            out[after:] = inverse(start_frame(out[after])) @ out[after:]
        out[first:after] = standing
    return out, limited


def _poisson_frames(rng: np.random.Generator, times: Times, per_min: float) -> NDArray[np.int64]:
    """The first frames, rising, after the events of a Poisson process over the session."""
    duration_s = (times[-1] - times[0]) * 1e-9
    at_s = np.sort(rng.uniform(0.0, duration_s, rng.poisson(per_min * duration_s / 60)))
    return np.searchsorted((times - times[0]) * 1e-9, at_s)


def _jitter(count: int, seed: int, model: VioModel) -> Array:
    """Small motions (N, 4, 4) in camera axes, new at every frame."""
    rng = np.random.default_rng([seed, _JITTER])
    turn = Rotation.from_rotvec(np.radians(model.jitter_deg) * rng.standard_normal((count, 3)))
    return make_pose(turn.as_matrix(), model.jitter_m * rng.standard_normal((count, 3)))
