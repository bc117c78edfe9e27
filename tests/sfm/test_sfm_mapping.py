from pathlib import Path

import numpy as np
import pycolmap

from sfm.mapping import adjust_robustly
from sfm.model import load_models


def test_points_behind_a_camera_are_taken_out(tmp_path: Path) -> None:
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(num_rigs=6, num_cameras_per_rig=1, num_frames_per_rig=1, num_points3D=60)
    model = pycolmap.synthesize_dataset(options)
    behind, image_id = next((p, t.image_id) for p, point in model.points3D.items() for t in point.track.elements)
    centre = model.image(image_id).projection_center()
    model.point3D(behind).xyz = 2 * centre - model.point3D(behind).xyz

    loss_px = adjust_robustly(model, tmp_path, 6)

    model.write_binary(tmp_path)
    left = load_models([tmp_path], 6)
    assert np.isfinite(loss_px) and np.isfinite(left.residual_px).all() and np.isfinite(left.point_error_px()).all()
    assert left.registered.all() and len(left.xyz) >= 59
