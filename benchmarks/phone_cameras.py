"""Ground truth of simulated phones whose lens, shutter and focus nobody states: `python -m benchmarks.phone_cameras`.

Grid: scenes of the demo's size with lenses, readout times and focus breathing as measured on phones, against the truth;
one of each scene, and one with fewer frames, beside stock COLMAP on the same images (every pair matched, one OPENCV
camera a session). Walks: small captures (320x240, three walks; capture n has seed 100 + n), a lens and readout time
drawn for each, to count how often the stated uncertainties hold. Weak: one small walk each whose geometry hardly tells
the focal length (`benchmarks.weak_captures`), up to sfm. Each case is kept as `<work>/<part>/<case>.json` when it is
done, and the same command goes on with the rest; its captures and runs are deleted. Writes
docs/results/phone-cameras.md and .csv; cases that aren't in <work> stay as the .csv there has them.
"""

import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from benchmarks import groundtruth_inputs as inputs
from benchmarks.cost import run_timed
from benchmarks.gates import PLACES, SFM_OF_SMALL
from benchmarks.gates import PROFILE as SMALL
from benchmarks.gates_captures import Capture, write_capture
from benchmarks.results import circumstances_of, markdown_table, now, write_page
from benchmarks.stock import stock_cost, stock_poses
from benchmarks.weak_captures import KINDS, write_weak_capture
from groundwalk.capture_import.definition import STAGE as IMPORT
from groundwalk.sfm.definition import STAGE as SFM
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.tables import read_table, table_of

app = new_app(__doc__ or "")

# Columns of sfm.lenses that are held against the truth, and those of their standard deviations.
_ESTIMATES = {"k1": "k1_sd", "k2": "k2_sd", "k3": "k3_sd", "readout_s": "readout_sd_s"}


@dataclass(frozen=True)
class Phone:
    """A scene of the demo and the camera that walks through it; `frame_fraction` where there are fewer frames."""

    scene: str
    k1: float
    k2: float
    readout_s: float
    breathing: float
    beside_stock: bool = False
    frame_fraction: float | None = None

    @property
    def name(self) -> str:
        fewer = "" if self.frame_fraction is None else f"_{100 * self.frame_fraction:g}% of frames"
        return f"{self.scene}_{self.k1:g}_{self.k2:g}_{1000 * self.readout_s:g}ms_{100 * self.breathing:g}%{fewer}"


GRID = [
    Phone("Office", 0.075, -0.16, 0.013, 0.0, beside_stock=True, frame_fraction=0.04),
    Phone("Church", 0.075, -0.16, 0.013, 0.0, beside_stock=True),
    Phone("Office", 0.092, -0.125, 0.03, 0.005),
    Phone("Church", 0.0, 0.0, 0.0, 0.0),
    Phone("Office", 0.16, -0.40, 0.01, 0.005),
    Phone("Church", 0.092, -0.125, 0.02, 0.005),
    Phone("Office", 0.0, 0.0, 0.02, 0.0),
    Phone("Church", 0.16, -0.40, 0.03, 0.0),
    Phone("Office", 0.05, -0.05, 0.0, 0.005),
    Phone("Church", 0.12, -0.20, 0.0, 0.005),
    Phone("Office", 0.12, -0.20, 0.02, 0.0),
    Phone("Church", 0.05, -0.05, 0.01, 0.005),
    Phone("Office", 0.075, -0.16, 0.013, 0.0, beside_stock=True),
]
# What a case of the grid must keep: the largest, or from least to most.
_LIMITS: dict[str, tuple[str, float, float]] = {
    "frames with ground truth": ("%", 100.0, 100.0),
    "position error, median": ("cm", 0.0, 0.6),
    "position error, 95th percentile": ("cm", 0.0, 1.5),
    "rotation error, median": ("deg", 0.0, 0.03),
    **{
        f"{what} within 95 % bounds, {part}": ("%", 85.0, 99.0 if part == "SfM's part" else 100.0)
        for what in ("position", "rotation")
        for part in ("SfM's part", "whole")
    },
}


