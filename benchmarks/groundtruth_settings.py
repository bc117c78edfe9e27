"""What sfm's settings are worth on a small simulated capture: `python -m benchmarks.groundtruth_settings --data data`.

Reads a finished import of a simulated scene, works in `--out` and holds everything against the true poses. Parts:
`features` (SIFT's settings) and `retrieval` (which frames of other sessions are proposed). Seconds are processor
seconds of one thread.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import pycolmap
import typer

from benchmarks.groundtruth_inputs import errors_after_sim3, true_poses
from groundwalk.artefacts import DataRoot, UserError
from groundwalk.artefacts.cli import ProfileOption, SceneOption, new_app
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.settings import resolve_settings
from groundwalk.artefacts.tables import poses_of, read_table
from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.model_adjustment import camera_log
from groundwalk.sfm.database import create_database, image_name, read_descriptors
from groundwalk.sfm.extensions import RETRIEVALS
from groundwalk.sfm.mapping.build import build_models, read_built, selected_models
from groundwalk.sfm.mapping.mappers import MappingInput
from groundwalk.sfm.mapping.source import VerifiedPairs
from groundwalk.sfm.model import load_models
from groundwalk.sfm.pairs.candidates import Pairs, sequence_pairs, unique_pairs, view_overlap
from groundwalk.sfm.pairs.features import extract_features
from groundwalk.sfm.pairs.matching import match_pairs
from groundwalk.sfm.pairs.retrieval import retrieval_pairs
from groundwalk.sfm.settings import SfmSettings

_REACH_M = 12.0
_OVERLAP = 0.5

app = new_app(__doc__ or "")


def quiet(done: int, note: str = "") -> None:
    """Report to nobody."""


class Part:
    """Some frames of an imported simulated scene, their true map_T_cam (N, 4, 4), and a folder for COLMAP's files."""

    def __init__(self, scene: str, data: DataRoot, profile: str, rows: np.ndarray, folder: Path) -> None:
        whole = read_table(data.run(profile, scene, "import") / "frames.parquet", schema("import", "frames"))
        self.frames = whole.iloc[rows].reset_index(drop=True)
        self.truth = true_poses(scene, data)[rows]
        self.session = self.frames["session_id"].to_numpy(str)
        self.folder, self.images = folder, folder / "images"
        self.names = [image_name(i, p) for i, p in zip(self.frames["frame_id"], self.frames["image"], strict=True)]
        for name, image in zip(self.names, self.frames["image"], strict=True):
            link = self.images / name
            link.parent.mkdir(parents=True, exist_ok=True)
            if not link.is_symlink():
                link.symlink_to((data.captures(scene) / image).resolve())

    def features(self, settings: SfmSettings, name: str = "features") -> tuple[Path, float]:
        """The database with the features of all frames, and the seconds that they took; made anew."""
        path = self.folder / f"{name}.db"
        path.unlink(missing_ok=True)
        create_database(path, self.frames, self.names)
        start = time.process_time()
        extract_features(quiet, path, self.images, self.names, settings)
        return path, time.process_time() - start

    def true_overlap(self, pairs: Pairs) -> Array:
        """The share of their views that two frames have in common up to some metres, walls between them aside, (P,)."""
        return overlap_of(self.frames, self.truth, pairs)


def overlap_of(frames: pd.DataFrame, world_T_cam: Array, pairs: Pairs) -> Array:
    intrinsics, size = frames[["fx", "fy", "cx", "cy"]].to_numpy(float), frames[["width", "height"]].to_numpy(float)
    return view_overlap(pairs, world_T_cam, intrinsics, size, _REACH_M)


def across_sessions(session_N: np.ndarray) -> Pairs:
    """All pairs of frames of two sessions."""
    a, b = np.triu_indices(len(session_N), 1)
    return np.stack([a, b], axis=1)[session_N[a] != session_N[b]]


def overlapping_rows(scene: str, data: DataRoot, profile: str, frames: int) -> np.ndarray:
    """Rows of the same number of consecutive frames of every session, where they see most of what the first one sees
    as it begins."""
    table = read_table(data.run(profile, scene, "import") / "frames.parquet", schema("import", "frames"))
    truth = true_poses(scene, data)
    sessions = [np.flatnonzero(table["session_id"] == s) for s in table["session_id"].unique()]
    each = frames // len(sessions)
    if min(map(len, sessions)) < each:
        raise UserError("the sessions are too short", expected=f"{each} frames", found=min(map(len, sessions)))
    seed = sessions[0][:each]
    chosen = [seed]
    for rows in sessions[1:]:
        pairs = np.stack(np.meshgrid(seed, rows, indexing="ij"), axis=-1).reshape(-1, 2)
        seen = overlap_of(table, truth, pairs).reshape(each, -1).max(axis=0)
        first = int(np.argmax(np.convolve(seen, np.ones(each), "valid")))
        chosen.append(rows[first : first + each])
    return np.concatenate(chosen)


def pairs_to_match(part: Part, settings: SfmSettings, database: Path) -> Pairs:
    """What the stage proposes first, without VIO."""
    descriptors = read_descriptors(database, len(part.names))
    image = RETRIEVALS[settings.retrieval].describe(descriptors, settings.retrieval_words, 0)
    alike = retrieval_pairs(image, part.session, settings.retrieval_pairs)
    following = sequence_pairs(part.session, part.frames["t_ns"], settings.sequence_pairs + settings.vio_pairs)
    return unique_pairs(np.concatenate([following, alike]))


