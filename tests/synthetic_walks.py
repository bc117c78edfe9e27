"""Walks with known truth: SfM in a gauge of its own, VIO with drift, as the tables that the stage reads."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.alignment.check_models import AlignInputs, check_models, refusal
from groundwalk.alignment.ground_truth import AlignResult, build
from groundwalk.alignment.rulers.scale_check import check_rulers
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables
from groundwalk.alignment.uncertainty import covariance_in_map
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import make_pose, yaw_rotation
from groundwalk.store import DataRoot
from groundwalk.store.files import write_json
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame, poses_of, write_table
from tests.known import cells, filled


@dataclass(frozen=True)
class Walks:
    """Settings of a synthetic scene; the defaults are noise-free."""

    seed: int = 0
    sessions: int = 3
    frames: int = 60
    speed_m: float = 1.2
    """metres between frames, which are a second apart"""
    sfm_m: float = 0.0
    sfm_deg: float = 0.0
    drift_m: float = 0.0
    """random walk of VIO's position, metres in each axis over one metre walked"""
    drift_yaw_deg: float = 0.0
    """random walk of VIO's yaw over one metre walked"""
    jitter_m: float = 0.0
    phone_scale: float = 0.0
    """one sigma of each session's VIO scale"""
    phone_tilt_deg: float = 0.0
    """one sigma of each session's gravity error, per axis"""
    gauge: Sim3 = field(
        default_factory=lambda: Sim3(
            0.37, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -7.0, 1.0])
        )
    )

    def make(self, **changes: Any) -> "Scene":
        return _make(replace(self, **changes))


@dataclass
class Scene:
    """The stage's inputs, and the truth: map_T_cam (N, 4, 4) in the true map."""

    frames: pd.DataFrame
    images: pd.DataFrame
    jumps: pd.DataFrame
    true_T_cam: np.ndarray
    phone_scales: np.ndarray
    intrinsics: pd.DataFrame = field(
        default_factory=lambda: pd.DataFrame(columns=schema("sfm", "intrinsics").column_names)
    )
    pairs: pd.DataFrame = field(default_factory=lambda: pd.DataFrame(columns=schema("sfm", "pairs").column_names))

    @property
    def sfm(self) -> SfmTables:
        return SfmTables.of(self.frames, self.images, self.intrinsics, self.pairs)

    @property
    def recordings(self) -> dict[str, str]:
        return {s: s for s in self.frames["session_id"]}

    def inputs(self, **changes: Any) -> AlignInputs:
        """What the alignment works on."""
        tables: dict[str, Any] = {
            "frames": self.frames,
            "sfm": self.sfm,
            "jumps": self.jumps,
            "recordings": self.recordings,
        }
        return AlignInputs(**tables | changes)

    def in_gauge(self, other_S_sfm: Sim3) -> "Scene":
        """The same scene with SfM's poses and covariances in another gauge."""
        images = self.images.copy()
        poses = other_S_sfm.poses(poses_of(images, "sfm_cam"))
        images[pose_frame("sfm_cam", poses).columns] = pose_frame("sfm_cam", poses)
        images["covariance"] = cells(
            None if c is None else covariance_in_map(np.reshape(c, (1, 6, 6)), other_S_sfm).ravel().tolist()
            for c in images["covariance"]
        )
        return replace(self, images=images)

    def part(self, rows: np.ndarray) -> "Scene":
        """The same scene with some of its frames, in this order."""
        frames, images = (table.iloc[rows].reset_index(drop=True) for table in (self.frames, self.images))
        return replace(self, frames=frames, images=images, true_T_cam=self.true_T_cam[rows])

    def set_sfm(self, sfm_T_cam: np.ndarray) -> None:
        table = pose_frame("sfm_cam", sfm_T_cam)
        self.images[table.columns] = table

    def set_focal(self, session_id: str, scale: float, sd: float) -> None:
        """What the images of the first model say of a session's focal length: its factor and standard error."""
        row = {"model_id": "incremental/0", "session_id": session_id, "frames": 1, "focal_scale": scale}
        row |= {"focal_scale_sd": sd, "focus_sd": 0.001, "angular_sd": 0.02}
        self.intrinsics = pd.DataFrame([*self.intrinsics.to_dict("records"), row])

    def set_vio(self, vio_T_cam: np.ndarray) -> None:
        table = pose_frame("vio_cam", vio_T_cam)
        self.frames[table.columns] = table


