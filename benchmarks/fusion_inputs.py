"""The walks that the fusion benchmark runs on: simulated ones, and what is spoilt on purpose."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from benchmarks.regressor_errors.model import apr_seeds, read_apr_models, simulate_apr
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.gravity import gravity_in_camera
from groundwalk.geometry.poses import Array, inverse
from groundwalk.simulation.scenes import scenery
from groundwalk.simulation.session import outline
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.vio import FITTED, VioModel, simulate_vio, start_frame
from groundwalk.simulation.walks import plan_walk
from groundwalk.store import DataRoot
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings

SIMULATED, KIDNAPPED, BETTER_APR = "simulated", "kidnapped", "better APR"

_DRIFT = replace(FITTED, interruptions_per_min=0.0)  # import starts a new session where tracking is lost
_AWAY_S = 60
_DRAW = 0  # of odometry and predictions
_SEED = 0  # of places and walks


@dataclass(frozen=True)
class Case:
    """Walks of one kind in one scene, with one regressor's predictions."""

    kind: str
    scene: str
    model: str
    walks: tuple[Walk, ...]


@dataclass(frozen=True, eq=False)
class Track:
    """A walk before anyone has predicted anything: t_ns (N,), true poses map_T_cam and odometry vio_T_cam (N, 4, 4)."""

    name: str
    t_ns: NDArray[np.int64]
    map_T_cam: Array
    vio_T_cam: Array


def simulated_tracks(scene: str, model: VioModel = _DRIFT) -> list[Track]:
    """The scene's test walks with simulated odometry."""
    return [
        Track(name, t_ns, map_T_cam, _vio(t_ns, map_T_cam, _seed(scene, name, _DRAW), model))
        for name, t_ns, map_T_cam in _true_walks(scene)
    ]


@cache
def _true_walks(scene: str) -> list[tuple[str, NDArray[np.int64], Array]]:
    """Name, t_ns (N,) and true poses map_T_cam (N, 4, 4) of the test walks, at one pose a second, with as many images
    as Table I lists.

    The map is that of the ground truth: its origin is where the first session began. UserError for an unknown scene.
    """
    settings = resolve_settings(SimulateSettings, "simulate", DataRoot(SHIPPED_DATA), "paper", scene, [])
    plan, walks = scenery(scene, _SEED), {}
    for session in outline(settings, scene, _SEED):
        rng = np.random.default_rng([_SEED, zlib.crc32(f"{scene}/{session.name}".encode())])
        seconds = np.arange(session.images) / settings.image_hz
        walk = plan_walk(plan.route, plan.place, session.images / settings.image_hz, session.side, session.start, rng)
        t_ns = np.round((session.boot_s + seconds) * 1e9).astype(np.int64)
        walks[session.name] = t_ns, walk.world_T_cam(seconds)
    map_T_world = inverse(start_frame(walks[min(walks)][1][0]))
    return [(name, t_ns, map_T_world @ poses) for name, (t_ns, poses) in walks.items() if name.startswith("test-")]


def _vio(t_ns: NDArray[np.int64], map_T_cam: Array, seed: int, model: VioModel) -> Array:
    """Odometry's poses, NaN where its tracking is lost."""
    vio_T_cam, is_limited = simulate_vio(t_ns, map_T_cam, seed, model)
    return np.where(is_limited[:, None, None], np.nan, vio_T_cam)


def _jumps(scene: str) -> list[Track]:
    """1 to some metres, once a minute."""
    return simulated_tracks(scene, replace(_DRIFT, jumps_per_min=1.0, jump_min_m=1.0, jump_mean_m=3.0))


def _restarts(scene: str) -> list[Track]:
    """Tracking lost for 5 s every two minutes; then odometry starts anew, with another origin and heading."""
    return simulated_tracks(scene, replace(FITTED, interruptions_per_min=0.5, interruption_s=5.0))


def _scale(scene: str) -> list[Track]:
    """5 % too long."""
    return [_moved(track, 1.05 * np.diff(track.vio_T_cam[:, :3, 3], axis=0)) for track in simulated_tracks(scene)]


def _noise(scene: str) -> list[Track]:
    """Each step wrong by 10 % of its length on each axis, which adds up."""
    tracks = []
    for track in simulated_tracks(scene):
        steps = np.diff(track.vio_T_cam[:, :3, 3], axis=0)
        rng = np.random.default_rng(_seed(scene, track.name, _DRAW) + 1)
        wrong = rng.standard_normal(steps.shape) * np.linalg.norm(steps, axis=1, keepdims=True)
        tracks.append(_moved(track, steps + 0.1 * wrong))
    return tracks


