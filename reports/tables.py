"""Tables I to III in the paper's layout, the published numbers in lines of their own, and Table IV, which the paper
leaves out: every method over all test frames."""

from collections.abc import Callable, Iterable

import pandas as pd

from groundwalk.reports.cells import (
    AVERAGE,
    ERRORS,
    LEVELS,
    PUBLISHED_MODELS,
    TABLE_I,
    TABLE_II,
    TABLE_III,
    TABLE_IV,
    column_name,
)
from groundwalk.reports.grids import EMPTY, OURS, PUBLISHED, Block, Grid, Row
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.published import PAPER_METHOD, RAW_METHOD
from groundwalk.scoring.errors import sure_enough
from groundwalk.store.tables import gap_warning

SUBSET_TITLES = {
    "rp": "Only reliable predictions",
    "opt": "Only optimised poses",
    "rp+opt": "Reliable predictions and optimised poses",
}
_ENVIRONMENTS = ("outdoor", "indoor", "unknown")
_SCORED = ((RAW_METHOD, "all"), (RAW_METHOD, "subset"), (PAPER_METHOD, "subset"))
_PUBLISHED_NOTE = (
    "Lines marked “published” are printed in the MobileARLoc paper: other captures, other phone, other machine. They "
    "stand here for orientation; this run didn't measure them."
)

Look = Callable[[str], str]


