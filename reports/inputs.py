"""What the report reads of one scene, and the few facts about it that every table and page must say."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pandas as pd

from groundwalk.geometry.poses import Array
from groundwalk.reports.published import PAPER_METHOD
from groundwalk.store import StageRun
from groundwalk.store.choices import MapUnit, PoseSource
from groundwalk.store.files import STOPPED, partial_folder, read_json
from groundwalk.store.georeference import FILE, read_georeference
from groundwalk.store.schemas import schema
from groundwalk.store.simulated import TRUE_POSES
from groundwalk.store.tables import dataset_frames, has_vertical, map_unit, poses_of, scale_warning, with_gravity_of_map
from groundwalk.store.text import name_list
from groundwalk.store.true_poses import true_poses_of

# Fewer training frames than this, and a regressor's accuracy says nothing about regressors.
ENOUGH_TRAINING_FRAMES = 100
# A test frame this close in time to a training frame of its walk shows nearly the same picture.
LEAK_S = 5.0
MAX_NEAR_COPIES = 0.05


def compared(errors: pd.DataFrame) -> pd.DataFrame:
    """Of rows of fuse.errors, those of test frames that all of a model's methods ran on: where only some test sessions
    have VIO, and something is fused, those of these sessions."""
    test = errors[errors["split"] == "test"]
    ran = test.groupby(["model", "frame_id"])["method"].transform("size")
    return test[ran == test.groupby("model")["method"].transform("nunique")]


@dataclass(frozen=True)
class SceneInputs:
    """The tables of one scene that the report is made from.

    Tables of stages that aren't finished are empty; `stages` are those that are. `stopped` is why sfm or align found no
    result at its last attempt, with `what`, `where`, `expected`, `found` and `do`. `predictions` are the regressors'
    and the structure localisers', `cards` and `localisers` say what these are. `true_T_cam` (N, 4, 4) are the
    simulator's poses of the rows of `ground_truth`, None of a real capture. `manifests` has those of all stages that
    went in, by a name to show. `checks_plot` and `control_plot` are None where align left no such
    picture; `georeference` says how well the map's place on earth is known, without the place, or why it isn't.
    """

    name: str
    environment: str
    simulated: bool
    profile: str
    seed: int
    stages: frozenset[str]
    stopped: dict[str, str]
    frames: pd.DataFrame
    sessions: pd.DataFrame
    rejects: pd.DataFrame
    jumps: pd.DataFrame
    images: pd.DataFrame
    ground_truth: pd.DataFrame
    true_T_cam: Array | None
    residuals: pd.DataFrame
    align_sessions: pd.DataFrame
    drift: pd.DataFrame
    align_checks: pd.DataFrame
    control: pd.DataFrame
    predictions: pd.DataFrame
    history: pd.DataFrame
    cards: pd.DataFrame
    localisers: pd.DataFrame
    poses: pd.DataFrame
    errors: pd.DataFrame
    intervals: pd.DataFrame
    fused_sessions: pd.DataFrame
    methods: pd.DataFrame
    validation: pd.DataFrame
    checks_plot: Path | None
    control_plot: Path | None
    georeference: str
    manifests: dict[str, dict[str, Any]]

    @property
    def models(self) -> list[str]:
        return list(dict.fromkeys(self.errors["model"]))

    @property
    def test_frames(self) -> int:
        return int((self.frames["split"] == "test").sum())

    @cached_property
    def compared(self) -> pd.DataFrame:
        """`compared` of the scene's errors."""
        return compared(self.errors)

    @property
    def scored_frames(self) -> int:
        """Test frames with ground truth: what every share and level is a share of."""
        return int(self.errors.loc[self.errors["split"] == "test", "frame_id"].nunique())

    def label(self, model: str) -> str:
        """The model as tables and pages print it."""
        return self._labels.get(model, model)

    @cached_property
    def _labels(self) -> dict[str, str]:
        both = pd.concat([table[["model", "label"]] for table in (self.cards, self.localisers)])
        return dict(both.dropna().itertuples(index=False, name=None))

    @cached_property
    def method_labels(self) -> dict[str, str]:
        """What stands behind the model's label for each method: nothing for the raw regressor."""
        labelled = zip(self.methods["method"], self.methods["label"], self.methods["fuses"], strict=True)
        return {str(method): f"+{label}" if fuses else "" for method, label, fuses in labelled}

    @property
    def raw_methods(self) -> set[str]:
        """The methods that answer with the regressor's pose alone."""
        return set(self.methods.loc[~self.methods["fuses"], "method"])

    @property
    def fuses(self) -> bool:
        """Whether any method fused anything in this scene."""
        return bool(self.methods["fuses"].any())

    @property
    def unfused_sessions(self) -> set[str]:
        """The test sessions in which predictions stand alone, as nothing was fused."""
        test = self.errors[self.errors["split"] == "test"]
        return set(test["session_id"]) - set(test.loc[~test["method"].isin(self.raw_methods), "session_id"])

    @property
    def vio_sessions(self) -> set[str]:
        """The sessions with VIO; the others have a reference, or no poses at all."""
        return set(self.sessions.loc[self.sessions["pose_source"] == PoseSource.VIO, "session_id"])

    @property
    def is_images_alone(self) -> bool:
        """No session has poses: photos or videos."""
        return bool((self.sessions["pose_source"] == PoseSource.NONE).all())

    def why_alone(self) -> str:
        """Why predictions stand alone in the scene, or in some of its test sessions; empty where all are fused."""
        alone = sorted(self.unfused_sessions)
        if not alone:
            return ""
        reason = "no method that fuses was run"
        if not self.vio_sessions.intersection(alone):
            reason = "no VIO"
        elif self.unit is not MapUnit.METRE:
            reason = "VIO is in metres, and the map isn't"
        if not self.fuses:
            return f"{reason}: nothing is fused, and every model stands alone"
        return (
            f"{reason} in {name_list(alone, 3)}: nothing is fused there; methods that fuse, and what they are compared "
            "with, are over the frames of the other test sessions"
        )

    @property
    def fused_method(self) -> str | None:
        """The method that figures show beside the regressor: the paper's rule or, where that wasn't run, the first
        causal one that fuses; None where there is none."""
        fusing = self.methods.loc[self.methods["fuses"] & self.methods["causal"], "method"].tolist()
        return PAPER_METHOD if PAPER_METHOD in fusing else next(iter(fusing), None)

    def ahead(self, model: str) -> str | None:
        """The method that is ahead on held-out frames for a model, maybe a raw one; None where that isn't known."""
        rows = self.validation[(self.validation["model"] == model) & self.validation["ahead"].astype(bool)]
        return None if rows.empty or self.fused_method is None else str(rows["method"].iloc[0])

    def best(self, model: str) -> str | None:
        """The method that stands for fusion with a model: the one that is ahead, or the one that figures show."""
        return self.ahead(model) or self.fused_method

    def frame_errors(self, model: str, method: str | None) -> pd.DataFrame:
        """One row a frame with the raw regressor's errors, and those of a method where it has some. Where it fuses,
        without frames of sessions without VIO."""
        fused = self.errors[(self.errors["method"] == method) & (self.errors["model"] == model)]
        return fused if len(fused) else self.raw_errors(model)

    def raw_errors(self, model: str) -> pd.DataFrame:
        """One row a frame with the raw regressor's errors, in the columns `raw_…`."""
        return self.errors[self.errors["model"] == model].drop_duplicates("frame_id")

    @property
    def offline(self) -> set[str]:
        """The fusion methods that see whole walks before they answer."""
        return set(self.methods.loc[~self.methods["causal"], "method"])

    @property
    def unit(self) -> MapUnit:
        """What positions in the map are in."""
        return map_unit(self.ground_truth)

    def marker(self) -> str:
        """What must stand by every number of this scene."""
        kind = "simulated, test walks in the training walks' light" if self.simulated else "real capture"
        facts = [kind, f"{self.profile} profile", f"seed {self.seed}", f"{len(self.frames)} frames"]
        vertical = "" if has_vertical(self.ground_truth) else "NO VERTICAL: the map's +y may point anywhere"
        return ", ".join([*facts, *filter(None, [scale_warning(self.unit), vertical])])

    def extent_m(self) -> tuple[float, float, float]:
        """Length, width and height of the camera positions with ground truth; length and width are the sides of the
        smallest rectangle about them, since the map's heading is arbitrary."""
        xyz_N3 = poses_of(self.ground_truth, "map_cam")[:, :3, 3]
        xyz_N3 = xyz_N3[np.isfinite(xyz_N3).all(axis=1)]
        if not len(xyz_N3):
            return float("nan"), float("nan"), float("nan")
        _, sides, _ = cv2.minAreaRect(xyz_N3[:, [0, 2]].astype(np.float32))
        return max(sides), min(sides), float(np.ptp(xyz_N3[:, 1]))

    @property
    def leak_s(self) -> float | None:
        """Seconds between the closest test and training frame of one recording, or None where none has both."""
        return cast(float | None, self.manifests["import"]["figures"]["leak_s"])

    @property
    def near_copies(self) -> float | None:
        """The fraction of test images that show nearly what a training image shows, or None where images have times."""
        return self.manifests["import"]["figures"].get("test_images_near_train")

    def why_meaningless(self) -> list[str]:
        """Reasons why this scene's accuracy means nothing; none where it may mean something."""
        if not len(self.cards):
            return []
        reasons = []
        trained_on = int((self.frames["split"] == "train").sum())
        if trained_on < ENOUGH_TRAINING_FRAMES:
            reasons.append(f"there are only {trained_on} training frames")
        if self.leak_s is not None and self.leak_s < LEAK_S:
            reasons.append(f"training and test frames are of one walk, as little as {self.leak_s:.1f} s apart")
        if (self.near_copies or 0) > MAX_NEAR_COPIES:
            reasons.append(f"{self.near_copies:.0%} of test images show nearly what a training image shows")
        return reasons


