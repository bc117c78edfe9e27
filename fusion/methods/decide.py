"""The paper's rule on whole walks at once: the same decisions as `MobileARLoc.step`, some hundred times as fast.

The pair checks are worked out for all frames together and the state machine, `mobilearloc.Rule`, runs on their
verdicts. What depends on few options, such as the alignment that a run would give, is kept for the next set of options,
so that a sweep over thresholds costs little more than the state machine.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from groundwalk.fusion.methods.localiser import Status, is_rigid
from groundwalk.fusion.methods.mobilearloc import (
    MobileARLocOptions,
    Rule,
    Verdict,
    averages_aligned,
    has_closed_form,
    reference,
    scores,
)
from groundwalk.fusion.methods.odometry import have_jumped
from groundwalk.fusion.methods.pair_check import are_consecutive, are_consistent, length_errors, pair_errors
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, tq_from_pose

_STATUS = np.array([str(s) for s in Status], dtype=object)
_CODE = {status: code for code, status in enumerate(Status)}
_AHEAD = 64  # frames whose similarity is worked out at once


@dataclass(frozen=True)
class Decisions:
    """What the rule says about a walk of N frames, as `fuse.Fused` has it.

    status (N,), map_T_cam (N, 4, 4): with the frames that later ones confirmed; live_*: in time. Poses are NaN where
    there is none.
    """

    status: NDArray[np.object_]
    map_T_cam: Array
    live_status: NDArray[np.object_]
    live_map_T_cam: Array


class _Alignments:
    """The alignments that runs of K judged frames give, by the run's last frame, and how they score frames after it."""

    def __init__(self, frames: int) -> None:
        self.map_T_vio = np.full((frames, 4, 4), np.nan)
        self.known = np.zeros(frames, dtype=bool)
        self.scores: dict[int, list[float]] = {}