class Tables:
    """The four tables of some scenes, laid out from their cells (ours and published)."""

    def __init__(self, cells: pd.DataFrame, scenes: list[SceneInputs]) -> None:
        self.scenes = {scene.name: scene for scene in scenes}
        self.models = list(dict.fromkeys(m for scene in scenes for m in scene.models))
        self.labels = {m: scene.label(m) for scene in scenes for m in scene.models}
        self.methods_cells = cells[cells["table"] == TABLE_IV]
        printed = cells[cells["table"] != TABLE_IV]
        # Published numbers are in metres whatever ours are in.
        self.unit = " or ".join(cells.loc[cells["quantity"] == "translation", "unit"].unique())
        keys = ["table", "source", "environment", "scene", "row", "column"]
        self.text = dict(zip(printed[keys].itertuples(index=False, name=None), printed["text"], strict=True))
        # Without the paper's rule the model alone is all that its tables have.
        has_rule = (printed["method"] == PAPER_METHOD).any()
        self.scored = _SCORED if has_rule else _SCORED[:1]
        self.titles = SUBSET_TITLES if has_rule else {"rp+opt": "All test frames"}

    def all(self) -> list[Grid]:
        return [self.dataset(), self.errors(), self.levels(), self.methods()]

    def dataset(self) -> Grid:
        """Table I: frames, extent, storage and time."""
        models = list(dict.fromkeys([*PUBLISHED_MODELS.values(), *self.models]))
        columns = [("", "scene"), ("", "numbers"), ("images", "train"), ("images", "test")]
        columns.append(("", f"extent ({self.unit})"))
        heads = [self.labels.get(m, m) for m in models]
        columns += [("storage (MB)", m) for m in heads] + [("time an image (ms)", m) for m in heads]
        names = ["train images", "test images", "extent"]
        names += [f"{m} {what}" for what in ("storage", "runtime") for m in models]
        blocks = self._blocks(TABLE_I, "scene", "", names, lambda look, name: look(name))
        every = [table for scene in self.scenes.values() for table in (scene.cards, scene.localisers)]
        cards = pd.concat([table[["device", "model"]] for table in every if len(table)])
        devices = cards.groupby("device", sort=False)["model"].unique()
        notes = [
            "Extent of ours: length × width × height of the box about the camera positions with ground truth. A MB is "
            "2^20 bytes, ours and the paper's alike.",
            "Time of ours: median of single inferences on "
            + "; ".join(f"{device} ({', '.join(names)})" for device, names in devices.items())
            + ". A regressor's is of a cropped image, a structure localiser's of a decoded image with its features. "
            "Published times were taken on an NVIDIA RTX 3090.",
        ]
        return self._grid("table1", "Table I", "Datasets, and what a localiser costs", columns, blocks, notes)

    def errors(self) -> Grid:
        """Table II: mean and median error over each subset."""
        columns, names = [("", "scene"), ("", "numbers")], []
        for statistic in ("mean", "median"):
            for model in self.models:
                group = f"{statistic} ({self.unit}/°)"
                columns += [(group, column_name(self.labels[model], *scored)) for scored in self.scored]
                names += [column_name(model, *scored, statistic) for scored in self.scored]

        def cell(look: Look, name: str) -> str:
            return _with_slashes(look(f"{name} {quantity}") for quantity in ERRORS)

        blocks = [b for row, title in self.titles.items() for b in self._blocks(TABLE_II, row, title, names, cell)]
        caption = f"Mean and median error of position ({self.unit}) and rotation (°) on test walks"
        return self._grid("table2", "Table II", caption, columns, blocks, self._coverage_notes())

    def levels(self) -> Grid:
        """Table III: shares of frames within the accuracy levels."""
        columns, group = [("", "scene"), ("", "numbers")], "high/medium/low (share)"
        columns += [(group, column_name(self.labels[m], *scored)) for m in self.models for scored in self.scored]
        names = [column_name(m, *scored) for m in self.models for scored in self.scored]

        def cell(look: Look, name: str) -> str:
            entry = _with_slashes(look(f"{name} level {level}") for level in LEVELS)
            share = look(f"{name} share frames")
            return entry if share == EMPTY else f"{entry} ({share})"

        blocks = [b for row, title in self.titles.items() for b in self._blocks(TABLE_III, row, title, names, cell)]
        caption = (
            "Percentage of frames with high (0.25 m, 2°), medium (0.5 m, 5°) and low (5 m, 10°) accuracy; in "
            "parentheses the subset's share of the test frames"
        )
        return self._grid("table3", "Table III", caption, columns, blocks, self._coverage_notes())

    def methods(self) -> Grid:
        """Table IV: every method over all test frames, and over the frames that all causal ones answer; those that see
        the whole walk before they answer stand apart."""
        missing_fails = "all test frames, a missing pose is a failure"
        heads = ("coverage (%)", f"median ({self.unit}/°)", "high/medium/low (%)")
        columns = [("", "scene"), ("", "method"), *((missing_fails, head) for head in heads)]
        columns += [("answered frames", f"mean ({self.unit}/°)")]
        fuses = any(scene.fuses for scene in self.scenes.values())
        if fuses:
            common = "frames that all causal ones answer"
            columns += [(common, head) for head in ("share (%)", f"mean ({self.unit}/°)", f"median ({self.unit}/°)")]
        blocks = []
        for scene in self.scenes.values():
            of_scene = self.methods_cells[self.methods_cells["scene"] == scene.name]
            for model, cells in of_scene.groupby("model", sort=False):
                causal: list[Row] = []
                offline: list[Row] = []
                for method, of_method in cells.groupby("method", sort=False):
                    label = column_name(scene.label(str(model)), str(method), "all", labels=scene.method_labels)
                    rows = offline if method in scene.offline else causal
                    rows.append(Row((scene.name, label, *self._method_numbers(of_method))[: len(columns)], OURS))
                blocks.append(Block(f"{scene.name}, {model}", tuple(causal)))
                if offline:
                    title = f"{scene.name}, {model}, offline: sees the whole walk, not to be ranked with the others"
                    blocks.append(Block(title, tuple(offline)))
        notes = [
            "Poses in time: what an app would have had when the frame came, without confirmation by later ones. A "
            f"frame without a pose is infinitely wrong in a median ({EMPTY}: the median itself is infinite) and a "
            "failure in the levels; a mean can only be taken over answered frames: read it beside the coverage.",
            *(self._meanings() if fuses else []),
            *(f"{s.name}: {s.why_alone()}." for s in self.scenes.values() if s.unfused_sessions),
            *self._uncertain_notes(),
        ]
        title = f"{'All methods' if fuses else 'Every model alone'} over all test frames (the paper has no such table)"
        return self._grid("table4", "Table IV", title, columns, blocks, notes)

    def _meanings(self) -> list[str]:
        """What each method is."""
        methods = pd.concat([scene.methods for scene in self.scenes.values()]).drop_duplicates("method")
        notes = []
        for what, rows in (("Methods", methods[methods["causal"]]), ("Offline", methods[~methods["causal"]])):
            if len(rows):
                meanings = zip(rows["method"], rows["meaning"], strict=True)
                notes.append(f"{what}: " + "; ".join(f"{name}: {meaning}" for name, meaning in meanings) + ".")
        return notes

    def _uncertain_notes(self) -> list[str]:
        """How many frames the levels leave out, of the scenes that have such frames."""
        notes = []
        for scene in self.scenes.values():
            scored = scene.errors[scene.errors["split"] == "test"].drop_duplicates("frame_id")
            if uncertain := int((~sure_enough(scored["quality"])).sum()):
                notes.append(
                    f"{scene.name}: {uncertain} of the {scene.scored_frames} test frames with ground truth are of "
                    "quality class C, too uncertain for the accuracy levels, which leave them out; means and medians "
                    "count them." + (" So no level can be scored." if uncertain == scene.scored_frames else "")
                )
        return notes

    def _method_numbers(self, cells: pd.DataFrame) -> list[str]:
        text = cells.set_index(["row", "statistic", "quantity"])["text"].to_dict()

        def pair(row: str, statistic: str) -> str:
            return _with_slashes(text[row, statistic, quantity] for quantity in ERRORS)

        return [
            text["all", "coverage", "frames"],
            pair("all", "median"),
            _with_slashes(text["all", "level", level] for level in LEVELS),
            pair("all", "mean"),
            text["common", "share", "frames"],
            pair("common", "mean"),
            pair("common", "median"),
        ]

    def _blocks(
        self, table: str, row: str, title: str, names: list[str], cell: Callable[[Look, str], str]
    ) -> list[Block]:
        blocks = []
        for environment in _ENVIRONMENTS:
            rows = []
            for scene in [*(s.name for s in self.scenes.values() if s.environment == environment), AVERAGE]:
                for source in (OURS, PUBLISHED):

                    def look(column: str, key: tuple[str, ...] = (table, source, environment, scene, row)) -> str:
                        return self.text.get((*key, column), EMPTY)

                    numbers = [cell(look, name) for name in names]
                    if set(numbers) != {EMPTY} or (source == OURS and scene != AVERAGE):
                        label = "published" if source == PUBLISHED else self._label(scene, environment)
                        rows.append(Row((scene, label, *numbers), source, scene == AVERAGE))
            if rows:
                place = "" if environment == "unknown" else environment
                blocks.append(Block(", ".join(filter(None, [title, place])).capitalize(), tuple(rows)))
        return blocks

    def _label(self, scene: str, environment: str) -> str:
        members = [s for s in self.scenes.values() if scene in (s.name, AVERAGE) and s.environment == environment]
        kind = "simulated" if any(s.simulated for s in members) else "ours"
        return f"{kind}, {members[0].profile}"

    def _grid(
        self, key: str, title: str, what: str, columns: list[tuple[str, str]], blocks: list[Block], notes: list[str]
    ) -> Grid:
        markers = "; ".join(f"{scene.name}: {scene.marker()}" for scene in self.scenes.values())
        meaningless = [
            f"{scene.name}: the regressors' accuracy means nothing here: {' and '.join(reasons)}."
            for scene in self.scenes.values()
            if (reasons := scene.why_meaningless())
        ]
        published = any(row.source == PUBLISHED for block in blocks for row in block.rows)
        notes = [*meaningless, *notes, *self._card_notes(), *([_PUBLISHED_NOTE] if published else [])]
        return Grid(key, title, f"{what}. {markers}.", tuple(columns), tuple(blocks), 2, tuple(notes))

    def _coverage_notes(self) -> list[str]:
        notes = [
            "“Same frames” is the model alone over just the frames of the subset: like for like with “+VIO”, the "
            "paper's rule. The plain column is over all test frames, as in the paper."
        ] * (len(self.scored) > 1)
        for scene in self.scenes.values():
            shares = []
            for model in scene.models if scene.fused_method == PAPER_METHOD else ():
                column = column_name(model, PAPER_METHOD, "subset", "share frames")
                key = (TABLE_III, OURS, scene.environment, scene.name, "rp+opt", column)
                shares.append(f"{column_name(scene.label(model), PAPER_METHOD, 'subset')} scores {self.text[key]} %")
            facts = [f"{scene.scored_frames} test frames with ground truth of {scene.test_frames}"]
            if shares:
                facts.append(f"{', '.join(shares)} of them")
            elif scene.fuses:
                facts.append(f"{PAPER_METHOD}, the paper's rule, wasn't run")
            rule = scene.poses.loc[scene.poses["method"] == PAPER_METHOD, "reasons"]
            note = f"{scene.name}: {'; '.join([*facts, *filter(None, [gap_warning(rule), scene.why_alone()])])}."
            if scene.ground_truth["gt_uses_vio"].any():
                note += " VIO positions took part in this ground truth, which flatters methods that use VIO."
            notes.append(note)
        return [*notes, *self._refusal_notes(), *self._uncertain_notes()]

    def _refusal_notes(self) -> list[str]:
        """How many test frames each structure localiser refused."""
        notes = []
        for scene in self.scenes.values():
            said = scene.predictions[scene.predictions["split"] == "test"]
            said = said[said["model"].isin(scene.localisers["model"])]
            for model, rows in said.groupby("model", sort=False):
                if refused := int(rows["refusal"].notna().sum()):
                    note = f"{scene.name}: {scene.label(str(model))} refused {refused} of {len(rows)} test frames: "
                    notes.append(note + "failures in medians and levels; its means are over the others.")
        return notes

    def _card_notes(self) -> list[str]:
        cards: dict[str, list[str]] = {}
        for scene in self.scenes.values():
            for _, card in scene.cards.iterrows():
                cards.setdefault(card_text(card), []).append(scene.name)
        several = len(self.scenes) > 1
        return [text + (f" ({', '.join(names)})" if several else "") + "." for text, names in cards.items()]


def _with_slashes(numbers: Iterable[str]) -> str:
    """The numbers of one cell; empty where one of them is."""
    parts = list(numbers)
    return EMPTY if EMPTY in parts else "/".join(parts)


def card_text(card: pd.Series) -> str:
    """What a reader must know of a model: where its weights come from, its input, and what was made smaller."""
    if not card["file"]:
        return f"{card['model']}: {card['weights']}"
    made_smaller = card["reduced"]
    beside_the_paper = f"reduced from the paper: {made_smaller}" if made_smaller else "as in the paper"
    if pd.isna(made_smaller):
        beside_the_paper = "not in the paper"
    parts = [
        f"backbone weights: {card['weights']}",
        f"input {card['crop_px']:.0f} px",
        *([str(card["layers"])] if card["layers"] else []),
        f"{card['epochs']:.0f} epochs on {card['train_frames']:.0f} frames, seed {card['seed']}",
        *([f"trained on {', '.join(card['scenes'])}"] if len(card["scenes"]) > 1 else []),
        beside_the_paper,
    ]
    return f"{card['model']}: {'; '.join(parts)}"
