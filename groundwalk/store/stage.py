"""Running a stage: its partial folder, its manifest, and the rename that finishes it."""

import contextlib
import gc
import platform
import shutil
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeVar

import pandas as pd
import rerun as rr

from groundwalk.store import progress, recording
from groundwalk.store.checkout import git_revision
from groundwalk.store.choices import MapUnit
from groundwalk.store.cores import machine
from groundwalk.store.damage import free_bytes
from groundwalk.store.definition import Stage
from groundwalk.store.errors import MachineError, UserError
from groundwalk.store.files import RECORDING, STOPPED, partial_folder, refuse_irreplaceable, swap_in, write_json
from groundwalk.store.hints import of_scene
from groundwalk.store.images import image_file
from groundwalk.store.manifests import MANIFEST, listed_files, load_manifest, missing_stage, output_hashes
from groundwalk.store.memory import PeakMemory
from groundwalk.store.outdated import prepared
from groundwalk.store.registry import Lazy, PluginError
from groundwalk.store.resuming import run_resumable
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot, SceneConfig, Settings
from groundwalk.store.tables import dataset_frames, map_unit, scale_warning, table_of, with_gravity_of_map, write_table

S = TypeVar("S", bound=Settings)
T = TypeVar("T")

_SCRATCH = "scratch"
_VERSIONS = ["groundwalk", "numpy", "opencv-python-headless", "pyarrow", "pycolmap", "rerun-sdk", "scipy", "torch"]


@dataclass
class StageRun(Generic[S]):
    """What a stage's `run` function gets: its scene, settings and inputs, and where its outputs go."""

    stage: Stage[S]
    scene: SceneConfig
    profile: str
    settings: S
    seed: int
    data: DataRoot
    simulated: bool
    work: Path
    sources: frozenset[tuple[str, str]] = frozenset()
    """Scene and stage of every artefact that it may read."""
    figures: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    def begin(self) -> None:
        """Run the stage; figures and times of a failed attempt before are forgotten."""
        self.figures.clear()
        self.seconds.clear()
        (self.work / STOPPED).unlink(missing_ok=True)
        try:
            self.stage.run(self)
        except UserError as error:
            if do := error.details["do"]:
                error.details["do"] = of_scene(str(do), self.data, self.scene.name)
            if not isinstance(error, MachineError):  # which is nothing against the capture
                with contextlib.suppress(OSError):  # a full disk: what the user must know is the error
                    texts = {name: str(value) for name, value in error.details.items() if value is not None}
                    write_json(self.work / STOPPED, {"what": error.what, **texts})
            raise

    @property
    def captures(self) -> Path:
        """data/captures/<scene>, the capture folder."""
        return self.data.captures(self.scene.name)

    @property
    def before(self) -> Path | None:
        """The finished artefact of this stage before recordings were added to the scene, or taken out of it."""
        return self.data.before / self.stage.name if self.data.before else None

    @property
    def holds(self) -> bool:
        """What `before` says of frames that are still there stays as it is."""
        return self.data.holds

    @property
    def scratch(self) -> Path:
        """A folder for checkpoints: it survives a kill and is dropped when the stage ends."""
        path = self.work / _SCRATCH
        path.mkdir(exist_ok=True)
        return path

    @property
    def leaves(self) -> list[str]:
        """The plain scenes of this run: the scene itself, or a group's."""
        return self.data.leaves(self.scene)

    def folder(self, stage: str, scene: str | None = None) -> Path:
        """The finished artefact folder of a stage of this scene (or of a group's member)."""
        path = self.data.run(self.profile, scene or self.scene.name, stage)
        if not (path / MANIFEST).is_file():
            raise missing_stage(path, stage, scene or self.scene.name)
        return path

    def read(self, stage: str, table: str, scene: str | None = None) -> pd.DataFrame:
        """A table of a finished stage of this scene (or of a group's member)."""
        return table_of(self.folder(stage, scene).parent, stage, table)

    def dataset_frames(self, scene: str | None = None) -> pd.DataFrame:
        """import.frames without support frames, and without gravity in a map without a vertical: what every stage reads
        but sfm and align."""
        frames = dataset_frames(self.read("import", "frames", scene))
        return with_gravity_of_map(frames, self.read("align", "ground_truth", scene))

    def map_unit(self, scene: str | None = None) -> MapUnit:
        """The unit of the map that align made of this scene (or of a group's member)."""
        return map_unit(self.read("align", "ground_truth", scene))

    def manifest(self, stage: str, scene: str | None = None) -> dict[str, Any]:
        return load_manifest(self.folder(stage, scene))

    def image_path(self, image: str, scene: str | None = None) -> Path:
        """The absolute path of a `frames.image` entry: relative to the capture folder, or to the import artefact
        where import copied the image (`import:` in front)."""
        name = scene or self.scene.name
        return image_file(image, self.data.captures(name), self.data.run(self.profile, name, "import"))

    def write(self, table: str, frame: pd.DataFrame) -> None:
        """Write one of the stage's tables, checked against its schema."""
        write_table(self.work / f"{table}.parquet", frame, schema(self.stage.name, table))

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time a step; the manifest lists the seconds."""
        start = time.monotonic()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.monotonic() - start

    def track(self, items: Iterable[T], text: str, total: int | None = None) -> Iterator[T]:
        """Yield the items with progress and the time left."""
        return progress.track(items, text, total)

    def say(self, text: str) -> None:
        """One line for the user."""
        progress.console.print(f"  {of_scene(text, self.data, self.scene.name)}")

    def warn_of_scale(self) -> None:
        """A line for each scene whose map isn't metric."""
        for leaf in self.leaves:
            if warning := scale_warning(self.map_unit(leaf)):
                self.say(f"warning: {leaf}: {warning}")

    def leave_out(self, faults: Iterable[PluginError]) -> None:
        """Name each plug-in that takes no part, also in the manifest."""
        for fault in faults:
            self.say(f"warning: {fault}")
            self.figure(f"left out: {fault.what}", f"{fault.details['where']}: {fault.reason}")

    def figure(self, name: str, value: float | int | str | bool | None) -> None:
        """Keep a number or text in the manifest."""
        self.figures[name] = value

    def recording(self, blueprint: object) -> contextlib.AbstractContextManager[rr.RecordingStream]:
        """The stage's recording.rrd, with its blueprint."""
        name = f"{self.profile}/{self.scene.name}"
        return recording.open_recording(self.work / RECORDING, self.stage.name, name, blueprint)


