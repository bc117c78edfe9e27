"""The paper's rule once more, slow and literal, as an oracle: whole walks at a time, in plain steps.

Nothing here is shared with fusion/ or geometry/. A walk is a list of frames from one session.
"""

from dataclasses import dataclass
from math import acos, degrees, pi, sin, sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.linalg import inv, norm
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from tests.fusion.random_walks import RandomWalk

if TYPE_CHECKING:
    from groundwalk.fusion.methods.odometry import PairOptions
    from groundwalk.fusion.methods.paper_rule import PaperRuleOptions


@dataclass
class Frame:
    """A time in seconds, and poses (4, 4) by odometry and by the regressor; without one it is all NaN."""

    t: float
    vio: np.ndarray
    apr: np.ndarray

    @property
    def has_vio(self) -> bool:
        return bool(np.isfinite(self.vio).all())

    @property
    def has_apr(self) -> bool:
        return bool(np.isfinite(self.apr).all())


@dataclass
class Answer:
    live: str = "none"  # what the app had in time
    pose: np.ndarray | None = None
    label: str = "none"  # what the paper counts


Numbered = list[tuple[int, Frame]]
"""Frames with their indices in the walk."""


def literal_frames(walk: RandomWalk) -> list[Frame]:
    none = np.full((4, 4), np.nan)
    poses = [[none if pose is None else pose for pose in source] for source in (walk.vio, walk.apr)]
    return [Frame(t * 1e-9, vio, apr) for t, vio, apr in zip(walk.t_ns, *poses, strict=True)]


def place(pose: np.ndarray) -> np.ndarray:
    return pose[:3, 3]


def dist(a: np.ndarray, b: np.ndarray) -> float:
    return float(norm(place(a) - place(b)))


def cos_half_angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between two rotations: what the dot product of their quaternions is, without its sign."""
    return sqrt(max(0.0, 1 + float(np.sum(a[:3, :3] * b[:3, :3])))) / 2


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return degrees(2 * acos(min(1.0, cos_half_angle(a, b))))


def fermat_point(points: np.ndarray) -> np.ndarray:
    """The point of least summed distance to three: a corner of 120 degrees or more, or the trilinear formula."""
    weights = []
    for k in range(3):
        p, q, r = np.roll(points, -k, axis=0)
        u, v = q - p, r - p
        if norm(u) == 0 or norm(v) == 0:
            return p
        angle = acos(max(-1.0, min(1.0, float(u @ v / norm(u) / norm(v)))))
        if angle >= 2 * pi / 3:
            return p
        weights.append(float(norm(q - r)) / sin(angle + pi / 3))
    return np.average(points, axis=0, weights=weights)


def middle(points: np.ndarray, how: str) -> np.ndarray:
    mean = points.mean(axis=0)
    if how == "mean":
        return mean
    if len(points) == 3:
        return fermat_point(points)

    def cost(y: np.ndarray) -> float:
        return float(norm(points - y, axis=1).sum())

    found = minimize(cost, mean, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13, "maxiter": 5000})
    return min([found.x, *points], key=cost)


def average(poses: np.ndarray, how: str) -> np.ndarray:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    quaternions[quaternions @ quaternions[0] < 0] *= -1
    result = np.eye(4)
    result[:3, :3] = Rotation.from_quat(quaternions.sum(axis=0)).as_matrix()
    result[:3, 3] = middle(poses[:, :3, 3], how)
    return result


def align(run: list[Frame], o: "PaperRuleOptions") -> np.ndarray:
    """map_T_vio (4, 4) from a run of frames."""
    apr, vio = np.array([f.apr for f in run]), np.array([f.vio for f in run])
    if o.reference == "per_frame":
        return average(apr @ inv(vio), o.position_average)
    return average(apr, o.position_average) @ inv(average(vio, o.position_average))


def pair_is_consistent(a: Frame, b: Frame, o: "PairOptions") -> bool:
    if not (o.interval_s - o.interval_tolerance_s <= round(b.t - a.t, 9) <= o.interval_s + o.interval_tolerance_s):
        return False
    if o.pair_check == "se3":
        apr, vio = inv(a.apr) @ b.apr, inv(a.vio) @ b.vio
        rpe, roe = dist(apr, vio), angle_deg(apr, vio)
    else:
        rpe = abs(dist(a.apr, b.apr) - dist(a.vio, b.vio))
        roe = abs(angle_deg(a.apr, b.apr) - angle_deg(a.vio, b.vio))
        if o.rotation_step == "norm":
            roe = 0.0
    if o.comparison == "<":
        return rpe < o.d_th_m and roe < o.o_th_deg
    return rpe <= o.d_th_m and roe <= o.o_th_deg


def frame_has_drifted(f: Frame, reference: np.ndarray, o: "PaperRuleOptions") -> bool:
    carried = reference @ f.vio
    if o.similarity == "metric":
        return dist(carried, f.apr) >= o.similarity_m or angle_deg(carried, f.apr) >= o.similarity_deg
    lengths = float(norm(place(carried)) * norm(place(f.apr)))
    cosine = float(place(carried) @ place(f.apr)) / lengths if lengths > 1e-12 else 1.0
    return (cosine + cos_half_angle(carried, f.apr)) / 2 <= o.gamma


def split_at_jumps(frames: list[Frame], o: "PaperRuleOptions") -> list[Numbered]:
    """Pieces of a walk between odometry jumps."""
    pieces: list[Numbered] = [[]]
    last: Frame | None = None
    for index, f in enumerate(frames):
        if f.has_vio:
            limit = 0.0 if last is None else o.vio_speed_m_s * (f.t - last.t) + o.vio_jump_m
            if last is not None and dist(last.vio, f.vio) > limit:
                pieces.append([])
            last = f
        pieces[-1].append((index, f))
    return pieces


def label_walk(frames: list[Frame], o: "PaperRuleOptions") -> list[Answer]:
    """The rule's answers to a walk, one a frame."""
    answers = [Answer() for _ in frames]
    for piece in split_at_jumps(frames, o):
        _label_piece(piece, o, answers)
    return answers


