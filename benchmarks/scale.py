"""Import, sfm and align of one place with more and more frames: `python -m benchmarks.scale sizes`
(`make bench-scale`).

Simulated Church, images of 640x480, the features and pairs of profile demo; two thirds of the frames are for training.
Each size is kept as `<work>/<frames>.json` when it is done, and the same command goes on with the rest; captures and
runs are deleted. Writes docs/results/scale.md and scale.csv; sizes that aren't in <work> stay as the .csv there has
them. `python -m benchmarks.scale added` adds the last walk to ground truth of all others by `groundwalk add`, beside a
rebuild: docs/results/added.md.
"""

import json
import os
import shutil
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from benchmarks.cost import measure
from benchmarks.groundtruth_inputs import PROFILE, ground_truth_targets, run_stage
from benchmarks.results import circumstances, circumstances_of, kept, markdown_table, now, write_page
from groundwalk.geometry.fits import fit_yaw
from groundwalk.geometry.poses import rotation_angle
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import load_manifest
from groundwalk.store.tables import poses_of

app = new_app(__doc__ or "")

_SCENE = "Church"
_MODULES = {"import": "capture_import", "sfm": "sfm", "align": "alignment"}
_TEST_SHARE = 3  # one of so many frames


def _simulate(frames: int, root: DataRoot) -> None:
    test = frames // _TEST_SHARE
    sizes = [f"train_frames={frames - test}", f"test_frames={test}", "frame_fraction=1.0"]
    run_stage("simulation", _SCENE, root, *sizes)


def run_size(frames: int, root: DataRoot) -> dict[str, Any]:
    """Costs of the stages and errors of the ground truth for so many frames."""
    _simulate(frames, root)
    row: dict[str, Any] = {"frames": frames}
    for stage, module in _MODULES.items():
        cost = run_stage(module, _SCENE, root)
        row |= {f"{stage} s": cost.wall_s, f"{stage} cpu s": cost.cpu_s, f"{stage} MiB": cost.peak_mib}
    truth, targets, _ = ground_truth_targets(_SCENE, root)
    row |= {target.name: target.value for target in targets}
    row["models"] = load_manifest(root.run(PROFILE, _SCENE, "sfm"))["figures"]["models"]
    row |= {f"class {name}": int((truth["quality"] == name).sum()) for name in "ABC"}
    revision = load_manifest(root.run(PROFILE, _SCENE, "align"))["git_revision"]
    return row | now() | {"revision": revision, "load": os.getloadavg()[0]}


def _exponent(rows: pd.DataFrame, column: str) -> str:
    """By how much a cost grows from the smallest to the largest size, as a power of the frames."""
    first, last = rows.iloc[0], rows.iloc[-1]
    return f"{np.log(last[column] / first[column]) / np.log(last['frames'] / first['frames']):.2f}"


def _table(rows: pd.DataFrame) -> Iterable[list[str]]:
    yield [
        *("frames", "with ground truth", "A, B, C", "models", "position cm: median, p95", "rotation deg"),
        *("inside 95 % bounds", *(f"{stage} s (processor), MiB" for stage in _MODULES), "load", "revision"),
    ]
    for row in rows.to_dict("records"):
        inside = row.get("position within 95 % bounds, whole")  # of a model with covariances
        yield [
            str(row["frames"]),
            f"{row['frames with ground truth']:.1f} %",
            ", ".join(str(row[f"class {name}"]) for name in "ABC"),
            str(row["models"]),
            f"{row['position error, median']:.2f}, {row['position error, 95th percentile']:.2f}",
            f"{row['rotation error, median']:.3f}",
            "" if pd.isna(inside) else f"{inside:.0f} %",
            *(f"{row[f'{s} s']:.0f} ({row[f'{s} cpu s']:.0f}), {row[f'{s} MiB']:.0f}" for s in _MODULES),
            *(f"{row['load']:.1f}", row["revision"]),
        ]


