"""Simulated scenes up to import, and their ground truth against the truth."""

import sys

import numpy as np
import pandas as pd

from benchmarks.cost import Cost, measure
from groundwalk.alignment.check_truth import TruthTarget, truth_targets
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_sim3, pose_residuals
from groundwalk.geometry.poses import Array
from groundwalk.store import DataRoot
from groundwalk.store.choices import QualityClass
from groundwalk.store.manifests import load_manifest
from groundwalk.store.tables import poses_of, table_of
from groundwalk.store.true_poses import true_poses_of

PROFILE = "demo"


def run_stage(module: str, scene: str, root: DataRoot, *settings: str, anew: bool = False) -> Cost:
    """Run a stage of a scene as a process of its own, `anew` even if it's up to date; what it cost."""
    sets = [word for setting in settings for word in ("--set", setting)]
    arguments = ["--scene", scene, "--profile", PROFILE, "--data", str(root.root), *sets, *["--force"] * anew]
    return measure([sys.executable, "-m", f"groundwalk.{module}", *arguments], root.run(PROFILE, scene, module))


def simulated(scene: str, root: DataRoot, *settings: str) -> None:
    """A simulated scene up to import."""
    run_stage("simulation", scene, root, *settings)
    run_stage("capture_import", scene, root)


def true_poses(scene: str, root: DataRoot) -> Array:
    """The true map_T_cam (N, 4, 4) of the frames of an imported simulated scene."""
    return true_poses_of(table_of(root.run(PROFILE, scene), "import", "frames"), scene, PROFILE, root)


def ground_truth_targets(
    scene: str, root: DataRoot, profile: str = PROFILE
) -> tuple[pd.DataFrame, list[TruthTarget], int]:
    """The ground truth of a simulated scene, how it compares with the truth, and how many frames its bounds are
    about."""
    run = root.run(profile, scene)
    gt, figures = table_of(run, "align", "ground_truth"), load_manifest(run / "align")["figures"]
    return gt, *truth_targets(gt, true_poses_of(gt, scene, profile, root), figures)


def ground_truth_errors(gt: pd.DataFrame, scene: str, root: DataRoot, profile: str) -> Array:
    """Position errors of a simulated scene's ground truth, metres."""
    has_pose = (gt["quality"] != QualityClass.NONE).to_numpy()
    one_map = np.zeros(np.count_nonzero(has_pose), np.int64)
    true_T_cam = true_poses_of(gt, scene, profile, root)[has_pose]
    return errors_after_sim3(poses_of(gt, "map_cam")[has_pose], one_map, true_T_cam)[0]


def errors_after_sim3(sfm_T_cam: Array, model_N: np.ndarray, true_T_cam: Array) -> tuple[Array, Array]:
    """Errors in metres and degrees of registered frames, each model (`model_N`, -1 for none) fitted to the truth alone.

    Models of fewer than three frames, or of frames on a line, can't be fitted and don't count.
    """
    metres, degrees = [np.empty(0)], [np.empty(0)]
    for number in range(int(model_N.max(initial=-1)) + 1):
        of_model = model_N == number
        try:
            fit = fit_sim3(true_T_cam[of_model, :3, 3], sfm_T_cam[of_model, :3, 3])
        except GeometryError:
            continue
        error_m, error_rad = pose_residuals(true_T_cam[of_model], fit.poses(sfm_T_cam[of_model]), np.eye(4))
        metres.append(error_m)
        degrees.append(np.degrees(error_rad))
    return np.concatenate(metres), np.concatenate(degrees)
