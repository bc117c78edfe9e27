"""Every number of the tables as one row: what it is, how it prints, and what it was computed from."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import pandas as pd

from groundwalk.reports.grids import EMPTY, OURS, PUBLISHED
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.published import PAPER_METHOD, RAW_METHOD, PrintedTables
from groundwalk.reports.statistics import scene_scores
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
    table: str,
    scene: SceneInputs,
    row: str,
    column: str,
    figure: tuple[float, int, str],
    source: tuple[int, str],
    **more: str,
) -> dict[str, object]:
    """A row of `cells`; figure: the value, its digits and its unit; source: rows and table that it is from.
    Metres are the map's unit, whatever that is."""
    value, digits, unit = figure
    unit = scene.unit.symbol if unit == "m" else unit
    base = {"source": OURS, "table": table, "environment": scene.environment, "scene": scene.name, "row": row}
    empty = dict.fromkeys(("model", "method", "options", "over", "statistic", "quantity"), "")
    text = more.pop("text", number(value, digits))
    numbers = {"value": value, "text": text, "unit": unit, "source_rows": source[0], "source_table": source[1]}
    return {**base, "column": column, **empty, **more, **numbers}


def _dataset(scene: SceneInputs) -> Iterator[dict[str, object]]:
    def cell(column: str, value: float, unit: str, source: tuple[int, str], **more: str) -> dict[str, object]:
        keys = {"statistic": "value", "quantity": column}
        return _cell(TABLE_I, scene, "scene", column, (value, 0, unit), source, **(keys | more))

    yield cell("train images", scene.training_frames, "", (len(scene.frames), "import.frames"))
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
            runtime = scene.runtime_ms(model)
            source = (int((scene.predictions["model"] == model).sum()), f"{stage}.predictions")
            yield cell(f"{model} runtime", runtime, "ms", source, model=model, text=number(runtime, 1))


def _scores(scene: SceneInputs) -> Iterator[dict[str, object]]:
    for _, s in scene_scores(scene.errors, scene.name, scene.offline).iterrows():
        paper = s["subset"] in SUBSETS
        numbers = [
            (statistic, q, s[f"{statistic}_{u}"], u, digits_of(s[f"{statistic}_{u}"]))
            for statistic in ("mean", "median")
            for q, u in ERRORS.items()
        ]
        numbers += [("level", level, s[level], "%", 1) for level in LEVELS]
        if not paper or s["over"] == "subset":
            numbers += [(name, "frames", s[name], "%", 1) for name in ("share", "coverage")]
        keys = {k: str(s[k]) for k in ("model", "method", "options", "over")}
        for statistic, quantity, value, unit, digits in numbers:
            table = TABLE_IV if not paper else TABLE_II if statistic in ("mean", "median") else TABLE_III
            labels = _PAPER_LABELS if paper else scene.method_labels
            column = column_name(s["model"], s["method"], s["over"], statistic, quantity, labels=labels)
            more = keys | {"statistic": statistic, "quantity": quantity}
            source = (int(s["certain" if statistic == "level" else "frames"]), "fuse.errors")
            yield _cell(table, scene, s["subset"], column, (float(value), digits, unit), source, **more)


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

    def add(table: str, s: pd.Series, row: str, column: str, value: float, text: str, unit: str, **more: str) -> None:
        if s["scene"] not in names and not (s["scene"] == AVERAGE and s["environment"] in complete):
            return
        base = {"source": PUBLISHED, "table": table, "environment": s["environment"], "scene": s["scene"], "row": row}
        empty = dict.fromkeys(("model", "method", "options", "over", "statistic", "quantity"), "")
        figure = {"value": value, "text": text, "unit": unit, "source_rows": 1, "source_table": _PUBLISHED_FILES[table]}
        rows.append({**base, "column": column, **empty, **more, **figure})

    of_environment = tables.dataset.groupby("environment")["scene"].agg(set)
    complete = {str(environment) for environment, members in of_environment.items() if members <= names}
    for _, s in tables.dataset.iterrows():
        for column in ("train images", "test images"):
            value = float(s[column.replace(" ", "_")])
            add(TABLE_I, s, "scene", column, value, f"{value:.0f}", "", statistic="value", quantity=column)
        extent = str(s["extent_m"])
        length = float(extent.split("x")[0])
        text = extent.replace("x", "×")
        add(TABLE_I, s, "scene", "extent", length, text, "m", statistic="value", quantity="extent")
        for key, model in PUBLISHED_MODELS.items():
            for what, unit in (("storage", "MB"), ("runtime", "ms")):
                value = float(s[f"{key}_{what}_{unit.lower()}"])
                keys = {"model": model, "statistic": "value", "quantity": f"{model} {what}"}
                add(TABLE_I, s, "scene", f"{model} {what}", value, f"{value:g}", unit, **keys)
    for _, s in tables.errors.iterrows():
        for quantity, unit in ERRORS.items():
            value = float(s[f"{quantity}_{unit}"])
            keys = {k: str(s[k]) for k in ("model", "method", "over", "statistic")} | {"quantity": quantity}
            column = column_name(s["model"], s["method"], s["over"], s["statistic"], quantity)
            add(TABLE_II, s, s["subset"], column, value, str(s[f"{quantity}_{unit}_text"]), unit, **keys)
    for _, s in tables.levels.iterrows():
        keys = {k: str(s[k]) for k in ("model", "method", "over")}
        for quantity, statistic in [*((level, "level") for level in LEVELS), ("share", "share")]:
            value = float(s[quantity])
            if math.isnan(value):
                continue
            name = "frames" if quantity == "share" else quantity
            column = column_name(s["model"], s["method"], s["over"], statistic, name)
            more = keys | {"statistic": statistic, "quantity": name}
            add(TABLE_III, s, s["subset"], column, value, str(s[f"{quantity}_text"]), "%", **more)
    return pd.DataFrame(rows)


