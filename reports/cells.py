"""Every number of the tables as one row: what it is, how it prints, and what it was computed from."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pandas as pd

from groundwalk.reports.grids import EMPTY, OURS, PUBLISHED
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.published import PAPER_METHOD, RAW_METHOD, PrintedTables
from groundwalk.reports.statistics import scene_scores
from groundwalk.scoring.bootstrap import figures_by_session
from groundwalk.scoring.errors import sure_enough
from groundwalk.scoring.scores import SUBSETS

TABLE_I, TABLE_II, TABLE_III, TABLE_IV = "I", "II", "III", "IV"
AVERAGE = "average"
ERRORS = {"translation": "m", "rotation": "deg"}
LEVELS = ("high", "medium", "low")
_PUBLISHED_FILES = {
    TABLE_I: "shipped/published/table1_dataset.csv",
    TABLE_II: "shipped/published/table2_pose_errors.csv",
    TABLE_III: "shipped/published/table3_accuracy_levels.csv",
}
# What a cell may be left without.
_NO_KEYS: dict[str, object] = dict.fromkeys(("model", "method", "options", "over", "statistic", "quantity"), "")
# What stands behind the model in a heading of the paper's tables.
_PAPER_LABELS = {"": "", RAW_METHOD: "", PAPER_METHOD: "+VIO"}
PUBLISHED_MODELS = {"hloc": "HLoc", "pn": "PN", "mst": "MS-T"}


def column_name(model: str, method: str, over: str, *what: str, labels: Mapping[str, str] = _PAPER_LABELS) -> str:
    """A heading: "PN", "PN, same frames", "PN+VIO" (the paper's rule) or "PN+<label>", then what is counted."""
    label = labels.get(method, f"+{method}")
    name = f"{model}, same frames" if not label and over == "subset" else model + label
    return " ".join([name, *what]).strip()


def number(value: float, digits: int) -> str:
    return EMPTY if math.isnan(value) else f"{value:.{digits}f}"


def digits_of(error: float) -> int:
    """How many decimals an error has, in metres or degrees: two as in the paper, and one more where it's below 0.1."""
    return 3 if error < 0.1 else 2


def our_cells(scenes: list[SceneInputs]) -> pd.DataFrame:
    """All cells of ours: Tables I to IV of each scene, and Table II's averages over each environment's scenes."""
    rows: list[dict[str, object]] = []
    for scene in scenes:
        rows += _dataset(scene)
        rows += _scores(scene)
    rows += _averages(rows)
    return pd.DataFrame(rows)


def _cell(
    scene: SceneInputs, figure: tuple[float, str, str], source: tuple[int, str], **more: str
) -> dict[str, object]:
    """A row of `cells`; figure: the value, its text and its unit; source: rows and table that it is from; more: its
    other columns. Metres are the map's unit, whatever that is."""
    value, text, unit = figure
    numbers = {"value": value, "text": text, "unit": scene.unit.symbol if unit == "m" else unit}
    place = {"source": OURS, "environment": scene.environment, "scene": scene.name}
    return _NO_KEYS | place | numbers | more | {"source_rows": source[0], "source_table": source[1]}


def _dataset(scene: SceneInputs) -> Iterator[dict[str, object]]:
    def cell(column: str, value: float, unit: str, source: tuple[int, str], **more: str) -> dict[str, object]:
        keys = {"table": TABLE_I, "row": "scene", "column": column, "statistic": "value", "quantity": column}
        return _cell(scene, (value, more.pop("text", number(value, 0)), unit), source, **(keys | more))

    # Those held out for choosing a checkpoint are of the training walks, too.
    training_frames = int(scene.frames["split"].isin(["train", "val"]).sum())
    yield cell("train images", training_frames, "", (len(scene.frames), "import.frames"))
    yield cell("test images", scene.test_frames, "", (len(scene.frames), "import.frames"))
    yield cell("scored images", scene.scored_frames, "", (len(scene.errors), "fuse.errors"))
    known = (int(scene.ground_truth["map_cam_tx"].notna().sum()), "align.ground_truth")
    length, width, height = scene.extent_m()
    text = EMPTY if math.isnan(length) else f"{length:.1f}×{width:.1f}×{height:.1f}"
    yield cell("extent", length, "m", known, text=text)
    for stage, models in (("train", scene.cards), ("localise", scene.localisers)):
        for _, card in models.iterrows():
            model = str(card["model"])
            mib = float(card["bytes"]) / 2**20
            yield cell(f"{model} storage", mib, "MiB", (1, f"{stage}.models"), model=model, text=number(mib, 1))
            times = scene.predictions.loc[scene.predictions["model"] == model, "inference_ms"]
            runtime, source = float(times.median()), (len(times), f"{stage}.predictions")
            yield cell(f"{model} runtime", runtime, "ms", source, model=model, text=number(runtime, 1))


def _scores(scene: SceneInputs) -> Iterator[dict[str, object]]:
    for _, s in scene_scores(scene).iterrows():
        paper = s["subset"] in SUBSETS
        numbers = [(m, q, s[f"{m}_{unit}"], unit) for m in ("mean", "median") for q, unit in ERRORS.items()]
        numbers += [("level", level, s[level], "%") for level in LEVELS]
        if not paper or s["over"] == "subset":
            numbers += [(name, "frames", s[name], "%") for name in ("share", "coverage")]
        keys = {k: str(s[k]) for k in ("model", "method", "options", "over")} | {"row": s["subset"]}
        for statistic, quantity, value, unit in numbers:
            keys["table"] = TABLE_IV if not paper else TABLE_II if statistic in ("mean", "median") else TABLE_III
            labels = _PAPER_LABELS if paper else scene.method_labels
            keys["column"] = column_name(s["model"], s["method"], s["over"], statistic, quantity, labels=labels)
            source = (int(s["certain" if statistic == "level" else "frames"]), "fuse.errors")
            figure = (float(value), number(value, 1 if unit == "%" else digits_of(value)), unit)
            yield _cell(scene, figure, source, **keys, statistic=statistic, quantity=quantity)


def _averages(rows: list[dict[str, object]]) -> list[dict[str, object]]:
    """Table II's averages: the mean over scenes of each scene's figure, where an environment has several scenes."""
    errors = pd.DataFrame([r for r in rows if r["table"] == TABLE_II])
    keys = ["environment", "row", "column"]
    all_scenes = errors.groupby("environment")["scene"].nunique().to_dict()
    averages = []
    for (environment, _, _), scenes in errors.groupby(keys, sort=False):
        if len(scenes) > 1:
            # A scene without a figure leaves none for the average either: it would be one over other scenes. Nor is
            # there one over units.
            of_all = scenes["scene"].nunique() == all_scenes[environment]
            of_one_unit = scenes["unit"].isin(ERRORS.values()).all()
            value = float(scenes["value"].mean(skipna=False)) if of_all and of_one_unit else math.nan
            row: dict[str, object] = {str(name): cell for name, cell in scenes.iloc[0].items()}
            row |= {"scene": AVERAGE, "options": "", "value": value, "text": number(value, digits_of(value))}
            averages.append(row | {"source_rows": int(scenes["source_rows"].sum())})
    return averages


def published_cells(tables: PrintedTables, scenes: list[SceneInputs]) -> pd.DataFrame:
    """The paper's cells of the same scenes, and of the averages where all scenes of an environment are there."""
    names = {scene.name for scene in scenes} & set(tables.dataset["scene"])
    rows: list[dict[str, object]] = []

    def add(s: pd.Series, value: float, text: str, unit: str, **more: str) -> None:
        if s["scene"] in names or (s["scene"] == AVERAGE and s["environment"] in complete):
            place = {"source": PUBLISHED, "environment": s["environment"], "scene": s["scene"]}
            figure = {"value": value, "text": text, "unit": unit, "source_rows": 1}
            rows.append(_NO_KEYS | place | figure | more | {"source_table": _PUBLISHED_FILES[more["table"]]})

    of_table = {"table": TABLE_I, "row": "scene", "statistic": "value"}
    of_environment = tables.dataset.groupby("environment")["scene"].agg(set)
    complete = {str(environment) for environment, members in of_environment.items() if members <= names}
    for _, s in tables.dataset.iterrows():
        for column in ("train images", "test images"):
            value = float(s[column.replace(" ", "_")])
            add(s, value, f"{value:.0f}", "", column=column, quantity=column, **of_table)
        extent = str(s["extent_m"])
        length = float(extent.split("x")[0])
        add(s, length, extent.replace("x", "×"), "m", column="extent", quantity="extent", **of_table)
        for key, model in PUBLISHED_MODELS.items():
            for what, unit in (("storage", "MB"), ("runtime", "ms")):
                value, name = float(s[f"{key}_{what}_{unit.lower()}"]), f"{model} {what}"
                add(s, value, f"{value:g}", unit, model=model, column=name, quantity=name, **of_table)
    for _, s in tables.errors.iterrows():
        for quantity, unit in ERRORS.items():
            keys = {k: str(s[k]) for k in ("model", "method", "over", "statistic")} | {"quantity": quantity}
            keys["column"] = column_name(s["model"], s["method"], s["over"], s["statistic"], quantity)
            text = str(s[f"{quantity}_{unit}_text"])
            add(s, float(s[f"{quantity}_{unit}"]), text, unit, table=TABLE_II, row=s["subset"], **keys)
    for _, s in tables.levels.iterrows():
        keys = {k: str(s[k]) for k in ("model", "method", "over")}
        for quantity, statistic in [*((level, "level") for level in LEVELS), ("share", "share")]:
            if math.isnan(value := float(s[quantity])):
                continue
            keys["quantity"], keys["statistic"] = "frames" if quantity == "share" else quantity, statistic
            keys["column"] = column_name(s["model"], s["method"], s["over"], statistic, keys["quantity"])
            add(s, value, str(s[f"{quantity}_text"]), "%", table=TABLE_III, row=s["subset"], **keys)
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class LocaliserErrors:
    """What a localiser reaches over the `frames` of Table IV, alone or with the method that is ahead, as it is printed
    there."""

    model: str
    name: str
    is_structure: bool
    is_fused: bool
    frames: int
    position: str
    rotation: str
    levels: str
    coverage: str
    interval: str


def localiser_errors(scene: SceneInputs, cells: pd.DataFrame) -> Iterator[LocaliserErrors]:
    """What each localiser reaches; none without errors."""
    ours = cells[(cells["source"] == OURS) & (cells["scene"] == scene.name) & (cells["table"] == TABLE_IV)]
    ours = ours[ours["row"] == "all"]
    for model in scene.models:
        for method in dict.fromkeys([RAW_METHOD, scene.best(model)]):
            of_method = ours[(ours["model"] == model) & (ours["method"] == method)]
            found = of_method.set_index(["statistic", "quantity"])
            text = found["text"]
            if method is not None and len(text):
                yield LocaliserErrors(
                    model=model,
                    name=scene.label(model) + (scene.method_labels[method] or ", alone"),
                    is_structure=model in set(scene.localisers["model"]),
                    is_fused=method not in scene.raw_methods,
                    frames=int(found["source_rows"]["coverage", "frames"]),
                    position=text["median", "translation"],
                    rotation=text["median", "rotation"],
                    levels="/".join(text["level", level] for level in LEVELS),
                    coverage=text["coverage", "frames"],
                    interval=_interval(scene, model, method),
                )


def _interval(scene: SceneInputs, model: str, method: str) -> str:
    """The bounds of the median position error in time, where fuse took test frames alone."""
    tables = (scene.intervals, scene.errors, scene.compared)
    found, errors, over = (t[(t["model"] == model) & (t["method"] == method)] for t in tables)
    found = found[(found["subset"] == "all") & (found["figure"] == "position_median_m")][["low", "high"]].astype(float)
    if len(over) < len(errors):  # fuse's is over walks, too, in which nothing is fused
        errors_m, errors_deg = (over[f"live_{name}"].to_numpy(float) for name in ("position_m", "rotation_deg"))
        sessions = over["session_id"].to_numpy(object)
        drawn = figures_by_session(sessions, errors_m, errors_deg, sure_enough(over["quality"]))
        found = pd.DataFrame([bounds for name, _, *bounds in drawn if name == "position_median_m"], dtype=float)
    if set(scene.errors["split"]) != {"test"} or found.empty or found.iloc[0].isna().all():
        return EMPTY
    low, high = found.iloc[0]
    return f"{number(low, digits_of(low))} to {'infinite' if math.isnan(high) else number(high, digits_of(high))}"
