"""Do the checks find what is broken, and name it? `python -m benchmarks.gates`

Thirty broken inputs, five of each kind, ten captures that state a wrong distortion, ten short walks (0.5 to 3 m), whose
scale must be within its 95 % bounds, and thirty clean ones, all small simulated captures, go through import, sfm and
align as a user would run them. Found is what any of the three refuses or what align's checks name; the cause must be
right. A clean one must come out without a failed check of the scene or a session. Wrong is a pose more than 25 cm or 2
degrees from the truth after a fit of origin and heading, which are free; scale and vertical are the map's own. `given`
are the frames with ground truth, `wrong` those of them that are so, the same of class A and B alone: catching a fault
is worth little if wrong labels go out beside it. `lost` are registered frames without ground truth, `lost, right` those
of them that SfM had placed rightly within their model.

Each case is written down when it's done; the same command goes on with the rest. `--seconds` ends a slice. Writes
docs/results/gates.md and .csv.
"""

import json
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from benchmarks import gates_breaking as breaking
from benchmarks.gates_captures import CORRIDOR, Capture, write_capture
from benchmarks.results import circumstances_of, kept, markdown_table, now, write_page
from groundwalk.alignment.definition import STAGE as ALIGN
from groundwalk.capture_import.definition import STAGE as IMPORT
from groundwalk.consistency.motions import MIRRORED, MISTAKE_REASONS, UNRELATED, UPSIDE_DOWN
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3, fit_robust, fit_sim3, fit_yaw
from groundwalk.geometry.poses import Array
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.sfm.definition import STAGE as SFM
from groundwalk.store import DataRoot, Stage, UserError, execute
from groundwalk.store.choices import FailureCause, Rejected
from groundwalk.store.cli import new_app
from groundwalk.store.manifests import load_manifest
from groundwalk.store.tables import poses_of, table_of
from groundwalk.store.true_poses import true_poses_of

PROFILE = "tiny"
CLEAN = "clean"
SHORT = "clean, scale within its bounds"
NOTHING = "nothing"
LENS = "stated distortion wrong"
SFM_OF_SMALL = ["max_features=1024", "sequence_pairs=3", "vio_pairs=4", "retrieval_pairs=4"]
# What keeps a corridor's look-alike stretches apart, switched off: pairs are tried however far apart, and a model that
# is inconsistent with VIO isn't attempted again, so that align's checks get it.
_ALL_PAIRS = ["sequence_pairs=40", "vio_max_distance_m=1000", "vio_pairs=0", "retry=false"]
_WALKS = ["walk-1", "walk-2", "walk-3"]
PLACES = ("Office", "Stairs", "Square", "Bar", "Atrium", "Church")
_BACKWARD = "time goes backward"
_WRONG_M, _WRONG_DEG = 0.25, 2.0
_BOUND = 1.96
# Lenses that an app may state instead of the simulated phones' (k1 0.05 to 0.12, k2 -0.2 to -0.05): none at all, other
# signs (the inverse's), another lens, or one in other units.
_WRONG_LENSES = [(-0.09, 0.14), (0.3, -0.1), (-0.25, 0.06), (0.0, 0.3), (0.25, -0.4), (-0.12, 0.0), (0.2, 0.1)]
_WRONG_LENSES += [(0.03, 0.35), (-0.3, 0.1), (0.35, -0.6)]
_COLUMNS = ["case", "capture", "expected", "fault", "stage", "message", "seconds", "revision", "date"]
_COLUMNS += ["frames", "registered", "given", "wrong", "given_ab", "wrong_ab", "lost", "lost_right"]
_COLUMNS += ["worst_m", "scale_error", "scale_sd"]

app = new_app(__doc__ or "")


@dataclass(frozen=True)
class Case:
    """An input: its name, the fault that is to be found, the capture, how it is broken, and sfm's settings."""

    name: str
    expected: str
    capture: Capture
    broken: Callable[[Path], None] | None = None
    other: Capture | None = None
    sfm: list[str] = field(default_factory=list)


