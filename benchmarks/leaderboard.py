"""All fusion methods on walks in folders and on finished runs, who is ahead, scene by scene: `python -m
benchmarks.leaderboard`.

A folder holds any number of cases, each a folder with `frames.parquet`, `ground_truth.parquet` and
`predictions.parquet` as `evaluate` reads them; what a case is called is its path. The first part of that path is its
group, over which figures are averaged. A file `about.txt` in the folder says where the tables are from."""

import hashlib
import multiprocessing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer
from numpy.typing import NDArray

from benchmarks.results import busy_machine, markdown_table
from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.evaluate import ERRORS, ahead_of, joined_walks
from groundwalk.fusion.evaluation.fuse import Fused, Run, error_rows, fuse_all, stacked
from groundwalk.fusion.evaluation.summary import figures
from groundwalk.fusion.files.walks import Files, Inputs
from groundwalk.fusion.methods import METHODS, method, resolve_options
from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.fusion.walk import Walk, known, with_odometry
from groundwalk.geometry.poses import inverse, skew
from groundwalk.scoring import errors as scoring_errors
from groundwalk.store import DataRoot, UserError
from groundwalk.store.checkout import git_revision
from groundwalk.store.cli import new_app
from groundwalk.store.files import make_writable
from groundwalk.store.manifests import load_manifest
from groundwalk.store.progress import track
from groundwalk.store.tables import dataset_frames, table_of

app = new_app(__doc__ or "")
RAW, RULE = "raw", "paper_rule"
KEY = ["group", "scene", "model"]
_TABLES = ("frames", "ground_truth", "predictions")
_THINNED = 5  # frames of which one is asked about
_LATE = 3  # frames between an image and its prediction
_PAGE, _TABLE = "fusion.md", "fusion.csv"
_HEADER = """# Fusion methods beside each other

Written by `python -m benchmarks.leaderboard`; not to be edited. Errors are over all frames with ground truth, in time;
a frame without a pose counts as failed in medians, percentiles and levels, and means have the coverage beside them.
`/rule` is a mean error over the paper's rule's in the same scene with the same model, the geometric mean over scenes
and models. In bounds: share of errors within the method's 95 % bounds, mean over scenes (worst). Levels: (0.25 m, 2°),
(0.5 m, 5°), (5 m, 10°). Ahead is the causal method whose mean errors are least (the geometric mean of position and
rotation, over the coverage).
`fusion.csv` has every figure."""


@dataclass(frozen=True)
class Case:
    """One model's predictions of one scene's walks."""

    group: str
    scene: str
    model: str
    walks: list[Walk]


def cases_in(folder: Path) -> tuple[list[Case], list[str]]:
    """The cases below a folder, and lines that say where they are from. UserError where there is none."""
    places = sorted(path.parent for path in folder.rglob("predictions.parquet"))
    if not places:
        raise UserError(
            "there are no predictions in the folder",
            where=folder,
            expected="<scene>/frames.parquet, ground_truth.parquet and predictions.parquet",
            do="lay them there, or write published predictions with python -m benchmarks.fusion_tables",
        )
    cases: list[Case] = []
    names: list[str] = []
    digest = hashlib.sha256()
    for place in places:
        files = [place / f"{name}.parquet" for name in _TABLES]
        parts = place.relative_to(folder).parts
        group, scene = (parts[0], "/".join(parts[1:])) if len(parts) > 1 else (folder.resolve().name, "".join(parts))
        cases += _cases(group, Files(*files).read(scene or group))
        names.append(scene or group)
        for file in files:
            digest.update(file.read_bytes())
    about = folder / "about.txt"
    lines = about.read_text(encoding="utf-8").split("\n") if about.is_file() else []
    about_lines = [line for line in lines if line.strip()]
    return cases, [
        f"{folder.name}: {len(places)} scenes, sha256 {digest.hexdigest()[:16]}",
        *_without_odometry(names, cases),
        *about_lines,
    ]


