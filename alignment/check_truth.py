"""`python -m groundwalk.alignment check-truth`: a simulated scene's ground truth against the simulator's poses.

A check for people and benchmarks: no stage reads the true poses.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from groundwalk.alignment.uncertainty import SharedSd, shared_covariance
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_sim3, fit_yaw, pose_residuals
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import within_bounds
from groundwalk.store import UserError
from groundwalk.store.choices import QualityClass
from groundwalk.store.cli import DataOption, ProfileOption
from groundwalk.store.manifests import load_manifest
from groundwalk.store.settings import DataRoot
from groundwalk.store.tables import poses_of, table_of
from groundwalk.store.true_poses import true_poses_of


@dataclass(frozen=True)
class TruthTarget:
    """One line of the check: a value, between `minimum` and `maximum`, and its unit."""

    name: str
    value: float
    unit: str
    maximum: float
    minimum: float = 0.0

    @property
    def is_met(self) -> bool:
        return self.minimum <= self.value <= self.maximum

    @property
    def limits(self) -> str:
        """In words."""
        if not self.minimum:
            return f"≤ {self.maximum:g} {self.unit}"
        return f"≥ {self.minimum:g}{f' to {self.maximum:g}' if self.maximum < 100 else ''} {self.unit}"


def compare_with_truth(map_T_cam: Array, true_T_cam: Array, frames: int) -> list[TruthTarget]:
    """The targets for poses (N, 4, 4) with ground truth, out of `frames`, and the true poses of the same frames.

    Position and rotation errors are after one similarity fit (Umeyama). Scale and vertical are the map's own: what
    that fit had to correct, without the heading, which is free. Raises GeometryError where there are too few poses.
    """
    true_S_map = fit_sim3(true_T_cam[:, :3, 3], map_T_cam[:, :3, 3])
    metres, radians = pose_residuals(true_T_cam, true_S_map.poses(map_T_cam), np.eye(4))
    degrees = np.degrees(radians)
    up_in_true = true_S_map.rotation[:, 1]
    tilt_deg = float(np.degrees(np.arctan2(np.hypot(up_in_true[0], up_in_true[2]), up_in_true[1])))
    return [
        TruthTarget("frames with ground truth", 100 * len(map_T_cam) / frames, "%", 100.0, minimum=98.0),
        TruthTarget("position error, median", 100 * float(np.median(metres)), "cm", 2.0),
        TruthTarget("position error, 95th percentile", 100 * float(np.percentile(metres, 95)), "cm", 5.0),
        TruthTarget("rotation error, median", float(np.median(degrees)), "deg", 0.1),
        TruthTarget("rotation error, 95th percentile", float(np.percentile(degrees, 95)), "deg", 0.3),
        # The map is too large where truth must be shrunk onto it.
        TruthTarget("metric scale error", 100 * abs(1 / true_S_map.scale - 1), "%", 0.5),
        TruthTarget("vertical error", tilt_deg, "deg", 0.2),
    ]


def compare_with_bounds(map_T_cam: Array, true_T_cam: Array, covariance: Array, shared: SharedSd) -> list[TruthTarget]:
    """How many frames lie within their 95 % bounds; poses (N, 4, 4), covariances (N, 6, 6) as align gives them.

    SfM's part is compared after what all frames share has been fitted: a similarity, and one turn of all cameras in
    their axes. The whole is compared after what is free has been fitted, heading and origin; what frames share is one
    draw, so it has no upper limit.
    """
    xyz = map_T_cam[:, :3, 3]
    of_sfm = covariance - shared_covariance(map_T_cam, xyz.mean(axis=0), shared)
    true_S_map = fit_sim3(true_T_cam[:, :3, 3], xyz)
    true_T_map = fit_yaw(true_T_cam[:, :3, 3], xyz)
    similar = true_S_map.poses(map_T_cam)
    turns = Rotation.from_matrix(np.swapaxes(similar[:, :3, :3], 1, 2) @ true_T_cam[:, :3, :3])
    similar[:, :3, :3] = similar[:, :3, :3] @ turns.mean().as_matrix()
    parts = {
        "SfM's part": (similar, true_S_map.rotation, of_sfm, 98.0),
        "whole": (true_T_map @ map_T_cam, true_T_map[:3, :3], covariance, 100.0),
    }
    targets = []
    for part, (placed, turn, stated, maximum) in parts.items():
        both = block_diag(turn, turn)
        shares = within_bounds(placed, true_T_cam, both @ stated @ both.T).mean(axis=0)
        for name, within in zip(("position", "rotation"), (100 * shares).tolist(), strict=True):
            targets.append(TruthTarget(f"{name} within 95 % bounds, {part}", within, "%", maximum, minimum=90.0))
    return targets


def truth_targets(gt: pd.DataFrame, true_T_cam: Array, figures: dict[str, Any]) -> tuple[list[TruthTarget], int]:
    """The targets for align.ground_truth (N rows), and how many frames their bounds are about; `true_T_cam` (N, 4, 4),
    `figures` of align's manifest. Without a metric scale or a vertical there are no bounds. Raises GeometryError where
    there are too few poses."""
    has_pose = (gt["quality"] != QualityClass.NONE).to_numpy()
    if (missing := int(np.isnan(true_T_cam[has_pose, 0, 0]).sum())) > 0:
        raise UserError(
            "some frames have no true pose",
            where="true_poses.parquet of the capture",
            expected="a row for each frame's session and time",
            found=f"{missing} of {len(gt)} frames without one",
            do="import and align the captures that these true poses belong to",
        )
    map_T_cam, true_T_cam, covariance = poses_of(gt, "map_cam")[has_pose], true_T_cam[has_pose], gt["covariance"]
    targets = compare_with_truth(map_T_cam, true_T_cam, len(gt))
    # The manifest has scale and vertical of the first model only.
    has_bounds = (covariance.notna() & (gt["component"] == 0)).to_numpy()[has_pose]
    if not has_bounds.any() or None in (figures["scale_sd"], figures["vertical_sd_deg"]):
        return targets, 0
    stated = np.stack(list(covariance[has_pose][has_bounds])).reshape(-1, 6, 6)
    vertical, camera = (float(np.radians(figures[name])) for name in ("vertical_sd_deg", "camera_sd_deg"))
    shared = SharedSd(figures["scale_sd"], vertical, camera)
    bounds = compare_with_bounds(map_T_cam[has_bounds], true_T_cam[has_bounds], stated, shared)
    return targets + bounds, int(has_bounds.sum())


def check_truth(
    scene: Annotated[str, typer.Option(help="A simulated scene.")],
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Compare a simulated scene's ground truth with its true poses; exits with 1 where a target is missed."""
    root = DataRoot(data)
    gt = table_of(root.run(profile, scene), "align", "ground_truth")
    figures = load_manifest(root.run(profile, scene, "align"))["figures"]
    if figures["scale_sd"] is None:
        found, do = "scale_source none in align's manifest", "simulate longer walks"
        raise UserError("the map has no metric scale to compare with the truth", found=found, do=do)
    try:
        targets, _ = truth_targets(gt, true_poses_of(gt, scene, profile, root), figures)
    except GeometryError as error:
        raise UserError("too little ground truth to compare", where=scene, found=error) from None
    count = int((gt["quality"] != QualityClass.NONE).sum())
    typer.echo(f"{scene}, {profile}: {count} of {len(gt)} frames against the truth")
    for target in targets:
        status = "ok" if target.is_met else "missed"
        typer.echo(f"{status:>6}  {target.name}: {target.value:.3f} {target.unit} ({target.limits})")
    if not all(target.is_met for target in targets):
        raise typer.Exit(1)