def run_phone(phone: Phone, work: Path) -> dict[str, Any]:
    """The figures of one case of the grid."""
    root = DataRoot(work / "data")
    shutil.rmtree(root.root, ignore_errors=True)
    settings = [f"lens=[{phone.k1}, {phone.k2}, 0]", f"readout_s={phone.readout_s}"]
    settings.append(f"focus_breathing={phone.breathing}")
    settings += [] if phone.frame_fraction is None else [f"frame_fraction={phone.frame_fraction}"]
    inputs.simulated(phone.scene, root, *settings)
    figures: dict[str, Any] = {}
    for module in ("sfm", "alignment"):
        folder = root.run(inputs.PROFILE, phone.scene, module)
        arguments = ["--scene", phone.scene, "--profile", inputs.PROFILE, "--data", str(root.root)]
        log = work / f"{module}.log"
        status, cost = run_timed([sys.executable, "-m", f"groundwalk.{module}", *arguments], folder, log)
        figures |= {f"{module}_cpu_s": cost.cpu_s, f"{module}_wall_s": cost.wall_s, f"{module}_mib": cost.peak_mib}
        if status:
            return figures | {"refused": log.read_text(encoding="utf-8")[-2000:]}
    figures |= _against_truth(phone.scene, inputs.PROFILE, root)
    if phone.beside_stock:
        figures |= _stock(phone, root, work / "stock", figures)
    shutil.rmtree(root.root)
    return figures


def run_walk(number: int, work: Path) -> dict[str, Any]:
    """The figures of one small capture whose phone is drawn by its number."""
    capture = Capture(PLACES[number % len(PLACES)], 100 + number)
    data = DataRoot(work / "data")
    figures: dict[str, Any] = {"place": capture.place}
    if refusal := _mapped(data, lambda folder: write_capture(folder, capture)):
        return figures | refusal
    arguments = ["--scene", "Case", "--profile", SMALL, "--data", str(data.root)]
    status, _ = run_timed([sys.executable, "-m", "groundwalk.alignment", *arguments], work, work / "alignment.log")
    if status:
        figures |= _cameras("Case", SMALL, data)
        return figures | {"refused": (work / "alignment.log").read_text(encoding="utf-8")[-2000:]}
    return figures | _against_truth("Case", SMALL, data)


def run_weak(kind: str, seed: int, work: Path) -> dict[str, Any]:
    """The figures of one walk of a kind of `benchmarks.weak_captures`."""
    data = DataRoot(work / "data")
    figures: dict[str, Any] = {"kind": kind}
    refusal = _mapped(data, lambda folder: write_weak_capture(folder, kind, seed), "retry=false")
    return figures | (refusal or _cameras("Case", SMALL, data))


def _mapped(data: DataRoot, write: Callable[[Path], None], *settings: str) -> dict[str, Any]:
    """Write a small capture and take it through import and sfm; why one refuses it, where one does."""
    shutil.rmtree(data.root, ignore_errors=True)
    data.captures("Case").parent.mkdir(parents=True)
    write(data.captures("Case"))
    try:
        execute(IMPORT, "Case", SMALL, data, [])
        execute(SFM, "Case", SMALL, data, [*SFM_OF_SMALL, *settings])
    except UserError as error:
        return {"refused": " ".join(str(error).split())}
    return {}


def _against_truth(scene: str, profile: str, root: DataRoot) -> dict[str, Any]:
    """Errors and coverage of a scene's ground truth, and the cameras that were estimated beside the true ones."""
    gt, targets, _ = inputs.ground_truth_targets(scene, root, profile)
    classes = gt["quality"].value_counts()
    return {
        "frames": len(gt),
        **{f"class_{name}": int(classes.get(name, 0)) for name in "ABC"},
        "frames_over_2_cm": int(np.count_nonzero(inputs.ground_truth_errors(gt, scene, root, profile) > 0.02)),
        **{target.name: target.value for target in targets},
        **_cameras(scene, profile, root),
    }


def _cameras(scene: str, profile: str, root: DataRoot) -> dict[str, Any]:
    """k1, k2, k3, readout time, offset of time stamps and focal length by the largest model, with their sigmas, and the
    true ones."""
    run = root.run(profile, scene)
    images, frames = table_of(run, "sfm", "images"), table_of(run, "import", "frames")
    sessions = table_of(run, "import", "sessions").set_index("session_id")
    cameras = read_table(root.captures(scene) / "true_cameras.parquet", schema("simulate", "true_cameras"))
    keys = pd.DataFrame({"session_id": frames["session_id"].map(sessions["recording"]), "t_ns": frames["t_ns"]})
    true = keys.merge(cameras, on=["session_id", "t_ns"], how="left", validate="many_to_one")
    lens = table_of(run, "sfm", "lenses").sort_values("frames").iloc[-1]
    intrinsics = table_of(run, "sfm", "intrinsics")
    registered = images["registered"].to_numpy()
    focal_error = images["fx"].to_numpy()[registered] / true["fx"].to_numpy()[registered] - 1
    figures: dict[str, Any] = {
        "revision": load_manifest(run / "sfm")["git_revision"],
        "registered": int(registered.sum()),
        "focal_error": float(np.median(focal_error)),
        "focal_sd": float((intrinsics["focal_scale_sd"] / intrinsics["focal_scale"]).median()),
    }
    for name, sd in _ESTIMATES.items():
        figures |= {name: float(lens[name]), f"{name}_sd": float(lens[sd]), f"true_{name}": float(true[name].iloc[0])}
    return figures


