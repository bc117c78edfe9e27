"""The verdict on a capture: which frames can be trusted to what, why the others can't, and where VIO drifts."""

import contextlib
import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_sim3, fit_yaw, pose_residuals
from groundwalk.geometry.poses import Array
from groundwalk.reports.cells import LocaliserErrors
from groundwalk.reports.grids import EMPTY
from groundwalk.reports.inputs import SceneInputs
from groundwalk.scoring.errors import SURE_CLASSES, within_bounds
from groundwalk.store.choices import CheckName, DriftDefinition, MapUnit, NotRegistered, QualityClass, Rejected
from groundwalk.store.tables import has_vertical, have_times, poses_of
from groundwalk.store.text import grouped_reasons

_PARTS = (slice(3), slice(3, 6))  # of a covariance
MIN_TRUSTED = 0.5
"""Share of the frames of class A or B below which a capture isn't accepted, though some frames have ground truth."""
_OF_THE_MAP = (
    CheckName.COMPONENT_SCALE,
    CheckName.MAP_SCALE,
    CheckName.MAP_VERTICAL,
    CheckName.REFERENCE_SCALE,
    CheckName.REFERENCE_VERTICAL,
)

_CLOSER = "frames closer together, things seen from further aside or nearer, a loop or a second walk there"
_SHARPER = "walk and turn slower, with more light: sharp images of still things"
FRAME_ADVICE = {
    "position uncertain": _CLOSER,
    "rotation uncertain": _CLOSER,
    "few points seen": f"aim at things with texture; {_SHARPER}",
    "reprojection": _SHARPER,
    NotRegistered.NO_VERIFIED_PAIRS: f"overlap with other frames: {_CLOSER}",
    NotRegistered.NOT_MAPPED: f"overlap with other frames: {_CLOSER}",
    NotRegistered.MISPLACED: "look at the image: a look-alike place? More frames on the way to it tell the two apart",
    "SfM inconsistent with VIO": "more overlap there, where SfM broke or VIO jumped (docs/how-to/failed-check.md)",
    "SfM and reference inconsistent": f"nothing tells which is wrong there; more images settle it: {_CLOSER}",
    "the map has no metric scale": "a ruler in view (docs/how-to/ruler.md), surveyed points, or a data set's unit",
}
"""By words of a frame's reason: what to do in another capture."""


class State(StrEnum):
    """Of a capture."""

    ACCEPTED = "accepted"
    UNDECIDED = "undecided"
    REFUSED = "refused"
    UNREADABLE = "unreadable"
    OPEN = "not judged yet"


@dataclass(frozen=True)
class Problem:
    """What was refused, left out or is undecided: how many frames or images, why, and what to do about it."""

    what: str
    count: int | None
    why: str
    do: str = ""


@dataclass(frozen=True)
class TrueErrors:
    """Of a simulated scene's ground truth against the simulator's poses; heading and origin, which are free, fitted.

    Medians over frames, metres and degrees, beside `stated`, the medians of what the covariances state along their
    least certain axis, what all frames share included; percent inside the stated 95 % bounds; scale in percent,
    vertical in degrees.
    """

    position: float
    position_stated: float
    rotation_deg: float
    rotation_stated_deg: float
    position_within: float
    rotation_within: float
    scale: float
    vertical_deg: float


@dataclass(frozen=True)
class Verdict:
    """What the page's first screen and verdict.json say of a scene.

    `frames`: one row a frame with frame_id, session_id, split, seconds since its session's first frame, quality,
    reason, position_sd, rotation_sd_deg (one sigma, least certain axis, without what all frames share), vio_error,
    vio_error_deg (after a rigid fit of the session's VIO), travelled (along VIO, or ground truth without one),
    true_error, and positions x, y, z and vio_x, vio_y, vio_z in the map; lengths in the map's unit, NaN where there is
    none.
    """

    state: State
    why: str
    frames: pd.DataFrame
    problems: list[Problem]
    true_errors: TrueErrors | None

    @property
    def trusted(self) -> pd.DataFrame:
        """The frames of class A or B."""
        return self.frames[self.frames["quality"].isin(SURE_CLASSES)]

    def coverage(self) -> tuple[float, float]:
        """The share of the walked path between frames of class A or B, and the longest stretch without one."""
        total, covered, longest = 0.0, 0.0, 0.0
        for _, walk in self.frames.groupby("session_id"):
            at = walk["travelled"].to_numpy(float)
            trusted = walk["quality"].isin(SURE_CLASSES).to_numpy()
            steps = np.diff(at, prepend=0.0)
            total += float(at[-1])
            covered += float(steps[1:][trusted[1:] & trusted[:-1]].sum())
            longest = max(longest, float(np.diff([0.0, *at[trusted], at[-1]]).max()))
        return (covered / total if total > 0 else float("nan")), longest