@app.command()
def sizes(
    sizes: Annotated[str, typer.Option(help="Numbers of frames, joined by commas.")] = "500,1000,2500",
    work: Annotated[Path, typer.Option(help="Folder for results and, while a size runs, its data.")] = Path(
        "build/scale"
    ),
    out: Annotated[Path, typer.Option(help="Folder for the tables.")] = Path("docs/results"),
) -> None:
    """Run the sizes that have no result yet, and write the page."""
    for frames in map(int, sizes.split(",")):
        root = DataRoot(work / f"data-{frames}")
        kept(work / f"{frames}.json", partial(run_size, frames, root))  # its stages go on where they were stopped
        shutil.rmtree(root.root, ignore_errors=True)
    rows = pd.DataFrame([json.loads(path.read_text(encoding="utf-8")) for path in work.glob("*.json")])
    if (published := out / "scale.csv").is_file():
        rows = pd.concat([pd.read_csv(published), rows]).drop_duplicates("frames", keep="last")
    rows = rows.sort_values("frames")
    costs = [("time", f"{s} s") for s in _MODULES] + [("memory", f"{s} MiB") for s in _MODULES]
    growth = ", ".join(f"{column.split()[0]}'s {what} {_exponent(rows, column)}" for what, column in costs)
    sections = [
        "# Size of one place",
        "Written by `make bench-scale`, not to be edited; `scale.csv` has every figure. "
        "Simulated Church, walked through for longer and longer: 640x480, features and pairs as in profile demo. "
        "MiB: the largest process.",
        circumstances_of(rows["revision"], rows["date"]),
        markdown_table(_table(rows)),
        f"Growth from the smallest to the largest, as a power of the number of frames: {growth}.",
    ]
    write_page(out, "scale", sections, [list(rows), *rows.itertuples(index=False)])


@app.command()
def added(
    frames: Annotated[int, typer.Option(help="Frames of the whole place.")] = 500,
    walk: Annotated[str, typer.Option(help="The recording that is added.")] = "test-1",
    work: Annotated[Path, typer.Option(help="Folder for the data, an empty one.")] = Path("build/added"),
    out: Annotated[Path, typer.Option(help="Folder for the page.")] = Path("docs/results"),
) -> None:
    """A walk added to a finished ground truth, and a rebuild with it."""
    rebuilt, grown = DataRoot(work / "rebuilt"), DataRoot(work / "grown")
    _simulate(frames, rebuilt)
    shutil.copytree(rebuilt.captures(_SCENE), grown.captures(_SCENE), ignore=shutil.ignore_patterns(walk))
    for module in _MODULES.values():
        run_stage(module, _SCENE, grown)
    before = _truth(grown)
    arguments = [rebuilt.captures(_SCENE) / walk, "--scene", _SCENE, "--profile", PROFILE, "--data", grown.root]
    command = [sys.executable, "-m", "groundwalk", "add", *map(str, arguments)]
    adding = measure(command, grown.run(PROFILE, _SCENE))
    rebuilding = [run_stage(module, _SCENE, rebuilt) for module in _MODULES.values()]

    after, whole = _truth(grown), _truth(rebuilt)
    is_same = after.loc[before.index].equals(before)
    both = after.index[(after["quality"] != "none") & (whole.loc[after.index, "quality"] != "none")]
    poses, others = (poses_of(gt.loc[both], "map_cam") for gt in (after, whole))
    placed = fit_yaw(others[:, :3, 3], poses[:, :3, 3]) @ poses
    is_new = ~both.isin(before.index)
    off_m = np.linalg.norm(placed[:, :3, 3] - others[:, :3, 3], axis=1)[is_new]
    off_deg = np.degrees(rotation_angle(np.swapaxes(placed[:, :3, :3], 1, 2) @ others[:, :3, :3]))[is_new]
    wall_s, cpu_s = sum(c.wall_s for c in rebuilding), sum(c.cpu_s for c in rebuilding)
    rows = [
        ["", "seconds", "processor seconds", "MiB"],
        ["import to align", f"{wall_s:.0f}", f"{cpu_s:.0f}", f"{max(c.peak_mib for c in rebuilding):.0f}"],
        [f"groundwalk add {walk}", f"{adding.wall_s:.0f}", f"{adding.cpu_s:.0f}", f"{adding.peak_mib:.0f}"],
    ]
    sections = [
        "# A walk added to a finished ground truth",
        "Written by `python -m benchmarks.scale added`, not to be edited. Simulated Church, profile demo.",
        circumstances(),
        markdown_table(rows),
        f"Adding takes {adding.wall_s / wall_s:.0%} of a rebuild's time, {adding.cpu_s / cpu_s:.0%} of its processor "
        f"time: {is_new.sum()} frames to {len(before)}, whose rows are "
        f"{'the same to the bit' if is_same else 'CHANGED'}. Poses of the new frames against the rebuild's, after a "
        f"turn about the vertical and a shift of the whole: median {1e3 * np.median(off_m):.1f} mm and "
        f"{np.median(off_deg):.3f} deg, at most {1e3 * off_m.max():.1f} mm and {off_deg.max():.3f} deg; "
        f"{(after['quality'] == 'none').sum()} frames without a pose.",
    ]
    write_page(out, "added", sections)


def _truth(root: DataRoot) -> pd.DataFrame:
    path = root.run(PROFILE, _SCENE, "align") / "ground_truth.parquet"
    return pd.read_parquet(path).set_index("frame_id")


if __name__ == "__main__":
    app()
