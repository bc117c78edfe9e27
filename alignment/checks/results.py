"""Results of checks: value, limit and status, and the frames that lose their ground truth or its class by them; as a
table, and as lines for the user."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.checks.definitions import ADVICE_BY_CAUSE, DEFINITIONS
from groundwalk.consistency.decisions import Status, decide
from groundwalk.store.choices import CheckName, CheckUnit, FailureCause
from groundwalk.store.schemas import schema

Rows = NDArray[np.intp]
"""Positions in the frames table."""
NO_ROWS: Rows = np.empty(0, dtype=np.intp)
_PRIORITY: list[FailureCause | None] = [*FailureCause]


@dataclass(frozen=True)
class Subject:
    """What a check is about: a number of frames, their session and SfM model (empty and None: the whole scene), and the
    times of a window's frames."""

    frames: int
    session_id: str = ""
    component: int | None = None
    t_ns: np.ndarray | None = None


class Quantity(NamedTuple):
    """A value and its standard error, which counts and known lengths don't have. No value: there is no estimate; NaN:
    it is unknown."""

    value: float | None = None
    sd: float | None = None


@dataclass(frozen=True)
class Failure:
    """What a failure means. `rows` then get no ground truth; where the check is undecided they are of class C at best,
    unless `lowers_class` is false."""

    cause: FailureCause
    reason: str
    rows: Rows = field(default_factory=lambda: NO_ROWS)
    lowers_class: bool = True


class Exclusion(NamedTuple):
    """Frames that get no ground truth, and why; `is_of_model`: for a fault elsewhere in their SfM model."""

    rows: Rows
    reason: str
    is_of_model: bool = False


@dataclass(frozen=True, kw_only=True)
class CheckResult:
    """A check's outcome. `exclusions` get no ground truth, `undecided_rows` class C at best."""

    name: CheckName
    subject: Subject
    status: Status
    value: float | None
    sd: float | None
    limit: float
    cause: FailureCause | None
    reason: str
    exclusions: tuple[Exclusion, ...] = ()
    undecided_rows: Rows = field(default_factory=lambda: NO_ROWS)

    @property
    def advice(self) -> str:
        """What to do where it failed, or what would decide it; empty where it passed."""
        definition = DEFINITIONS[self.name]
        if self.status is Status.FAILED and self.cause in ADVICE_BY_CAUSE:
            return ADVICE_BY_CAUSE[self.cause]
        return {Status.FAILED: definition.remedy, Status.UNDECIDED: definition.evidence}.get(self.status, "")


def evaluate(
    name: CheckName, subject: Subject, estimate: Quantity, limit: float, failure: Failure, status: Status | None = None
) -> CheckResult:
    """Compare an estimate with its limit: passed, failed, or undecided where its standard error leaves both open or it
    is NaN; no estimate fails. `status` where the caller has decided already."""
    definition, (value, sd), reason = DEFINITIONS[name], estimate, failure.reason
    if status is None:
        is_minimum = definition.limit_is_minimum
        status = Status.FAILED if value is None else decide(value, sd or 0.0, limit, at_least=is_minimum)
        reason = "" if status is Status.UNDECIDED else reason
    if status is Status.UNDECIDED and not reason:
        figures = _with_unit(estimate, definition.unit), _with_unit(Quantity(limit), definition.unit)
        reason = "{}: {} (limit {})".format(definition.estimate, *figures)
    if value is None or np.isnan(value):
        value = sd = None
    passed = status is Status.PASSED
    return CheckResult(
        name=name,
        subject=subject,
        status=status,
        value=value,
        sd=None if sd is None or np.isnan(sd) else sd,
        limit=limit,
        cause=None if passed else failure.cause,
        reason="" if passed else reason,
        exclusions=(Exclusion(failure.rows, reason),) if status is Status.FAILED and len(failure.rows) else (),
        undecided_rows=failure.rows if status is Status.UNDECIDED and failure.lowers_class else NO_ROWS,
    )


def with_status(results: Sequence[CheckResult], status: Status) -> list[CheckResult]:
    """The results with this status."""
    return [result for result in results if result.status is status]