def judge(scene: SceneInputs) -> Verdict:
    """The verdict by what the finished stages wrote."""
    frames = _frames(scene)
    state, why = _state(scene, frames)
    return Verdict(state, why, frames, _problems(scene, frames), _true_errors(scene))


def _state(scene: SceneInputs, frames: pd.DataFrame) -> tuple[State, str]:
    if scene.stopped:
        return State.REFUSED, _sentence(scene.stopped["what"], scene.stopped.get("found"))
    if "align" not in scene.stages:
        return State.OPEN, "ground truth hasn't been made yet: run the stage align"
    if scene.is_images_alone:
        # How exact such a map is nothing but the images says; where places look alike they are wrong by metres.
        placed, figures = (frames["quality"] != QualityClass.NONE).sum(), scene.manifests["align"]["figures"]
        scale, vertical = (str(figures[f"{name}_source"]).replace("none", "unknown") for name in ("scale", "vertical"))
        return State.UNDECIDED, (
            f"images alone (scale: {scale}; vertical: {vertical}): {placed} of {len(frames)} are in the map. Nothing "
            "but the images checks its shape, so no sigma is said: look-alike places may be one in it"
        )
    return state_of(scene.align_checks, frames["quality"])


def state_of(checks: pd.DataFrame, quality: pd.Series) -> tuple[State, str]:
    """Whether a capture with ground truth is accepted, and why: by the table align.checks, and the quality classes of
    its frames. This is what page, verdict.json, terminal and the tables of docs/results mean by it."""
    of_map = checks[checks["check"].isin(_OF_THE_MAP)]
    reasons = list(dict.fromkeys(of_map.loc[of_map["status"] != "passed", "reason"]))
    share = quality.isin(SURE_CLASSES).mean()
    if share < MIN_TRUSTED:
        reasons.insert(0, f"{math.ceil(MIN_TRUSTED * len(quality))} of {len(quality)} are needed")
    if reasons:
        return State.UNDECIDED, f"{100 * share:.0f} % of the frames are of class A or B, but: {'; '.join(reasons)}"
    return State.ACCEPTED, f"{100 * share:.0f} % of the frames are of class A or B; scale and vertical are known"


def _sentence(what: str, more: str | None) -> str:
    """A reason on one line; an error's details may be lists with a line each."""
    lines = [line.strip() for line in (more or "").splitlines()]
    return f"{what} ({'; '.join(filter(None, lines))})" if more else what


def _frames(scene: SceneInputs) -> pd.DataFrame:
    frames = scene.frames.sort_values(["session_id", "t_ns"], kind="stable").reset_index(drop=True)
    truth = scene.ground_truth.set_index("frame_id").reindex(frames["frame_id"]).reset_index()
    residuals = scene.residuals.drop_duplicates("frame_id").set_index("frame_id").reindex(frames["frame_id"])
    vio_xyz, map_xyz = _vio_in_map(scene, frames), poses_of(truth, "map_cam")[:, :3, 3]
    seconds = (frames["t_ns"] - frames.groupby("session_id")["t_ns"].transform("min")) * 1e-9
    table = frames[["frame_id", "session_id", "split"]].assign(
        seconds=seconds.where(have_times(frames)),
        quality=truth["quality"].fillna(QualityClass.NONE),
        reason=truth["reason"].fillna(scene.stopped.get("what", "")),
        position_sd=truth["position_sd_m"].astype(float),
        rotation_sd_deg=truth["rotation_sd_deg"].astype(float),
        vio_error=residuals["position_m"].to_numpy(float),
        vio_error_deg=residuals["rotation_deg"].to_numpy(float),
        true_error=np.nan,
        **dict(zip("xyz", map_xyz.T, strict=True)),
        **dict(zip(("vio_x", "vio_y", "vio_z"), vio_xyz.T, strict=True)),
        travelled=0.0,
    )
    raw_vio = poses_of(frames, "vio_cam")[:, :3, 3]
    in_map = scene.unit is not MapUnit.METRE  # lengths by VIO would be in another unit than those of the map
    walked = map_xyz if in_map else np.where(np.isnan(raw_vio), map_xyz, raw_vio)
    for rows in frames.groupby("session_id").indices.values():
        steps = np.linalg.norm(np.diff(walked[rows], axis=0), axis=1)  # nothing from or to an unknown position
        table.loc[rows, "travelled"] = np.cumsum(np.r_[0.0, np.nan_to_num(steps)])
    if scene.is_images_alone:
        table[["position_sd", "rotation_sd_deg"]] = np.nan
    if scene.true_T_cam is not None:
        errors = pd.Series(_true_residuals(scene)[0], scene.ground_truth["frame_id"])
        table["true_error"] = errors.reindex(table["frame_id"]).to_numpy()
    return table