def align(inputs: AlignInputs, settings: AlignSettings) -> AlignResult:
    """The whole alignment; UserError where it gives no ground truth."""
    checked = check_models(inputs, settings)
    rulers = check_rulers(checked.components, inputs.rulers, settings.max_ruler_size_error)
    checked = replace(checked, checks=[*checked.checks, *(ruler.result for ruler in rulers)])
    error = refusal(checked, inputs.frames, settings)
    if error is not None:
        raise error
    return build(inputs.frames, inputs.sfm.images, checked, inputs.reference)


def _walk(rng: np.random.Generator, w: Walks) -> np.ndarray:
    """Smooth path in the plane with a little height, looking ahead and around."""
    turn = np.cumsum(rng.normal(0, 0.15, w.frames)) + rng.uniform(-np.pi, np.pi)
    step = w.speed_m * np.stack([np.cos(turn), np.zeros_like(turn), np.sin(turn)], axis=1)
    xyz = rng.normal(0, 8, 3) * [1, 0, 1] + np.cumsum(step, axis=0)
    xyz[:, 1] = 1.6 + 0.05 * np.sin(np.arange(w.frames)) * min(1.0, w.speed_m)
    yaw = -turn + 0.5 * np.sin(np.arange(w.frames) / 5)
    pitch = 0.2 * np.sin(np.arange(w.frames) / 3 + rng.uniform(0, 6))
    level = yaw_rotation(yaw) @ np.diag([1.0, -1.0, -1.0])
    return make_pose(level @ Rotation.from_euler("x", pitch[:, None]).as_matrix(), xyz)


def _vio(rng: np.random.Generator, w: Walks, true_T_cam: np.ndarray, scale: float) -> np.ndarray:
    tilt = Rotation.from_rotvec(np.radians(w.phone_tilt_deg) * rng.normal(size=3) * [1, 0, 1]).as_matrix()
    vio_T_true = make_pose(tilt @ yaw_rotation(rng.uniform(-np.pi, np.pi)), rng.normal(0, 5, 3))
    path = scale * true_T_cam[:, :3, 3]
    steps = np.diff(path, axis=0)
    length = np.linalg.norm(steps, axis=1)
    yaw = np.radians(w.drift_yaw_deg) * np.cumsum(np.sqrt(length) * rng.normal(size=len(length)))
    bent = yaw_rotation(yaw)
    steps = np.einsum("nij,nj->ni", bent, steps)
    steps += w.drift_m * np.sqrt(length)[:, None] * rng.normal(size=steps.shape)
    xyz = np.concatenate([path[:1], path[0] + np.cumsum(steps, axis=0)])
    rotation = np.concatenate([np.eye(3)[None], bent]) @ true_T_cam[:, :3, :3]
    return vio_T_true @ make_pose(rotation, xyz + w.jitter_m * rng.normal(size=xyz.shape))


