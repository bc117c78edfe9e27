"""Method `paper_rule`: the fusion rule of the MobileARLoc paper (section III), each open point of it an option.

Two stages take turns. *Alignment* waits for N+1 consecutive frames whose predictions move as odometry does; their
averages align the two frames. *Optimisation* then passes on predictions that go on moving as odometry does, replaces
the others by odometry carried through the alignment, and goes back to alignment when N reliable predictions in a row
say that the alignment has drifted. docs/explanation/fusion.md lists the paper's open points beside the options.
"""

from collections import deque
from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.odometry import OdometryLocaliser, PairOptions, Predicted, check_pair
from groundwalk.geometry.averages import geometric_median, karcher_mean, quaternion_mean
from groundwalk.geometry.poses import Array, inverse, pose_from_tq, tq_from_pose
from groundwalk.scoring.errors import position_error, rotation_error_deg

_AT_ORIGIN_M = 1e-12


class PaperRuleOptions(PairOptions):
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


class PaperRule(OdometryLocaliser):
    """The paper's rule, one frame at a time. Frames without a prediction are carried by odometry and change nothing."""

    options_type = PaperRuleOptions
    options: PaperRuleOptions

    def _forget(self) -> None:
        super()._forget()
        self._optimising = False  # the stage, else alignment
        self._trail = 0  # consecutive consistent frames up to the newest, capped at a run's length
        self._drifted = 0  # reliable frames in a row that had drifted
        self._recent: deque[Predicted] = deque(maxlen=self.options.run_frames)  # newest last
        self._map_T_vio: Array | None = None

    def _advance(self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None) -> Estimate:
        if vio_T_cam is None:
            return Estimate(None, Status.NONE, map_T_vio=self._map_T_vio, reasons=("no_odometry",))
        return super()._advance(t_ns, vio_T_cam, map_T_cam_predicted)

    def _fuse(self, t_ns: int, vio_T_cam: Array, map_T_cam_predicted: Array | None) -> Estimate:
        options, map_T_cam = self.options, map_T_cam_predicted
        if map_T_cam is None:
            return replace(self._carried(vio_T_cam), reasons=("no_prediction",))
        frame = (t_ns, map_T_cam, vio_T_cam)
        inconsistent, signals = check_pair(self._recent[-1], frame, options) if self._recent else ("", {})
        reasons = (inconsistent,) if inconsistent else ()
        consistent = bool(self._recent) and not inconsistent
        self._recent.append(frame)
        self._trail = min(self._trail + 1, options.run_frames) if consistent and self._trail else 1
        whole_run = self._trail == options.run_frames
        if not self._optimising:
            if whole_run:
                return self._locked(signals)
            if self._map_T_vio is None and options.before_first_lock == "prediction":
                return Estimate(map_T_cam, Status.PREDICTED, reasons=reasons, signals=signals)
            return replace(self._carried(vio_T_cam), reasons=reasons, signals=signals)
        if not consistent:
            if options.drift_count == "reset":
                self._drifted = 0
            return replace(self._carried(vio_T_cam), reasons=reasons, signals=signals)
        assert self._map_T_vio is not None
        signals["similarity"] = similarity(map_T_cam, self._map_T_vio @ vio_T_cam, options)
        self._drifted = self._drifted + 1 if signals["similarity"] <= options.gate else 0
        if self._drifted == options.n:
            if options.realign_from == "recent" and whole_run:
                return self._locked(signals)
            if options.realign_from != "recent":
                self._trail = 1 if options.realign_from == "trigger" else 0
            self._optimising, reasons = False, ("drift",)
        return Estimate(map_T_cam, Status.RELIABLE, map_T_vio=self._map_T_vio, reasons=reasons, signals=signals)

    def _locked(self, signals: dict[str, float]) -> Estimate:
        """The frames of the run are reliable, and give a new alignment."""
        self._optimising, self._drifted = True, 0
        times_ns, predicted, odometry = zip(*self._recent, strict=True)
        self._map_T_vio = reference(np.array(predicted), np.array(odometry), self.options)
        confirms = tuple(zip(times_ns[:-1], predicted[:-1], strict=True))
        return Estimate(predicted[-1], Status.RELIABLE, None, self._map_T_vio, confirms, ("locked",), signals)

    def _carried(self, vio_T_cam: Array) -> Estimate:
        status = Status.OPTIMISED if self._optimising else Status.ALIGNING
        hidden = status is Status.ALIGNING and self.options.while_aligning == "none"
        if self._map_T_vio is None or hidden:
            return Estimate(None, Status.NONE, map_T_vio=self._map_T_vio)
        return Estimate(self._map_T_vio @ vio_T_cam, status, map_T_vio=self._map_T_vio)


def similarity(map_T_a: Array, map_T_b: Array, options: PaperRuleOptions) -> float:
    """How alike two poses (4, 4) are: the paper's S (equation 8), or with `metric` 1 where they are equal, falling to
    0 where they are `similarity_m` or `similarity_deg` apart."""
    if options.similarity == "metric":
        distance = position_error(map_T_a, map_T_b) / options.similarity_m
        return float(1.0 - max(distance, rotation_error_deg(map_T_a, map_T_b) / options.similarity_deg))
    (x_a, q_a), (x_b, q_b) = tq_from_pose(map_T_a), tq_from_pose(map_T_b)
    lengths = float(np.linalg.norm(x_a) * np.linalg.norm(x_b))
    # 0/0 at the origin counts as 1: a pose there has no direction to disagree in.
    cosine = float(x_a @ x_b) / lengths if lengths > _AT_ORIGIN_M else 1.0
    return (cosine + abs(float(q_a @ q_b))) / 2


def reference(map_T_cam: Array, vio_T_cam: Array, options: PaperRuleOptions) -> Array:
    """The alignment map_T_vio (4, 4) from a run's predictions and odometry, both (R, 4, 4)."""
    if options.reference == "per_frame":
        return _average(map_T_cam @ inverse(vio_T_cam), options)
    return _average(map_T_cam, options) @ inverse(_average(vio_T_cam, options))


def _average(poses: Array, options: PaperRuleOptions) -> Array:
    """The average (4, 4) of poses (R, 4, 4)."""
    xyz, q = tq_from_pose(poses)
    position = xyz.mean(axis=0) if options.position_average == "mean" else geometric_median(xyz)
    return pose_from_tq(position, quaternion_mean(q) if options.rotation_average == "gramkow" else karcher_mean(q))