def _vio_in_map(scene: SceneInputs, frames: pd.DataFrame) -> Array:
    """VIO's positions (N, 3), each part of a session fitted rigidly to the map; NaN where there is no fit."""
    vio_T_cam = poses_of(frames, "vio_cam")
    map_T_vio = np.full((len(frames), 4, 4), np.nan)
    fits = poses_of(scene.align_sessions, "map_vio")
    for fit, (_, part) in zip(fits, scene.align_sessions.iterrows(), strict=True):
        inside = frames["t_ns"].between(part["t_start_ns"], part["t_end_ns"])
        inside &= frames["session_id"] == part["session_id"]
        map_T_vio[inside.to_numpy() & np.isnan(map_T_vio[:, 0, 0])] = fit
    return np.asarray((map_T_vio @ vio_T_cam)[:, :3, 3])


def _problems(scene: SceneInputs, frames: pd.DataFrame) -> list[Problem]:
    problems = [problem_of(scene.stopped)] if scene.stopped else []
    left_out = scene.rejects[scene.rejects["rejected"] == Rejected.RECORDING]
    for recording, why in left_out[["session_id", "reason"]].itertuples(index=False):
        problems.append(Problem(f"recording {recording} left out", None, why))
    checks = scene.align_checks[scene.align_checks["status"] != "passed"]
    for key, rows in checks.groupby(["status", "check", "reason", "advice"], sort=False):
        status, check, reason, advice = map(str, key)
        of = "".join(f", {session}" for session in rows["session_id"].unique() if session)
        problems.append(Problem(f"check {check} {status}{of}", int(rows["frames"].max()), reason, advice))
    for what, quality in (("no ground truth", QualityClass.NONE), ("class C", QualityClass.C)):
        of_class = frames[(frames["quality"] == quality) & (frames["reason"] != "")]
        reasons = pd.Series(grouped_reasons(list(of_class["reason"])), dtype=object)
        for why, count in reasons.value_counts().items():
            do = next((advice for words, advice in FRAME_ADVICE.items() if words in str(why)), "")
            problems.append(Problem(what, int(count), str(why), do))
    return problems


def problem_of(stopped: dict[str, Any]) -> Problem:
    """What stopped a stage, as its UserError says it in `what`, `where`, `expected`, `found` and `do`."""
    details = (f"{name}: {stopped[name].strip()}" for name in ("where", "expected", "found") if stopped.get(name))
    return Problem("the capture", None, _sentence(stopped["what"], "\n".join(details)), stopped.get("do") or "")


def _true_residuals(scene: SceneInputs) -> Array:
    """Errors (2, N) of the ground truth's positions, and of its rotations in degrees; NaN where there is none."""
    map_T_cam, true_T_cam = poses_of(scene.ground_truth, "map_cam"), scene.true_T_cam
    errors = np.full((2, len(map_T_cam)), np.nan)
    if true_T_cam is None or scene.unit is not MapUnit.METRE or not has_vertical(scene.ground_truth):
        return errors
    known = np.isfinite(map_T_cam).all(axis=(1, 2)) & np.isfinite(true_T_cam).all(axis=(1, 2))
    with contextlib.suppress(GeometryError):  # too few poses, or all in one place
        true_T_map = fit_yaw(true_T_cam[known, :3, 3], map_T_cam[known, :3, 3])
        metres, radians = pose_residuals(true_T_cam[known], map_T_cam[known], true_T_map)
        errors[:, known] = metres, np.degrees(radians)
    return errors


