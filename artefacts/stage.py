"""Running a stage: its inputs and key, its partial folder, its manifest, and the rename that finishes it."""

import contextlib
import hashlib
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Generic, TypeVar

import pandas as pd
import rerun as rr

from artefacts import progress, recording
from artefacts.errors import UserError
from artefacts.locks import locked
from artefacts.schemas import schema
from artefacts.settings import SHIPPED_DATA, DataRoot, SceneConfig, Settings, resolve_settings
from artefacts.simulated import SIMULATED_MARKER, TRUTH_FILES
from artefacts.tables import dataset_frames, read_table, write_table

S = TypeVar("S", bound=Settings)
T = TypeVar("T")

MANIFEST = "manifest.json"
KEY_FILE = "key.json"
_SCRATCH = "scratch"
UNHASHED = (MANIFEST, recording.RECORDING, KEY_FILE)
_VERSIONS = (
    "groundwalk",
    "numpy",
    "opencv-python-headless",
    "pyarrow",
    "pycolmap",
    "rerun-sdk",
    "scipy",
    "torch",
)


@dataclass(frozen=True)
class Stage(Generic[S]):
    """A stage of the pipeline.

    `version` goes up when the same input gives another output, so that old artefacts are made again.
    `reads_captures` is for import, the one stage whose input is the capture folder.
    """

    name: str
    version: int
    settings: type[S]
    needs: tuple[str, ...]
    run: Callable[["StageRun[S]"], None]
    help: str
    reads_captures: bool = False
    reads_shipped: tuple[str, ...] = ()  # folders of the repository's data/


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
    figures: dict[str, Any] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)

    @property
    def captures(self) -> Path:
        """data/captures/<scene>, the capture folder."""
        return self.data.captures(self.scene.name)

    @property
    def scratch(self) -> Path:
        """A folder for safe points: survives a kill, dropped when the stage ends."""
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
            raise _missing_input(stage, path, scene or self.scene.name)
        return path

    def read(self, stage: str, table: str, scene: str | None = None) -> pd.DataFrame:
        """A table of a finished stage of this scene (or of a group's member)."""
        return read_table(self.folder(stage, scene) / f"{table}.parquet", schema(stage, table))

    def dataset_frames(self, scene: str | None = None) -> pd.DataFrame:
        """import.frames without support frames: what every stage reads but sfm and align."""
        return dataset_frames(self.read("import", "frames", scene))

    def manifest(self, stage: str, scene: str | None = None) -> dict[str, Any]:
        """The manifest of a finished stage."""
        return load_manifest(self.folder(stage, scene))

    def image_path(self, image: str, scene: str | None = None) -> Path:
        """The absolute path of a `frames.image` entry: relative to the capture folder, or to the import artefact
        where import copied the image (`import:` in front)."""
        name = scene or self.scene.name
        if image.startswith("import:"):
            return self.data.run(self.profile, name, "import") / image.removeprefix("import:")
        return self.data.captures(name) / image

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
        progress.console.print(f"  {text}", markup=False)

    def figure(self, name: str, value: float | int | str | bool | None) -> None:
        """Keep a number or text in the manifest."""
        self.figures[name] = value

    @contextlib.contextmanager
    def recording(self, blueprint: object) -> Iterator[rr.RecordingStream]:
        """The stage's recording.rrd, with its blueprint."""
        name = f"{self.profile}/{self.scene.name}"
        with recording.open_recording(self.work / recording.RECORDING, self.stage.name, name, blueprint) as stream:
            yield stream