def cases_of_runs(data: DataRoot) -> tuple[list[Case], list[str]]:
    """Test walks of each run in the data folder that has predictions, of regressors and of structure localisers, and
    the runs' names."""
    cases: list[Case] = []
    names = []
    for folder in sorted((data.root / "runs").glob("*/*")):
        if not all((folder / stage / "manifest.json").is_file() for stage in ("import", "align", "train")):
            continue
        frames, truth, *predictions = (
            table_of(folder, stage, name)
            for stage, name in (
                ("import", "frames"),
                ("align", "ground_truth"),
                ("train", "predictions"),
                *([("localise", "predictions")] if (folder / "localise" / "manifest.json").is_file() else []),
            )
        )
        scene = f"{folder.name} ({folder.parent.name})"
        captures = "simulated" if load_manifest(folder / "import")["simulated"] else "real"
        for kind, table in zip(("regressors", "structure localisers"), predictions, strict=False):
            cases += _cases(f"{kind}, {captures} captures", Inputs(scene, dataset_frames(frames), truth, table))
        names.append(scene)
    cases += [change(case) for case in cases if case.group.startswith("structure") for change in (_thinned, _late)]
    return cases, [f"runs: {', '.join(names)}", *_without_odometry(names, cases)] if names else []


def _thinned(case: Case) -> Case:
    """The same with few predictions, as of an app that asks a server now and then."""
    walks = []
    for walk in case.walks:
        is_asked = (np.arange(len(walk)) % _THINNED == 0)[:, None, None]
        walks.append(replace(walk, map_T_cam_predicted=np.where(is_asked, walk.map_T_cam_predicted, np.nan)))
    return replace(case, group=f"{case.group}, one frame in {_THINNED} asked", walks=walks)


def _late(case: Case) -> Case:
    """The same with predictions that come so many frames after the image, as of a slow server: odometry carries each
    to the frame at which it comes."""
    walks = []
    for walk in case.walks:
        then, now = np.arange(len(walk) - _LATE), np.arange(_LATE, len(walk))
        carried = np.full_like(walk.map_T_cam_predicted, np.nan)
        carried[now] = walk.map_T_cam_predicted[then] @ inverse(walk.vio_T_cam[then]) @ walk.vio_T_cam[now]
        covariance = walk.predicted_covariance
        if covariance is not None:
            by_then = np.tile(np.eye(6), (len(now), 1, 1))
            by_then[:, 3:, :3] = -skew(carried[now, :3, 3] - walk.map_T_cam_predicted[then, :3, 3])
            late = np.full_like(covariance, np.nan)
            late[now] = by_then @ covariance[then] @ np.swapaxes(by_then, 1, 2)
            covariance = late
        walks.append(replace(walk, map_T_cam_predicted=carried, predicted_covariance=covariance))
    return replace(case, group=f"{case.group}, {_LATE} frames late", walks=walks)


def _without_odometry(scenes: Iterable[str], cases: Iterable[Case]) -> list[str]:
    """A line that names the scenes that no case is of, where any: nothing can be fused there."""
    left_out = sorted(set(scenes) - {case.scene for case in cases})
    return [f"without odometry, where nothing is fused: {', '.join(left_out)}"] if left_out else []


def _cases(group: str, inputs: Inputs) -> Iterator[Case]:
    settings = FuseSettings()
    for model, joined in joined_walks(inputs, settings.splits):
        if walks := with_odometry(joined.walks):
            yield Case(group, inputs.scene, model, walks)


def scores(cases: Sequence[Case], methods: Sequence[str] = (), processes: int = 1) -> pd.DataFrame:
    """A row a case and method, all there are if none is named: errors over all frames in time, coverage and bounds."""
    options = {name: resolve_options(name) for name in (RAW, RULE, *(methods or METHODS))}
    work = partial(_case_rows, options=options)
    rows: list[dict[str, Any]] = []
    if processes == 1:
        for case in track(cases, "cases"):
            rows += work(case)
    else:
        with multiprocessing.get_context("spawn").Pool(processes) as pool:
            for part in track(pool.imap(work, cases), "cases", total=len(cases)):
                rows += part
    return pd.DataFrame(rows)


