"""`python -m benchmarks.vio_drift.fit --trajectories … --out …`: measures phone odometry's drift on recordings."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from benchmarks.vio_drift.estimators import (
    JUMP_MIN_M,
    DriftEstimate,
    TruthCheck,
    YawFit,
    check_against_truth,
    fit_height,
    fit_position,
    fit_steady,
    fit_yaw_drift,
    rate,
)
from benchmarks.vio_drift.recordings import Recordings, read_recordings
from groundwalk.simulation.vio import FIT_FILE, VioModel
from groundwalk.store.cli import new_app

RPE_1M_M = 0.02
"""ARKit's relative pose error over about 1 s or 1 m of walking: Kim et al., Sensors 22(24), 9873, 2022."""

_TAG_WALKS = "5 ARKit walks past AprilTags (Invisible Map)"
_STEADY = "2 ARKit logs at 60 Hz (ARKit Data Logger)"
_HEADER = "# Written by `python -m benchmarks.vio_drift.fit`; docs/explanation/vio-drift.md says how it was measured.\n"


@dataclass(frozen=True)
class Parameter:
    """A fitted parameter of the model and where it comes from."""

    estimate: DriftEstimate
    source: str


@dataclass(frozen=True)
class Fit:
    """All parameters by their name in VioModel, and what else the recordings say."""

    parameters: Mapping[str, Parameter]
    tag_m: tuple[DriftEstimate, DriftEstimate]
    yaw: YawFit
    truth: Sequence[TruthCheck]


def fit(recordings: Recordings) -> Fit:
    """The drift model's parameters from the recordings."""
    walks = [log.walk for log in recordings.tag_logs]
    position = fit_position(walks, RPE_1M_M)
    height = fit_height(walks)
    yaw = fit_yaw_drift(walks)
    steady = fit_steady(recordings.steady_logs)
    still_s = [s for log in recordings.tag_logs for s in log.stood_still_s]
    walked_min = sum(log.duration_s for log in recordings.tag_logs) / 60

    mean_still = sum(still_s) / len(still_s)
    by_name = {
        "scale_std": Parameter(position.scale, _TAG_WALKS),
        "gravity_std_deg": Parameter(height.tilt.scaled(np.degrees(1.0)), _TAG_WALKS),
        "yaw_bias_deg_per_m": Parameter(yaw.bias, _TAG_WALKS),
        "yaw_walk_deg_per_sqrt_m": Parameter(yaw.walk, _TAG_WALKS),
        "yaw_session_spread": Parameter(yaw.spread, _TAG_WALKS),
        "position_walk_m_per_sqrt_m": Parameter(position.walk, _TAG_WALKS),
        "height_walk_m_per_sqrt_m": Parameter(height.walk, _TAG_WALKS),
        "correlation_m": Parameter(
            DriftEstimate.exactly(position.correlation_m),
            f"the position walk above with {RPE_1M_M} m of error over 1 m: Kim et al., Sensors 22(24), 9873, 2022",
        ),
        "jitter_m": Parameter(steady.jitter_m, _STEADY),
        "jitter_deg": Parameter(steady.jitter_deg, _STEADY),
        "jumps_per_min": Parameter(rate(steady.jumps, steady.duration_s / 60), _STEADY),
        "jump_min_m": Parameter(
            DriftEstimate.exactly(JUMP_MIN_M), "the least step that stands out of the noise at 60 Hz"
        ),
        "jump_mean_m": Parameter(steady.jump_mean_m, _STEADY),
        "interruptions_per_min": Parameter(rate(len(still_s), walked_min), _TAG_WALKS),
        "interruption_s": Parameter(DriftEstimate.exactly(mean_still, len(still_s)), _TAG_WALKS),
    }
    return Fit(
        {f.name: by_name[f.name] for f in fields(VioModel)},
        (position.tag, height.tag),
        yaw,
        [check_against_truth(pair) for pair in recordings.truth_pairs],
    )


def to_toml(result: Fit) -> str:
    """The fit as a TOML file: a table a parameter. `value` is what the model takes; a bound where `low` is 0."""
    units = {f.name: f.metadata for f in fields(VioModel)}
    blocks = [_HEADER]
    for name, p in result.parameters.items():
        e = p.estimate
        blocks.append(
            f"[{name}]  # {units[name]['meaning']}\n"
            f"value = {_short(e.value)}\n"
            f'unit = "{units[name]["unit"]}"\n'
            f"low = {_short(e.low)}  # 68 % interval\n"
            f"high = {_short(e.high)}\n"
            f"samples = {e.samples}\n"
            f'source = "{p.source}"\n'
        )
    return "\n".join(blocks)


def _short(value: float) -> str:
    """Three digits, more than the recordings know; so the last bits of a platform's arithmetic don't show."""
    return repr(float(f"{value:.3g}"))


def _show(result: Fit, console: Console) -> None:
    table = Table("parameter", "value", "68 % interval", "unit", "samples", "source")
    units = {f.name: f.metadata["unit"] for f in fields(VioModel)}
    for name, p in result.parameters.items():
        e = p.estimate
        interval = f"{_short(e.low)} .. {_short(e.high)}" if e.low < e.high else "none"
        table.add_row(name, _short(e.value), interval, units[name], str(e.samples), p.source)
    console.print(table)
    by_session = ", ".join(f"{e.best:.2g}" for e in result.yaw.walk_by_session)
    console.print(f"yaw walk by session, bias within: {by_session} deg/sqrt(m)")
    along, up = result.tag_m
    console.print(f"a tag's place is seen to {along.best:.3f} m along a segment, {up.best:.3f} m in height")
    for check in result.truth:
        console.print(
            f"ground truth, session {check.name}, {check.path_m:.1f} m: scale {check.scale:.4f}, "
            f"positions {check.rms_m:.3f} m RMS, {check.rpe_1s_m:.3f} m RMS over 1 s"
        )


app = new_app("Measure the drift of phone odometry on real recordings and write the parameters of the simulation.")


@app.command()
def main(
    trajectories: Annotated[Path, typer.Option(help="Folder of recordings (docs/explanation/vio-drift.md).")],
    out: Annotated[Path, typer.Option(help="TOML file to write.")] = FIT_FILE,
) -> None:
    """Fit, print a table and write the TOML file."""
    recordings = read_recordings(trajectories)
    result = fit(recordings)
    _show(result, Console(width=150))
    out.write_text(to_toml(result), encoding="utf-8")


if __name__ == "__main__":
    app()