def _stock(phone: Phone, root: DataRoot, folder: Path, ours: dict[str, Any]) -> dict[str, Any]:
    """Errors and costs of stock COLMAP on the images of a case, beside `ours`."""
    cost = stock_cost(phone.scene, inputs.PROFILE, root, folder)
    truth = inputs.true_poses(phone.scene, root)
    metres, degrees = inputs.errors_after_sim3(*stock_poses(folder, len(truth)), truth)
    shutil.rmtree(folder)
    return {
        "stock_registered": len(metres),
        "stock position error, median": 100 * float(np.median(metres)),
        "stock position error, 95th percentile": 100 * float(np.percentile(metres, 95)),
        "stock rotation error, median": float(np.median(degrees)),
        "stock_cpu_s": cost.cpu_s,
        "stock_wall_s": cost.wall_s,
    }


def _run_parts(cases: dict[tuple[str, str], Callable[[Path], dict[str, Any]]], seconds: float, work: Path) -> None:
    """Run the cases, by part and name, that have no result yet."""
    start = time.monotonic()
    for (part, name), run in cases.items():
        path = work / part / f"{name}.json"
        if path.is_file() or (seconds and time.monotonic() - start > seconds):
            continue
        folder = work / part / name
        folder.mkdir(parents=True, exist_ok=True)
        begun = time.monotonic()
        figures = run(folder) | {"date": now()["date"], "load": os.getloadavg()[0]}
        path.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
        shutil.rmtree(folder)
        print(f"{part} {name}: {time.monotonic() - begun:.0f} s", flush=True)


def _rows(work: Path, published: Path, part: str) -> list[dict[str, Any]]:
    """The results of a part's cases: those that the table has, and those of `work` in their place."""
    rows: dict[str, dict[str, Any]] = {}
    if published.is_file():
        table = pd.read_csv(published, dtype=str, keep_default_na=False)
        for _, case, figure, value in table[table["part"] == part].itertuples(index=False):
            rows.setdefault(case, {"case": case})[figure] = _value(figure, value)
    for path in (work / part).glob("*.json"):
        rows[path.stem] = {"case": path.stem, **json.loads(path.read_text(encoding="utf-8"))}
    return [rows[case] for case in sorted(rows)]


def _value(figure: str, text: str) -> Any:
    if figure in ("revision", "date", "place", "kind", "refused"):
        return text
    return float(text) if set(text) & set(".en") else int(text)


def _grid_table(rows: list[dict[str, Any]]) -> Iterable[list[str]]:
    yield [
        *("case", "ground truth of", "A, B, C", "position cm: median, p95", "rotation deg"),
        *("inside 95 % bounds, position: SfM's part, whole", "rotation: SfM's part, whole", "missed", "k1", "k2"),
        *("readout ms", "sfm s (processor)", "sfm MiB", "revision"),
    ]
    for row in rows:
        if "refused" in row:
            yield [row["case"], "refused", *[""] * 12]
            continue
        inside = [
            [f"{row[f'{what} within 95 % bounds, {part}']:.1f}" for part in ("SfM's part", "whole")]
            for what in ("position", "rotation")
        ]
        yield [
            row["case"],
            f"{_with_ground_truth(row)} of {row['frames']}",
            f"{row['class_A']}, {row['class_B']}, {row['class_C']}",
            f"{row['position error, median']:.2f}, {row['position error, 95th percentile']:.2f}",
            f"{row['rotation error, median']:.3f}",
            ", ".join(inside[0]),
            ", ".join(inside[1]),
            ", ".join(_missed(row)),
            *(_estimate(row, name) for name in ("k1", "k2", "readout_s")),
            f"{row['sfm_wall_s']:.0f} ({row['sfm_cpu_s']:.0f})",
            f"{row['sfm_mib']:.0f}",
            row["revision"],
        ]
    finished = [row for row in rows if "refused" not in row]
    means = [f"{np.mean([row[name] for row in finished]):.1f}" for name in _LIMITS if "bounds" in name]
    yield ["mean of the cases", *[""] * 4, ", ".join(means[:2]), ", ".join(means[2:]), *[""] * 7]


