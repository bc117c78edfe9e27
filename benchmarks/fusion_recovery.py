"""How fusion methods bear what goes wrong in the middle of a walk, and how they begin: `python -m
benchmarks.fusion_recovery`.

Simulated test walks of the six scenes, with predictions as wrong as the published regressors'. A third of the way in,
odometry jumps, turns or predictions go wrong. A method has recovered at the first frame whose error is at most 1.5
times the larger of its error before (mean of 30 s) and of what the same method has at that frame of the walk as it was,
in position and in rotation. Writes docs/results/fusion_recovery.md and .csv.
"""

import multiprocessing
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from numpy.typing import NDArray

from benchmarks import fusion_inputs as inputs
from benchmarks.leaderboard import RULE, within_bounds
from benchmarks.regressor_errors.model import REGRESSORS
from benchmarks.results import circumstances, markdown_table, write_page
from groundwalk.fusion.evaluation.fuse import Run, fuse, pose_errors
from groundwalk.fusion.methods import METHODS, resolve_options
from groundwalk.fusion.methods.localiser import Status
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.poses import Array, interpolate, make_pose, yaw_rotation
from groundwalk.simulation.scenes import NAMES
from groundwalk.store.cli import new_app
from groundwalk.store.progress import track

app = new_app(__doc__ or "")

_BEFORE_S, _AFTER_S, _FACTOR = 30, 60, 1.5
_START_S = 10.0
_FOLLOWED = ("drift_aware", "error_state", "last_good", RULE)  # window30 and pose_graph take ten times as long


@dataclass(frozen=True)
class Trouble:
    """Something that goes wrong at a frame. spoilt: the walk with it, from a frame on. lasts_s: how long; recovery is
    counted from its end. within_s: how soon a method should have recovered. rate: frames a second, of which one has a
    prediction."""

    name: str
    spoilt: Callable[[Walk, int, np.random.Generator], Walk]
    lasts_s: int
    within_s: int
    rate: int = 1


def _jump(walk: Walk, at: int, rng: np.random.Generator) -> Walk:
    way = yaw_rotation(rng.uniform(0, 2 * np.pi)) @ np.array([5.0, 0.0, 0.0])
    return _with_odometry(walk, at, make_pose(np.eye(3), way))


def _relocalisation(walk: Walk, at: int, rng: np.random.Generator) -> Walk:
    turn = yaw_rotation(np.radians(30) * rng.choice([-1, 1]))
    place = walk.vio_T_cam[at, :3, 3]
    return _with_odometry(walk, at, make_pose(turn, place - turn @ place))


def _silence(walk: Walk, at: int, rng: np.random.Generator) -> Walk:
    predictions = walk.map_T_cam_predicted.copy()
    predictions[at : at + 10] = np.nan
    return replace(walk, map_T_cam_predicted=predictions)


def _outliers(walk: Walk, at: int, rng: np.random.Generator) -> Walk:
    """30 % of the predictions from there on are those of other frames of the walk, turned about."""
    predictions = walk.map_T_cam_predicted.copy()
    gross = at + np.flatnonzero(rng.random(len(walk) - at) < 0.3)
    predictions[gross] = walk.map_T_cam_predicted[rng.permutation(len(walk))[: len(gross)]]
    predictions[gross, :3, :3] = yaw_rotation(rng.uniform(0, 2 * np.pi, len(gross))) @ predictions[gross, :3, :3]
    return replace(walk, map_T_cam_predicted=predictions)


def _wrong_place(walk: Walk, at: int, rng: np.random.Generator) -> Walk:
    """60 s of perceptual aliasing: predictions move as the phone does, 10 m away and turned by 115 degrees."""
    predictions = walk.map_T_cam_predicted.copy()
    place, turn = walk.map_T_cam[at, :3, 3], yaw_rotation(2.0)
    shift = yaw_rotation(rng.uniform(0, 2 * np.pi)) @ np.array([10.0, 0.0, 0.0])
    predictions[at : at + 60] = make_pose(turn, place + shift - turn @ place) @ predictions[at : at + 60]
    return replace(walk, map_T_cam_predicted=predictions)


def _with_odometry(walk: Walk, at: int, new_T_vio: Array) -> Walk:
    """The walk with another frame of odometry from a frame on."""
    vio = walk.vio_T_cam.copy()
    vio[at:] = new_T_vio @ vio[at:]
    return replace(walk, vio_T_cam=vio)


TROUBLES = [
    Trouble("odometry jumps by 5 m", _jump, 0, 5),
    Trouble("odometry turns by 30 deg in place", _relocalisation, 0, 5),
    Trouble("odometry jumps by 5 m, 30 frames a second", _jump, 0, 5, rate=30),
    Trouble("odometry turns by 30 deg in place, 30 frames a second", _relocalisation, 0, 5, rate=30),
    Trouble("10 s without predictions", _silence, 10, 5),
    Trouble("30 % gross outliers from there on", _outliers, 0, 5),
    Trouble("60 s of perceptual aliasing", _wrong_place, 60, 15),
]