def read_scene(r: StageRun[Any], leaf: str) -> SceneInputs:
    """Everything about a plain scene. Where the run is a group of scenes that trained or fused together, the models
    that it trained replace the scene's own of the same name."""

    def read(stage: str, table: str, owner: str = leaf) -> pd.DataFrame:
        of = schema(stage, table)
        is_there = (owner, stage) in r.sources and (
            stage != "fuse" or (r.folder(stage, owner) / f"{table}.parquet").is_file()
        )
        return r.read(stage, table, scene=owner) if is_there else of.arrow().empty_table().to_pandas()

    trainers = dict.fromkeys([leaf, _owner(r, leaf, "train")])
    trained_by = {str(m): owner for owner in trainers for m in read("train", "models", owner)["model"]}
    fused_by = _owner(r, leaf, "fuse")

    def trained(table: str) -> pd.DataFrame:
        parts = []
        for owner in trainers:
            part = read("train", table, owner)
            part = part[part["model"].map(trained_by) == owner]
            parts.append(part[part["scene"] == leaf] if "scene" in part else part)
        return pd.concat([p for p in parts if len(p)] or parts[:1], ignore_index=True)

    def fused(table: str) -> pd.DataFrame:
        part = read("fuse", table, fused_by)
        return part[part["scene"] == leaf].reset_index(drop=True)

    owners = {stage: [leaf] for stage in ("import", "sfm", "align", "localise")}
    owners |= {"train": list(trainers), "fuse": [fused_by]}
    manifests = {
        stage if owner == leaf else f"{stage} of {owner}": r.manifest(stage, owner)
        for stage, its_owners in owners.items()
        for owner in its_owners
        if (owner, stage) in r.sources
    }
    frames, images, truth = read("import", "frames"), read("sfm", "images"), read("align", "ground_truth")
    frames = with_gravity_of_map(dataset_frames(frames), truth)
    predictions = [p for p in (trained("predictions"), read("localise", "predictions")) if len(p)]
    errors, methods = fused("errors"), read("fuse", "methods", fused_by)
    simulated = bool(manifests["import"]["simulated"])
    has_truth = simulated and len(truth) and (r.data.captures(leaf) / TRUE_POSES).is_file()
    stopped: dict[str, str] = {}
    for stage in ("align", "sfm"):
        left = read_json(partial_folder(r.data.run(r.profile, leaf, stage)) / STOPPED)
        if (leaf, stage) not in r.sources and left:
            stopped = {name: str(text) for name, text in left.items()}
    final = r.data.run(r.profile, leaf, "align")
    plot = (final if (leaf, "align") in r.sources else partial_folder(final)) / "checks.png"
    control = final / "control.png"
    return SceneInputs(
        name=leaf,
        environment=r.data.scene(leaf)[0].environment,
        simulated=simulated,
        profile=r.profile,
        seed=r.seed,
        stages=frozenset(name.split()[0] for name in manifests),
        stopped=stopped,
        frames=frames,
        sessions=read("import", "sessions"),
        rejects=read("import", "rejects"),
        jumps=read("import", "jumps"),
        images=images[images["frame_id"].isin(frames["frame_id"])].reset_index(drop=True),
        ground_truth=truth,
        true_T_cam=true_poses_of(truth, leaf, r.profile, r.data) if has_truth else None,
        residuals=read("align", "residuals"),
        align_sessions=read("align", "sessions"),
        drift=read("align", "drift"),
        align_checks=read("align", "checks"),
        control=read("align", "control"),
        predictions=pd.concat(predictions, ignore_index=True) if predictions else trained("predictions"),
        history=trained("history"),
        cards=trained("models"),
        localisers=read("localise", "models"),
        poses=fused("poses"),
        errors=errors,
        intervals=fused("intervals"),
        fused_sessions=fused("sessions"),
        # A group's methods may have had nothing to fuse in this scene.
        methods=methods[methods["method"].isin(errors["method"])].reset_index(drop=True),
        validation=fused("validation"),
        checks_plot=plot if plot.is_file() else None,
        control_plot=control if (leaf, "align") in r.sources and control.is_file() else None,
        georeference=_georeference(final) if (leaf, "align") in r.sources else "",
        manifests=manifests,
    )


def _georeference(align: Path) -> str:
    found = read_georeference(align)
    return found.describe() if found is not None else str(read_json(align / FILE).get("refused", ""))


def _owner(r: StageRun[Any], leaf: str, stage: str) -> str:
    """Whose artefact of a stage counts for a scene: that of the group which runs the stage for it, or its own."""
    for name in (r.scene.name, *r.scene.members):
        config = r.data.scene(name)[0]
        if config.is_group and stage in config.stages and leaf in r.data.leaves(config):
            return name
    return leaf
