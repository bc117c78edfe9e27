"""Nothing of a test image is in a map: without the test images' files it's the same, byte for byte."""

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.artefacts import UserError
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.tables import pose_frame, pose_prefixes, write_table
from groundwalk.geometry.poses import make_pose
from groundwalk.localisation.build import build_map
from groundwalk.localisation.compact import write_map
from groundwalk.localisation.inputs import grey, read_features, read_inputs, training_of
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.settings import MapSettings
from groundwalk.scoring.errors import position_error

COUNT, FOCAL = 14, 300.0
TEST = np.arange(COUNT) % 5 == 2
SETTINGS = MapSettings(max_features=300, pairs_per_frame=5, max_points=400)
DEFAULTS = {"float64": 0.0, "int64": 0, "bool": False, "string": "", "list<float64>": [], "list<string>": []}


def filled(stage, table, count, **columns):
    of = schema(stage, table)
    values = {c.name: [None if c.nullable else DEFAULTS[c.dtype]] * count for c in of.columns}
    values |= {f"{prefix}_qw": [1.0] * count for prefix in pose_prefixes(of)}
    return pd.DataFrame(values, dtype=object).assign(**columns)


def write(run, stage, table, frame):
    (run / stage).mkdir(parents=True, exist_ok=True)
    write_table(run / stage / f"{table}.parquet", frame, schema(stage, table))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Pictures of a blotchy board and a second one behind it, and a run with their poses."""
    root = tmp_path_factory.mktemp("scene")
    rng = np.random.default_rng(0)
    boards = [
        cv2.resize(rng.integers(0, 255, (50, 70), np.uint8), (700, 500), interpolation=cv2.INTER_CUBIC) for _ in "ab"
    ]
    down = np.diag([1.0, -1.0, -1.0])
    poses = make_pose(
        np.tile(down, (COUNT, 1, 1)),
        np.stack(
            [np.linspace(-0.6, 0.6, COUNT), 0.1 * rng.standard_normal(COUNT), 3 + 0.1 * rng.standard_normal(COUNT)], 1
        ),
    )
    (root / "captures").mkdir()
    camera = {"width": 320, "height": 240, "fx": FOCAL, "fy": FOCAL, "cx": 160.0, "cy": 120.0}
    names = [f"{row}.png" for row in range(COUNT)]
    for pose, name in zip(poses, names, strict=True):
        cv2.imwrite(str(root / "captures" / name), picture(boards, pose))
    ids = [f"walk/{row:06d}" for row in range(COUNT)]
    split = np.where(TEST, "test", "train").tolist()
    keys = {"frame_id": ids, "session_id": "walk", "t_ns": list(range(COUNT)), "split": split}
    down_in_cam = {"gravity_x": 0.0, "gravity_y": 1.0, "gravity_z": 0.0}
    run = root / "run"
    write(run, "import", "frames", filled("import", "frames", COUNT, **keys, image=names, **camera, **down_in_cam))
    write(run, "import", "vio", filled("import", "vio", 0))
    write(run, "sfm", "images", filled("sfm", "images", COUNT, frame_id=ids, readout_s=0.0))
    known = {name: camera[name] for name in ("fx", "fy", "cx", "cy")}
    truth = filled("align", "ground_truth", COUNT, **keys, **pose_frame("map_cam", poses), **known, quality="A")
    write(run, "align", "ground_truth", truth)
    return root


def picture(boards, pose):
    """What a pinhole sees of boards at z = 0 and, left of it, at z = -0.7."""
    shown = np.full((240, 320), 128, np.uint8)
    for board, z, x in ((boards[1], -0.7, -2.0), (boards[0], 0.0, -0.7)):
        to_cam = pose[:3, :3].T
        # Board pixels are 5 mm.
        plane = np.array([[0.005, 0, x], [0, -0.005, 1.25], [0, 0, 0.0]]) - np.outer([0, 0, 1], [0, 0, -z])
        plane = to_cam @ (plane - np.outer(pose[:3, 3], [0, 0, 1]))
        # OpenCV's pixel centres are whole numbers.
        k = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
        shown = cv2.warpPerspective(board, k @ plane, (320, 240), shown, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT)
    return shown


def map_bytes(root):
    inputs = read_inputs(root / "run")
    rows = np.flatnonzero((inputs.frames["split"] != "test").to_numpy())
    features = read_features(inputs, rows, root / "captures", root / "run" / "import", SETTINGS)
    content = build_map("boards", training_of(inputs, rows, features), SETTINGS)[0]
    write_map(root / "map.gwmap", content)
    return content, (root / "map.gwmap").read_bytes()


def test_the_map_is_the_same_without_the_test_images_and_localises_them(scene):
    inputs = read_inputs(scene / "run")
    content, with_all = map_bytes(scene)
    localiser = MapLocaliser(content)
    images = [scene / "captures" / name for name in inputs.frames["image"]]
    for row in np.flatnonzero(TEST):
        answer = localiser.localise(grey(images[row]), inputs.logged[row], inputs.gravity[row])
        assert answer.map_T_cam is not None, answer.reason
        assert position_error(answer.map_T_cam, inputs.views.map_T_cam[row]) < 0.02
    for row in np.flatnonzero(TEST):
        images[row].unlink()
    assert map_bytes(scene)[1] == with_all
    images[0].unlink()
    with pytest.raises(UserError, match="image can't be read"):
        map_bytes(scene)
