"""The walks that the fusion benchmark runs on: what was recorded, what is simulated, and what is spoilt on purpose."""

import json
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from benchmarks.pose_walks import pose_walks
from benchmarks.regressor_errors.model import apr_seeds, read_apr_models, simulate_apr
from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.checks.jumps import find_jumps
from groundwalk.capture_import.formats import FORMATS
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.gravity import gravity_in_camera
from groundwalk.geometry.poses import Array, heading, interpolate, inverse, make_pose, yaw_rotation
from groundwalk.simulation.vio import FITTED, VioModel, simulate_vio, start_frame

SIMULATED, RECORDED, MEASURED = "simulated", "recorded", "measured"
KIDNAPPED, BETTER_APR = "kidnapped", "better APR"

_DRIFT = replace(FITTED, interruptions_per_min=0.0)  # import starts a new session where tracking is lost
_SMOOTH_DRIFT = replace(_DRIFT, jitter_m=0.0, jitter_deg=0.0, jumps_per_min=0.0)
_LARGE_JUMP_M = 0.5
_AWAY_S = 60


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


# ---------------------------------------------------------------- simulated walks


def simulated_tracks(scene: str, seed: int, model: VioModel = _DRIFT) -> list[Track]:
    """The scene's test walks with simulated odometry."""
    return [
        Track(w.name, w.t_ns, w.map_T_cam, _vio(w.t_ns, w.map_T_cam, _seed(scene, w.name, seed), model))
        for w in pose_walks(scene)
    ]


def _vio(t_ns: NDArray[np.int64], map_T_cam: Array, seed: int, model: VioModel) -> Array:
    """Odometry's poses, NaN where its tracking is lost."""
    track = simulate_vio(t_ns, map_T_cam, seed, model)
    return np.where((track.tracking == "normal")[:, None, None], track.vio_T_cam, np.nan)


# ---------------------------------------------------------------- odometry as bad as it gets


def _jumps(scene: str, seed: int) -> list[Track]:
    """1 to some metres, once a minute."""
    return simulated_tracks(scene, seed, replace(_DRIFT, jumps_per_min=1.0, jump_min_m=1.0, jump_mean_m=3.0))


def _restarts(scene: str, seed: int) -> list[Track]:
    """Tracking lost for 5 s every two minutes; then odometry starts anew, with another origin and heading."""
    return simulated_tracks(scene, seed, replace(FITTED, interruptions_per_min=0.5, interruption_s=5.0))


def _scale(scene: str, seed: int) -> list[Track]:
    """5 % too long."""
    return [_moved(track, 1.05 * np.diff(track.vio_T_cam[:, :3, 3], axis=0)) for track in simulated_tracks(scene, seed)]


def _noise(scene: str, seed: int) -> list[Track]:
    """Each step wrong by 10 % of its length on each axis, which adds up."""
    tracks = []
    for track in simulated_tracks(scene, seed):
        steps = np.diff(track.vio_T_cam[:, :3, 3], axis=0)
        rng = np.random.default_rng(_seed(scene, track.name, seed) + 1)
        wrong = rng.standard_normal(steps.shape) * np.linalg.norm(steps, axis=1, keepdims=True)
        tracks.append(_moved(track, steps + 0.1 * wrong))
    return tracks


def _dropouts(scene: str, seed: int) -> list[Track]:
    """Odometry missing for 5 to 20 s, once in 40 s; its frame is the same afterwards."""
    tracks = []
    for track in simulated_tracks(scene, seed):
        rng = np.random.default_rng(_seed(scene, track.name, seed) + 2)
        seconds = (track.t_ns - track.t_ns[0]) * 1e-9
        begin = np.arange(rng.uniform(10, 40), seconds[-1], 40)
        lost = ((seconds >= begin[:, None]) & (seconds < (begin + rng.uniform(5, 20, len(begin)))[:, None])).any(axis=0)
        tracks.append(replace(track, vio_T_cam=np.where(lost[:, None, None], np.nan, track.vio_T_cam)))
    return tracks


def _poor(scene: str, seed: int) -> list[Track]:
    """Ten times the drift, for a regressor with a tenth of the error."""
    sizes = ("yaw_bias_deg_per_m", "yaw_walk_deg_per_sqrt_m", "position_walk_m_per_sqrt_m", "height_walk_m_per_sqrt_m")
    return simulated_tracks(scene, seed, replace(_DRIFT, **{name: 10 * getattr(_DRIFT, name) for name in sizes}))


def _kidnapped(scene: str, seed: int) -> list[Track]:
    """A minute in the middle without frames, while the phone is carried on; odometry starts anew and doesn't say so."""
    tracks = []
    for track in simulated_tracks(scene, seed):
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