def _case_rows(case: Case, options: Mapping[str, MethodOptions]) -> list[dict[str, Any]]:
    rows = []
    for name, chosen in options.items():
        fused = fuse_all(Run(name, "", case.model), case.walks, partial(method(name).make, chosen))
        errors = stacked(error_rows(f) for f in fused)
        row: dict[str, Any] = {"group": case.group, "scene": case.scene, "model": case.model, "method": name}
        row |= {"causal": method(name).causal, "walks": len(case.walks), **figures(errors, "live_", len(errors))}
        for figure, error in (("position_p95_m", "live_position_m"), ("rotation_p95_deg", "live_rotation_deg")):
            failed = np.sort(errors[error].fillna(np.inf).to_numpy())
            row[figure] = float(failed[int(0.95 * len(failed))])
        inside = np.concatenate([within_bounds(f) for f in fused])
        for i, quantity in enumerate(("position", "rotation")):
            row[f"{quantity}_within_pct"] = 100 * float(inside[:, i].mean()) if len(inside) else np.nan
        rows.append(row)
    return rows


def within_bounds(fused: Fused) -> NDArray[np.bool_]:
    """Whether position and rotation errors lie within the 95 % bounds, (N, 2), of the frames that have bounds."""
    there = known(fused.live_map_T_cam) & known(fused.walk.map_T_cam) & known(fused.covariance)
    if not there.any():
        return np.zeros((0, 2), dtype=bool)
    poses = fused.live_map_T_cam[there], fused.walk.map_T_cam[there]
    return scoring_errors.within_bounds(*poses, fused.covariance[there])


def ahead(rows: pd.DataFrame) -> pd.DataFrame:
    """For each case the causal method that is ahead, and its mean errors."""
    listing = []
    causal = rows[rows["causal"]]
    for key, group in causal.groupby(KEY, sort=False):
        best = ahead_of(group)
        errors = group.loc[group["method"] == best, ERRORS].iloc[0]
        listing.append(dict(zip(KEY, key, strict=True)) | {"ahead": best} | errors.to_dict())
    return pd.DataFrame(listing)


def ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """A row a group and method: geometric means over scenes and models of mean errors over the rule's, the worst such
    ratio, and means of the other figures."""
    rule = rows[rows["method"] == RULE].set_index(KEY)[ERRORS]
    indexed = rows.set_index(KEY)
    ratio = indexed[ERRORS] / rule.reindex(indexed.index)
    table = indexed.assign(position=ratio[ERRORS[0]], rotation=ratio[ERRORS[1]]).reset_index()
    listing = []
    for (group, name), part in table.groupby(["group", "method"], sort=False):
        row: dict[str, Any] = {"group": group, "method": name if part["causal"].all() else f"{name} (offline)"}
        for quantity in ("position", "rotation"):
            row[f"{quantity} /rule"] = float(np.exp(np.log(part[quantity]).mean()))
            row[f"worst {quantity} /rule"] = float(part[quantity].max())
        for level in ("high", "medium", "low", "coverage"):
            row[f"{level} %"] = part[f"{level}_pct"].mean()
        for quantity in ("position", "rotation"):
            inside = part[f"{quantity}_within_pct"]
            row[f"{quantity} in bounds %"] = f"{inside.mean():.0f} ({inside.min():.0f})" if inside.notna().any() else ""
        listing.append(row)
    return pd.DataFrame(listing)