def execute(
    stage: Stage[S],
    scene_name: str,
    profile: str,
    data: DataRoot,
    overrides: list[str] | None = None,
    seed: int = 0,
    force: bool = False,
) -> Path:
    """Run a stage unless a finished artefact with the same key is there; returns the artefact's folder.

    The key is a hash of everything that the output depends on. A partial folder that a killed run left is continued
    when its key is the same, and dropped otherwise. Raises UserError for what a user can cause.
    """
    scene, _ = data.scene(scene_name)
    if scene.is_group and stage.name not in scene.stages:
        members = ", ".join(data.leaves(scene))
        raise UserError(
            f"{scene_name} is a group of scenes and has no stage {stage.name}",
            expected=f"one of {', '.join(scene.stages)}, or one of its scenes: {members}",
        )
    settings = resolve_settings(stage.settings, stage.name, data, profile, scene_name, overrides or [])
    final = data.run(profile, scene_name, stage.name)
    with locked(final):
        _finish_interrupted_rename(final)
        inputs = _inputs(stage, scene, profile, data)
        parts = {
            "stage": stage.name,
            "version": stage.version,
            "scene": scene.model_dump(mode="json"),
            "profile": profile,
            "settings": settings.model_dump(mode="json"),
            "seed": seed,
            "inputs": inputs,
        }
        key = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
        title = f"{stage.name} · {scene_name} · {profile}"
        if not force and (final / MANIFEST).is_file() and load_manifest(final).get("key") == key:
            progress.console.print(f"{title}: up to date", markup=False)
            os.utime(final / MANIFEST)
            return final

        work = partial_folder(final)
        resumed = _same_key(work, key) and not force
        if not resumed:
            shutil.rmtree(work, ignore_errors=True)
            work.mkdir(parents=True)
            (work / KEY_FILE).write_text(json.dumps({"key": key}))
        progress.console.print(
            f"{title}{': goes on where it was stopped' if resumed else ''}", markup=False, style="bold"
        )
        run = StageRun(stage, scene, profile, settings, seed, data, _simulated(stage, scene, profile, data), work)
        start = time.monotonic()
        stage.run(run)
        elapsed = time.monotonic() - start
        shutil.rmtree(work / _SCRATCH, ignore_errors=True)
        manifest = {"key": key, **parts, **_circumstances(run, elapsed, resumed), "outputs": _outputs(work)}
        write_json(work / MANIFEST, manifest)
        swap_in(work, final)
        progress.console.print(f"{title}: done in {progress.format_seconds(elapsed)} → {_shown(final)}", markup=False)
        return final


def load_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of an artefact folder; UserError where it can't be read."""
    try:
        content: dict[str, Any] = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError("a manifest can't be read", where=folder / MANIFEST, found=error) from None
    return content


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file, {} where there is none that can be read."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def write_json(path: Path, content: object) -> None:
    """Write JSON atomically."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(json.dumps(content, indent=2, allow_nan=False, default=str) + "\n", encoding="utf-8")
    partial.replace(path)


def hash_files(folder: Path, files: Iterable[Path]) -> dict[str, str]:
    """sha256 of files by their path relative to `folder`."""
    paths = sorted(files)
    with ThreadPoolExecutor() as pool:
        digests = pool.map(_sha256, paths)
        return {path.relative_to(folder).as_posix(): digest for path, digest in zip(paths, digests, strict=True)}


def capture_files(captures: Path) -> list[Path]:
    """The files of a capture folder that import may read: not those which hold the simulator's truth or notes."""
    found = []
    for base, folders, names in os.walk(captures, followlinks=False):
        folders[:] = sorted(f for f in folders if not f.startswith("."))
        at_top = Path(base) == captures
        for name in sorted(names):
            if not (name.startswith(".") or (at_top and name in TRUTH_FILES)):
                found.append(Path(base) / name)
    return found


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _inputs(stage: Stage[Any], scene: SceneConfig, profile: str, data: DataRoot) -> dict[str, Any]:
    """What the stage reads, each with a hash of its content."""
    if stage.reads_captures:
        captures = data.captures(scene.name)
        files = [path for path in capture_files(captures) if path.is_file()] if captures.is_dir() else []
        if not files:
            raise UserError(
                f"scene {scene.name} has no captures",
                where=captures,
                expected="a folder of phone captures",
                found="nothing",
                do=f"make scene={scene.name} captures=<your folder> all",
            )
        hashes = hash_files(captures, files)
        digest = hashlib.sha256(json.dumps(hashes, sort_keys=True).encode()).hexdigest()
        return {"captures": {"files": len(hashes), "sha256": digest}}
    sources = [(leaf, need) for leaf in data.leaves(scene) for need in stage.needs]
    if scene.is_group:
        for group in (*scene.members, scene.name):
            config = data.scene(group)[0]
            if config.is_group:
                sources += [(group, need) for need in stage.needs if need in config.stages]
    inputs = {}
    for name, need in sources:
        folder = data.run(profile, name, need)
        if not (folder / MANIFEST).is_file():
            raise _missing_input(need, folder, name)
        inputs[f"{name}/{need}"] = load_manifest(folder)["outputs"]
    for name in stage.reads_shipped:
        folder = SHIPPED_DATA / name
        inputs[f"data/{name}"] = hash_files(folder, sorted(path for path in folder.rglob("*") if path.is_file()))
    return inputs