BAD_ODOMETRY: dict[str, Callable[[str, int], list[Track]]] = {
    "jumps": _jumps,
    "restarts": _restarts,
    "scale 5 %": _scale,
    "noise 10 %": _noise,
    "dropouts": _dropouts,
    BETTER_APR: _poor,
}
_KINDS: dict[str, Callable[[str, int], list[Track]]] = {
    SIMULATED: simulated_tracks,
    **BAD_ODOMETRY,
    KIDNAPPED: _kidnapped,
}


def simulated_case(kind: str, scene: str, model: str, seeds: Sequence[int]) -> Case:
    """Simulated walks of a kind, with predictions of the error model; each seed is another regressor and phone."""
    amplitude = 0.1 if kind == BETTER_APR else 1.0
    regressors = [Regressor(scene, model, seed, amplitude) for seed in seeds]
    walks = [_predicted(track, r) for r in regressors for track in _KINDS[kind](scene, r.seed)]
    return Case(kind, scene, model, tuple(walks))


@dataclass(frozen=True)
class Regressor:
    """A simulated regressor: as wrong as the published one was in the scene; each seed is wrong in another way."""

    scene: str
    model: str
    seed: int
    amplitude: float = 1.0

    def predict(self, walk: str, map_T_cam: Array) -> Array:
        """Predictions (N, 4, 4) for true poses of a walk; noise and part of the bias differ from walk to walk."""
        errors = read_apr_models()[self.scene, self.model]
        return simulate_apr(map_T_cam, errors, *apr_seeds(self.scene, self.model, self.seed, walk), self.amplitude)


# ---------------------------------------------------------------- recorded odometry


def recorded_tracks(folder: Path, seed: int = 0) -> list[Track]:
    """Every recording of odometry below a folder, one pose a second.

    None of these has ground truth. The recorded poses are the odometry as it is, with its jumps and its noise. The true
    walk is *made* from them: the recorded motion with a drift of the fitted size applied, so that the recording differs
    from it by a drift of that size. Where odometry lost its place, the phone is taken to have stayed where it was.
    """
    tracks = []
    for name, t_ns, vio_T_cam in _recordings(folder).values():
        walked = _without_jumps(t_ns, vio_T_cam)
        truth = simulate_vio(t_ns, walked, _seed("recorded", name, seed), _SMOOTH_DRIFT).vio_T_cam
        tracks.append(_each_second(Track(name, t_ns, truth, vio_T_cam)))
    return tracks


def measured_tracks(folder: Path) -> list[Track]:
    """The recordings that motion capture measured, one pose a second: real odometry beside its real error."""
    truths = {path: path / "groundtruth.jsonl" for path in _recordings(folder)}
    return [
        _each_second(_beside_truth(*_recordings(folder)[path], truth))
        for path, truth in truths.items()
        if truth.is_file()
    ]


def recorded_case(kind: str, tracks: list[Track], scene: str, model: str, seeds: Sequence[int] = (0,)) -> Case:
    """Recorded walks with predictions as wrong as the regressor was in the scene; each seed is another regressor."""
    walks = [_predicted(track, Regressor(scene, model, seed)) for seed in seeds for track in tracks]
    return Case(kind, scene, model, tuple(walks))


@cache
def _recordings(folder: Path) -> dict[Path, tuple[str, NDArray[np.int64], Array]]:
    """Name, t_ns (N,) and vio_T_cam (N, 4, 4) of each recording that import can read, by its file or folder."""
    recordings = {}
    for path in sorted([folder, *folder.rglob("*")]):
        form = next((f for f in FORMATS.values() if f.fits(path)), None)
        if form is None:
            continue
        session = form.read(path, Limits())
        posed = [(f.t_ns, f.vio_T_cam) for f in session.frames if f.vio_T_cam is not None]
        t_ns, first = np.unique([t for t, _ in posed], return_index=True)
        recordings[path] = (f"{form.id}/{path.stem}", t_ns.astype(np.int64), np.array([posed[i][1] for i in first]))
    return recordings


def _without_jumps(t_ns: NDArray[np.int64], vio_T_cam: Array) -> Array:
    """The walk (N, 4, 4) without its large jumps: there place and heading stay as they were. Odometry finds gravity
    anew after one, so pitch and roll are odometry's throughout."""
    walked = vio_T_cam.copy()
    for jump in find_jumps(t_ns, vio_T_cam):
        if jump.jump_m > _LARGE_JUMP_M:
            before, after = walked[jump.index - 1], walked[jump.index]
            turn = yaw_rotation(heading(before[:3, :3] @ after[:3, :3].T))
            walked[jump.index :] = make_pose(turn, before[:3, 3] - turn @ after[:3, 3]) @ walked[jump.index :]
    return walked