def exclusion_reasons(results: Sequence[CheckResult], not_registered: np.ndarray) -> np.ndarray:
    """Why frames (N,) get no ground truth, empty where they do: SfM has no pose, as `not_registered` (N,) says, or a
    check of their own excludes them, or one of their model; of several the first."""
    reasons = not_registered.copy()
    exclusions = [exclusion for result in results for exclusion in result.exclusions]
    for rows, reason, _ in sorted(exclusions, key=lambda exclusion: exclusion.is_of_model):
        reasons[rows[reasons[rows] == ""]] = reason
    return reasons


def undecided_reasons(results: Sequence[CheckResult], count: int) -> np.ndarray:
    """The first undecided check by which frames (count,) are of class C at best; empty where none is."""
    reasons = np.full(count, "", dtype=object)
    for result in results:
        rows = result.undecided_rows[reasons[result.undecided_rows] == ""]
        reasons[rows] = f"check {result.name} undecided: {result.reason}"
    return reasons


def main_failure(results: Sequence[CheckResult]) -> CheckResult | None:
    """The failed check that names the run: by its cause, then by its frames."""
    failed = [result for result in with_status(results, Status.FAILED) if result.cause]
    return min(failed, key=lambda result: (_PRIORITY.index(result.cause), -result.subject.frames), default=None)


def checks_table(results: Sequence[CheckResult]) -> pd.DataFrame:
    """The align.checks table."""
    rows = [
        {
            "check": result.name,
            "session_id": result.subject.session_id,
            "component": result.subject.component,
            "t_start_ns": None if result.subject.t_ns is None else int(result.subject.t_ns[0]),
            "t_end_ns": None if result.subject.t_ns is None else int(result.subject.t_ns[-1]),
            "frames": result.subject.frames,
            "unit": DEFINITIONS[result.name].unit,
            **{name: getattr(result, name) for name in ("value", "sd", "limit", "status", "cause", "reason", "advice")},
        }
        for result in results
    ]
    table = pd.DataFrame(rows, columns=schema("align", "checks").column_names)
    table[["value", "sd"]] = table[["value", "sd"]].astype(float)
    return table.astype({"t_start_ns": "Int64", "t_end_ns": "Int64", "component": "Int64"})


def describe(results: Sequence[CheckResult]) -> list[str]:
    """How many checks failed or are undecided, and a line for each of them, windows of a session together."""
    counts = {status: len(with_status(results, status)) for status in (Status.FAILED, Status.UNDECIDED)}
    parts = [f"{count} {status}" for status, count in counts.items() if count]
    lines = [f"checks: {', '.join(parts)} of {len(results)}" if parts else f"checks: all {len(results)} passed"]
    undecided = dict.fromkeys(result.name for result in with_status(results, Status.UNDECIDED))
    if undecided:
        lines[0] += f"; undecided: {', '.join(undecided)}"
    groups: dict[tuple[Status, CheckName, str], list[CheckResult]] = {}
    for status in counts:
        for result in with_status(results, status):
            groups.setdefault((status, result.name, result.subject.session_id), []).append(result)
    for (status, name, session_id), group in groups.items():
        session = f", {session_id}" if session_id else ""
        cause = f"{group[0].cause}: " if status is Status.FAILED else ""
        count = f" ({len(group)} checks)" if len(group) > 1 else ""
        decides = " would decide it" if status is Status.UNDECIDED else ""
        advice = f"; {group[0].advice}{decides}" if group[0].advice else ""
        lines.append(f"  {status}: {name}{session}: {cause}{group[0].reason}{count}{advice}")
    return lines


def _with_unit(estimate: Quantity, unit: CheckUnit) -> str:
    value, sd = estimate
    if value is None or np.isnan(value):
        return "unknown"
    factor, symbol = (100, "%") if unit is CheckUnit.FRACTION else (1, unit)
    return f"{factor * value:.3g}{'' if sd is None else f' ± {factor * sd:.2g}'} {symbol}"