class RuleWalk:
    """A walk prepared for the rule, for any number of options."""

    def __init__(self, walk: Walk) -> None:
        """Raises GeometryError where time doesn't rise or an odometry pose isn't a rigid transform."""
        self.walk = walk
        if np.any(np.diff(walk.t_ns) <= 0):
            raise GeometryError("times of a walk must rise")
        has_vio = known(walk.vio_T_cam)
        if not is_rigid(walk.vio_T_cam[has_vio]).all():
            raise GeometryError("an odometry pose isn't a finite rigid transform")
        self._has_vio = has_vio
        self._used = np.flatnonzero(has_vio & is_rigid(walk.map_T_cam_apr))  # frames that the rule judges
        self._apr, self._vio = walk.map_T_cam_apr[self._used], walk.vio_T_cam[self._used]
        odometry = np.flatnonzero(has_vio)
        self._seconds_vio = np.diff(walk.t_ns[odometry]) * 1e-9
        self._moved_vio = np.linalg.norm(np.diff(walk.vio_T_cam[odometry, :3, 3], axis=0), axis=1)
        self._after = odometry[1:]
        self._seconds = np.diff(walk.t_ns[self._used]) * 1e-9
        # Newest judged frame at each frame, -1 before the first.
        self._newest = np.searchsorted(self._used, np.arange(len(walk)), side="right") - 1
        self._errors: dict[tuple[str, str], tuple[Array, Array]] = {}
        self._alignments: dict[tuple[object, ...], _Alignments] = {}

    @cached_property
    def _tq(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """Positions and quaternions of predictions and of odometry."""
        return tq_from_pose(self._apr), tq_from_pose(self._vio)

    @cached_property
    def _turned(self) -> Array:
        """R_apr R_vio^T (K, 9): its product with map_R_vio is the trace that the similarity needs."""
        return (self._apr[:, :3, :3] @ self._vio[:, :3, :3].transpose(0, 2, 1)).reshape(-1, 9)

    def decide(self, options: MobileARLocOptions) -> Decisions:
        """The rule's answers to the walk."""
        n, used = len(self.walk), self._used
        jumped = np.zeros(n, dtype=bool)
        jumped[self._after] = have_jumped(self._seconds_vio, self._moved_vio, options)
        piece = np.cumsum(jumped)
        consistent = np.zeros(len(used), dtype=bool)
        if len(used):
            reading = (options.pair_check, options.rotation_step)
            if reading not in self._errors:
                self._errors[reading] = (
                    length_errors(*self._tq, options)
                    if options.pair_check == "lengths"
                    else pair_errors(self._apr, self._vio, options)
                )
            same = piece[used[1:]] == piece[used[:-1]]
            near = are_consecutive(self._seconds, options)
            consistent[1:] = same & near & are_consistent(*self._errors[reading], options)
        alignments = self._aligned(consistent, options)
        verdicts, locks, optimising = self._run(consistent, piece[used], alignments, options)
        return self._answers(verdicts, locks, optimising, piece, alignments, options)

    def _aligned(self, consistent: NDArray[np.bool_], options: MobileARLocOptions) -> _Alignments:
        """The alignments for these options, at once for all runs where that is cheap."""
        o = options
        reading = (o.run_frames, o.reference, o.position_average, o.rotation_average)
        metric = (o.similarity_m, o.similarity_deg) if o.similarity == "metric" else ()
        alignments = self._alignments.setdefault((*reading, *metric), _Alignments(len(consistent)))
        if has_closed_form(o):
            broken = np.cumsum(~consistent)
            ends = np.zeros(len(consistent), dtype=bool)
            ends[o.run_frames - 1 :] = broken[o.run_frames - 1 :] == broken[: len(broken) - o.run_frames + 1]
            self._align(np.flatnonzero(ends & ~alignments.known), alignments, o)
        return alignments

    def _align(self, ends: NDArray[np.int64], alignments: _Alignments, options: MobileARLocOptions) -> None:
        """Work out the alignments of the runs with these last frames."""
        if len(ends):
            runs = ends[:, None] + np.arange(1 - options.run_frames, 1)
            if options.reference == "per_frame":
                map_T_vio = reference(self._apr[runs], self._vio[runs], options)
            else:
                apr, vio = ((xyz[runs], q[runs]) for xyz, q in self._tq)
                map_T_vio = averages_aligned(apr, vio, options)
            alignments.map_T_vio[ends] = map_T_vio
            alignments.known[ends] = True

    def _run(
        self,
        consistent: NDArray[np.bool_],
        piece: NDArray[np.int64],
        alignments: _Alignments,
        options: MobileARLocOptions,
    ) -> tuple[list[Verdict], list[int], list[bool]]:
        """For each judged frame its verdict, the lock (a judged frame) in force after it or -1, and the stage."""
        verdicts: list[Verdict] = []
        locks: list[int] = []
        optimising: list[bool] = []
        rule, lock, k, gate = Rule(), -1, 0, options.gate
        scores: list[float] = []

        def has_drifted() -> bool:
            while k - lock - 1 >= len(scores):
                self._score(lock, scores, alignments.map_T_vio[lock], options)
            return scores[k - lock - 1] <= gate

        last = int(piece[0]) if len(piece) else 0
        for k, (moves_alike, here) in enumerate(zip(consistent.tolist(), piece.tolist(), strict=True)):
            if here != last:
                rule, lock, last = Rule(), -1, here
            verdict = rule.advance(moves_alike, has_drifted, options)
            if verdict is Verdict.LOCKED:
                lock = k
                scores = alignments.scores.setdefault(k, [])
                if not alignments.known[k]:
                    self._align(np.array([k]), alignments, options)
            verdicts.append(verdict)
            locks.append(lock)
            optimising.append(rule.optimising)
        return verdicts, locks, optimising

    def _score(self, lock: int, known: list[float], map_T_vio: Array, options: MobileARLocOptions) -> None:
        """Extend the list of the similarities of frames after a lock."""
        start = lock + 1 + len(known)
        ahead = slice(start, start + _AHEAD)
        carried = self._vio[ahead, :3, 3] @ map_T_vio[:3, :3].T + map_T_vio[:3, 3]
        trace = self._turned[ahead] @ map_T_vio[:3, :3].ravel()
        known += scores(self._apr[ahead, :3, 3], carried, trace, options).tolist()

    def _answers(
        self,
        verdicts: list[Verdict],
        locks: list[int],
        optimising: list[bool],
        piece: NDArray[np.int64],
        alignments: _Alignments,
        options: MobileARLocOptions,
    ) -> Decisions:
        n, used, apr = len(self.walk), self._used, self.walk.map_T_cam_apr
        # Frames without a judged one before them in their piece are carried by nothing.
        newest = self._newest
        valid = newest >= 0
        valid[valid] = piece[used[newest[valid]]] == piece[valid]
        lock = np.full(n, -1)
        lock[valid] = np.array(locks, dtype=int)[newest[valid]]
        stage = np.zeros(n, dtype=bool)
        stage[valid] = np.array(optimising, dtype=bool)[newest[valid]]

        code = np.full(n, _CODE[Status.NONE])
        carried = self._has_vio & (lock >= 0)
        if options.while_aligning == "none":
            carried &= stage
        code[carried] = np.where(stage[carried], _CODE[Status.OPTIMISED], _CODE[Status.ALIGNING])
        passed = np.array([v in (Verdict.LOCKED, Verdict.RELIABLE, Verdict.DRIFTED) for v in verdicts], dtype=bool)
        reliable = used[passed]
        code[reliable] = _CODE[Status.RELIABLE]
        predicted = used[np.array([v is Verdict.WAITING for v in verdicts], dtype=bool)]
        predicted = predicted[lock[predicted] < 0]
        if options.before_first_lock == "prediction":
            code[predicted] = _CODE[Status.PREDICTED]

        poses = np.full((n, 4, 4), np.nan)
        poses[carried] = alignments.map_T_vio[lock[carried]] @ self.walk.vio_T_cam[carried]
        raw = (code == _CODE[Status.RELIABLE]) | (code == _CODE[Status.PREDICTED])
        poses[raw] = apr[raw]

        locked = np.flatnonzero([v is Verdict.LOCKED for v in verdicts])
        confirmed = used[(locked[:, None] - np.arange(1, options.run_frames)).ravel()]
        final_code, final = code.copy(), poses.copy()
        final_code[confirmed] = _CODE[Status.RELIABLE]
        final[confirmed] = apr[confirmed]
        return Decisions(_STATUS[final_code], final, _STATUS[code], poses)