RATES = sorted({trouble.rate for trouble in TROUBLES})


@dataclass(frozen=True)
class Course:
    """A method's errors on a walk, infinite without a pose, where it says that it is lost, and where an error is beyond
    its 95 % bounds; (N,) each."""

    position_m: Array
    rotation_deg: Array
    lost: NDArray[np.bool_]
    beyond: NDArray[np.bool_]


def refined(walk: Walk, rate: int) -> Walk:
    """The walk with `rate` frames for one: odometry and true poses between two frames are interpolated."""
    if rate == 1:
        return walk
    count = rate * (len(walk) - 1) + 1
    t_ns = np.interp(np.arange(count) / rate, np.arange(len(walk)), walk.t_ns).astype(np.int64)
    predictions = np.full((count, 4, 4), np.nan)
    predictions[::rate] = walk.map_T_cam_predicted
    return replace(
        walk,
        frame_id=np.array([f"{i // rate}-{i % rate}" for i in range(count)], dtype=object),
        t_ns=t_ns,
        gravity=np.repeat(walk.gravity, rate, axis=0)[:count],
        vio_T_cam=interpolate(walk.t_ns, walk.vio_T_cam, t_ns),
        map_T_cam=interpolate(walk.t_ns, walk.map_T_cam, t_ns),
        map_T_cam_predicted=predictions,
    )


def course(walk: Walk, method: str, rate: int = 1) -> Course:
    """Of the frames with a prediction, of which there are so many fewer."""
    fused = fuse(Run("", "", ""), walk, METHODS[method].make(resolve_options(method)))
    errors = pose_errors(fused.live_map_T_cam, walk.map_T_cam)
    position, rotation = (np.where(np.isnan(error), np.inf, error) for error in errors)
    lost = np.isin(fused.live_status, [Status.LOST, Status.NONE, Status.ALIGNING])
    beyond = np.zeros(len(walk), dtype=bool)
    beyond[known(fused.covariance)] = ~within_bounds(fused).all(axis=1)
    return Course(position[::rate], rotation[::rate], lost[::rate], beyond[::rate])


@dataclass(frozen=True)
class Recovery:
    """seconds: from the trouble's end on, infinite where it isn't over within a minute. said: the share of the frames
    until then, trouble included, that are off and said to be lost; NaN where none is off. unsaid_s: for how long errors
    are beyond their bounds and it isn't said to be lost. off: whether any frame was."""

    seconds: float
    said: float
    unsaid_s: float
    off: bool


def recovery(plain: Course, spoilt: Course, at: int, end: int) -> Recovery:
    """From trouble that begins at one frame and ends at another. Walks have a frame a second."""
    good = np.ones(len(plain.lost), dtype=bool)
    for name in ("position_m", "rotation_deg"):
        usual, now = getattr(plain, name), getattr(spoilt, name)
        before = float(np.mean(usual[at - _BEFORE_S : at]))
        good &= now <= _FACTOR * np.maximum(before, usual)
    after = np.flatnonzero(good[end : end + _AFTER_S])
    seconds = float(after[0]) if len(after) else np.inf
    until = end + (int(after[0]) if len(after) else _AFTER_S)
    bad, lost = ~good[at:until], spoilt.lost[at:until]
    said = float(lost[bad].mean()) if bad.any() else np.nan
    return Recovery(seconds, said, float((spoilt.beyond[at:until] & ~lost).sum()), bool(bad.any()))


def rows_of(pair: tuple[str, str], methods: Sequence[str]) -> list[dict[str, object]]:
    """A row a walk, trouble and method of a scene and regressor."""
    scene, model = pair
    case = inputs.simulated_case(inputs.SIMULATED, scene, model)
    rows: list[dict[str, object]] = []
    for number, walk in enumerate(case.walks):
        at = len(walk) // 3
        if at < _BEFORE_S or at + 60 + _AFTER_S > len(walk):
            continue
        for method in methods:
            plains = {rate: course(refined(walk, rate), method, rate) for rate in RATES}
            of = {"scene": scene, "model": model, "walk": walk.session_id, "method": method}
            rows.append(of | start_row(walk, plains[1]))
            for which, trouble in enumerate(TROUBLES):
                rng, plain, rate = np.random.default_rng([number, which]), plains[trouble.rate], trouble.rate
                spoilt_walk = trouble.spoilt(refined(walk, rate), rate * at, rng)
                end = at + trouble.lasts_s
                result = recovery(plain, course(spoilt_walk, method, rate), at, end)
                found = {
                    "what": trouble.name,
                    "recovered_s": result.seconds,
                    "lost_fraction": result.said,
                    "unsaid_s": result.unsaid_s,
                    "off": result.off,
                    "before_m": float(plain.position_m[at - _BEFORE_S : at].mean()),
                }
                rows.append(of | found)
    return rows


