"""What VIO's drift does to steps and windows of different lengths: `python -m benchmarks.gates_windows`

Simulated walks without pictures: true poses with a few millimetres of noise stand for SfM, VIO drifts as fitted to real
recordings (docs/explanation/vio-drift.md). Prints how far the map's scale and vertical are off, and how far VIO parts
from SfM within a window: what align's limits must let pass.
"""

from dataclasses import replace
from typing import Annotated

import numpy as np
import typer

from benchmarks.pose_walks import PoseWalk, pose_walks
from groundwalk.alignment.checks.windows import segment_windows
from groundwalk.alignment.map_frame import common_scale, common_vertical
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.settings import AlignSettings
from groundwalk.artefacts.cli import new_app
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.geometry.fits import Sim3, direction_angles
from groundwalk.geometry.poses import Array, make_pose, path_length
from groundwalk.simulation.vio import FITTED, simulate_vio

_UP = np.array([0.0, 1.0, 0.0])
_SFM_SD_M = 0.006
_FRAMES = 90
# Drift alone: import finds jumps and lost tracking, and no window crosses them.
_DRIFT = replace(FITTED, jumps_per_min=0.0, interruptions_per_min=0.0)

app = new_app(__doc__ or "")


@app.command()
def main(
    scene: Annotated[str, typer.Option(help="The place walked through.")] = "Church",
    draws: Annotated[int, typer.Option(help="Draws of five walks each.", min=2)] = 20,
) -> None:
    """Print the tables."""
    walks = [*pose_walks(scene, "train"), *pose_walks(scene, "test")][:5]
    settings = AlignSettings()
    scenes = [_segments(walks, seed) for seed in range(draws)]
    paths = [s.path_m for s in scenes[0]]
    print(f"Simulated: {len(walks)} walks through {scene} of {min(paths):.0f} to {max(paths):.0f} m, {draws} draws\n")
    print("| step, m | scale off, RMS | largest | RMS of error / stated sigma |")
    print("|---|---|---|---|")
    for step_m in (0.5, 1.0, 2.0, 5.0, 10.0):
        scales = [
            common_scale(
                segments,
                step_m=step_m,
                step_sd=settings.step_scale_sd,
                phone_sd=settings.phone_scale_sd,
            )
            for segments in scenes
        ]
        off, sd = np.array([f.log for f in scales]), np.array([f.sd for f in scales])
        print(f"| {step_m:g} | {_rms(off):.2%} | {np.abs(off).max():.2%} | {_rms(off / sd):.2f} |")
    phone = float(np.radians(settings.phone_tilt_sd_deg))
    verticals = [common_vertical(segments, phone_sd=phone) for segments in scenes]
    ups = np.stack([vertical.up_sfm for vertical in verticals if vertical])
    tilt = np.degrees(direction_angles(ups, _UP))
    print(f"\nvertical off: {_rms(tilt):.3f} degrees RMS, {tilt.max():.3f} at most")
    _print_residuals(scenes, settings)


def _segments(walks: list[PoseWalk], seed: int) -> list[Segment]:
    """The walks with VIO, and SfM's poses at the true scale."""
    segments = []
    for number, walk in enumerate(walks):
        rng = np.random.default_rng([seed, number])
        t_ns, true = walk.t_ns[:_FRAMES], walk.map_T_cam[:_FRAMES]
        vio = simulate_vio(t_ns, true, int(rng.integers(2**31)), _DRIFT)
        sfm = make_pose(true[:, :3, :3], true[:, :3, 3] + _SFM_SD_M * rng.normal(size=(len(true), 3)))
        up_cam = np.swapaxes(vio.vio_T_cam[:, :3, :3], 1, 2) @ _UP
        rows = np.arange(len(true))
        segments.append(
            Segment(
                session_id=walk.name,
                recording=walk.name,
                index=0,
                component=0,
                rows=rows,
                t_ns=t_ns,
                sfm_T_cam=sfm,
                vio_T_cam=vio.vio_T_cam,
                up_cam=up_cam,
                travelled_m=path_length(vio.vio_T_cam[:, :3, 3]),
            )
        )
    return segments


def _print_residuals(scenes: list[list[Segment]], settings: AlignSettings) -> None:
    none = VioDrift(0.0, 0.0, 0.0, 0.0)
    metric_S_sfm, length_m, sd = Sim3(1.0, np.eye(3), np.zeros(3)), settings.window_m, settings.fit_sd
    segments = [segment for of_scene in scenes for segment in of_scene]
    windows = [w for s in segments for w in segment_windows(s, metric_S_sfm, length_m, none, sd)]
    metres = np.array([w.position_m.max() for w in windows])
    degrees = np.degrees([w.rotation.max() for w in windows])
    limit = settings.vio_drift
    limit_m, limit_deg = float(limit.metres(settings.window_m)), float(np.degrees(limit.radians(settings.window_m)))
    print(f"\n{len(windows)} windows of {settings.window_m:g} m: largest residual")
    print("| | median | 99th percentile | largest | limit |")
    print("|---|---|---|---|---|")
    for name, values, most in (("position, m", metres, limit_m), ("rotation, degrees", degrees, limit_deg)):
        print(
            f"| {name} | {np.median(values):.2f} | {np.percentile(values, 99):.2f} | {values.max():.2f} | {most:.2f} |"
        )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    app()
