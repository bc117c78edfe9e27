"""The gate: what is checked before ground truth is given out, and the frames that get none."""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from alignment.agreement import Window
from artefacts.schemas import schema


@dataclass
class Gate:
    """Collects checks, one row of align.gate each."""

    rows: list[dict[str, object]] = field(default_factory=list)

    def check(
        self,
        name: str,
        value: float | None,
        limit: float,
        unit: str,
        reason: str,
        *,
        session_id: str = "",
        frames: int,
        at_least: bool = False,
        t_ns: np.ndarray | None = None,
    ) -> bool:
        """Note a check: `value` must be at most `limit` (or `at_least`); no value fails. `reason` says what it means
        if it fails; `t_ns` are the times of its frames, for a window."""
        passed = value is not None and bool(value >= limit if at_least else value <= limit)
        self.rows.append(
            {
                "check": name,
                "session_id": session_id,
                "t_start_ns": None if t_ns is None else int(t_ns[0]),
                "t_end_ns": None if t_ns is None else int(t_ns[-1]),
                "frames": frames,
                "value": value,
                "limit": limit,
                "unit": unit,
                "passed": passed,
                "reason": "" if passed else reason,
            }
        )
        return passed

    def check_window(self, window: Window) -> None:
        """Note both checks of a window: its largest residuals against what VIO may drift by there."""
        times = window.segment.t_ns[window.inside]
        wrong = int(window.wrong.sum())
        reason = f"{wrong} of {len(window.inside)} frames move otherwise in SfM than in VIO"
        for name, value, limit, unit in (
            ("window_position", float(window.position_m.max()), window.limit_m, "m"),
            (
                "window_rotation",
                float(np.degrees(window.rotation.max())),
                float(np.degrees(window.limit_rotation)),
                "deg",
            ),
        ):
            self.check(
                name,
                value,
                limit,
                unit,
                reason,
                session_id=window.segment.session_id,
                frames=len(times),
                t_ns=times,
            )

    @property
    def failed(self) -> list[dict[str, object]]:
        return [row for row in self.rows if not row["passed"]]

    def table(self) -> pd.DataFrame:
        """The align.gate table."""
        table = pd.DataFrame(self.rows, columns=schema("align", "gate").column_names)
        return table.astype({"t_start_ns": "Int64", "t_end_ns": "Int64", "value": float})