def _missing_input(stage: str, folder: Path, scene: str) -> UserError:
    return UserError(f"stage {stage} of scene {scene} hasn't been run", where=folder, do=f"make scene={scene} {stage}")


def _simulated(stage: Stage[Any], scene: SceneConfig, profile: str, data: DataRoot) -> bool:
    """Whether any capture behind this run is simulated, as import saw it."""
    if stage.reads_captures:
        return (data.captures(scene.name) / SIMULATED_MARKER).is_file()
    return any(bool(load_manifest(data.run(profile, leaf, "import"))["simulated"]) for leaf in data.leaves(scene))


def _circumstances(run: StageRun[Any], elapsed: float, resumed: bool) -> dict[str, Any]:
    peak = max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return {
        "simulated": run.simulated,
        "figures": run.figures,
        "seconds": {name: round(value, 3) for name, value in run.seconds.items()},
        "total_seconds": round(elapsed, 3),
        "resumed": resumed,
        # Linux counts kilobytes, macOS bytes.
        "peak_memory_mib": round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": {name: _version(name) for name in _VERSIONS} | {"python": platform.python_version()},
        "git_revision": _git_revision(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def _git_revision() -> str:
    here = Path(__file__).resolve().parent
    try:
        shown = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=12"],
            cwd=here,
            capture_output=True,
            text=True,
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return shown.stdout.strip()


def _outputs(work: Path) -> dict[str, str]:
    unhashed = {work / name for name in UNHASHED}
    return hash_files(work, (p for p in work.rglob("*") if p.is_file() and p not in unhashed))


def partial_folder(final: Path) -> Path:
    """Where a run writes until it ends: beside the folder that it becomes."""
    return final.with_name(f".{final.name}.partial")


def old_folder(final: Path) -> Path:
    """Where a replaced folder is between the two renames of `swap_in`."""
    return final.with_name(f".{final.name}.old")


def _same_key(work: Path, key: str) -> bool:
    return bool(read_json(work / KEY_FILE).get("key") == key)


def swap_in(work: Path, final: Path) -> None:
    """Put a finished folder in its place; a kill between the two renames is mended by the next run."""
    old = old_folder(final)
    (work / KEY_FILE).unlink(missing_ok=True)
    shutil.rmtree(old, ignore_errors=True)
    if final.exists():
        final.rename(old)
    work.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def _finish_interrupted_rename(final: Path) -> None:
    work, old = partial_folder(final), old_folder(final)
    if (work / MANIFEST).is_file():
        swap_in(work, final)
    elif old.exists() and not final.exists():
        old.rename(final)
    shutil.rmtree(old, ignore_errors=True)


def _shown(path: Path) -> str:
    try:
        return str(path.relative_to(Path.cwd()))
    except ValueError:
        return str(path)
