"""Ground truth that walks are added to or taken out of, on synthetic walks."""

from pathlib import Path

import numpy as np
import pytest

from groundwalk.alignment import held
from groundwalk.alignment.check_models import check_models
from groundwalk.alignment.ground_truth import AlignResult, build
from groundwalk.alignment.settings import AlignSettings
from groundwalk.geometry.fits import Sim3, fit_sim3
from groundwalk.scoring.errors import position_error
from groundwalk.store.files import write_json
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of, write_table
from tests.known import there
from tests.synthetic_walks import Scene, Walks, align

SETTINGS = AlignSettings()


def written(scene: Scene, folder: Path) -> Path:
    """What later runs read of a scene's finished ground truth."""
    aligned = align(scene.inputs(), SETTINGS)
    scale, vertical = aligned.main.component.scale, aligned.main.component.vertical
    figures = {"metres_per_sfm_unit": aligned.main.map_S_sfm.scale, "scale_sd": scale.sd}
    figures["vertical_sd_deg"] = float(np.degrees(vertical.sd))
    write_table(folder / "ground_truth.parquet", aligned.ground_truth, schema("align", "ground_truth"))
    write_json(folder / "manifest.json", {"outputs": {}, "simulated": True, "figures": figures})
    return folder


def changed(scene: Scene, before: Path) -> AlignResult:
    """The ground truth of a scene in the map of the artefact `before`."""
    inputs = scene.inputs(numbers=held.model_numbers(scene.images, before))
    checked = held.in_map_before(check_models(inputs, SETTINGS), scene.frames, scene.images, before)
    return held.with_rows_before(build(scene.frames, scene.images, checked, None), before)


@pytest.mark.parametrize(("there_before", "now"), [([0, 1], [0, 1, 2]), ([0, 1], [0, 2])], ids=["added", "exchanged"])
def test_a_walk_added_to_a_smaller_model_is_where_that_lies_in_the_map(
    walks: Walks, tmp_path: Path, there_before: list[int], now: list[int]
) -> None:
    scene, number = walks.make(), np.arange(180) // 60
    # The first walk's end and all of the third are in a second model, which the third makes the largest.
    second = (number == 2) | ((number == 0) & (np.arange(180) >= 40))
    sfm_T_cam = poses_of(scene.images, "sfm_cam")
    sfm_T_cam[second] = Sim3(5.0, np.eye(3), np.array([1.0, 2, 3])).poses(sfm_T_cam[second])
    scene.set_sfm(sfm_T_cam)
    scene.images["model_id"] = np.where(second, "incremental/1", "incremental/0")
    before = written(scene.part(np.flatnonzero(np.isin(number, there_before))), tmp_path)
    scene = scene.part(np.flatnonzero(np.isin(number, now)))
    truth = changed(scene, before).ground_truth
    gt, is_old = poses_of(truth, "map_cam"), truth["session_id"].isin([f"walk{k}" for k in there_before]).to_numpy()
    true_S_map = fit_sim3(scene.true_T_cam[is_old, :3, 3], gt[is_old, :3, 3])
    assert position_error(true_S_map.poses(gt), scene.true_T_cam).max() < 1e-8
    added = truth[~is_old]
    assert (added["component"] == 1).all() and added["gt_uses_vio"].all()


def test_a_walk_that_vio_contradicts_is_refused_by_its_own_frames(walks: Walks, tmp_path: Path) -> None:
    scene, drifting = walks.make(sessions=2), walks.make(sessions=2, drift_m=0.35)
    before = written(scene.part(np.arange(60)), tmp_path)
    vio_T_cam = poses_of(scene.frames, "vio_cam")
    vio_T_cam[60:] = poses_of(drifting.frames, "vio_cam")[60:]
    scene.set_vio(vio_T_cam)
    settings = AlignSettings(min_consistent_fraction=0.95)
    checked = held.in_map_before(check_models(scene.inputs(), settings), scene.frames, scene.images, before)
    error = there(held.refusal_of_added(checked, scene.frames, settings, before))
    assert error.details["where"].startswith("worst from walk1/") and " to walk1/" in error.details["where"]