def execute(
    stage: Stage[S],
    scene_name: str,
    profile: str,
    data: DataRoot,
    overrides: list[str] | None = None,
    seed: int = 0,
    force: bool = False,
) -> Path:
    """Run a stage unless a finished artefact with the same key is there, whole; returns the artefact's folder.

    The key is a hash of everything that the output depends on. A partial folder that a killed run left is continued
    when its key is the same, and dropped otherwise. Inputs are held while the stage runs, and verified before. Raises
    UserError for what a user can cause.
    """
    with prepared(stage, scene_name, profile, data, overrides or [], seed) as job:
        final, inputs = job.final, job.inputs
        title = f"{stage.name} · {scene_name} · {profile}"
        if not force and job.is_current():
            progress.console.print(f"{title}: up to date")
            (partial_folder(final) / STOPPED).unlink(missing_ok=True)  # with settings that were taken back
            return final

        work = partial_folder(final)
        for folder in (final, work):
            refuse_irreplaceable(folder)
        inputs.verify()
        _refuse_small_disk(work, stage.space_bytes(job.settings, inputs.frames()))
        sources = frozenset((name, need) for name, need, _ in inputs.sources)
        run = StageRun(stage, inputs.scene, profile, job.settings, seed, data, inputs.simulated(), work, sources)
        if isinstance(stage.run, Lazy):
            # What runs it stays in use: the garbage collector would look through it for nothing, again and again.
            gc.disable()
            stage.run.load()
            gc.freeze()
            gc.enable()
        start = time.monotonic()
        with PeakMemory() as memory:
            resumed = run_resumable(work, job.key, title, force, run.begin)
        elapsed = time.monotonic() - start
        try:
            inputs.refuse_changed()
        except UserError:
            shutil.rmtree(work, ignore_errors=True)  # its checkpoints may be of what was there meanwhile
            raise
        shutil.rmtree(work / _SCRATCH, ignore_errors=True)
        circumstances = _circumstances(run, elapsed, resumed, memory)
        if inputs.captures_state:
            circumstances["captures_state"] = inputs.captures_state
        write_json(work / MANIFEST, {"key": job.key, **job.parts, **circumstances, "outputs": output_hashes(work)})
        swap_in(work, final, listed_files)
        shown = final.relative_to(Path.cwd()) if final.is_relative_to(Path.cwd()) else final
        progress.console.print(f"{title}: done in {progress.format_seconds(elapsed)} → {shown}")
        return final


def _refuse_small_disk(work: Path, needed: int) -> None:
    """UserError where a run has not enough room to begin or go on: better now than hours later."""
    there = sum(path.lstat().st_size for path in work.rglob("*"))
    free = free_bytes(work)
    if free is not None and free + there < needed:
        raise UserError(
            "the disk is nearly full",
            where=work.parent,
            expected=f"about {(needed - there) / 2**20:,.0f} MiB for this stage",
            found=f"{free / 2**20:,.0f} MiB free",
            do="free some space, or name a data folder on another disk with --data",
        )


def _circumstances(run: StageRun[Any], elapsed: float, resumed: bool, memory: PeakMemory) -> dict[str, Any]:
    versions = dict.fromkeys(_VERSIONS, "not installed")
    for name in _VERSIONS:
        with contextlib.suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return {
        "simulated": run.simulated,
        "figures": run.figures,
        "seconds": {name: round(value, 3) for name, value in run.seconds.items()},
        "total_seconds": round(elapsed, 3),
        "resumed": resumed,
        "peak_memory_mib": round(memory.peak_bytes / 2**20, 1),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions | {"python": platform.python_version()},
        "git_revision": git_revision(),
        "machine": machine(),
        "recorded": (run.work / RECORDING).is_file(),
    }
