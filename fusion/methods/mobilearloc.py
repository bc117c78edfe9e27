"""Method `mobilearloc`: the fusion rule of the MobileARLoc paper (section III), each open point of it an option.

Two stages take turns. *Alignment* waits for N+1 consecutive frames whose predictions move as odometry does; their
averages align the two frames. *Optimisation* then passes on predictions that go on moving as odometry does, replaces
the others by odometry carried through the alignment, and goes back to alignment when N reliable predictions in a row
say that the alignment has drifted. docs/explanation/fusion.md lists the paper's open points beside the options.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.localiser import Estimate, Localiser, State, Status, array, plain
from groundwalk.fusion.methods.odometry import have_jumped
from groundwalk.fusion.methods.pair_check import PairOptions, are_consecutive, are_consistent, pair_errors
from groundwalk.geometry.averages import fermat_points, geometric_median, karcher_mean, quaternion_mean
from groundwalk.geometry.poses import Array, inverse, pose_from_tq, tq_from_pose

_AT_ORIGIN_M = 1e-12


class MobileARLocOptions(PairOptions):
    """The paper's four thresholds, and one option for each point that its text leaves open."""

    n: int = Field(2, ge=1, description="N: consistent pairs that lock, and reliable drifted frames that unlock")
    gamma: float = Field(0.99, ge=-1, le=1, description="gamma: similarity at or below which a frame has drifted")

    alignment_frames: Literal["n+1", "n+2"] = Field("n+1", description="frames of a run that locks")
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

    @cached_property
    def run_frames(self) -> int:
        return self.n + (1 if self.alignment_frames == "n+1" else 2)

    @property
    def gate(self) -> float:
        """The similarity at or below which a reliable frame has drifted."""
        return self.gamma if self.similarity == "cosine" else 0.0

    @property
    def gates(self) -> dict[str, float]:
        return super().gates | {"similarity": self.gate}


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
        jumped = self._vio is not None and have_jumped(
            (t_ns - self._vio[0]) * 1e-9, float(np.linalg.norm(vio_T_cam[:3, 3] - self._vio[1][:3, 3])), self.options
        )
        if jumped:
            self._forget()
        self._vio = (t_ns, vio_T_cam)
        if map_T_cam_apr is None:
            estimate = self._carried(vio_T_cam, Status.OPTIMISED if self._rule.optimising else Status.ALIGNING)
            return replace(estimate, reasons=("no_prediction",))
        estimate = self._judge(_Frame(t_ns, vio_T_cam, map_T_cam_apr))
        return estimate.because("odometry_jump") if jumped else estimate

    def _judge(self, frame: _Frame) -> Estimate:
        options = self.options
        last = self._recent[-1] if self._recent else None
        signals: dict[str, float] = {}
        consistent = last is not None and bool(are_consecutive((frame.t_ns - last.t_ns) * 1e-9, options))
        reasons: tuple[str, ...] = () if consistent or last is None else ("gap",)
        if last is not None and consistent:
            rpe_m, roe_deg = pair_errors(
                np.array([last.map_T_cam, frame.map_T_cam]), np.array([last.vio_T_cam, frame.vio_T_cam]), options
            )
            signals = {"rpe_m": float(rpe_m[0]), "roe_deg": float(roe_deg[0])}
            consistent = bool(are_consistent(signals["rpe_m"], signals["roe_deg"], options))
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


def similarity(map_T_a: Array, map_T_b: Array, options: MobileARLocOptions) -> Array:
    """How alike poses (..., 4, 4) are: the paper's S (equation 8), or with `metric` 1 where they are equal, falling to
    0 where they are `similarity_m` or `similarity_deg` apart."""
    trace = np.sum(map_T_a[..., :3, :3] * map_T_b[..., :3, :3], axis=(-1, -2))
    return scores(map_T_a[..., :3, 3], map_T_b[..., :3, 3], trace, options)


def scores(x_a: Array, x_b: Array, trace: Array, options: MobileARLocOptions) -> Array:
    """`similarity` from positions (..., 3) and the traces (...,) of the rotations' products a^T b."""
    # The trace is 4 w^2 - 1, and w the product of the two quaternions.
    product = np.sqrt(np.clip((trace + 1) / 4, 0.0, 1.0))
    if options.similarity == "metric":
        distance = np.linalg.norm(x_a - x_b, axis=-1) / options.similarity_m
        return 1.0 - np.maximum(distance, np.degrees(2 * np.arccos(product)) / options.similarity_deg)
    lengths = np.linalg.norm(x_a, axis=-1) * np.linalg.norm(x_b, axis=-1)
    defined = lengths > _AT_ORIGIN_M
    # 0/0 at the origin counts as 1: a pose there has no direction to disagree in.
    cosine = np.where(defined, np.sum(x_a * x_b, axis=-1) / np.where(defined, lengths, 1.0), 1.0)
    return (cosine + product) / 2


def reference(map_T_cam: Array, vio_T_cam: Array, options: MobileARLocOptions) -> Array:
    """The alignments map_T_vio (..., 4, 4) from runs' predictions and odometry, both (..., R, 4, 4)."""
    if options.reference == "per_frame":
        return _average(tq_from_pose(map_T_cam @ inverse(vio_T_cam)), options)
    return averages_aligned(tq_from_pose(map_T_cam), tq_from_pose(vio_T_cam), options)


def averages_aligned(apr: tuple[Array, Array], vio: tuple[Array, Array], options: MobileARLocOptions) -> Array:
    """`reference` by averaged poses, from positions (..., R, 3) and quaternions (..., R, 4)."""
    return _average(apr, options) @ inverse(_average(vio, options))


def _average(poses: tuple[Array, Array], options: MobileARLocOptions) -> Array:
    """The average pose (..., 4, 4) of positions (..., R, 3) and quaternions (..., R, 4)."""
    xyz, q = poses
    if options.position_average == "mean":
        position = xyz.mean(axis=-2)
    elif options.run_frames == 3:
        position = fermat_points(xyz.reshape(-1, 3, 3)).reshape(*xyz.shape[:-2], 3)
    else:
        position = _each(geometric_median, xyz)
    rotation = quaternion_mean(q) if options.rotation_average == "gramkow" else _each(karcher_mean, q)
    return pose_from_tq(position, rotation)


def has_closed_form(options: MobileARLocOptions) -> bool:
    """Whether many references cost hardly more than one."""
    median_of_three = options.position_average == "mean" or options.run_frames == 3
    return median_of_three and options.rotation_average == "gramkow"


def _each(average: Callable[[Array], Array], runs: Array) -> Array:
    """The average (..., D) of each run (..., R, D)."""
    flat = runs.reshape(-1, *runs.shape[-2:])
    return np.array([average(run) for run in flat]).reshape(*runs.shape[:-2], runs.shape[-1])
