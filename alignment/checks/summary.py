"""Check results as the table and as lines for the user."""

from collections.abc import Sequence

import pandas as pd

from groundwalk.alignment.checks.definitions import DEFINITIONS
from groundwalk.alignment.checks.results import CheckResult, with_status
from groundwalk.consistency.decisions import Status
from groundwalk.store.choices import CheckName
from groundwalk.store.schemas import schema


def checks_table(results: Sequence[CheckResult]) -> pd.DataFrame:
    """The align.checks table."""
    table = pd.DataFrame([_row(result) for result in results], columns=schema("align", "checks").column_names)
    table[["value", "sd"]] = table[["value", "sd"]].astype(float)
    return table.astype({"t_start_ns": "Int64", "t_end_ns": "Int64", "component": "Int64"})


def _row(result: CheckResult) -> dict[str, object]:
    subject = result.subject
    return {
        "check": result.name,
        "session_id": subject.session_id,
        "component": subject.component,
        "t_start_ns": None if subject.t_ns is None else int(subject.t_ns[0]),
        "t_end_ns": None if subject.t_ns is None else int(subject.t_ns[-1]),
        "frames": subject.frames,
        "value": result.value,
        "sd": result.sd,
        "limit": result.limit,
        "unit": DEFINITIONS[result.name].unit,
        "status": result.status,
        "cause": result.cause,
        "reason": result.reason,
        "advice": result.advice,
    }


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
    return lines + [_describe_group(group) for group in groups.values()]


def _describe_group(group: Sequence[CheckResult]) -> str:
    first = group[0]
    session = f", {first.subject.session_id}" if first.subject.session_id else ""
    cause = f"{first.cause}: " if first.status is Status.FAILED else ""
    count = f" ({len(group)} checks)" if len(group) > 1 else ""
    decides = " would decide it" if first.status is Status.UNDECIDED else ""
    advice = f"; {first.advice}{decides}" if first.advice else ""
    return f"  {first.status}: {first.name}{session}: {cause}{first.reason}{count}{advice}"