def _dropouts(scene: str) -> list[Track]:
    """Odometry missing for 5 to 20 s, once in 40 s; its frame is the same afterwards."""
    tracks = []
    for track in simulated_tracks(scene):
        rng = np.random.default_rng(_seed(scene, track.name, _DRAW) + 2)
        seconds = (track.t_ns - track.t_ns[0]) * 1e-9
        begin = np.arange(rng.uniform(10, 40), seconds[-1], 40)
        lost = ((seconds >= begin[:, None]) & (seconds < (begin + rng.uniform(5, 20, len(begin)))[:, None])).any(axis=0)
        tracks.append(replace(track, vio_T_cam=np.where(lost[:, None, None], np.nan, track.vio_T_cam)))
    return tracks


def _poor(scene: str) -> list[Track]:
    """Ten times the drift, for a regressor with a tenth of the error."""
    sizes = ("yaw_bias_deg_per_m", "yaw_walk_deg_per_sqrt_m", "position_walk_m_per_sqrt_m", "height_walk_m_per_sqrt_m")
    return simulated_tracks(scene, replace(_DRIFT, **{name: 10 * getattr(_DRIFT, name) for name in sizes}))


def _kidnapped(scene: str) -> list[Track]:
    """A minute in the middle without frames, while the phone is carried on; odometry starts anew and doesn't say so."""
    tracks = []
    for track in simulated_tracks(scene):
        middle = len(track.t_ns) // 2
        away = min(_AWAY_S, middle // 2)
        anew = inverse(start_frame(track.vio_T_cam[middle]))
        kept = np.r_[: middle - away // 2, middle + away // 2 : len(track.t_ns)]
        vio = track.vio_T_cam.copy()
        vio[middle:] = anew @ vio[middle:]
        tracks.append(Track(track.name, track.t_ns[kept], track.map_T_cam[kept], vio[kept]))
    return tracks


def _moved(track: Track, steps: Array) -> Track:
    """The same track with other steps (N-1, 3) of odometry."""
    vio = track.vio_T_cam.copy()
    vio[1:, :3, 3] = vio[0, :3, 3] + np.cumsum(steps, axis=0)
    return replace(track, vio_T_cam=vio)


BAD_ODOMETRY: dict[str, Callable[[str], list[Track]]] = {
    "jumps": _jumps,
    "restarts": _restarts,
    "scale 5 %": _scale,
    "noise 10 %": _noise,
    "dropouts": _dropouts,
    BETTER_APR: _poor,
}
_KINDS: dict[str, Callable[[str], list[Track]]] = {SIMULATED: simulated_tracks, **BAD_ODOMETRY, KIDNAPPED: _kidnapped}


def simulated_case(kind: str, scene: str, model: str) -> Case:
    """Simulated walks of a kind, with predictions as wrong as the published regressor's were in the scene."""
    errors, amplitude = read_apr_models()[scene, model], 0.1 if kind == BETTER_APR else 1.0
    walks = []
    for track in _KINDS[kind](scene):
        predicted = simulate_apr(track.map_T_cam, errors, *apr_seeds(scene, model, _DRAW, track.name), amplitude)
        walks.append(predicted_walk(scene, replace(track, name=f"{track.name}~{_DRAW}"), predicted))
    return Case(kind, scene, model, tuple(walks))


def predicted_walk(scene: str, track: Track, predicted: Array) -> Walk:
    """A walk of a track and predictions (N, 4, 4)."""
    count = len(track.t_ns)
    gravity = np.full((count, 3), np.nan)
    there = known(track.vio_T_cam)
    gravity[there] = gravity_in_camera(track.vio_T_cam[there])
    frame_id = np.array([f"{track.name}/{i:06d}" for i in range(count)], dtype=object)
    return Walk(scene, track.name, "test", frame_id, track.t_ns, gravity, track.vio_T_cam, predicted, track.map_T_cam)


def drifting_odometry(t_ns: NDArray[np.int64], map_T_cam: Array, *seed: object) -> Array:
    """Odometry vio_T_cam (N, 4, 4) with the usual drift for true poses; the same for the same seed."""
    return _vio(t_ns, map_T_cam, _seed(*seed), _DRIFT)


def _seed(*parts: object) -> int:
    return zlib.crc32("/".join(str(p) for p in parts).encode())