def _label_piece(piece: Numbered, o: "PaperRuleOptions", answers: list[Answer]) -> None:
    need = o.n + 1 if o.alignment_frames == "n+1" else o.n + 2
    stage, low = "alignment", 0
    run: Numbered = []
    reference: np.ndarray | None = None
    # Every frame with a prediction, with whether it was consistent with the one before.
    seen: list[tuple[int, Frame, bool]] = []

    def say(index: int, status: str, pose: np.ndarray) -> None:
        answers[index] = Answer(status, pose, status)

    def carried(index: int, f: Frame, status: str) -> None:
        if reference is None or (status == "aligning" and o.while_aligning == "none"):
            return
        say(index, status, reference @ f.vio)

    def lock(frames_of_run: Numbered) -> np.ndarray:
        for i, _ in frames_of_run:
            answers[i].label = "reliable"
        return align([f for _, f in frames_of_run], o)

    for index, f in piece:
        if not f.has_vio:
            continue
        if not f.has_apr:
            carried(index, f, "optimised" if stage == "optimisation" else "aligning")
            continue
        consistent = bool(seen) and pair_is_consistent(seen[-1][1], f, o)
        seen.append((index, f, consistent))
        if stage == "alignment":
            if not (run and consistent):
                run = []
            run.append((index, f))
            if len(run) == need:
                reference, stage, low = lock(run), "optimisation", 0
                say(index, "reliable", f.apr)
            elif reference is None and o.before_first_lock == "prediction":
                say(index, "predicted", f.apr)
            else:
                carried(index, f, "aligning")
            continue
        if not consistent:
            if o.drift_count == "reset":
                low = 0
            carried(index, f, "optimised")
            continue
        say(index, "reliable", f.apr)
        assert reference is not None
        low = low + 1 if frame_has_drifted(f, reference, o) else 0
        if low == o.n:
            stage, low = "alignment", 0
            if o.realign_from == "next":
                run = []
            elif o.realign_from == "trigger":
                run = [(index, f)]
            else:
                start = len(seen) - 1
                while start > 0 and seen[start][2] and len(seen) - start < need:
                    start -= 1
                run = [(i, g) for i, g, _ in seen[start:]]
                if len(run) == need:
                    reference, stage = lock(run), "optimisation"
