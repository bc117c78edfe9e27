"""The runs below a data folder, by what their files say of them."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from groundwalk.store.files import STOPPED, partial_folder, read_json
from groundwalk.store.manifests import MANIFEST, is_manifest, outdated_stages
from groundwalk.store.settings import STAGES, DataRoot


@dataclass(frozen=True)
class RunFiles:
    """A run with a finished stage: the finished stages in order, those manifests of theirs that aren't damaged, the
    stages that are outdated, the report's verdict.json ({} where there is none), and why a stage stopped at its last
    attempt, `stage: what` ("": none did)."""

    folder: Path
    finished: list[str]
    manifests: dict[str, dict[str, Any]]
    outdated: list[str]
    verdict: dict[str, Any]
    stopped: str

    @property
    def name(self) -> tuple[str, str]:
        """Scene and profile."""
        return self.folder.name, self.folder.parent.name

    @property
    def simulated(self) -> bool:
        return any(manifest["simulated"] for manifest in self.manifests.values())


def runs_in(data: DataRoot, scene: str = "*") -> Iterator[RunFiles]:
    """All runs of a data folder, or those of a scene, by profile and name."""
    for folder in sorted((data.root / "runs").glob(f"*/{scene}")):
        finished = [stage for stage in STAGES if (folder / stage / MANIFEST).is_file()]
        contents = {stage: read_json(folder / stage / MANIFEST) for stage in finished}
        manifests = {stage: m for stage, m in contents.items() if is_manifest(m) and isinstance(m.get("scene"), dict)}
        stopped = {stage: read_json(partial_folder(folder / stage) / STOPPED).get("what") for stage in STAGES}
        if finished:
            yield RunFiles(
                folder=folder,
                finished=finished,
                manifests=manifests,
                outdated=list(outdated_stages(folder, manifests)),
                verdict=read_json(folder / "report" / "verdict.json"),
                stopped="; ".join(f"{stage}: {what}" for stage, what in stopped.items() if what),
            )


@dataclass(frozen=True)
class Finished:
    """A finished stage of a run, and what it took; 0 where its manifest doesn't say."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def seconds(self) -> float:
        """On the clock."""
        return float(self.manifest.get("total_seconds") or 0)

    @property
    def mib(self) -> float:
        """The most memory at once."""
        return float(self.manifest.get("peak_memory_mib") or 0)


def finished_stages(data: DataRoot, stage: str, profile: str = "*") -> list[Finished]:
    """The runs of a data folder that have finished a stage, of one profile or of all."""
    paths = sorted((data.root / "runs").glob(f"{profile}/*/{stage}/{MANIFEST}"))
    return [Finished(path.parent, read_json(path)) for path in paths]
