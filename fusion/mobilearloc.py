"""Method `mobilearloc`: the fusion rule of the MobileARLoc paper (section III), each open point of it an option.

Two stages take turns. *Alignment* waits for N+1 consecutive frames whose predictions move as odometry does; their
averages align the two frames. *Optimisation* then passes on predictions that go on moving as odometry does, replaces
the others by odometry carried through the alignment, and goes back to alignment when N reliable predictions in a row
say that the alignment has drifted. docs/fusion.md lists the paper's open points beside the options.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from fusion.localiser import Estimate, Localiser, MethodOptions, State, Status, array, plain
from geometry.averages import geometric_median, karcher_mean, quaternion_mean
from geometry.metrics import relative_error, rpe_roe
from geometry.poses import Array, inverse, pose_from_tq, quaternion_angle, tq_from_pose

_AT_ORIGIN_M = 1e-12


class MobileARLocOptions(MethodOptions):
    """The paper's four thresholds, and one option for each point that its text leaves open."""

    n: int = Field(2, ge=1, description="N: consistent pairs that lock, and reliable drifted frames that unlock")
    d_th_m: float = Field(0.4, ge=0, description="d_th: largest relative position error of a consistent pair")
    o_th_deg: float = Field(4.0, ge=0, description="o_th: largest relative orientation error of a consistent pair")
    gamma: float = Field(0.99, ge=-1, le=1, description="gamma: similarity at or below which a frame has drifted")

    alignment_frames: Literal["n+1", "n+2"] = Field("n+1", description="frames of a run that locks")
    rotation_step: Literal["scalar_part", "norm"] = Field(
        "scalar_part", description="what arccos is taken of; the norm, as printed, makes every rotation step 0"
    )
    pair_check: Literal["lengths", "se3"] = Field(
        "lengths", description="compare the lengths of the steps, or the whole relative poses"
    )
    comparison: Literal["<=", "<"] = Field("<=", description="how an error compares with d_th and o_th")
    similarity: Literal["cosine", "metric"] = Field(
        "cosine", description="the paper's S in the map frame, or a test in metres and degrees"
    )
    similarity_m: float = Field(1.0, gt=0, description="with `metric`: drifted from this distance on")
    similarity_deg: float = Field(10.0, gt=0, description="with `metric`: drifted from this angle on")
    drift_count: Literal["skip", "reset"] = Field(
        "skip", description="what an unreliable frame does to the count of drifted reliable frames in a row"
    )
    reference: Literal["averaged_poses", "per_frame"] = Field(
        "averaged_poses", description="align the two averages, or average the alignments of the frames"
    )
    position_average: Literal["geometric_median", "mean"] = Field("geometric_median")
    rotation_average: Literal["gramkow", "karcher"] = Field("gramkow")
    realign_from: Literal["trigger", "next", "recent"] = Field(
        "trigger",
        description="first frame of the run after drift: the frame that showed it, the one after, or the earliest of "
        "the consistent frames that led to it",
    )
    before_first_lock: Literal["none", "prediction"] = Field("none", description="output before the first lock")
    while_aligning: Literal["last_reference", "none"] = Field(
        "last_reference", description="output while aligning again"
    )
    interval_s: float = Field(1.0, gt=0, description="time between consecutive predictions")
    interval_tolerance_s: float = Field(0.5, gt=0, description="a pair further off this interval isn't consecutive")
    vio_speed_m_s: float = Field(2.0, gt=0, description="fastest motion that odometry is believed without question")
    vio_jump_m: float = Field(1.0, gt=0, description="motion beyond that speed that counts as an odometry jump")

    @property
    def run_frames(self) -> int:
        return self.n + (1 if self.alignment_frames == "n+1" else 2)

    @property
    def gate(self) -> float:
        """The similarity at or below which a reliable frame has drifted."""
        return self.gamma if self.similarity == "cosine" else 0.0

    @property
    def gates(self) -> dict[str, float]:
        return {"rpe_m": self.d_th_m, "roe_deg": self.o_th_deg, "similarity": self.gate}


class Verdict(StrEnum):
    WAITING = "waiting"  # alignment goes on
    LOCKED = "locked"  # the last `run_frames` frames are reliable and give a new reference
    RELIABLE = "reliable"
    UNRELIABLE = "unreliable"
    DRIFTED = "drifted"  # reliable, and the one that sends the rule back to alignment


