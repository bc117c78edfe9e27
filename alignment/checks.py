"""Checks before ground truth is given out: what each estimates, what became of it, and the frames that it concerns."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from groundwalk.artefacts.schemas import schema
from groundwalk.consistency.decisions import Status, decide

# What a failed check means, in the words of align.gate's column `cause`; the first of those found names the run.
MIRRORED = "mirrored images"
SHUFFLED = "times shuffled"
INTRINSICS = "intrinsics wrong"
LOOK_ALIKE = "look-alike places folded together"
VIO_SCALE = "VIO scale wrong"
VIO_VERTICAL = "VIO vertical wrong"
NO_VERTICAL = "no vertical"
OTHER_SCENE = "another scene mixed in"
BROKEN_OFF = "broken off"
TOO_FEW = "too few frames registered"
DISAGREES = "SfM and VIO disagree"
REFERENCE = "SfM and the reference disagree"
RULER = "ruler and map disagree"
DEPTH = "map and depth sensor disagree"
UNCERTAIN = "uncertain"
CAUSES = (
    MIRRORED,
    SHUFFLED,
    INTRINSICS,
    LOOK_ALIKE,
    VIO_SCALE,
    VIO_VERTICAL,
    NO_VERTICAL,
    OTHER_SCENE,
    BROKEN_OFF,
    TOO_FEW,
    DISAGREES,
    REFERENCE,
    RULER,
    DEPTH,
    UNCERTAIN,
)


ANY_SCENE = "<scene>"


def setting(name: str) -> str:
    """Where a user sets a setting of the stage."""
    return f"[align] {name} in data/scenes/{ANY_SCENE}.toml"


_LEAVE_OUT = "take the session out of the captures' folder"
_BY_CAUSE = {
    MIRRORED: f"write the images as the camera sees them, not mirrored; or {_LEAVE_OUT}",
    SHUFFLED: f"give each image the time and pose that it was taken at; or {_LEAVE_OUT}",
}


@dataclass(frozen=True)
class Kind:
    """What a check estimates and in which unit; its value must be at most the limit, or `at_least`. What to do where it
    failed, and what would decide it."""

    estimate: str
    unit: str
    remedy: str
    decides: str = ""
    at_least: bool = False


KINDS = {
    "registered": Kind(
        "frames registered",
        "share",
        f"capture with more overlap between images, or lower {setting('least_registered')}",
        at_least=True,
    ),
    "session_registered": Kind(
        "frames registered",
        "share",
        f"{_LEAVE_OUT}, or lower {setting('least_registered')}",
        at_least=True,
    ),
    "component_metric": Kind("its scale", "share", "capture it again with more walking"),
    "component_vertical": Kind("frames with gravity", "frames", "use a capture format with gravity or phone poses"),
    "map_scale": Kind("standard error of the metric scale", "share", "", "a longer walk, a second session or a ruler"),
    "map_vertical": Kind("standard error of the vertical", "deg", "", "a second session"),
    "reference_scale": Kind(
        "standard error of the metric scale by the reference poses",
        "share",
        "",
        "more frames with reference poses, and their unit (reference_is_metric = true in [import] says the metre)",
    ),
    "reference_vertical": Kind(
        "standard error of the vertical by the reference poses", "deg", "", "more frames with reference poses"
    ),
    "session_focal": Kind(
        "focal length by the images against the captured one",
        "share",
        f"correct the captured focal length, or raise {setting('focal_limit')}: SfM has taken the images' one",
        "a walk that also turns and goes sideways",
    ),
    "session_motion": Kind(
        "steps that VIO explains",
        "share",
        f"{_LEAVE_OUT}, or lower {setting('motion_agreeing')}",
        "a longer walk with turns",
        at_least=True,
    ),
    "session_turns": Kind(
        "turns by SfM against VIO's",
        "share",
        f"correct the captured focal length, or raise {setting('turn_gain_limit')}",
        "a walk with more turns",
    ),
    "session_folded": Kind(
        "frames that lie where far ones do by VIO",
        "share",
        f"capture again with what tells the places apart in view, or raise {setting('folded_limit')}",
    ),
    "session_scale": Kind(
        "the session's scale against the others'",
        "share",
        f"{_LEAVE_OUT}, or raise {setting('session_scale_limit')}",
        "a longer walk in this session",
    ),
    "session_vertical": Kind(
        "the session's vertical against the others'",
        "deg",
        f"{_LEAVE_OUT}, or raise {setting('session_tilt_limit_deg')}",
        "a longer walk in this session",
    ),
    "ruler_scale": Kind(
        "the map's scale against the ruler",
        "share",
        f"measure the print and correct its size in [[ruler]] of data/scenes/{ANY_SCENE}.toml",
        "views of the whole ruler from several directions, a longer walk, or use_for_scale = true in its [[ruler]]",
    ),
    "window_position": Kind(
        "largest distance between SfM and VIO in a window",
        "m",
        f"capture again with more overlap there, or raise {setting('vio_drift_m')}",
        "more images there",
    ),
    "window_rotation": Kind(
        "largest angle between SfM and VIO in a window",
        "deg",
        f"capture again with more overlap there, or raise {setting('vio_drift_deg')}",
        "more images there",
    ),
    "session_reference": Kind(
        "frames away from their reference poses",
        "share",
        f"correct the data set's poses or intrinsics, {_LEAVE_OUT}, or raise {setting('reference_limit_m')}, "
        "reference_limit_share or reference_limit_deg",
    ),
    "session_depth_scale": Kind(
        "the depth sensor's depth against the map's",
        "share",
        f"measure a length in the scene with a ruler, to tell whether map or sensor is wrong; or raise "
        f"{setting('depth_scale_limit')}",
        "more frames with depth, nearer to what they see",
    ),
    "session_depth_by_distance": Kind(
        "the depth sensor's depth against the map's, between near and far points",
        "share",
        f"check the captured focal length and lens; or raise {setting('depth_spread_limit')}",
        "more frames with depth",
    ),
    "session_unsure": Kind(
        "frames that SfM is uncertain of and VIO contradicts",
        "share",
        f"capture with more overlap between images, or raise {setting('unsure_share')}",
    ),
    "component_tied": Kind(
        "VIO path between the models",
        "m",
        f"capture what lies between, or raise {setting('bridge_m')}",
    ),
}


@dataclass(frozen=True)
class About:
    """What a check is about: of how many frames, which session and model, and for a window its frames' times."""

    frames: int
    session_id: str = ""
    component: int | None = None
    t_ns: np.ndarray | None = None