def cases() -> Iterator[Case]:
    """All eighty; the first of each kind first, so that a slice sees every kind."""
    for k in range(5):
        place, next_place = PLACES[k], PLACES[(k + 1) % 5]
        base = Capture(place, 1)
        one = _WALKS[k % 3]
        yield Case(f"another scene {k + 1}", FailureCause.OTHER_SCENE, base, other=Capture(next_place, 1))
        flips = [(_WALKS, 1), ([one], 1), (_WALKS, 0), (_WALKS, 1), ([one], 0)][k]
        yield Case(f"mirrored {k + 1}", FailureCause.MIRRORED_IMAGES, base, partial(breaking.mirrored, *flips))
        focal = [(_WALKS, 1.1), (_WALKS, 0.9), ([one], 1.1), (_WALKS, 1.1), (_WALKS, 0.9)][k]
        yield Case(f"intrinsics {k + 1}", FailureCause.WRONG_INTRINSICS, base, partial(breaking.focal_scaled, *focal))
        longer = partial(breaking.vio_scaled, one, (1.1, 0.9)[k % 2])
        yield Case(f"VIO scale {k + 1}", FailureCause.WRONG_VIO_SCALE, base, longer)
        yield Case(f"look-alike {k + 1}", FailureCause.PERCEPTUAL_ALIASING, Capture(CORRIDOR, k + 1, 1), sfm=_ALL_PAIRS)
        shuffle = breaking.pictures_shuffled if k % 2 == 0 else breaking.times_shuffled
        walks = [_WALKS, _WALKS, [one], [one], _WALKS][k]
        yield Case(f"shuffled {k + 1}", FailureCause.MISMATCHED_IMAGES, base, partial(shuffle, walks, k))
        for number in (2 * k, 2 * k + 1):
            stated = partial(breaking.lens_stated, _WRONG_LENSES[number])
            yield Case(f"stated lens {number + 1}", LENS, Capture(PLACES[number % 6], 1 + number // 6), stated)
            length_m = (0.5, 0.8, 1.0, 1.5, 2.0, 3.0)[number % 6]
            short = Capture(PLACES[(number + number // 6) % 6], 20 + number, 1, length_m)
            yield Case(f"short {number + 1}", SHORT, short)
        for clean in PLACES:
            yield Case(f"clean {clean} {k + 1}", CLEAN, Capture(clean, k + 1))


def run_case(case: Case, captures: Path) -> dict[str, Any]:
    """Take a case through the stages in a data folder of its own: what became of it, by the columns of gates.csv."""
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        data = DataRoot(Path(temporary))
        scene = "Case"
        data.captures(scene).parent.mkdir(parents=True)
        shutil.copytree(_rendered(captures, case.capture), data.captures(scene))
        if case.broken is not None:
            case.broken(data.captures(scene))
        if case.other is not None:
            breaking.walk_replaced(_rendered(captures, case.other), _WALKS[-1], data.captures(scene))
        fault, stage, message = _named_fault(data, scene, case)
        labels = _labels(data, scene)
    return {
        "case": case.name,
        "capture": case.capture.name,
        "expected": case.expected,
        "fault": fault,
        "stage": stage,
        "message": message,
        "seconds": time.monotonic() - start,
        **now(),
        **labels,
    }


def _rendered(captures: Path, capture: Capture) -> Path:
    folder = captures / capture.name
    if not folder.is_dir():
        write_capture(folder, capture)
    return folder


def _named_fault(data: DataRoot, scene: str, case: Case) -> tuple[str, str, str]:
    """The fault that the pipeline tells first, the stage that does, and in which words."""
    stages: list[tuple[Stage[Any], list[str]]] = [(IMPORT, []), (SFM, [*SFM_OF_SMALL, *case.sfm]), (ALIGN, [])]
    for stage, settings in stages:
        try:
            execute(stage, scene, PROFILE, data, settings)
        except UserError as error:
            text = " ".join(str(error).split())
            return _named(text), stage.name, text
        if stage is IMPORT:
            rejects = table_of(data.run(PROFILE, scene), "import", "rejects")
            for reason in rejects.loc[rejects["rejected"] == Rejected.RECORDING, "reason"]:
                return _named(reason), stage.name, reason
            backward = int(rejects["reason"].str.contains(_BACKWARD).sum())
            if backward:
                return FailureCause.MISMATCHED_IMAGES, stage.name, f"{backward} rows: {_BACKWARD}"
    lenses = table_of(data.run(PROFILE, scene), "sfm", "lenses")
    if lenses["stated_is_wrong"].any():
        lens = lenses[lenses["stated_is_wrong"]].iloc[0]
        return LENS, "sfm", f"stated {lens['stated_k1']:g}, {lens['stated_k2']:g}; {lens['k1']:.3f}, {lens['k2']:.3f}"
    checks = table_of(data.run(PROFILE, scene), "align", "checks")
    failed = checks[checks["status"] == "failed"]
    # A window that fails costs its frames; a fault is what a scene or a session is told for.
    failed = failed[~failed["check"].str.startswith("window_")]
    if not len(failed):
        return NOTHING, "", ""
    row = failed.iloc[int(failed["cause"].map(list(FailureCause).index).to_numpy().argmin())]
    return str(row["cause"]), "align", f"{row['session_id'] or 'scene'}: {row['reason']}"


def _named(text: str) -> str:
    """The fault that an error names."""
    mirrored = "the images are mirrored", MISTAKE_REASONS[MIRRORED], MISTAKE_REASONS[UPSIDE_DOWN]
    if any(words in text for words in mirrored):
        return FailureCause.MIRRORED_IMAGES
    if MISTAKE_REASONS[UNRELATED] in text:
        return FailureCause.MISMATCHED_IMAGES
    return next((cause for cause in FailureCause if cause in text), "refused without a name")


def _labels(data: DataRoot, scene: str) -> dict[str, Any]:
    """What the frames of a case were given, and how right it is: how many there are, are registered, have ground truth
    and a wrong one, the same of class A and B, have none although registered, and are right among these; and the
    largest error given out, metres."""
    run = data.run(PROFILE, scene)
    if not (run / "align" / "ground_truth.parquet").is_file():
        return {}
    gt = table_of(run, "align", "ground_truth")
    images = table_of(run, "sfm", "images")
    images = gt[["frame_id"]].merge(images, on="frame_id", how="left")
    true_T_cam = true_poses_of(gt, scene, PROFILE, data)
    given, registered = (gt["quality"] != "none").to_numpy(), images["registered"].to_numpy(bool)
    sure = gt["quality"].isin(["A", "B"]).to_numpy()
    metres, wrong = np.full(len(gt), np.inf), np.ones(len(gt), dtype=bool)
    metres[given], wrong[given] = _errors(true_T_cam[given], poses_of(gt, "map_cam")[given], _fit_yaw)
    # A lost frame has no pose in the map: its place among the others of its model is what can be right.
    in_model = np.ones(len(gt), dtype=bool)
    for model in images.loc[registered, "model_id"].unique():
        of_model = registered & (images["model_id"] == model).to_numpy()
        _, in_model[of_model] = _errors(true_T_cam[of_model], poses_of(images, "sfm_cam")[of_model], fit_sim3)
    lost = registered & ~given
    figures = load_manifest(run / "align")["figures"]
    scale_error = None
    if given.sum() >= 3 and np.isfinite(true_T_cam[given]).all():
        scale_error = 1 / fit_sim3(true_T_cam[given, :3, 3], poses_of(gt, "map_cam")[given, :3, 3]).scale - 1
    return {
        "frames": len(gt),
        "registered": int(registered.sum()),
        "given": int(given.sum()),
        "wrong": int((given & wrong).sum()),
        "given_ab": int(sure.sum()),
        "wrong_ab": int((sure & wrong).sum()),
        "lost": int(lost.sum()),
        "lost_right": int((lost & ~in_model).sum()),
        "worst_m": float(metres[given].max()) if given.any() and np.isfinite(metres[given]).all() else None,
        "scale_error": scale_error,
        "scale_sd": figures["scale_sd"],
    }


def _fit_yaw(true: Array, xyz: Array, weights: Array) -> Sim3:
    true_T_map = fit_yaw(true, xyz, weights)
    return Sim3(1.0, true_T_map[:3, :3], true_T_map[:3, 3])


def _errors(true_T_cam: Array, b_T_cam: Array, fit: Callable[[Array, Array, Array], Sim3]) -> tuple[Array, np.ndarray]:
    """Metres (N,) of poses (N, 4, 4) from the truth after a robust fit, so that a few wrong ones stand out, and which
    are wrong (N,); all are where there are too few for a fit."""
    metres, wrong = np.full(len(b_T_cam), np.inf), np.ones(len(b_T_cam), dtype=bool)
    # A frame from another scene has no true pose in this one.
    known = np.isfinite(true_T_cam[:, 0, 0])
    true, xyz = true_T_cam[known, :3, 3], b_T_cam[known, :3, 3]
    try:
        true_S_b, _ = fit_robust(
            lambda w: fit(true, xyz, w), lambda s: np.linalg.norm(true - s.points(xyz), axis=1), len(xyz), floor=0.02
        )
    except GeometryError:
        return metres, wrong
    placed = true_S_b.poses(b_T_cam[known])
    metres[known] = position_error(placed, true_T_cam[known])
    wrong[known] = (metres[known] > _WRONG_M) | (rotation_error_deg(placed, true_T_cam[known]) > _WRONG_DEG)
    return metres, wrong


@app.command()
def main(
    work: Annotated[
        Path, typer.Option(help="Captures, and results of the cases that ran, which aren't run again.")
    ] = Path("build/gates"),
    out: Annotated[Path, typer.Option(help="Folder for the tables.")] = Path("docs/results"),
    only: Annotated[str, typer.Option(help="Only cases whose name begins so.")] = "",
    seconds: Annotated[float, typer.Option(help="Start no further case after this long; 0: no end.")] = 0.0,
    again: Annotated[bool, typer.Option("--again", help="Forget what was found before.")] = False,
) -> None:
    """Run the cases that are left and write the tables; exits with 1 where a case isn't right."""
    start = time.monotonic()
    results = work / "cases"
    if again:
        shutil.rmtree(results, ignore_errors=True)
    for case in cases():
        path = results / f"{case.name.replace(' ', '-')}.json"
        if not case.name.startswith(only) or path.is_file():
            continue
        if seconds and time.monotonic() - start > seconds:
            break
        outcome = kept(path, partial(run_case, case, work / "captures"))
        print("{case}: expected {expected}, found {fault} ({seconds:.0f} s)".format(**outcome), flush=True)
    names = [case.name for case in cases()]
    outcomes = [json.loads(path.read_text(encoding="utf-8")) for path in results.glob("*.json")]
    outcomes.sort(key=lambda outcome: names.index(outcome["case"]))
    table = pd.DataFrame(outcomes, columns=_COLUMNS).assign(right=[_is_right(outcome) for outcome in outcomes])
    counts = _COLUMNS[_COLUMNS.index("frames") : _COLUMNS.index("worst_m")]
    table[counts] = table[counts].fillna(0).astype(int)
    write_page(out, "gates", _sections(table))
    table.to_csv(out / "gates.csv", index=False)
    print((out / "gates.md").read_text(encoding="utf-8"))
    if not table["right"].all():
        raise typer.Exit(1)


def _is_right(outcome: dict[str, Any]) -> bool:
    """The fault was named; or there is none, and of a short walk the scale is within its bounds."""
    if outcome["expected"] not in (SHORT, CLEAN):
        return bool(outcome["fault"] == outcome["expected"])
    error, sd = outcome.get("scale_error"), outcome.get("scale_sd")
    is_within = error is not None and sd is not None and abs(error) <= _BOUND * sd
    return bool(outcome["fault"] == NOTHING and (is_within or outcome["expected"] == CLEAN))


def _sections(table: pd.DataFrame) -> Iterator[str]:
    yield "# Gates: what is broken is found and named"
    yield (
        "Written by `python -m benchmarks.gates`, not to be edited; `gates.csv` has every figure. All simulated: small "
        "captures, 320x240, of a phone whose lens and shutter nobody states, taken through import, sfm and align. A "
        "capture is named by place, seed, number of walks and, where it is short, length."
    )
    yield circumstances_of(table["revision"], table["date"])
    yield markdown_table(_summary(table))
    yield "Wrong: more than 25 cm or 2 degrees from the truth. Lost: registered, without ground truth."
    head = ["case", "capture", "expected", "found", "by", "right", "frames", "given", "wrong", "given A, B"]
    rows = [[*head, "wrong A, B", "lost", "lost, right", "worst, m", "scale error ± sd, %"]]
    for o in table.to_dict("records"):
        counts = (o[name] for name in ("frames", "given", "wrong", "given_ab", "wrong_ab", "lost", "lost_right"))
        worst = "" if pd.isna(o["worst_m"]) else f"{o['worst_m']:.3f}"
        scale = "" if pd.isna(o["scale_error"]) else f"{100 * o['scale_error']:+.2f}"
        scale += "" if pd.isna(o["scale_sd"]) else f" ± {100 * o['scale_sd']:.2f}"
        named = (o[name] for name in ("case", "capture", "expected", "fault", "stage"))
        rows.append([*named, "yes" if o["right"] else "**no**", *map(str, counts), worst, scale])
    yield markdown_table(rows)


def _summary(table: pd.DataFrame) -> Iterator[Sequence[str]]:
    yield "inputs", "run", "what became of them", "to reach", "frames with ground truth, wrong; of class A and B, wrong"
    kinds = (LENS, SHORT, CLEAN)
    for kind, label, limit in (
        ("", "broken", "all caught"),
        (LENS, LENS, "all named"),
        (SHORT, "clean, short walks (0.5 to 3 m)", "≥ 9 of 10"),
        (CLEAN, CLEAN, "none refused"),
    ):
        group = table[table["expected"] == kind if kind else ~table["expected"].isin(kinds)]
        right, total = group["right"].sum(), sum((c.expected if c.expected in kinds else "") == kind for c in cases())
        became = {
            "": f"{(group['fault'] != NOTHING).sum()} caught, {right} named rightly",
            LENS: f"{right} named",
            SHORT: f"{right} accepted with their scale within its 95 % bounds",
            CLEAN: f"{len(group) - right} refused",
        }
        given, wrong, sure, wrong_ab = (group[name].sum() for name in ("given", "wrong", "given_ab", "wrong_ab"))
        yield label, f"{len(group)} of {total}", became[kind], limit, f"{given}, {wrong}; {sure}, {wrong_ab}"


if __name__ == "__main__":
    app()