def _true_errors(scene: SceneInputs) -> TrueErrors | None:
    metres, degrees = _true_residuals(scene)
    stated = np.isfinite(metres) & scene.ground_truth["covariance"].notna().to_numpy(bool)
    if scene.true_T_cam is None or not stated.any():
        return None
    map_T_cam, true_T_cam = poses_of(scene.ground_truth, "map_cam")[stated], scene.true_T_cam[stated]
    covariance = np.stack(list(scene.ground_truth.loc[stated, "covariance"])).reshape(-1, 6, 6)
    true_T_map = fit_yaw(true_T_cam[:, :3, 3], map_T_cam[:, :3, 3])
    true_S_map = fit_sim3(true_T_cam[:, :3, 3], map_T_cam[:, :3, 3])
    # Both in the map's axes, in which the covariances are.
    within = within_bounds(map_T_cam, np.linalg.inv(true_T_map) @ true_T_cam, covariance)
    rotation_sd, position_sd = (np.sqrt(np.linalg.eigvalsh(covariance[:, p, p])[:, -1]) for p in _PARTS)
    up = true_S_map.rotation[:, 1]
    return TrueErrors(
        position=float(np.median(metres[stated])),
        position_stated=float(np.median(position_sd)),
        rotation_deg=float(np.median(degrees[stated])),
        rotation_stated_deg=float(np.degrees(np.median(rotation_sd))),
        position_within=100 * float(within[:, 0].mean()),
        rotation_within=100 * float(within[:, 1].mean()),
        scale=100 * abs(1 / float(true_S_map.scale) - 1),
        vertical_deg=float(np.degrees(np.arctan2(np.hypot(up[0], up[2]), up[1]))),
    )


def drift_by_distance(scene: SceneInputs) -> list[dict[str, float]]:
    """VIO's relative position error over travelled distances, all sessions together: metres, percent, samples."""
    is_by_distance = scene.drift["definition"] == DriftDefinition.DISTANCE_POSITION
    rows = scene.drift[is_by_distance & (scene.drift["session_id"] == "all")]
    names = {"interval": "distance_m", "median": "median_percent", "p95": "p95_percent", "samples": "samples"}
    return rows.sort_values("interval")[list(names)].rename(columns=names).to_dict("records")  # type: ignore[return-value]


def usual_drift(scene: SceneInputs) -> dict[str, float] | None:
    """The row of `drift_by_distance` that a first look shows: over about 5 m."""
    return min(drift_by_distance(scene), key=lambda row: abs(row["distance_m"] - 5), default=None)


def as_json(scene: SceneInputs, verdict: Verdict, localisers: list[LocaliserErrors]) -> dict[str, Any]:
    """The content of verdict.json: the headline, every localiser as the page's first screen has it, and every frame."""
    figures = scene.manifests["align"]["figures"] if "align" in scene.stages else {}
    trusted, (coverage, longest) = verdict.trusted, verdict.coverage()
    counts = verdict.frames["quality"].value_counts()
    headline = {
        "frames": len(verdict.frames),
        **{f"class_{name}": int(counts.get(name, 0)) for name in QualityClass},
        "trusted_share": len(trusted) / max(len(verdict.frames), 1),
        "position_sd_median": trusted["position_sd"].median(),
        "position_sd_p95": trusted["position_sd"].quantile(0.95),
        "rotation_sd_median_deg": trusted["rotation_sd_deg"].median(),
        "rotation_sd_p95_deg": trusted["rotation_sd_deg"].quantile(0.95),
        "path_covered": coverage,
        "longest_stretch_without_trusted_frame": longest,
        **{name: figures.get(name) for name in ("scale_source", "scale_sd", "vertical_source", "vertical_sd_deg")},
        "vio_jumps": len(scene.jumps),
    }
    per_frame = verdict.frames.drop(columns=["true_error"] if scene.true_T_cam is None else [])
    return {
        "scene": scene.name,
        "captures": "simulated" if scene.simulated else "real",
        "verdict": verdict.state.value,
        "why": verdict.why,
        "length_unit": scene.unit.symbol,
        "headline": _plain(headline),
        "localisers": [_localiser(of) for of in localisers],
        "true_errors": None if verdict.true_errors is None else _plain(vars(verdict.true_errors)),
        "vio_error_by_distance": [_plain(row) for row in drift_by_distance(scene)],
        "problems": [vars(problem) for problem in verdict.problems],
        "frames": [_plain(row) for row in per_frame.to_dict("records")],
    }


def _localiser(of: LocaliserErrors) -> dict[str, Any]:
    texts = of.position, of.rotation, of.coverage
    position, rotation, coverage = (None if text == EMPTY else float(text) for text in texts)
    return {
        "localiser": of.name,
        "model": of.model,
        "kind": "structure localiser" if of.is_structure else "regressor",
        "fused": of.is_fused,
        "frames": of.frames,
        "median_position": position,
        "median_rotation_deg": rotation,
        "coverage": coverage,
    }


def _plain(row: dict[Any, Any]) -> dict[str, Any]:
    """Values as JSON has them, six digits of a fraction; what isn't known is null."""

    def plain(value: Any) -> Any:
        if isinstance(value, float | np.floating):
            return float(f"{value:.6g}") if np.isfinite(value) else None
        return value.item() if isinstance(value, np.generic) else value

    return {str(name): plain(value) for name, value in row.items()}