def _make(w: Walks) -> Scene:
    rng = np.random.default_rng(w.seed)
    scales = 1 + w.phone_scale * rng.normal(size=w.sessions)
    frames, true = [], []
    for number in range(w.sessions):
        true_T_cam = _walk(rng, w)
        vio_T_cam = _vio(rng, w, true_T_cam, scales[number])
        gravity = -np.swapaxes(vio_T_cam[:, :3, :3], 1, 2)[:, :, 1]
        name = f"walk{number}"
        table = pd.DataFrame(
            {
                "frame_id": [f"{name}/{i:06d}" for i in range(w.frames)],
                "session_id": name,
                "image": [f"{name}/{i:06d}.jpg" for i in range(w.frames)],
                "split": "test" if number == w.sessions - 1 else "train",
                "t_ns": 10**12 * (number + 1) + 10**9 * np.arange(w.frames),
                "tracking": "normal",
                "fx": 1400.0,
                "focal_sd": 0.0,
                "width": 1920,
                "height": 1440,
                "first_row": "top",
                "support": False,
                **{f"gravity_{axis}": gravity[:, i] for i, axis in enumerate("xyz")},
            }
        )
        frames.append(pd.concat([table, pose_frame("vio_cam", vio_T_cam)], axis=1))
        true.append(true_T_cam)
    table, true_T_cam = pd.concat(frames, ignore_index=True), np.concatenate(true)
    sigma = np.concatenate([np.full(3, np.radians(max(w.sfm_deg, 0.01))), np.full(3, max(w.sfm_m, 0.001))])
    error = Rotation.from_rotvec(np.radians(w.sfm_deg) * rng.normal(size=(len(true_T_cam), 3))).as_matrix()
    seen = make_pose(
        error @ true_T_cam[:, :3, :3], true_T_cam[:, :3, 3] + w.sfm_m * rng.normal(size=(len(true_T_cam), 3))
    )
    images = pd.DataFrame(
        {
            "frame_id": table["frame_id"],
            "registered": True,
            "not_registered": None,
            "model_id": "incremental/0",
            "observations": 500,
            "reprojection_px": 0.8,
            "covariance": [np.diag(sigma**2).ravel().tolist()] * len(table),
            **{"fx": 1400.0, "fy": 1400.0, "cx": 960.0, "cy": 720.0, "distortion": [[]] * len(table)},
            "camera_origin": "prior",
            "readout_s": 0.0,
            **{f"{name}_{axis}": 0.0 for name in ("angular", "velocity") for axis in "xyz"},
        }
    )
    scene = Scene(
        table,
        pd.concat([images, pose_frame("sfm_cam", seen)], axis=1),
        pd.DataFrame({"session_id": [], "t_ns": [], "jump_m": [], "jump_deg": []}).astype({"session_id": str}),
        true_T_cam,
        scales,
    )
    return scene.in_gauge(w.gauge)


@pytest.fixture(scope="session")
def walks() -> Walks:
    """Settings of synthetic walks; `walks.make(seed=3, ...)` gives a scene."""
    return Walks()


def write_artefact(data: DataRoot, stage: str, tables: dict[str, pd.DataFrame]) -> None:
    folder = data.run("tiny", "Place", stage)
    folder.mkdir(parents=True)
    for name, table in tables.items():
        write_table(folder / f"{name}.parquet", table, schema(stage, name))
    write_json(folder / "manifest.json", {"outputs": {}, "simulated": True})


def make_place(walks: Walks, root: DataRoot) -> None:
    """Artefacts of two synthetic walks, and their true poses."""
    scene = walks.make(sessions=2, frames=20, sfm_m=0.005, sfm_deg=0.02, drift_m=0.005)
    frames = filled("import", "frames", len(scene.frames), **scene.frames, cx=960.0, cy=720.0, fy=1400.0)
    names = pd.DataFrame({"session_id": list(scene.recordings), "recording": list(scene.recordings)})
    jumps = scene.jumps.assign(dt_s=0.1, splits=False).astype({"t_ns": "int64", "splits": bool})
    sessions, reference = filled("import", "sessions", len(names), **names), filled("import", "reference", 0)
    write_artefact(root, "import", {"frames": frames, "sessions": sessions, "jumps": jumps, "reference": reference})
    xyz = dict(zip("xyz", np.random.default_rng(0).normal(size=(50, 3)).T, strict=True))
    points = filled("sfm", "points", 50, **xyz, r=200, model_id="incremental/0")
    images = filled("sfm", "images", len(scene.images), **scene.images)
    tables = {"images": images, "intrinsics": scene.intrinsics, "pairs": scene.pairs, "points": points}
    write_artefact(root, "sfm", tables)
    truth = pd.concat([scene.frames[["session_id", "t_ns"]], pose_frame("map_cam", scene.true_T_cam)], axis=1)
    root.captures("Place").mkdir(parents=True)
    write_table(root.captures("Place") / "true_poses.parquet", truth, schema("simulate", "true_poses"))


@pytest.fixture
def data(walks: Walks, tmp_path: Path) -> DataRoot:
    """The scene Place with import and sfm done."""
    root = DataRoot(tmp_path / "data")
    make_place(walks, root)
    return root


@pytest.fixture(scope="module")
def data_of_module(walks: Walks, tmp_path_factory: pytest.TempPathFactory) -> DataRoot:
    """The same for all tests of a module."""
    root = DataRoot(tmp_path_factory.mktemp("place") / "data")
    make_place(walks, root)
    return root