@dataclass(frozen=True)
class LocaliserErrors:
    """What a localiser reaches over all test frames, alone or with the method that is ahead, as Table IV prints it."""

    model: str
    name: str
    is_structure: bool
    is_fused: bool
    position: str
    rotation: str
    levels: str
    coverage: str
    interval: str


def localiser_errors(scene: SceneInputs, cells: pd.DataFrame) -> list[LocaliserErrors]:
    """What each localiser reaches; none without errors."""
    ours = cells[(cells["source"] == OURS) & (cells["scene"] == scene.name) & (cells["table"] == TABLE_IV)]
    ours = ours[ours["row"] == "all"]
    found = []
    for model in scene.models:
        for method in dict.fromkeys([RAW_METHOD, scene.best(model)]):
            of_way = ours[(ours["model"] == model) & (ours["method"] == method)].drop_duplicates(
                ["statistic", "quantity"]
            )
            text = of_way.set_index(["statistic", "quantity"])["text"]
            if method is None or text.empty:
                continue
            found.append(
                LocaliserErrors(
                    model=model,
                    name=scene.label(model) + (scene.method_labels[method] or ", alone"),
                    is_structure=model in set(scene.localisers["model"]),
                    is_fused=method not in scene.raw_methods,
                    position=text["median", "translation"],
                    rotation=text["median", "rotation"],
                    levels="/".join(text["level", level] for level in LEVELS),
                    coverage=text["coverage", "frames"],
                    interval=_interval(scene, model, method),
                )
            )
    return found


def _interval(scene: SceneInputs, model: str, method: str) -> str:
    """The bounds of the median position error in time, where fuse took test frames alone."""
    i = scene.intervals
    found = i[(i["model"] == model) & (i["method"] == method) & (i["subset"] == "all")]
    found = found[found["figure"] == "position_median_m"][["low", "high"]].astype(float)
    if scene.evaluated_splits != "test" or found.empty or found.iloc[0].isna().all():
        return EMPTY
    low, high = found.iloc[0]
    return f"{number(low, digits_of(low))} to {'infinite' if math.isnan(high) else number(high, digits_of(high))}"