def start_row(walk: Walk, plain: Course) -> dict[str, object]:
    """When a method gives its first pose that it doesn't call lost, and the mean errors of the first 10 s."""
    seconds = (walk.t_ns - walk.t_ns[0]) * 1e-9
    said = np.flatnonzero(np.isfinite(plain.position_m) & ~plain.lost)
    early = (seconds <= _START_S) & np.isfinite(plain.position_m)
    return {
        "what": "start",
        "first_s": float(seconds[said[0]]) if len(said) else np.inf,
        "start_position_m": float(plain.position_m[early].mean()) if early.any() else np.nan,
        "start_rotation_deg": float(plain.rotation_deg[early].mean()) if early.any() else np.nan,
        "start_answered": float(early.sum() / (seconds <= _START_S).sum()),
    }


@app.command()
def main(
    out: Annotated[Path, typer.Option(help="Folder for fusion_recovery.md and .csv.")] = Path("docs/results"),
    scenes: Annotated[str, typer.Option(help="Scenes, joined by commas.")] = ",".join(NAMES),
    methods: Annotated[str, typer.Option(help="Causal methods, joined by commas.")] = ",".join(_FOLLOWED),
    processes: Annotated[int, typer.Option(min=1, help="Worker processes.")] = os.cpu_count() or 1,
) -> None:
    """Run the methods, and write what came out."""
    chosen = methods.split(",")
    pairs = [(scene, model) for scene in scenes.split(",") for model in REGRESSORS]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        parts = pool.imap(partial(rows_of, methods=chosen), pairs)
        rows = pd.DataFrame([row for rows in track(parts, "scenes and regressors", len(pairs)) for row in rows])
    write_page(out, "fusion_recovery", _page(rows, chosen))
    rows.to_csv(out / "fusion_recovery.csv", index=False, lineterminator="\n", float_format="%.6g")


def _page(rows: pd.DataFrame, methods: Sequence[str]) -> Iterable[str]:
    yield "# Recovery of fusion methods, and their start"
    yield (
        "Written by `python -m benchmarks.fusion_recovery`; not to be edited. Simulated walks, odometry and "
        "predictions, these as wrong as the published PN and MS-T, one frame and one prediction a second, seed 0; "
        "with 30 frames a second, one has a prediction. A third of the way in something goes wrong. Recovered: "
        "error at most 1.5 times the larger of the mean of the 30 s before and of the same method's error at that "
        "frame without the trouble, in position and in rotation, within a minute of the trouble's end. Says so: share "
        "of the frames until then that are off and said to be lost, or have no pose. Beyond bounds unsaid: "
        "for how long until then, trouble included, an error is beyond the method's own 95 % bounds in position or in "
        "rotation and it isn't said to be lost, mean of the walks; never, for a method without bounds."
    )
    yield circumstances()
    for trouble in TROUBLES:
        yield f"## {trouble.name}"
        yield markdown_table(_recovery_rows(rows[rows["what"] == trouble.name], methods, trouble.within_s))
    yield "## Start"
    yield (
        "First pose: seconds until the first one that isn't said to be lost. Errors: means over the walks of those of "
        f"the first {_START_S:g} s, over frames with a pose."
    )
    yield markdown_table(_start_table(rows[rows["what"] == "start"], methods))


def _recovery_rows(rows: pd.DataFrame, methods: Sequence[str], within_s: int) -> Iterable[list[str]]:
    limit = f"within {within_s} s, %"
    head = ["method", "walks", "error before, m", limit, "median s", "90 % within s", "says so, %"]
    yield [*head, "beyond bounds unsaid, s"]
    for method in methods:
        of = rows[rows["method"] == method]
        seconds = of["recovered_s"].to_numpy(float)
        yield [
            method,
            str(len(of)),
            f"{of['before_m'].mean():.2g}",
            f"{100 * float((seconds <= within_s).mean()):.0f}",
            _seconds(seconds, 50),
            _seconds(seconds, 90),
            f"{100 * float(of['lost_fraction'].mean()):.0f}" if of["lost_fraction"].notna().any() else "",
            f"{of['unsaid_s'].mean():.1f}",
        ]


def _seconds(seconds: Array, percent: float) -> str:
    return f"{float(np.percentile(seconds, percent, method='higher')):.0f}".replace("inf", "never")


def _start_table(rows: pd.DataFrame, methods: Sequence[str]) -> Iterable[list[str]]:
    rule = rows[rows["method"] == RULE].set_index(["scene", "model", "walk"])["first_s"]
    yield ["method", "first pose, median s", "no later than the rule's, %", "position m", "rotation deg", "past, %"]
    for method in methods:
        of = rows[rows["method"] == method].set_index(["scene", "model", "walk"])
        first = of["first_s"].to_numpy(float)
        yield [
            method,
            f"{float(np.median(first)):.0f}",
            f"{100 * float((first <= rule.reindex(of.index).to_numpy(float)).mean()):.0f}",
            f"{of['start_position_m'].mean():.3g}",
            f"{of['start_rotation_deg'].mean():.3g}",
            f"{100 * of['start_answered'].mean():.0f}",
        ]


if __name__ == "__main__":
    app()
