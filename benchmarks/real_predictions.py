"""Published predictions of real regressors as walks for the fusion benchmark.

Read are folders laid out as HR-APR's (github.com/lck666666/HR-APR): `<model>/<data set>/<scene>_predict.txt` and
`<scene>_test_gt.txt`, a line a frame of `<sequence>/<frame> x y z qw qx qy qz`, the pose of the camera in the scene,
with the camera's y axis up and z axis back.

The files say neither which way is up nor what odometry saw. Up is what the true cameras' x axes are square to, as
people hold a camera level. Odometry is made from the true poses with the drift of
docs/explanation/vio-drift.md: simulated.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.fusion_inputs import Case, Track, drifting_odometry, predicted_walk
from groundwalk.geometry.fits import rotation_to_up
from groundwalk.geometry.poses import Array, make_pose, pose_from_tq
from groundwalk.store import UserError

REAL = "real"
DEVELOPMENT = ("chess", "fire", "office", "KingsCollege")
# Which frames of a sequence are a second apart: 7-Scenes has 30 a second, Cambridge Landmarks one or two.
STRIDES = {"7Scenes": 30, "Cambridge": 1}
_TO_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def real_cases(
    folder: Path, scenes: Sequence[str], seeds: Sequence[int], strides: Mapping[str, int] = STRIDES
) -> list[Case]:
    """A case for each scene and model: every test sequence is a walk, each seed another phone's odometry."""
    cases = []
    for scene in scenes:
        files = sorted(folder.glob(f"*/*/{scene}_predict.txt"))
        if not files:
            raise UserError(
                f"there are no predictions for {scene}",
                where=str(folder),
                expected=f"<model>/<data set>/{scene}_predict.txt",
            )
        cases += [_case(file, scene, seeds, strides) for file in files]
    return cases


def _case(file: Path, scene: str, seeds: Sequence[int], strides: Mapping[str, int]) -> Case:
    model, data_set = file.parent.parent.name, file.parent.name
    if data_set not in strides:
        raise UserError(f"data set {data_set!r} isn't known", where=str(file), expected=" or ".join(strides))
    names, predicted = read_poses(file)
    true_names, truth = read_poses(file.with_name(f"{scene}_test_gt.txt"))
    if names != true_names:
        raise UserError("predictions and ground truth aren't of the same frames", where=str(file))
    up_T_map = make_pose(rotation_to_up(_up(truth)), np.zeros(3))
    predicted, truth = up_T_map @ predicted @ _TO_OPENCV, up_T_map @ truth @ _TO_OPENCV
    walks = []
    for seed in seeds:
        for sequence, rows in _sequences(names).items():
            kept = rows[:: strides[data_set]]
            t_ns = np.arange(len(kept), dtype=np.int64) * 10**9
            vio = drifting_odometry(t_ns, truth[kept], "real", scene, sequence, seed)
            track = Track(f"{sequence}~{seed}", t_ns, truth[kept], vio)
            walks.append(predicted_walk(scene, track, predicted[kept]))
    return Case(REAL, scene, model, tuple(walks))


def read_poses(file: Path) -> tuple[list[str], Array]:
    """Names and poses (N, 4, 4) of a file's frames. UserError for a missing file or a line of another form."""
    if not file.is_file():
        raise UserError("a file of poses is missing", where=str(file))
    names, numbers = [], []
    for count, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        name, *values = line.split()
        try:
            x, y, z, qw, qx, qy, qz = (float(v) for v in values)
        except ValueError:
            raise UserError(
                "a line isn't a pose", where=f"{file}:{count}", expected="name x y z qw qx qy qz", found=line
            ) from None
        names.append(name)
        numbers.append([x, y, z, qx, qy, qz, qw])
    table = np.array(numbers)
    return names, pose_from_tq(table[:, :3], table[:, 3:])


def _up(map_T_cam: Array) -> Array:
    """The unit vector (3,) that the cameras' x axes are most nearly square to, on the side of their y axes."""
    sideways = map_T_cam[:, :3, 0]
    axis = np.linalg.eigh(sideways.T @ sideways)[1][:, 0]
    return np.asarray(axis * np.sign(axis @ map_T_cam[:, :3, 1].mean(axis=0)))


def _sequences(names: Sequence[str]) -> dict[str, NDArray[np.int64]]:
    """Rows of each sequence, in the order of their frames' names."""
    of = np.array([name.split("/")[0] for name in names])
    order = np.argsort(np.array(names), kind="stable")
    return {str(s): order[of[order] == s] for s in dict.fromkeys(of.tolist())}