@app.command()
def leaderboard(
    folders: Annotated[
        list[Path] | None,
        typer.Argument(
            help="Folders of GROUP/SCENE/ with frames.parquet, ground_truth.parquet and predictions.parquet."
        ),
    ] = None,
    data: Annotated[Path, typer.Option(help="The data folder, whose finished runs take part.")] = Path("data"),
    out: Annotated[Path, typer.Option(help="Folder for fusion.md and fusion.csv.")] = Path("build/leaderboard"),
    methods: Annotated[str, typer.Option(help="Methods, joined by commas; all if empty.")] = "",
    processes: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 1,
) -> None:
    """Compare the methods, write the files and print the page. UserError where there is nothing to run on, or the
    folder `out` can't be made or has files of these names that no leaderboard wrote."""
    revision = git_revision()  # before the run: the checkout may move on meanwhile
    cases, sources = cases_of_runs(DataRoot(data))
    for folder in folders or []:
        more, lines = cases_in(folder)
        cases, sources = cases + more, sources + lines
    if not cases:
        raise UserError(
            "there is nothing to run on",
            where=data,
            found="; ".join(sources) or None,
            do="name a folder of predictions, or finish a run of a scene; the scene needs VIO",
        )
    _refuse_other_files(out)
    make_writable(out)
    chosen = [name.strip() for name in methods.split(",") if name.strip()]
    print(write_leaderboard(out, scores(cases, chosen, processes), sources, revision))


def _refuse_other_files(out: Path) -> None:
    page = out / _PAGE
    there = [path for path in (page, out / _TABLE) if path.exists()]
    if there and not (page.is_file() and page.read_bytes().startswith(_HEADER.encode().splitlines()[0])):
        raise UserError(
            "the output folder holds a file that no leaderboard wrote",
            where=there[0],
            expected=f"a new folder, or one with {_PAGE} of an earlier leaderboard, whose files are replaced",
            do="name another folder with --out",
        )


def write_leaderboard(out: Path, rows: pd.DataFrame, sources: list[str], revision: str) -> str:
    """Write fusion.md and fusion.csv into the folder; returns what stands in fusion.md."""
    head = {"revision": revision, "date": datetime.now(UTC).date().isoformat(), "machine": busy_machine()}
    rows.assign(**head).to_csv(out / _TABLE, index=False, float_format="%.6g", lineterminator="\n")
    lines = [*(f"- {name}: {value}" for name, value in head.items()), *(f"- {source}" for source in sources)]
    sections = [_HEADER, "\n".join(lines)]
    table = ratios(rows)
    for group in table["group"].unique():
        part = table[table["group"] == group].drop(columns="group")
        here = rows[rows["group"] == group]
        sections += [f"## {group}: {_counts(here)}", _markdown(part), "### Scene by scene", _markdown(_by_scene(here))]
    text = "\n\n".join(sections) + "\n"
    (out / _PAGE).write_text(text, encoding="utf-8")
    return text


def _counts(rows: pd.DataFrame) -> str:
    cases = rows.drop_duplicates(KEY)
    return f"{cases['scene'].nunique()} scenes, {len(cases)} cases, {cases['walks'].sum()} walks"


def _by_scene(rows: pd.DataFrame) -> pd.DataFrame:
    """Who is ahead in each case, beside the raw regressor and the rule."""
    indexed = rows.set_index([*KEY, "method"])
    listing = []
    for best in ahead(rows).to_dict("records"):
        key = tuple(best[name] for name in KEY)
        row = {"scene": best["scene"], "model": best["model"]}
        row["ahead"] = "none: the predictor alone" if best["ahead"] == RAW else best["ahead"]
        names = [best["ahead"], *[name for name in (RAW, RULE) if name != best["ahead"]]]
        for label, name in zip(("ahead", *names[1:]), names, strict=True):
            errors = indexed.loc[(*key, name), ERRORS]
            answered = np.isfinite(errors[ERRORS[0]])
            row[f"{label}: mean"] = f"{errors[ERRORS[0]]:.3g} m, {errors[ERRORS[1]]:.3g}°" if answered else "no pose"
        best_row = indexed.loc[(*key, best["ahead"])]
        row["p95"] = f"{best_row['position_p95_m']:.3g} m, {best_row['rotation_p95_deg']:.3g}°"
        listing.append(row)
    return pd.DataFrame(listing).fillna("")


def _markdown(table: pd.DataFrame) -> str:
    return markdown_table([list(table.columns), *(list(map(_cell, row)) for row in table.itertuples(index=False))])


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.0f}" if 1000 <= abs(value) < np.inf else f"{value:.3g}"
    return str(value)


if __name__ == "__main__":
    app()
