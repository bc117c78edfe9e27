"""Reading a scene's run: its tables as DataFrames, images as arrays, poses as matrices."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from html import escape
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from numpy.typing import ArrayLike
from pyarrow.parquet import read_metadata

from groundwalk.geometry.poses import Array
from groundwalk.store.errors import UserError
from groundwalk.store.files import read_json, sha256_of
from groundwalk.store.hints import run_command, setting_of
from groundwalk.store.images import Image, image_file, read_image
from groundwalk.store.manifests import MANIFEST, missing_stage
from groundwalk.store.schemas import TableSchema, schema, stage_tables
from groundwalk.store.settings import STAGES
from groundwalk.store.tables import dataset_frames, points_in_map, poses_of, read_table

if TYPE_CHECKING:
    from groundwalk.geometry.cameras import Camera
    from groundwalk.localisation.localisers import FileLocaliser
    from groundwalk.localisation.results import QueryResult
    from groundwalk.torch_dataset import TorchDataset, Transform


@dataclass(frozen=True, eq=False, repr=False)
class Run:
    """What the finished stages of a scene's run wrote; `groundwalk.open` makes it.

    Lengths are in metres, angles in degrees and capture times in nanoseconds unless a column says otherwise;
    `columns(stage, table)` gives type, unit, frame and meaning of each. A DataFrame is the caller's to change.

    `folder` is the run's, `captures` its scene's capture folder (None where that isn't known), `manifests` those of the
    finished stages, in order; `outdated` names, for each stage made from inputs that were replaced since, one of them.
    """

    folder: Path
    captures: Path | None
    manifests: dict[str, dict[str, Any]]
    outdated: dict[str, str]
    _tables: dict[tuple[str, str], pd.DataFrame] = field(default_factory=dict)
    _localisers: dict[str, "FileLocaliser"] = field(default_factory=dict)

    def __repr__(self) -> str:
        kind = "simulated, " if self.simulated else ""
        return f"Run({self.scene!r}, profile {self.profile!r}, {kind}finished: {', '.join(self.manifests)})"

    @property
    def _manifest(self) -> dict[str, Any]:
        return next(iter(self.manifests.values()))

    @property
    def scene(self) -> str:
        """The scene's name."""
        return str(self._manifest["scene"]["name"])

    @property
    def profile(self) -> str:
        """The profile that the scene was run with."""
        return str(self._manifest["profile"])

    @property
    def simulated(self) -> bool:
        """Whether the captures are simulated: then no error says anything about a real place."""
        return bool(self._manifest["simulated"])

    def _repr_html_(self) -> str:
        page = f"<p>The page: <code>{escape(str(self.page))}</code></p>" if "report" in self.manifests else ""
        return f"<pre>{escape(self.summary())}</pre>{page}"

    @property
    def page(self) -> Path:
        """The report's page, an HTML file. UserError where the stage report isn't finished."""
        self._check("report")
        return self.folder / "report" / "page.html"

    def view(self, *, web: bool = False) -> None:
        """Open the recordings of the finished stages in the Rerun viewer, or `web` in a browser; returns when it is
        closed. UserError where there is none."""
        from groundwalk.store.web_viewer import view_run

        view_run(self.folder, web=web)

    def tables(self) -> pd.DataFrame:
        """The tables of the finished stages, one row each: stage, table, rows, meaning."""
        schemas = (of for stage in self.manifests for of in stage_tables(stage))
        found = ((of, self.folder / of.stage / f"{of.name}.parquet") for of in schemas)
        rows = [(of.stage, of.name, read_metadata(path).num_rows, of.meaning) for of, path in found if path.is_file()]
        return pd.DataFrame(rows, columns=["stage", "table", "rows", "meaning"])

    @property
    def sessions(self) -> pd.DataFrame:
        """Recordings of the captures, one row each."""
        return self.table("import", "sessions")

    @property
    def rejects(self) -> pd.DataFrame:
        """What import left out of the captures, one row each, and why."""
        return self.table("import", "rejects")

    @property
    def checks(self) -> pd.DataFrame:
        """What had to hold before ground truth was given out, one row a check, with its status, reason and advice."""
        return self.table("align", "checks")

    @property
    def frames(self) -> pd.DataFrame:
        """Frames of the dataset, one row each, with camera and VIO pose; without the support frames of SfM, which
        `table("import", "frames")` has, too.
        """
        return dataset_frames(self.table("import", "frames"))

    @property
    def ground_truth(self) -> pd.DataFrame:
        """Ground truth, one row a frame: poses map_T_cam with covariance and quality class."""
        return self.table("align", "ground_truth")

    @property
    def predictions(self) -> pd.DataFrame:
        """The poses of regressors (stage train) and structure localisers (stage localise), one row a frame and model,
        of the stages of both that are finished. What only localisers say is null for regressors; a frame that a
        localiser refused has a `refusal`, its `reason` and no pose.
        """
        stages = [stage for stage in ("train", "localise") if stage in self.manifests] or ["train"]
        parts = [self.table(stage, "predictions") for stage in stages]
        columns = [column for part in parts for column in part.columns]
        filled = [part for part in parts if len(part)] or parts[:1]
        return pd.concat(filled, ignore_index=True).reindex(columns=list(dict.fromkeys(columns)))

    def localise(
        self,
        image: "Image | str | PathLike[str]",
        *,
        intrinsics: "Camera | Mapping[str, float] | ArrayLike",
        gravity: "ArrayLike | None" = None,
        prior: "ArrayLike | None" = None,
        model: str | None = None,
    ) -> "QueryResult":
        """Where an image was taken, by a structure localiser of the stage localise: a `QueryResult` with map_T_cam (4,
        4), metres, its covariance (6, 6) of (rotation, position) in the map's axes, rad and m, and inliers; or without
        a pose, but with a `refusal` and its `reason`.

        image: RGB (H, W, 3) or grey (H, W), uint8, or a file, as the sensor delivers it. intrinsics: in pixels of that
        image, a geometry.cameras.Camera, a mapping with fx, fy, cx, cy (and width, height, first_row), K (3, 3) or
        the four numbers; the lens is known to the map. gravity: (3,), down, in camera axes (x right, y down, z
        forward). prior: about where the camera is, map_T_cam (4, 4). model: the localiser's id, the first with a file
        unless given.

        UserError where the stage isn't finished, or intrinsics and the rest can't be what they should.
        """
        from groundwalk.localisation.locate import ask_map
        from groundwalk.runtime.queries import known_of, query_of

        known = known_of(intrinsics, gravity, prior)
        return ask_map(self._localiser(model), query_of(image, known, "intrinsics of groundwalk.Run.localise"))

    @property
    def poses(self) -> pd.DataFrame:
        """Poses after fusion with VIO, one row a frame, method and model."""
        return self.table("fuse", "poses")

    @property
    def errors(self) -> pd.DataFrame:
        """Errors of `poses` and `predictions` against the ground truth, one row a frame with ground truth, method and
        model. A frame without a pose has a row, too, whose errors are NaN: it counts as failed, so put infinity there
        before a median.
        """
        return self.table("fuse", "errors")

    @property
    def points(self) -> pd.DataFrame:
        """The points of SfM in the map: x, y, z in metres, +y up (where the map has scale and vertical, see
        scale_source and vertical_source of `ground_truth`). Models that aren't in the map are left out;
        `table("sfm", "points")` has all, in SfM's unit.
        """
        return points_in_map(self.table("sfm", "points"), self.table("sfm", "images"), self.ground_truth)

    def table(self, stage: str, table: str) -> pd.DataFrame:
        """Any table; docs/reference/tables.md lists them.

        A column that may be null, and that an older version of the table didn't have, is null. UserError where the
        stage isn't finished, was made from inputs that were replaced since, or was run again after this run was opened,
        and for a table of another major version.
        """
        of = _schema(stage, table)
        if (stage, table) not in self._tables:
            self._check(stage)
            frame = read_table(self.folder / stage / f"{table}.parquet", of)
            self._refuse_replaced(stage)
            self._tables[stage, table] = frame
        return self._tables[stage, table].copy()

    def columns(self, stage: str, table: str) -> pd.DataFrame:
        """A table's columns, one row each: name, dtype, unit, frame, meaning, nullable."""
        names = ("name", "dtype", "unit", "frame", "meaning", "nullable")
        return pd.DataFrame([{n: getattr(c, n) for n in names} for c in _schema(stage, table).columns])

    def image(self, frame_id: str) -> Image:
        """A frame's image as captured: RGB (H, W, 3), uint8, with the lens's distortion, as the sensor delivers it
        (landscape). UserError where there is no such frame, or its file is gone or isn't the one that was imported.
        """
        if frame_id not in self._images:
            raise UserError(f"there is no frame {frame_id!r} in scene {self.scene}", expected="a frame_id of `frames`")
        image, sha256 = self._images[frame_id]
        if self.captures is None and not image.startswith("import:"):
            raise UserError(
                f"the captures of scene {self.scene} aren't beside its run",
                where=self.folder,
                do="name the data folder that has them: groundwalk.open(folder, data=...)",
            )
        path = image_file(image, self.captures or Path(), self.folder / "import")
        if path.is_file() and sha256_of(path) != sha256:
            raise UserError(
                f"the image of frame {frame_id} isn't the one that was imported: its sha256 differs",
                where=path,
                do=run_command(self.folder / "import"),
            )
        return read_image(path)

    def torch_dataset(self, split: str | None = "train", transform: "Transform | None" = None) -> "TorchDataset":
        """The frames of a split (train, val, test; None: all) with ground truth, as a torch.utils.data.Dataset; see
        `groundwalk.torch_dataset.TorchDataset` for what an item is.
        """
        from groundwalk.torch_dataset import TorchDataset

        return TorchDataset(self.frames, self.ground_truth, self.image, split, transform)

    def summary(self) -> str:
        """What the run holds and how accurate it is, in a few lines for people."""
        from groundwalk.summary import summary

        return summary(self.manifests, self.outdated, self.table)

    def _localiser(self, model: str | None) -> "FileLocaliser":
        """The structure localiser of that id, from its file, which is read once."""
        models = self.table("localise", "models")
        files = dict(models.loc[models["file"] != "", ["model", "file"]].itertuples(index=False, name=None))
        name = model or next(iter(files), "")
        if name not in files:
            where = setting_of("localise", "models", f"scenes/{self.scene}.toml of the data folder")
            raise UserError(
                f"scene {self.scene} has no structure localiser{f' {model!r}' if model else ''} that is kept in a file",
                expected=f"one of {', '.join(files)}" if files else None,
                do=f"name one that is, in {where}",
            )
        if name not in self._localisers:
            from groundwalk.localisation.locate import read_localiser

            localiser = read_localiser(self.folder / "localise" / files[name], self.scene)
            self._refuse_replaced("localise")
            self._localisers[name] = localiser
        return self._localisers[name]

    @cached_property
    def _images(self) -> dict[str, tuple[str, str]]:
        """frame_id -> the image's entry and sha256."""
        frames = self.table("import", "frames")
        return dict(zip(frames["frame_id"], zip(frames["image"], frames["image_sha256"], strict=True), strict=True))

    def _check(self, stage: str) -> None:
        """UserError where a stage's tables aren't there, or don't belong to those that are."""
        if stage in self.outdated:
            raise UserError(
                f"stage {stage} of scene {self.scene} is outdated: {self.outdated[stage]} was run again since",
                where=self.folder / stage,
                do=run_command(self.folder / stage),
            )
        if stage in self.manifests:
            return
        config = self._manifest["scene"]
        if config.get("members") and stage not in config.get("stages", []):
            raise UserError(
                f"{self.scene} is a group of scenes and has no stage {stage}",
                expected=f"one of {', '.join(config['stages'])}, or one of its scenes: {', '.join(config['members'])}",
            )
        raise missing_stage(self.folder / stage, stage, self.scene)

    def _refuse_replaced(self, stage: str) -> None:
        if read_json(self.folder / stage / MANIFEST).get("outputs") != self.manifests[stage]["outputs"]:
            raise UserError(
                f"stage {stage} was run again after this run was opened", where=self.folder / stage, do="open it again"
            )


def pose_array(table: pd.DataFrame, group: str = "map_cam") -> Array:
    """A pose group of a table as matrices (N, 4, 4), float64, one a row: `map_cam` is map_T_cam, which takes camera
    coordinates (OpenCV: x right, y down, z forward) to the map (metres, +y up). A row without a pose is NaN.

    Raises UserError where the table has no such group.
    """
    groups = [name.removesuffix("_qw") for name in table.columns if str(name).endswith("_qw")]
    if group not in groups:
        raise UserError(f"the table has no poses {group!r}", expected=f"one of {', '.join(groups) or 'none'}")
    return poses_of(table, group)


def _schema(stage: str, table: str) -> TableSchema:
    if stage not in STAGES:
        raise UserError(f"there is no stage {stage!r}", expected=f"one of {', '.join(STAGES)}")
    return schema(stage, table)