def mapped(part: Part, database: Path, settings: SfmSettings, folder: Path) -> None:
    """Map the verified pairs of the database into `folder`."""
    frames = part.frames
    with pycolmap.Database.open(database) as opened:
        ids, inliers = opened.read_two_view_geometry_num_inliers()
    enough = [pycolmap.pair_id_to_image_pair(i) for i, n in zip(ids, inliers, strict=True) if n >= settings.min_inliers]
    target = folder.with_suffix(".db")
    pairs = unique_pairs(np.array(enough) - 1)
    verified = VerifiedPairs(frames=frames, pairs=pairs, matched=database, features=database)
    source = MappingInput(target, part.images, poses_of(frames, "vio_cam"), part.session.astype(object), 0)
    none = pd.DataFrame({"session_id": []})
    cameras = camera_log(frames, {}, none, none, settings)
    build_models(quiet, verified, source, cameras, settings, folder)


def features(part: Part, settings: SfmSettings) -> Iterator[Mapping[str, object]]:
    """SIFT's settings: more features, larger images."""
    for max_features in (settings.max_features // 2, settings.max_features, 2 * settings.max_features):
        for max_image_size in (settings.max_image_size // 2, settings.max_image_size):
            changed = settings.model_copy(update={"max_features": max_features, "max_image_size": max_image_size})
            database, extracting = part.features(changed)
            pairs = pairs_to_match(part, changed, database)
            start = time.process_time()
            match_pairs(quiet, database, pairs, changed, 0)
            matching = time.process_time() - start
            mapped(part, database, changed, part.folder / "mapping")
            model = load_models(
                [part.folder / "mapping" / m.folder for m in selected_models(read_built(part.folder / "mapping"))],
                len(part.frames),
            )
            row = {"max_features": max_features, "max_image_size": max_image_size, "features s": extracting}
            yield row | {"matching s": matching, **errors(model.sfm_T_cam, model.model, part.truth)}


def retrieval(part: Part, settings: SfmSettings) -> Iterator[Mapping[str, object]]:
    """Each descriptor's share of the pairs across sessions that truly overlap, at the same number of pairs."""
    database, _ = part.features(settings)
    descriptors = read_descriptors(database, len(part.names))
    every = across_sessions(part.session)
    true = part.true_overlap(every) >= _OVERLAP
    key = every[:, 0] * len(part.names) + every[:, 1]
    for name, entry in RETRIEVALS.items():
        start = time.process_time()
        image = entry.describe(descriptors, settings.retrieval_words, 0)
        seconds = time.process_time() - start
        for per_frame in (2, 4, 10):
            pairs = retrieval_pairs(image, part.session, per_frame)
            overlapping = true[np.searchsorted(key, pairs[:, 0] * len(part.names) + pairs[:, 1])]
            with_one = np.unique(pairs[overlapping])
            could = np.unique(every[true])
            yield {
                "retrieval": name,
                "pairs a frame": per_frame,
                "pairs": len(pairs),
                "of them overlapping %": 100 * overlapping.mean(),
                "overlapping pairs found %": 100 * overlapping.sum() / true.sum(),
                "frames with one %": 100 * len(with_one) / len(could),
                "s": seconds,
            }


def errors(sfm_T_cam: Array, model_N: np.ndarray, truth: Array) -> dict[str, float]:
    """Registered frames, and medians of the errors after a similarity fit of each model."""
    metres, degrees = errors_after_sim3(sfm_T_cam, model_N, truth)
    return {
        "registered %": 100 * float(np.mean(model_N >= 0)),
        "mm": 1000 * float(np.median(metres)) if len(metres) else float("nan"),
        "deg": float(np.median(degrees)) if len(degrees) else float("nan"),
    }


PARTS: dict[str, Callable[[Part, SfmSettings], Iterator[Mapping[str, object]]]] = {
    "features": features,
    "retrieval": retrieval,
}


@app.command()
def main(
    scene: SceneOption = "Church",
    profile: ProfileOption = "demo",
    data: Annotated[Path, typer.Option(help="Data folder with the scene's finished import.")] = Path("data"),
    only: Annotated[list[str] | None, typer.Option(help=f"Only these parts: {', '.join(PARTS)}.")] = None,
    out: Annotated[Path, typer.Option(help="Work here.")] = Path("build/groundtruth_settings"),
    frames: Annotated[int, typer.Option(help="Frames of features, where the sessions meet.")] = 60,
    spread: Annotated[int, typer.Option(help="Frames of retrieval, spread over the whole scene.")] = 120,
) -> None:
    """Run the parts and print a Markdown table of each."""
    unknown = sorted(set(only or []) - set(PARTS))
    if unknown:
        raise UserError("there is no such part", found=", ".join(unknown), expected=f"some of {', '.join(PARTS)}")
    root = DataRoot(data)
    settings = resolve_settings(SfmSettings, "sfm", root, profile, scene, ["threads=1"])
    count = len(read_table(root.run(profile, scene, "import") / "frames.parquet", schema("import", "frames")))
    for part in only or PARTS:
        if part == "retrieval":
            rows = np.unique(np.linspace(0, count - 1, min(spread, count)).astype(int))
        else:
            rows = overlapping_rows(scene, root, profile, frames)
        print(f"\n{scene}, {part}, {len(rows)} frames: {(PARTS[part].__doc__ or '').splitlines()[0]}\n")
        for number, row in enumerate(
            PARTS[part](Part(scene, root, profile, rows, out.resolve() / scene / part), settings)
        ):
            if not number:
                print("|" + "|".join(f" {name} " for name in row) + "|")
                print("|" + "---|" * len(row))
            values = (f" {value:.4g} " if isinstance(value, float) else f" {value} " for value in row.values())
            print("|" + "|".join(values) + "|", flush=True)


if __name__ == "__main__":
    app()
