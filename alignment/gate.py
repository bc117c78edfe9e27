"""The gate: what is checked before ground truth is given out, and the frames that get none."""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from alignment.agreement import Window
from artefacts.schemas import schema
from geometry import motion_agreement
from geometry.motion_agreement import MISTAKES

# What a failed check means, in the words of align.gate's column `cause`; the first of those found names the run.
MIRRORED = MISTAKES[motion_agreement.MIRRORED][0]
SHUFFLED = MISTAKES[motion_agreement.UNRELATED][0]
INTRINSICS = "intrinsics wrong"
LOOK_ALIKE = "look-alike places folded together"
VIO_SCALE = "VIO scale wrong"
VIO_VERTICAL = "VIO vertical wrong"
OTHER_SCENE = "another scene mixed in"
BROKEN_OFF = "broken off"
TOO_FEW = "too few frames registered"
DISAGREES = "SfM and VIO disagree"
REFERENCE = "SfM and the reference disagree"
RULER = "ruler and map disagree"
DEPTH = "map and depth sensor disagree"
CAUSES = (
    MIRRORED,
    SHUFFLED,
    INTRINSICS,
    LOOK_ALIKE,
    VIO_SCALE,
    VIO_VERTICAL,
    OTHER_SCENE,
    BROKEN_OFF,
    TOO_FEW,
    DISAGREES,
    REFERENCE,
    RULER,
    DEPTH,
)


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
        cause: str,
        reason: str,
        *,
        session_id: str = "",
        component: int | None = None,
        frames: int,
        at_least: bool = False,
        t_ns: np.ndarray | None = None,
    ) -> bool:
        """Note a check: `value` must be at most `limit` (or `at_least`); no value fails. `cause` and `reason` say what
        it means if it fails; `t_ns` are the times of its frames, for a window."""
        passed = value is not None and bool(value >= limit if at_least else value <= limit)
        self.rows.append(
            {
                "check": name,
                "session_id": session_id,
                "component": component,
                "t_start_ns": None if t_ns is None else int(t_ns[0]),
                "t_end_ns": None if t_ns is None else int(t_ns[-1]),
                "frames": frames,
                "value": value,
                "limit": limit,
                "unit": unit,
                "verdict": "passed" if passed else "failed",
                "passed": passed,
                "cause": "" if passed else cause,
                "reason": "" if passed else reason,
            }
        )
        return passed

    def undecided(
        self,
        name: str,
        cause: str,
        reason: str,
        *,
        unit: str,
        session_id: str = "",
        component: int | None = None,
        frames: int,
    ) -> None:
        """Note a check that can't be decided, and why: it neither passes nor counts as failed."""
        self.check(name, None, 0.0, unit, cause, reason, session_id=session_id, component=component, frames=frames)
        self.rows[-1]["verdict"] = "undecided"

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
                DISAGREES,
                reason,
                session_id=window.segment.session_id,
                component=window.segment.component,
                frames=len(times),
                t_ns=times,
            )

    @property
    def failed(self) -> list[dict[str, object]]:
        return [row for row in self.rows if row["verdict"] == "failed"]

    @property
    def main_cause(self) -> dict[str, object] | None:
        """The failed check that says most about why: the first in the order of CAUSES, of the most frames."""

        def rank(row: dict[str, object]) -> tuple[int, int]:
            return CAUSES.index(str(row["cause"])), -int(str(row["frames"]))

        return min(self.failed, key=rank, default=None)

    def table(self) -> pd.DataFrame:
        """The align.gate table."""
        table = pd.DataFrame(self.rows, columns=schema("align", "gate").column_names)
        return table.astype({"t_start_ns": "Int64", "t_end_ns": "Int64", "component": "Int64", "value": float})
