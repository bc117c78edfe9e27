"""A run of two walks in a made-up scene, written by the stages' machinery from made-up tables."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import ConfigDict

from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array
from groundwalk.store import DataRoot, Settings, Stage, StageRun, execute
from groundwalk.store.files import sha256_of
from groundwalk.store.schemas import stage_tables
from groundwalk.store.tables import pose_frame
from tests.known import cells, filled

FRAMES = 12
LOST = 5  # the row that has no ground truth
NEEDS = {
    "import": (),
    "sfm": ("import",),
    "align": ("import", "sfm"),
    "localise": ("import", "sfm", "align"),
    "train": ("import", "align"),
    "fuse": ("import", "align", "localise", "train"),
}


class AnySettings(Settings):
    """Those of the real stages in profile tiny, which mean nothing here."""

    model_config = ConfigDict(extra="ignore")


@dataclass
class MadeUpRun:
    """The run of scene `place` in profile tiny, and what its tables were made from. `suffix` makes other tables."""

    data: DataRoot
    map_T_cam: Array
    map_S_sfm: Sim3
    points: Array
    pictures: list[np.ndarray] = field(default_factory=list)
    suffix: str = ""

    @property
    def folder(self) -> Path:
        return self.data.run("tiny", "place")

    def run(self, *stages: str) -> None:
        """Run stages, all unless named."""
        for name in stages or NEEDS:
            execute(self.stage(name), "place", "tiny", self.data, force=True)

    def stage(self, name: str) -> Stage[Settings]:
        """The stage that writes the made-up tables."""
        return Stage(name, 1, AnySettings, NEEDS[name], self._write, "", reads_captures=name == "import")

    def _write(self, r: StageRun[Settings]) -> None:
        tables = getattr(self, f"_{r.stage.name}")()
        for table in stage_tables(r.stage.name):
            r.write(table.name, tables.get(table.name, filled(table.stage, table.name, 0)))

    @property
    def _keys(self) -> dict[str, list[Any]]:
        ids = [f"walk-{i // 6}{self.suffix}/{i:06d}" for i in range(FRAMES)]
        splits = ["train", "train", "train", "val", "val", "train"] + ["test"] * 6
        return {
            "frame_id": ids,
            "session_id": [name.partition("/")[0] for name in ids],
            "split": splits,
            "t_ns": list(range(FRAMES)),
        }

    def _import(self) -> dict[str, pd.DataFrame]:
        images = [f"{i}.png" for i in range(FRAMES)]
        hashes = [sha256_of(self.data.captures("place") / name) for name in images]
        camera = {"width": 32, "height": 24, "fx": 30.0, "fy": 30.0, "cx": 16.0, "cy": 12.0}
        frames = filled("import", "frames", FRAMES, **self._keys, image=images, image_sha256=hashes, **camera)
        support = frames.iloc[[0]].assign(frame_id="walk-0/000900", support=True)
        sessions = filled("import", "sessions", 2, session_id=["walk-0", "walk-1"], duration_s=60.0, path_m=40.0)
        return {"frames": pd.concat([frames, support], ignore_index=True), "sessions": sessions}

    def _sfm(self) -> dict[str, pd.DataFrame]:
        poses = pose_frame("sfm_cam", self.map_S_sfm.inverse().poses(self.map_T_cam))
        images = filled("sfm", "images", FRAMES, frame_id=self._keys["frame_id"], model_id="m", **poses)
        xyz = dict(zip("xyz", self.map_S_sfm.inverse().points(self.points).T, strict=True))
        model_ids = ["m"] * (len(self.points) - 1) + ["not in the map"]
        return {"images": images, "points": filled("sfm", "points", len(self.points), model_id=model_ids, **xyz)}

    def _align(self) -> dict[str, pd.DataFrame]:
        poses = self.map_T_cam.copy()
        poses[LOST] = np.nan
        truth = filled("align", "ground_truth", FRAMES, **self._keys, **pose_frame("map_cam", poses), quality="A")
        truth = truth.assign(fx=31.0, fy=31.0, cx=16.0, cy=12.0, distortion=cells([[0.1, -0.2]] * FRAMES))
        truth.loc[LOST, "quality"] = "none"
        sessions = filled("align", "sessions", 2, session_id=["walk-0", "walk-1"])
        return {"ground_truth": truth.assign(scale_source="vio", vertical_source="gravity"), "sessions": sessions}

    def _localise(self) -> dict[str, pd.DataFrame]:
        """Poses of the test frames, of which the last one is refused."""
        poses = np.where((np.arange(FRAMES) == FRAMES - 1)[:, None, None], np.nan, self.map_T_cam)
        predicted = filled("localise", "predictions", FRAMES, **self._keys, **pose_frame("map_cam", poses), model="Map")
        predicted.loc[FRAMES - 1, ["refusal", "reason"]] = "few_features", "3 features, 30 needed"
        return {"predictions": predicted[predicted["split"] == "test"]}

    def _train(self) -> dict[str, pd.DataFrame]:
        predicted = pose_frame("map_cam", self.map_T_cam)
        return {"predictions": filled("train", "predictions", FRAMES, **self._keys, **predicted, model="PN")}

    def _fuse(self) -> dict[str, pd.DataFrame]:
        poses = filled("fuse", "poses", FRAMES, **self._keys, method="raw", model="PN")
        errors = filled("fuse", "errors", FRAMES, **self._keys, method="raw", model="PN", position_m=0.5)
        answers = {"position_median_m": [0.5, np.nan], "rotation_median_deg": [2.0, np.nan], "answered": [6, 2]}
        summary = filled("fuse", "summary", 2, method=["raw", "rule"], model="PN", subset="all", frames=6, **answers)
        errors = errors[errors["split"] == "test"]
        return {"poses": poses, "errors": errors, "summary": summary.assign(scored="method")}