@dataclass(slots=True)
class Rule:
    """The rule's state machine. It knows nothing of poses, only which pairs were consistent and which frames drifted.

    optimising: the stage, else alignment.
    trail: consecutive consistent frames up to the newest, capped at a run's length.
    drifted: reliable frames in a row that had drifted.
    """

    optimising: bool = False
    trail: int = 0
    drifted: int = 0

    def advance(self, consistent: bool, has_drifted: Callable[[], bool], options: MobileARLocOptions) -> Verdict:
        """Take in one frame with a prediction.

        consistent: the frame and the last one are consecutive and move alike.
        has_drifted: whether the frame disagrees with the reference; asked for reliable frames of optimisation only.
        """
        full = options.run_frames
        self.trail = min(self.trail + 1, full) if consistent and self.trail else 1
        if not self.optimising:
            return self._lock() if self.trail == full else Verdict.WAITING
        if not consistent:
            if options.drift_count == "reset":
                self.drifted = 0
            return Verdict.UNRELIABLE
        self.drifted = self.drifted + 1 if has_drifted() else 0
        if self.drifted < options.n:
            return Verdict.RELIABLE
        if options.realign_from == "recent" and self.trail == full:
            return self._lock()
        if options.realign_from != "recent":
            self.trail = 1 if options.realign_from == "trigger" else 0
        self.optimising = False
        return Verdict.DRIFTED

    def _lock(self) -> Verdict:
        self.optimising, self.drifted = True, 0
        return Verdict.LOCKED


class _Frame(NamedTuple):
    t_ns: int
    vio_T_cam: Array
    map_T_cam: Array


class MobileARLoc(Localiser):
    """The paper's rule, one frame at a time. Frames without a prediction are carried by odometry and change nothing."""

    def __init__(self, options: MobileARLocOptions | None = None) -> None:
        super().__init__()
        self.options = options or MobileARLocOptions()
        self._forget()

    def _forget(self) -> None:
        self._rule = Rule()
        self._recent: deque[_Frame] = deque(maxlen=self.options.run_frames)  # newest last, with predictions
        self._vio: tuple[int, Array] | None = None
        self._map_T_vio: Array | None = None

    def _advance(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_apr: Array | None, gravity: Array | None
    ) -> Estimate:
        if vio_T_cam is None:
            return Estimate(None, Status.NONE, map_T_vio=self._map_T_vio, reasons=("no_odometry",))
        jumped = self._has_jumped(t_ns, vio_T_cam)
        if jumped:
            self._forget()
        self._vio = (t_ns, vio_T_cam)
        if map_T_cam_apr is None:
            estimate = self._carried(vio_T_cam, Status.OPTIMISED if self._rule.optimising else Status.ALIGNING)
            return replace(estimate, reasons=("no_prediction",))
        estimate = self._judge(_Frame(t_ns, vio_T_cam, map_T_cam_apr))
        return replace(estimate, reasons=("odometry_jump", *estimate.reasons)) if jumped else estimate

    def _judge(self, frame: _Frame) -> Estimate:
        options = self.options
        last = self._recent[-1] if self._recent else None
        signals: dict[str, float] = {}
        consistent = last is not None and are_consecutive(last.t_ns, frame.t_ns, options)
        reasons: tuple[str, ...] = () if consistent or last is None else ("gap",)
        if last is not None and consistent:
            rpe_m, roe_deg = pair_errors(
                np.array([last.map_T_cam, frame.map_T_cam]), np.array([last.vio_T_cam, frame.vio_T_cam]), options
            )
            signals = {"rpe_m": float(rpe_m[0]), "roe_deg": float(roe_deg[0])}
            consistent = is_consistent(signals["rpe_m"], signals["roe_deg"], options)
            if not consistent:
                reasons = ("pair_inconsistent",)

        def has_drifted() -> bool:
            assert self._map_T_vio is not None
            score = similarity(frame.map_T_cam, self._map_T_vio @ frame.vio_T_cam, options)
            signals["similarity"] = float(score)
            return signals["similarity"] <= options.gate

        self._recent.append(frame)
        verdict = self._rule.advance(consistent, has_drifted, options)
        if verdict is Verdict.LOCKED:
            self._map_T_vio = reference(
                np.array([f.map_T_cam for f in self._recent]), np.array([f.vio_T_cam for f in self._recent]), options
            )
            confirms = tuple((f.t_ns, f.map_T_cam) for f in list(self._recent)[:-1])
            return Estimate(frame.map_T_cam, Status.RELIABLE, None, self._map_T_vio, confirms, ("locked",), signals)
        if verdict in (Verdict.RELIABLE, Verdict.DRIFTED):
            reasons = ("drift",) if verdict is Verdict.DRIFTED else ()
            return Estimate(
                frame.map_T_cam, Status.RELIABLE, map_T_vio=self._map_T_vio, reasons=reasons, signals=signals
            )
        if verdict is Verdict.WAITING and self._map_T_vio is None and options.before_first_lock == "prediction":
            return Estimate(frame.map_T_cam, Status.PREDICTED, reasons=reasons, signals=signals)
        status = Status.OPTIMISED if verdict is Verdict.UNRELIABLE else Status.ALIGNING
        return replace(self._carried(frame.vio_T_cam, status), reasons=reasons, signals=signals)

    def _carried(self, vio_T_cam: Array, status: Status) -> Estimate:
        hidden = status is Status.ALIGNING and self.options.while_aligning == "none"
        if self._map_T_vio is None or hidden:
            return Estimate(None, Status.NONE, map_T_vio=self._map_T_vio)
        return Estimate(self._map_T_vio @ vio_T_cam, status, map_T_vio=self._map_T_vio)

    def _has_jumped(self, t_ns: int, vio_T_cam: Array) -> bool:
        if self._vio is None:
            return False
        seconds = (t_ns - self._vio[0]) * 1e-9
        moved_m = float(np.linalg.norm(vio_T_cam[:3, 3] - self._vio[1][:3, 3]))
        return moved_m > self.options.vio_speed_m_s * seconds + self.options.vio_jump_m

    def _state(self) -> State:
        return {
            "rule": asdict(self._rule),
            "recent": [[f.t_ns, plain(f.vio_T_cam), plain(f.map_T_cam)] for f in self._recent],
            "vio": None if self._vio is None else [self._vio[0], plain(self._vio[1])],
            "map_T_vio": plain(self._map_T_vio),
        }

    def _set_state(self, state: State) -> None:
        self._forget()
        self._rule = Rule(**state["rule"])
        self._recent.extend(_Frame(t_ns, np.array(vio), np.array(apr)) for t_ns, vio, apr in state["recent"])
        self._vio = None if state["vio"] is None else (state["vio"][0], np.array(state["vio"][1]))
        self._map_T_vio = array(state["map_T_vio"])