def _with_ground_truth(row: dict[str, Any]) -> int:
    return sum(row[f"class_{name}"] for name in "ABC")


def _missed(row: dict[str, Any]) -> list[str]:
    """The figures of a case that aren't between their limits."""
    return [name for name, (_, least, most) in _LIMITS.items() if name in row and not least <= row[name] <= most]


def _estimate(row: dict[str, Any], name: str) -> str:
    scale, digits = (1000.0, 2) if name == "readout_s" else (1.0, 4)
    value, sd, true = (scale * row[column] for column in (name, f"{name}_sd", f"true_{name}"))
    return f"{value:.{digits}f} ± {sd:.{digits}f} ({true:.{digits}f})"


def _stock_table(rows: list[dict[str, Any]]) -> Iterable[list[str]]:
    yield ["case", "figure", "ours", "stock", "ours / stock", "to reach"]
    for row in (row for row in rows if "stock_cpu_s" in row):
        for name in list(_LIMITS)[1:4]:
            yield [row["case"], f"{name}, {_LIMITS[name][0]}", *_ratio(row[name], row[f"stock {name}"]), "≤ 0.5"]
        for name, label in (("wall_s", "seconds"), ("cpu_s", "processor seconds")):
            yield [row["case"], label, *_ratio(row[f"sfm_{name}"], row[f"stock_{name}"]), "≤ 0.25"]


def _ratio(ours: float, stock: float) -> list[str]:
    return [f"{ours:.3g}", f"{stock:.3g}", f"{ours / stock:.2f}"]


def _walks_table(rows: list[dict[str, Any]]) -> Iterable[list[str]]:
    estimated = [row for row in rows if "k1" in row]
    given = [row for row in rows if "refused" not in row]
    yield ["figure", "value", "to reach"]
    yield ["captures", str(len(rows)), ""]
    yield ["refused", str(len(rows) - len(given)), ""]
    for name in _ESTIMATES:
        error, sd = np.array([(row[name] - row[f"true_{name}"], row[f"{name}_sd"]) for row in estimated]).T
        known = np.isfinite(error) & np.isfinite(sd)
        inside = np.count_nonzero(np.abs(error[known]) <= 1.96 * sd[known])
        yield [f"{name} inside its 95 % bounds", f"{inside} of {known.sum()}", "85 to 99 %"]
        yield [f"{name} error, RMS", f"{np.sqrt(np.mean(error[known] ** 2)):.5f}", ""]
    focal = 100 * np.abs([row["focal_error"] for row in estimated])
    of_all = f"{np.median(focal):.2f}, {np.percentile(focal, 95):.2f}"
    yield ["focal length error, median, 95th percentile, %", of_all, "≤ 0.3"]
    p95_cm = np.array([row["position error, 95th percentile"] for row in given])
    yield [
        "ground truth p95 of a capture, cm: median of captures, captures over 2 cm",
        f"{np.median(p95_cm):.2f}, {int((p95_cm > 2).sum())} of {len(p95_cm)}",
        "≤ 2",
    ]
    # Captures that an older revision ran have no such count.
    if counted := [row for row in given if "frames_over_2_cm" in row]:
        over = sum(row["frames_over_2_cm"] for row in counted)
        placed = sum(_with_ground_truth(row) for row in counted)
        yield [
            f"frames with an error over 2 cm, of {len(counted)} captures (5 % of them: a 95th percentile of 2 cm)",
            f"{over} of {placed}, {100 * over / placed:.1f} %",
            "≤ 5 %",
        ]
    for name in (name for name in _LIMITS if "bounds" in name):
        frames = np.array([row["frames"] for row in given if name in row])
        inside_share = np.array([row[name] for row in given if name in row])
        yield [name, f"{np.average(inside_share, weights=frames):.1f} %", "85 to 99 %"]


def _weak_table(rows: list[dict[str, Any]]) -> Iterable[list[str]]:
    inside = "focal length inside its 95 % bounds"
    yield ["kind", "captures", "refused", inside, "error %: RMS", "stated %: median", "k1"]
    for kind in (*KINDS, "all"):
        of_kind = [row for row in rows if kind in ("all", row["kind"])]
        given = pd.DataFrame([row for row in of_kind if "refused" not in row])
        error, sd = given["focal_error"], given["focal_sd"]
        k1_error = (given["k1"] - given["true_k1"]).abs()
        yield [
            *(kind, str(len(of_kind)), str(len(of_kind) - len(given))),
            f"{(error.abs() <= 1.96 * sd).sum()} of {len(given)}",
            *(f"{100 * np.sqrt((error**2).mean()):.2f}", f"{100 * sd.median():.2f}"),
            f"{(k1_error <= 1.96 * given['k1_sd']).sum()} of {len(given)}",
        ]