_NO_ROWS = np.empty(0, dtype=np.intp)


@dataclass(frozen=True)
class Check:
    """The result of a check. `sd` is None where the value is a count or a length that is known. Rows of the frames
    table: `refused` get no ground truth for `frame_reason`, nor do `refused_too` for `model_reason`; `doubtful` get
    class C at best."""

    name: str
    about: About
    status: Status
    value: float | None
    sd: float | None
    limit: float
    cause: str
    reason: str
    refused: np.ndarray = field(default_factory=lambda: _NO_ROWS)
    refused_too: np.ndarray = field(default_factory=lambda: _NO_ROWS)
    doubtful: np.ndarray = field(default_factory=lambda: _NO_ROWS)
    frame_reason: str = ""
    model_reason: str = ""

    @property
    def advice(self) -> str:
        """What would decide it, or what to do; empty where it passed."""
        kind = KINDS[self.name]
        remedy = _BY_CAUSE.get(self.cause, kind.remedy)
        return {Status.PASSED: "", Status.FAILED: remedy, Status.UNDECIDED: kind.decides}[self.status]

    def row(self) -> dict[str, object]:
        """The row of align.gate."""
        t_ns = self.about.t_ns
        return {
            "check": self.name,
            "session_id": self.about.session_id,
            "component": self.about.component,
            "t_start_ns": None if t_ns is None else int(t_ns[0]),
            "t_end_ns": None if t_ns is None else int(t_ns[-1]),
            "frames": self.about.frames,
            "value": self.value,
            "sd": self.sd,
            "limit": self.limit,
            "unit": KINDS[self.name].unit,
            "status": self.status.value,
            "cause": self.cause,
            "reason": self.reason,
            "advice": self.advice,
        }


