"""Import, sfm and align of one place with more and more frames: `python -m benchmarks.scale` (`make bench-scale`).

Simulated Church, images of 640x480, the features and pairs of profile demo; two thirds of the frames are for training.
Each size is kept as `<work>/<frames>.json` when it is done, and the same command goes on with the rest; captures and
runs are deleted. Writes docs/results/scale.md and scale.csv; sizes that aren't in <work> stay as the .csv there has
them.
"""

import json
import os
import shutil
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from benchmarks.groundtruth_inputs import PROFILE, ground_truth_targets, run_stage
from benchmarks.results import circumstances_of, markdown_table, write_page
from groundwalk.store import DataRoot
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import load_manifest

app = new_app(__doc__ or "")

_SCENE = "Church"
_MODULES = {"import": "capture_import", "sfm": "sfm", "align": "alignment"}
_TEST_SHARE = 3  # one of so many frames


def run_size(frames: int, root: DataRoot) -> dict[str, Any]:
    """Costs of the stages and errors of the ground truth for so many frames."""
    test = frames // _TEST_SHARE
    sizes = [f"train_frames={frames - test}", f"test_frames={test}", "frame_fraction=1.0"]
    run_stage("simulation", _SCENE, root, *sizes)
    row: dict[str, Any] = {"frames": frames}
    for stage, module in _MODULES.items():
        cost = run_stage(module, _SCENE, root)
        row |= {f"{stage} s": cost.wall_s, f"{stage} cpu s": cost.cpu_s, f"{stage} MiB": cost.peak_mib}
    truth, targets, _ = ground_truth_targets(_SCENE, root)
    row |= {target.name: target.value for target in targets}
    row["models"] = load_manifest(root.run(PROFILE, _SCENE, "sfm"))["figures"]["models"]
    row |= {f"class {name}": int((truth["quality"] == name).sum()) for name in "ABC"}
    revision = load_manifest(root.run(PROFILE, _SCENE, "align"))["git_revision"]
    return row | {"revision": revision, "date": f"{datetime.now(UTC):%Y-%m-%d}", "load": os.getloadavg()[0]}


def _exponent(rows: pd.DataFrame, column: str) -> str:
    """By how much a cost grows from the smallest to the largest size, as a power of the frames."""
    first, last = rows.iloc[0], rows.iloc[-1]
    return f"{np.log(last[column] / first[column]) / np.log(last['frames'] / first['frames']):.2f}"


def _percent(share: float | None) -> str:
    """Empty where the model has no covariances."""
    return "" if share is None or np.isnan(share) else f"{share:.0f} %"


def _table(rows: pd.DataFrame) -> Iterable[list[str]]:
    yield [
        *("frames", "with ground truth", "A, B, C", "models", "position cm: median, p95", "rotation deg"),
        *("inside 95 % bounds", *(f"{stage} s (processor), MiB" for stage in _MODULES), "load"),
    ]
    for row in rows.to_dict("records"):
        yield [
            str(row["frames"]),
            f"{row['frames with ground truth']:.1f} %",
            ", ".join(str(row[f"class {name}"]) for name in "ABC"),
            str(row["models"]),
            f"{row['position error, median']:.2f}, {row['position error, 95th percentile']:.2f}",
            f"{row['rotation error, median']:.3f}",
            _percent(row.get("position within 95 % bounds, whole")),
            *(f"{row[f'{s} s']:.0f} ({row[f'{s} cpu s']:.0f}), {row[f'{s} MiB']:.0f}" for s in _MODULES),
            f"{row['load']:.1f}",
        ]


@app.command()
def main(
    sizes: Annotated[str, typer.Option(help="Numbers of frames, joined by commas.")] = "500,1000,2500",
    work: Annotated[Path, typer.Option(help="Folder for results and, while a size runs, its data.")] = Path(
        "build/scale"
    ),
    out: Annotated[Path, typer.Option(help="Folder for the tables.")] = Path("docs/results"),
) -> None:
    """Run the sizes that have no result yet, and write the page."""
    work.mkdir(parents=True, exist_ok=True)
    for frames in map(int, sizes.split(",")):
        path, root = work / f"{frames}.json", DataRoot(work / f"data-{frames}")
        if not path.is_file():
            row = run_size(frames, root)  # its stages go on where they were stopped
            path.write_text(json.dumps(row, indent=1) + "\n", encoding="utf-8")
            shutil.rmtree(root.root)
    rows = pd.DataFrame([json.loads(path.read_text(encoding="utf-8")) for path in work.glob("*.json")])
    if (published := out / "scale.csv").is_file():
        rows = pd.concat([pd.read_csv(published), rows]).drop_duplicates("frames", keep="last")
    rows = rows.sort_values("frames")
    costs = [("time", f"{s} s") for s in _MODULES] + [("memory", f"{s} MiB") for s in _MODULES]
    growth = ", ".join(f"{column.split()[0]}'s {what} {_exponent(rows, column)}" for what, column in costs)
    sections = [
        "# Size of one place",
        "Written by `make bench-scale` (`python -m benchmarks.scale`), not to be edited; `scale.csv` has every figure. "
        "Simulated Church, walked through for longer and longer: 640x480, features and pairs as in profile demo. "
        "MiB: the largest process.",
        circumstances_of(rows["revision"], rows["date"]),
        markdown_table(_table(rows)),
        f"Growth from the smallest to the largest, as a power of the number of frames: {growth}.",
    ]
    write_page(out, "scale", sections, [list(rows), *rows.itertuples(index=False)])


if __name__ == "__main__":
    app()