def are_consecutive(t_a_ns: int, t_b_ns: int, options: MobileARLocOptions) -> bool:
    """Whether two frames are one prediction interval apart."""
    return abs((t_b_ns - t_a_ns) * 1e-9 - options.interval_s) <= options.interval_tolerance_s


def is_consistent(rpe_m: float, roe_deg: float, options: MobileARLocOptions) -> bool:
    """Whether a pair's errors are within d_th and o_th."""
    if options.comparison == "<":
        return rpe_m < options.d_th_m and roe_deg < options.o_th_deg
    return rpe_m <= options.d_th_m and roe_deg <= options.o_th_deg


def pair_errors(map_T_cam: Array, vio_T_cam: Array, options: MobileARLocOptions) -> tuple[Array, Array]:
    """RPE in metres and ROE in degrees, both (N-1,), of predictions against odometry over frames (N, 4, 4).

    The paper's (section III-A) compare the lengths of the steps; `se3` compares the relative poses.
    """
    if options.pair_check == "se3":
        return relative_error(map_T_cam, vio_T_cam)
    rpe_m, roe_deg = rpe_roe(map_T_cam, vio_T_cam)
    return rpe_m, np.zeros_like(roe_deg) if options.rotation_step == "norm" else roe_deg


def similarity(map_T_a: Array, map_T_b: Array, options: MobileARLocOptions) -> Array:
    """How alike poses (..., 4, 4) are: the paper's S (equation 8), or with `metric` 1 where they are equal, falling to
    0 where they are `similarity_m` or `similarity_deg` apart."""
    (x_a, q_a), (x_b, q_b) = tq_from_pose(map_T_a), tq_from_pose(map_T_b)
    if options.similarity == "metric":
        distance = np.linalg.norm(x_a - x_b, axis=-1) / options.similarity_m
        return 1.0 - np.maximum(distance, np.degrees(quaternion_angle(q_a, q_b)) / options.similarity_deg)
    lengths = np.linalg.norm(x_a, axis=-1) * np.linalg.norm(x_b, axis=-1)
    defined = lengths > _AT_ORIGIN_M
    # 0/0 at the origin counts as 1: a pose there has no direction to disagree in.
    cosine = np.where(defined, np.sum(x_a * x_b, axis=-1) / np.where(defined, lengths, 1.0), 1.0)
    return (cosine + np.abs(np.sum(q_a * q_b, axis=-1))) / 2


def reference(map_T_cam: Array, vio_T_cam: Array, options: MobileARLocOptions) -> Array:
    """The alignment map_T_vio (4, 4) from a run's predictions and odometry, both (R, 4, 4)."""
    if options.reference == "per_frame":
        return _average(map_T_cam @ inverse(vio_T_cam), options)
    return _average(map_T_cam, options) @ inverse(_average(vio_T_cam, options))


def _average(poses: Array, options: MobileARLocOptions) -> Array:
    xyz, q = tq_from_pose(poses)
    position = geometric_median(xyz) if options.position_average == "geometric_median" else xyz.mean(axis=0)
    rotation = quaternion_mean(q) if options.rotation_average == "gramkow" else karcher_mean(q)
    return pose_from_tq(position, rotation)