def check(
    name: str,
    value: float | None,
    sd: float | None,
    limit: float,
    about: About,
    cause: str,
    reason: str,
    *,
    status: Status | None = None,
    rows: np.ndarray = _NO_ROWS,
    is_of_frames: bool = True,
) -> Check:
    """Compare an estimate with its limit; no value fails, NaN is undecided. `cause` and `reason` say what a failure
    means. `rows` of the frames table get no ground truth where it failed, and class C at best where it is undecided,
    unless (`is_of_frames` false) it says nothing of single frames."""
    kind = KINDS[name]
    if status is None:
        status = Status.FAILED if value is None else decide(value, sd or 0.0, limit, at_least=kind.at_least)
        reason = "" if status is Status.UNDECIDED else reason
    if status is Status.UNDECIDED and not reason:
        reason = f"{kind.estimate}: {_figure(value, sd, kind.unit)} (limit {_figure(limit, None, kind.unit)})"
    known = None if value is None or np.isnan(value) else value
    return Check(
        name,
        about,
        status,
        known,
        None if known is None or sd is None or np.isnan(sd) else sd,
        limit,
        "" if status is Status.PASSED else cause,
        "" if status is Status.PASSED else reason,
        refused=rows if status is Status.FAILED else _NO_ROWS,
        doubtful=rows if status is Status.UNDECIDED and is_of_frames else _NO_ROWS,
    )


def with_status(checks: Sequence[Check], status: Status) -> list[Check]:
    """The checks with this status."""
    return [c for c in checks if c.status is status]


def refusal_reasons(checks: Sequence[Check], registered: np.ndarray, otherwise: str) -> np.ndarray:
    """Why frames (N,) get no ground truth: the reason of the first check that refuses them, empty where none does;
    `otherwise` where SfM has no pose."""
    reason = np.where(registered, "", otherwise).astype(object)
    for rows, why in [
        *((c.refused, c.frame_reason or c.reason) for c in checks),
        *((c.refused_too, c.model_reason) for c in checks),
    ]:
        reason[rows[reason[rows] == ""]] = why
    return reason


def doubts(checks: Sequence[Check], count: int) -> np.ndarray:
    """Why frames (count,) are of class C at best, by the first check that is undecided; empty where none is."""
    doubt = np.full(count, "", dtype=object)
    for c in checks:
        rows = c.doubtful[doubt[c.doubtful] == ""]
        doubt[rows] = f"check {c.name} undecided: {c.reason}"
    return doubt


def main_failure(checks: Sequence[Check]) -> Check | None:
    """The failed check that says most about why: the first in the order of CAUSES, of the most frames."""
    failed = with_status(checks, Status.FAILED)
    return min(failed, key=lambda c: (CAUSES.index(c.cause), -c.about.frames), default=None)


def gate_table(checks: Sequence[Check]) -> pd.DataFrame:
    """The align.gate table."""
    table = pd.DataFrame([c.row() for c in checks], columns=schema("align", "gate").column_names)
    table[["value", "sd"]] = table[["value", "sd"]].astype(float)
    return table.astype({"t_start_ns": "Int64", "t_end_ns": "Int64", "component": "Int64"})


def describe(checks: Sequence[Check]) -> list[str]:
    """The headline, and a line for each check that failed or is undecided, windows of a session together."""
    counts = {status: len(with_status(checks, status)) for status in (Status.FAILED, Status.UNDECIDED)}
    named = dict.fromkeys(c.name for c in checks if c.status is Status.UNDECIDED)
    parts = [f"{count} {status}" for status, count in counts.items() if count]
    lines = [f"checks: {', '.join(parts)} of {len(checks)}" if parts else f"checks: all {len(checks)} passed"]
    if named:
        lines[0] += f"; undecided: {', '.join(named)}"
    groups: dict[tuple[Status, str, str], list[Check]] = {}
    for status in counts:
        for c in with_status(checks, status):
            groups.setdefault((status, c.name, c.about.session_id), []).append(c)
    for (status, name, session_id), group in groups.items():
        where = f", {session_id}" if session_id else ""
        times = f" ({len(group)} checks)" if len(group) > 1 else ""
        what = f"{group[0].cause}: {group[0].reason}" if status is Status.FAILED else group[0].reason
        after = " would decide it" if status is Status.UNDECIDED else ""
        advice = f"; {group[0].advice}{after}" if group[0].advice else ""
        lines.append(f"  {status}: {name}{where}: {what}{times}{advice}")
    return lines


def _figure(value: float | None, sd: float | None, unit: str) -> str:
    if value is None or np.isnan(value):
        return "not known"
    factor, sign = (100, " %") if unit == "share" else (1, f" {unit}")
    margin = "" if sd is None else f" ± {factor * sd:.2g}"
    return f"{factor * value:.3g}{margin}{sign}"