def _write(work: Path, out: Path) -> bool:
    """Write the tables of all cases that ran; whether all figures of the grid are met."""
    parts = {part: _rows(work, out / "phone-cameras.csv", part) for part in ("grid", "walks", "weak")}
    grid, walks, weak = parts.values()
    runs = grid + walks + weak
    revisions, dates = ([str(row.get(name)) for row in runs] for name in ("revision", "date"))
    loads = [f"{row['load']:.1f}" for row in grid]
    sections = [
        "# Simulated phones: lens, rolling shutter and focus unknown",
        "Written by `make bench-cameras` (`python -m benchmarks.phone_cameras`), not to be edited; `phone-cameras.csv` "
        "has every figure. All simulated. The app states a pinhole; sfm estimates the rest.",
        circumstances_of(revisions, dates),
    ]
    if grid:
        limits = "; ".join(f"{name} {low:g} to {high:g} {unit}" for name, (unit, low, high) in _LIMITS.items())
        sections += [
            "## Grid",
            "Named by scene, k1, k2, readout and focus breathing (share of the focal length); profile demo (its "
            "fraction of the paper's frames where no other is named), seed 0. "
            f"Estimates ± one sigma (true). To reach: {limits}. Errors of one capture's frames hang together, so the "
            "share inside differs from case to case where bounds are right, too: their mean says whether they are. "
            f"Load as each case ended: {', '.join(loads)}.",
            markdown_table(_grid_table(grid)),
            "## Beside stock COLMAP",
            "The same images; stock matches every pair and has one OPENCV camera a session.",
            markdown_table(_stock_table(grid)),
        ]
    if walks:
        sections += [
            "## Small captures",
            "320x240, three walks side by side in one of six places; capture n has seed 100 + n, which draws k1, k2, "
            "k3, readout and focus. To reach is meant for 60 captures.",
            markdown_table(_walks_table(walks)),
        ]
    if weak:
        sections += [
            "## Weak geometry",
            "320x240, one walk of 20 images (34 of the corridor): once round a box of prints in a plain room, without "
            "VIO, stated with the image's centre and a focal length that is 1 % off; a few metres through "
            "a hall of 36 m; a straight corridor. Lens, readout and focus are drawn. The focal length by the images "
            "against the true one, and k1 inside its 95 % bounds; of sfm's first attempt, also where that finds its "
            "models inconsistent with VIO and would go on to further ones. To reach: 85 to 99 % inside.",
            markdown_table(_weak_table(weak)),
        ]
    figures: list[tuple[Any, ...]] = [("part", "case", "figure", "value")]
    for part, rows in parts.items():
        figures += [(part, row["case"], name, row[name]) for row in rows for name in row if name != "case"]
    write_page(out, "phone-cameras", sections, figures)
    return not any("refused" in row or _missed(row) for row in grid)


@app.command()
def main(
    parts: Annotated[list[str] | None, typer.Option("--only", help="Only this part: grid, walks or weak.")] = None,
    scene: Annotated[str, typer.Option(help="Only cases of the grid whose name begins so.")] = "",
    walks: Annotated[int, typer.Option(help="How many small captures.")] = 60,
    weak: Annotated[int, typer.Option(help="How many captures of each kind of weak geometry.")] = 4,
    seconds: Annotated[float, typer.Option(help="Start no further case after this long; 0: no end.")] = 0.0,
    work: Annotated[Path, typer.Option(help="Results of the cases that ran, which aren't run again.")] = Path(
        "build/cameras"
    ),
    out: Annotated[Path, typer.Option(help="Folder for the tables.")] = Path("docs/results"),
) -> None:
    """Run the cases that are left and write the tables; exits with 1 where a figure is missed."""
    cases: dict[tuple[str, str], Callable[[Path], dict[str, Any]]] = {}
    cases |= {("grid", phone.name): partial(run_phone, phone) for phone in GRID if phone.name.startswith(scene)}
    cases |= {("walks", f"{number:02}"): partial(run_walk, number) for number in range(walks)}
    cases |= {("weak", f"{kind}_{seed}"): partial(run_weak, kind, seed) for seed in range(weak) for kind in KINDS}
    _run_parts({key: run for key, run in cases.items() if not parts or key[0] in parts}, seconds, work)
    met = _write(work, out)
    print((out / "phone-cameras.md").read_text(encoding="utf-8"))
    if not met:
        raise typer.Exit(1)


if __name__ == "__main__":
    app()
