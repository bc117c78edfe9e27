"""The paper's rule once more, slow and literal, as an oracle: whole walks at a time, plain Python, its own quaternions.

Nothing here is shared with fusion/ or geometry/. A frame is a `Frame`; a walk is a list of them from one session.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import acos, degrees, dist, hypot, pi, sin, sqrt
from typing import TYPE_CHECKING

from scipy.optimize import minimize

if TYPE_CHECKING:
    from groundwalk.fusion.methods.odometry import PairOptions
    from groundwalk.fusion.methods.paper_rule import PaperRuleOptions

Vector = tuple[float, ...]
Pose = tuple[Vector, Vector]
"""Position, and quaternion x, y, z, w."""


@dataclass
class Frame:
    t: float  # seconds
    vio: Pose | None
    apr: Pose | None

    @property
    def x_vio(self) -> Vector:
        assert self.vio is not None
        return self.vio[0]

    @property
    def q_vio(self) -> Vector:
        assert self.vio is not None
        return self.vio[1]

    @property
    def x_apr(self) -> Vector:
        assert self.apr is not None
        return self.apr[0]

    @property
    def q_apr(self) -> Vector:
        assert self.apr is not None
        return self.apr[1]


@dataclass
class Answer:
    live: str = "none"  # what the app had in time
    live_x: Vector | None = None
    live_q: Vector | None = None
    label: str = "none"  # what the paper counts
    x: Vector | None = None
    q: Vector | None = None


Numbered = list[tuple[int, Frame]]
"""Frames with their indices in the walk."""


def conj(q: Vector) -> Vector:
    return (-q[0], -q[1], -q[2], q[3])


def mul(a: Vector, b: Vector) -> Vector:
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def turn(q: Vector, v: Vector) -> Vector:
    return mul(mul(q, (*v, 0.0)), conj(q))[:3]


def add(a: Vector, b: Vector) -> Vector:
    return tuple(i + j for i, j in zip(a, b, strict=True))


def sub(a: Vector, b: Vector) -> Vector:
    return tuple(i - j for i, j in zip(a, b, strict=True))


def dot(a: Vector, b: Vector) -> float:
    return sum(i * j for i, j in zip(a, b, strict=True))


def angle_deg(a: Vector, b: Vector) -> float:
    return degrees(2 * acos(min(1.0, abs(dot(a, b)))))


def fermat_point(a: Vector, b: Vector, c: Vector) -> Vector:
    """The point of least summed distance to three: a corner of 120 degrees or more, or the trilinear formula."""
    corners = [(a, b, c), (b, c, a), (c, a, b)]
    weights = []
    for p, q, r in corners:
        u, v = sub(q, p), sub(r, p)
        if hypot(*u) == 0 or hypot(*v) == 0:
            return p
        angle = acos(max(-1.0, min(1.0, dot(u, v) / hypot(*u) / hypot(*v))))
        if angle >= 2 * pi / 3:
            return p
        weights.append(dist(q, r) / sin(angle + pi / 3))
    return tuple(sum(w * p[k] for w, (p, _, _) in zip(weights, corners, strict=True)) / sum(weights) for k in range(3))


def middle(points: Sequence[Vector], how: str) -> Vector:
    mean = tuple(sum(p[k] for p in points) / len(points) for k in range(3))
    if how == "mean":
        return mean
    if len(points) == 3:
        return fermat_point(*points)

    def cost(y: Vector) -> float:
        return sum(dist(p, y) for p in points)

    found = minimize(cost, mean, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13, "maxiter": 5000})
    return min([tuple(found.x), *points], key=cost)


def average_rotation(quaternions: Sequence[Vector]) -> Vector:
    first = quaternions[0]
    summed: Vector = (0.0, 0.0, 0.0, 0.0)
    for q in quaternions:
        summed = add(summed, q if dot(q, first) >= 0 else tuple(-i for i in q))
    return tuple(i / sqrt(dot(summed, summed)) for i in summed)


def align(run: list[Frame], o: "PaperRuleOptions") -> Pose:
    """(x, q) of map_T_vio from a run of frames."""
    if o.reference == "per_frame":
        transforms = []
        for f in run:
            q = mul(f.q_apr, conj(f.q_vio))
            transforms.append((sub(f.x_apr, turn(q, f.x_vio)), q))
        return middle([x for x, _ in transforms], o.position_average), average_rotation([q for _, q in transforms])
    x_apr, q_apr = middle([f.x_apr for f in run], o.position_average), average_rotation([f.q_apr for f in run])
    x_vio, q_vio = middle([f.x_vio for f in run], o.position_average), average_rotation([f.q_vio for f in run])
    q = mul(q_apr, conj(q_vio))
    return sub(x_apr, turn(q, x_vio)), q


def carry(reference: Pose, f: Frame) -> Pose:
    x, q = reference
    return add(x, turn(q, f.x_vio)), mul(q, f.q_vio)


def pair_is_consistent(a: Frame, b: Frame, o: "PairOptions") -> bool:
    if not (o.interval_s - o.interval_tolerance_s <= round(b.t - a.t, 9) <= o.interval_s + o.interval_tolerance_s):
        return False
    if o.pair_check == "se3":
        apr_x, apr_q = turn(conj(a.q_apr), sub(b.x_apr, a.x_apr)), mul(conj(a.q_apr), b.q_apr)
        vio_x, vio_q = turn(conj(a.q_vio), sub(b.x_vio, a.x_vio)), mul(conj(a.q_vio), b.q_vio)
        rpe, roe = dist(apr_x, vio_x), angle_deg(apr_q, vio_q)
    else:
        rpe = abs(dist(a.x_apr, b.x_apr) - dist(a.x_vio, b.x_vio))
        roe = abs(angle_deg(a.q_apr, b.q_apr) - angle_deg(a.q_vio, b.q_vio))
        if o.rotation_step == "norm":
            roe = 0.0
    if o.comparison == "<":
        return rpe < o.d_th_m and roe < o.o_th_deg
    return rpe <= o.d_th_m and roe <= o.o_th_deg


def frame_has_drifted(f: Frame, reference: Pose, o: "PaperRuleOptions") -> bool:
    x, q = carry(reference, f)
    if o.similarity == "metric":
        return dist(x, f.x_apr) >= o.similarity_m or angle_deg(q, f.q_apr) >= o.similarity_deg
    lengths = hypot(*x) * hypot(*f.x_apr)
    cosine = dot(x, f.x_apr) / lengths if lengths > 1e-12 else 1.0
    return (cosine + abs(dot(q, f.q_apr))) / 2 <= o.gamma


def split_at_jumps(frames: list[Frame], o: "PaperRuleOptions") -> list[Numbered]:
    """Pieces of a walk between odometry jumps."""
    pieces: list[Numbered] = [[]]
    last: Frame | None = None
    for index, f in enumerate(frames):
        if f.vio is not None:
            limit = 0.0 if last is None else o.vio_speed_m_s * (f.t - last.t) + o.vio_jump_m
            if last is not None and dist(last.x_vio, f.x_vio) > limit:
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
    reference: Pose | None = None
    # Every frame with a prediction, with whether it was consistent with the one before.
    seen: list[tuple[int, Frame, bool]] = []

    def say(index: int, status: str, pose: Pose) -> None:
        a = answers[index]
        a.live, (a.live_x, a.live_q) = status, pose
        a.label, (a.x, a.q) = status, pose

    def carried(index: int, f: Frame, status: str) -> None:
        if reference is None or (status == "aligning" and o.while_aligning == "none"):
            return
        say(index, status, carry(reference, f))

    def lock(frames_of_run: Numbered) -> Pose:
        for i, f in frames_of_run:
            answers[i].label, answers[i].x, answers[i].q = "reliable", f.x_apr, f.q_apr
        return align([f for _, f in frames_of_run], o)

    for index, f in piece:
        if f.vio is None:
            continue
        if f.apr is None:
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
                say(index, "reliable", (f.x_apr, f.q_apr))
            elif reference is None and o.before_first_lock == "prediction":
                say(index, "predicted", (f.x_apr, f.q_apr))
            else:
                carried(index, f, "aligning")
            continue
        if not consistent:
            if o.drift_count == "reset":
                low = 0
            carried(index, f, "optimised")
            continue
        say(index, "reliable", (f.x_apr, f.q_apr))
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