def _each_second(track: Track) -> Track:
    """The frames nearest to whole seconds."""
    seconds = (track.t_ns - track.t_ns[0]) * 1e-9
    at = np.unique(np.abs(seconds[None] - np.arange(0, seconds[-1], 1.0)[:, None]).argmin(axis=1))
    return Track(track.name, track.t_ns[at], track.map_T_cam[at], track.vio_T_cam[at])


def _beside_truth(name: str, t_ns: NDArray[np.int64], vio_T_cam: Array, path: Path) -> Track:
    """Motion capture's poses of the same device, in a map whose up is odometry's mean up.

    The marker body's place on the device, the rotation between the two worlds and the offset of the clocks aren't
    given; they are fitted over the whole walk (hand-eye calibration), which takes no drift away but a constant one.
    """
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    truth = [row["groundTruth"] for row in rows]
    xyz = np.array([[row["position"][a] for a in "xyz"] for row in truth])
    xyzw = np.array([[row["orientation"][a] for a in ("x", "y", "z", "w")] for row in truth])
    world_T_body = make_pose(Rotation.from_quat(xyzw).as_matrix(), xyz)
    truth_ns = np.array([round(row["time"] * 1e9) for row in rows], np.int64)

    def fit(offset_s: float) -> tuple[float, Rotation, Rotation, Array]:
        body = interpolate(truth_ns, world_T_body, t_ns[inside] + round(offset_s * 1e9))
        world_R_body = Rotation.from_matrix(body[:, :3, :3])
        turns = [(r[:-_APART].inv() * r[_APART:]).as_rotvec() for r in (world_R_body, vio_R_cam)]
        body_R_cam, _ = Rotation.align_vectors(*turns)
        world_R_vio = (world_R_body * body_R_cam * vio_R_cam.inv()).mean()
        left = (world_R_vio.inv() * world_R_body * body_R_cam * vio_R_cam.inv()).magnitude()
        return float(np.sqrt(np.mean(left**2))), body_R_cam, world_R_vio, body

    margin = int(2 * _CLOCKS_S * 1e9)
    inside = (t_ns > truth_ns[0] + margin) & (t_ns < truth_ns[-1] - margin)
    vio_R_cam = Rotation.from_matrix(vio_T_cam[inside, :3, :3])
    best = minimize_scalar(lambda s: fit(s)[0], bounds=(-_CLOCKS_S, _CLOCKS_S), method="bounded")
    _, body_R_cam, world_R_vio, body = fit(float(best.x))
    # world_p_body + world_R_body lever = world_R_vio vio_p_cam + shift
    matrix = np.concatenate([body[:, :3, :3], -np.tile(np.eye(3), (len(body), 1, 1))], axis=2).reshape(-1, 6)
    lever = np.linalg.lstsq(matrix, (world_R_vio.apply(vio_T_cam[inside, :3, 3]) - body[:, :3, 3]).ravel(), rcond=None)
    body_T_cam = make_pose(body_R_cam.as_matrix(), lever[0][:3])
    map_T_cam = make_pose(world_R_vio.inv().as_matrix(), np.zeros(3)) @ body @ body_T_cam
    return Track(name, t_ns[inside], map_T_cam, vio_T_cam[inside])


_APART = 30  # poses between which a turn is measured for the hand-eye calibration
_CLOCKS_S = 0.1  # the two clocks differ by no more


# ---------------------------------------------------------------- shared


def _predicted(track: Track, regressor: Regressor) -> Walk:
    """A walk with simulated predictions."""
    named = replace(track, name=f"{track.name}~{regressor.seed}")
    return predicted_walk(regressor.scene, named, regressor.predict(track.name, track.map_T_cam))


def predicted_walk(scene: str, track: Track, map_T_cam_predicted: Array) -> Walk:
    """A walk of a track and predictions (N, 4, 4)."""
    count = len(track.t_ns)
    gravity = np.full((count, 3), np.nan)
    there = known(track.vio_T_cam)
    gravity[there] = gravity_in_camera(track.vio_T_cam[there])
    frame_id = np.array([f"{track.name}/{i:06d}" for i in range(count)], dtype=object)
    return Walk(
        scene, track.name, "test", frame_id, track.t_ns, gravity, track.vio_T_cam, map_T_cam_predicted, track.map_T_cam
    )


def drifting_odometry(t_ns: NDArray[np.int64], map_T_cam: Array, *seed: object) -> Array:
    """Odometry vio_T_cam (N, 4, 4) with the usual drift for true poses; the same for the same seed."""
    return _vio(t_ns, map_T_cam, _seed(*seed), _DRIFT)


def _seed(*parts: object) -> int:
    return zlib.crc32("/".join(str(p) for p in parts).encode())
