"""The report of made-up runs: its numbers against a recount, its tables' form, its page and its errors."""

import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from groundwalk.commands import closing_lines
from groundwalk.fusion.evaluation.summary import intervals
from groundwalk.reports import style
from groundwalk.reports.definition import STAGE
from groundwalk.reports.grids import Block, Grid, Row, latex, latex_text, markdown
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.published import PUBLISHED, load_published
from groundwalk.reports.run_checks import AGREES
from groundwalk.store import UserError
from groundwalk.store.files import read_json
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.stage import execute
from groundwalk.store.tables import read_table
from tests.known import rewrite, table_of, there
from tests.reports.made_up_scenes import page_of, report_without_figures, rows_of

MakeRun = Callable[..., DataRoot]


@pytest.fixture(scope="module")
def church(make_run: MakeRun) -> tuple[DataRoot, Path]:
    data = make_run(Church={})
    return data, execute(STAGE, "Church", "tiny", data)


@pytest.fixture(scope="module")
def pair(make_run: MakeRun) -> tuple[DataRoot, Path]:
    data = make_run(group="both", Square={"train": 30, "test": 20, "uncertain": 0.3}, Hall={"train": 30, "test": 20})
    (data.root / "scenes" / "Hall.toml").write_text('environment = "outdoor"\n')
    return data, report_without_figures(data, "both")


@pytest.fixture(scope="module")
def chair(make_run: MakeRun) -> tuple[DataRoot, Path]:
    data = make_run(simulated=False, chair={"train": 9, "test": 3, "mixed": True, "uncertain": 1.0})
    return data, report_without_figures(data, "chair")


def errors_of(data: DataRoot, scene: str, model: str, method: str | None = None) -> pd.DataFrame:
    """Those of a model's test frames: by one method of fusion, or each frame once."""
    errors = table_of(data, scene, "fuse", "errors")
    errors = errors[(errors["split"] == "test") & (errors["model"] == model)]
    return errors.drop_duplicates("frame_id") if method is None else errors[errors["method"] == method]


def cells_of(folder: Path, **keys: str) -> pd.DataFrame:
    cells = read_table(folder / "cells.parquet", schema("report", "cells"))
    for column, value in keys.items():
        cells = cells[cells[column] == value]
    return cells


def test_cells_are_what_the_errors_say(church: tuple[DataRoot, Path]) -> None:
    data, folder = church
    errors = errors_of(data, "Church", "MS-T", "paper_rule")
    for subset, statuses in (("rp", {"reliable"}), ("opt", {"optimised"}), ("rp+opt", {"reliable", "optimised"})):
        part = errors[[status in statuses for status in errors["status"]]]
        ours = cells_of(folder, source="ours", scene="Church", model="MS-T", row=subset).set_index("column")["value"]
        assert ours["MS-T+VIO mean translation"] == pytest.approx(sum(part["position_m"]) / len(part))
        assert ours["MS-T+VIO median rotation"] == pytest.approx(np.percentile(part["rotation_deg"], 50))
        assert ours["MS-T, same frames mean rotation"] == pytest.approx(sum(part["raw_rotation_deg"]) / len(part))
        assert ours["MS-T mean translation"] == pytest.approx(sum(errors["raw_position_m"]) / len(errors))
        medium = [p <= 0.5 and r <= 5 for p, r in zip(part["position_m"], part["rotation_deg"], strict=True)]
        assert ours["MS-T+VIO level medium"] == pytest.approx(100 * sum(medium) / len(part))
        assert ours["MS-T+VIO share frames"] == pytest.approx(100 * len(part) / len(errors))


def test_offline_methods_stand_apart_and_do_not_shrink_the_common_frames(church: tuple[DataRoot, Path]) -> None:
    _, folder = church
    table = (folder / "tables" / "table4.md").read_text()
    blocks = re.split(r"\*\*(Church, .*?)\*\*", table)
    lines = dict(zip(blocks[1::2], blocks[2::2], strict=True))
    for model in ("PN", "MS-T"):
        assert "smoother" not in lines[f"Church, {model}"]
        offline = next(text for title, text in lines.items() if title.startswith(f"Church, {model}, offline: sees the"))
        assert f"{model}+smoother" in offline and "+VIO" not in offline
    assert "Offline: smoother: from the whole walk." in table
    ours = cells_of(folder, source="ours", table="IV", model="PN", row="common").set_index("method")
    covered = ours[ours["quantity"] == "frames"].groupby("method")["value"].apply(list)
    assert covered["paper_rule"][1] == covered["raw"][1] == 100 > covered["smoother"][1]


def test_frames_of_uncertain_ground_truth_are_left_out_of_levels_and_counted(
    pair: tuple[DataRoot, Path],
) -> None:
    data, folder = pair
    errors = errors_of(data, "Square", "PN", "paper_rule")
    part = errors[errors["status"].isin(["reliable", "optimised"])]
    sure = part[part["quality"] == "A"]
    assert 0 < len(sure) < len(part)
    ours = cells_of(folder, source="ours", table="III", scene="Square", row="rp+opt", model="PN", method="paper_rule")
    medium = ours[ours["quantity"] == "medium"].iloc[0]
    within = (sure["position_m"] <= 0.5) & (sure["rotation_deg"] <= 5)
    assert medium["value"] == pytest.approx(100 * within.mean()) and medium["source_rows"] == len(sure)
    means = cells_of(folder, table="II", scene="Square", row="rp+opt", column="PN+VIO mean translation", source="ours")
    mean = means.iloc[0]
    assert mean["value"] == pytest.approx(part["position_m"].mean()) and mean["source_rows"] == len(part)
    left_out = int((errors["quality"] == "C").sum())
    for number in (2, 3, 4):
        note = f"Square: {left_out} of the {len(errors)} test frames with ground truth are of quality class C"
        text = (folder / "tables" / f"table{number}.md").read_text()
        assert note in text and "Hall: " not in text.split(note)[1].split("\n")[0] and "So no level" not in text


def test_without_sure_ground_truth_no_level_is_scored(chair: tuple[DataRoot, Path]) -> None:
    _, folder = chair
    levels = cells_of(folder, source="ours", statistic="level")
    assert levels["value"].isna().all() and (levels["source_rows"] == 0).all()
    assert cells_of(folder, source="ours", statistic="mean", row="all")["value"].notna().all()
    for number in (3, 4):
        assert "So no level can be scored." in (folder / "tables" / f"table{number}.md").read_text()
    rows = rows_of(folder, "quality-chair")
    assert [rows[0][i] for i in (0, 4, 5, 6)] == ["C", "0.5 to 0.5", "0.02 to 0.02", "left out"]
    assert rows[1][0] == "none" and rows[1][6] == "not scored"
    assert int(rows[0][1]) + int(rows[1][1]) == 24 and "no level can be scored" in page_of(folder)


def test_a_map_without_metric_scale_is_marked_everywhere(
    make_run: MakeRun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawn: list[str] = []

    def texts_of(figure: Figure, folder: Path, name: str) -> str:
        drawn.extend(text.get_text() for text in figure.findobj(Text) if isinstance(text, Text) and "vio" not in name)
        return "<svg></svg>"

    monkeypatch.setattr(style, "save", texts_of)
    plain: dict[str, Any] = {"train": 30, "test": 24, "uncertain": 1.0, "localisers": ("Map",)}
    data = make_run(group="both", Yard=plain | {"scale_source": "none"}, Lane={"train": 30, "test": 24})
    folder = execute(STAGE, "Yard", "tiny", data)
    mark = "NO METRIC SCALE: positions are in SfM's unit, not in metres"
    assert f"warning: Yard: {mark}" in capsys.readouterr().err
    for number in range(1, 5):
        table = (folder / "tables" / f"table{number}.md").read_text()
        assert "NO VERTICAL: the map's +y may point anywhere" in table
        assert mark in table and not re.search(r"\(m[/)]", table)
    assert not [text for text in drawn if re.search(r"error.*\(c?m\)|^position \(m\)|\d m$", text)] and mark in "".join(
        drawn
    )
    page = page_of(folder)
    head, summary = page[: page.index("<main>")], page[page.index('id="verdict"') : page.index('id="capture"')]
    assert 'id="without-scale"' in head and "[import] reference_is_metric = true in data/scenes/Yard.toml" in head
    assert re.search(r"<b>± \d.* map units, ± \d.*°</b>", summary) and not re.search(r"<b>.* m, ", summary)
    assert "(m)" not in page[page.index('id="walks-Yard"') : page.index('id="all-checks"')]
    lengths = cells_of(folder, source="ours", quantity="translation")
    assert len(lengths) and set(lengths["unit"]) == {"map units"}
    assert "no_wrong_answer" not in set(read_table(folder / "checks.parquet", schema("report", "checks"))["check"])
    # Beside a metric scene there is no average over both.
    folder = execute(STAGE, "both", "tiny", data)
    assert "(map units or m/°)" in (folder / "tables" / "table2.md").read_text()
    averages = cells_of(folder, source="ours", scene="average", table="II").groupby("quantity")["value"]
    assert averages.count()["translation"] == 0 < averages.count()["rotation"]


@pytest.mark.usefixtures("no_figures")
def test_structure_localisers_stand_beside_the_regressors(make_run: MakeRun) -> None:
    data = make_run(Yard={"train": 30, "test": 24, "localisers": ("Map",)})
    (data.root / "scenes").mkdir(exist_ok=True)
    (data.root / "scenes" / "Yard.toml").write_text('environment = "outdoor"\n')
    folder = execute(STAGE, "Yard", "tiny", data)
    said = table_of(data, "Yard", "localise", "predictions")
    said = said[(said["split"] == "test")]
    refused = int(said["refusal"].notna().sum())
    assert refused == 8
    one = cells_of(folder, source="ours", table="I", model="Map").set_index("quantity")["text"]
    assert (one["Map storage"], one["Map runtime"]) == ("1.5", "60.0")
    errors = errors_of(data, "Yard", "Map")
    levels = cells_of(folder, source="ours", table="III", row="rp", model="Map", method="raw", over="all")
    high = levels.loc[levels["quantity"] == "high", "value"].iloc[0]
    assert high == pytest.approx(100 * errors["raw_position_m"].notna().mean()) and high < 90  # a refusal fails
    assert "Map, same frames" in (folder / "tables" / "table2.md").read_text()
    table = (folder / "tables" / "table1.md").read_text()
    for number in (2, 3):
        text = (folder / "tables" / f"table{number}.md").read_text()
        assert f"Yard: Map refused {refused} of {len(said)} test frames" in text
    page = page_of(folder)
    assert "Structure localisers" in page and f"{refused} thin_evidence of {len(said)}" in page
    assert "simulated, test walks in the training walks' light, tiny profile" in table
    findings = read_table(folder / "checks.parquet", schema("report", "checks"))
    wrong = findings[findings["check"] == "no_wrong_answer"]
    assert wrong["column"].tolist() == ["Map pose"] and wrong["status"].tolist() == ["agrees"]
    # Each by test walk, too.
    rows = rows_of(folder, "walks-Yard")
    walks = ["walk_3", "walk_4"]
    assert [row[:2] for row in rows] == [[model, walk] for model in ("PN", "MS-T", "Map") for walk in walks]
    for row in rows:
        errors = errors_of(data, "Yard", row[0])
        metres = errors.loc[errors["session_id"] == row[1], "raw_position_m"]
        assert row[2:4] == [str(len(metres)), str(int(metres.notna().sum()))]
        assert float(row[4]) == pytest.approx(metres.fillna(np.inf).median(), abs=0.01)


def test_the_pages_tables_have_what_the_stages_found(church: tuple[DataRoot, Path]) -> None:
    folder = church[1]
    assert rows_of(folder, "rejects-Church") == [
        ["a video can't be read: 0 bytes", "1", "0", "0", "0"],
        ["depth image is broken; its image is used without", "0", "0", "1", "0"],
        ["image is broken: truncated after … bytes", "0", "2", "0", "0"],
        ["no number", "0", "0", "0", "1"],
        ["not tracking", "0", "0", "0", "1"],
    ]
    assert [row[-1] for row in rows_of(folder, "sessions-Church")] == ["2", "0", "0", "0"]
    figures = ["12 of 13", "12", "6.4", "8.4", "15.0", "92", "+0.07 ± 0.01", "0.03 ± 0.16"]
    assert rows_of(folder, "control-Church") == [["total station", *figures, "passed"]]
    rows = rows_of(folder, "users-Church")
    assert ["PN", "raw", "never", "a whole walk", "0.125", "0.750", "–"] in rows
    assert ["PN", "paper_rule", "3.0", "4.2", "0.125", "0.750", "never"] in rows
    assert rows[-1] == ["MS-T", "smoother (offline)", "3.0", "4.2", "0.125", "0.750", "–"]
    # What is undecided isn't counted as failed.
    rows = rows_of(folder, "consistency-Church")
    assert ["window_position", "failed: pose in SfM inconsistent with VIO", "m", *"210", "0.01 to 0.3", "0.1"] in rows
    assert ["ruler_scale", "undecided: board: seen once", "m", *"101", "–", "0.03"] in rows
    checks = read_table(folder / "checks.parquet", schema("report", "checks"))
    assert {"all_scored", "ground_truth_without_vio", "no_leak"} == set(checks["check"])
    assert set(checks["status"]) == {AGREES}, checks.to_string()


def test_published_cells_are_the_files_numbers_and_never_ours(church: tuple[DataRoot, Path]) -> None:
    _, folder = church
    cells = cells_of(folder, source="published")
    assert set(cells["scene"]) == {"Church"}
    printed = load_published().errors
    printed = printed[printed["scene"] == "Church"]
    values = printed[["translation_m", "rotation_deg"]].to_numpy().ravel()
    assert sorted(cells.loc[cells["table"] == "II", "value"]) == sorted(values)
    lines = [line.split(",") for line in PUBLISHED["table3_accuracy_levels.csv"].read_text().splitlines()]
    digits = [text for line in lines if line[1] == "Church" for text in line[4:] if text]
    assert sorted(cells.loc[cells["table"] == "III", "text"]) == sorted(digits) and any(d.endswith("0") for d in digits)
    assert cells["source_table"].str.startswith("shipped/published/").all()
    assert not cells_of(folder, source="ours")["source_table"].str.startswith("shipped/published/").any()


def test_a_group_has_all_members_and_their_average(pair: tuple[DataRoot, Path]) -> None:
    _, folder = pair
    rows = cells_of(folder, source="ours", table="II", row="rp+opt", column="PN+VIO median rotation")
    ours = rows.set_index("scene")["value"]
    assert set(ours.index) == {"Square", "Hall", "average"}
    assert ours["average"] == pytest.approx((ours["Square"] + ours["Hall"]) / 2)
    # The paper's average is over other scenes, so it doesn't stand beside ours.
    assert "average" not in set(cells_of(folder, source="published")["scene"])
    assert "average" in (folder / "tables" / "table2.md").read_text()


def test_a_page_of_several_scenes_begins_with_a_row_of_each(pair: tuple[DataRoot, Path], church: Any) -> None:
    data, folder = pair
    page = page_of(folder)
    assert page.index('id="overview"') < page.index('id="verdict"') and 'id="overview"' not in page_of(church[1])
    rows = rows_of(folder, "overview")
    assert len(rows) == 2
    for scene, row in zip(("Square", "Hall"), rows, strict=True):
        assert row[0] == f'<a href="#scene-{scene}">{scene}</a>' and page.count(f'id="scene-{scene}"') == 1
        truth = table_of(data, scene, "align", "ground_truth")["quality"]
        verdict = read_json(folder / f"verdict-{scene}.json")
        trusted = f"{100 * (truth == 'A').mean():.0f}"
        assert row[1:6] == ["simulated", verdict["verdict"], trusted, "0.5 cm", "0.99 over 5 m"]
        found = {(one["fused"], one["model"]): one for one in verdict["localisers"]}
        best = min((one for one in found.values() if not one["fused"]), key=lambda one: one["median_position"])
        for text, one in zip(row[6:], (best, found[True, best["model"]]), strict=True):
            position, rotation = f"{one['median_position']:.2f} m", f"{one['median_rotation_deg']:.2f}°"
            assert text == f"{one['localiser'].removesuffix(', alone')}: {position}, {rotation}"


def test_a_groups_own_models_replace_its_members(pair: tuple[DataRoot, Path]) -> None:
    data, folder = pair
    for model, factor in (("PN", 1.0), ("MS-T", 0.5)):
        errors = errors_of(data, "Hall", model)
        ours = cells_of(folder, source="ours", table="II", scene="Hall", column=f"{model} mean translation")
        assert list(ours["value"]) == pytest.approx([factor * errors["raw_position_m"].mean()] * 3)
    page = page_of(folder)
    assert "train of both" in page and "fuse of both" in page
    assert "trained on Square, Hall" in (folder / "tables" / "table2.md").read_text()


def test_tables_are_well_formed(church: tuple[DataRoot, Path], pair: tuple[DataRoot, Path]) -> None:
    for _, folder in (church, pair):
        for number in (1, 2, 3, 4):
            md = (folder / "tables" / f"table{number}.md").read_text()
            for block in re.split(r"\n\n", md):
                lines = [line for line in block.splitlines() if line.startswith("|")]
                assert len({line.count("|") for line in lines}) <= 1
            assert "simulated" in md
            assert "scratch" in md and "2+2" in md  # the model cards' facts
            assert_balanced((folder / "tables" / f"table{number}.tex").read_text())


def assert_balanced(tex: str) -> None:
    """Braces, environments and columns of a LaTeX table fit together."""
    plain = re.sub(r"\\[\\{}&%#$_]", "", tex)
    assert plain.count("{") == plain.count("}")
    assert re.findall(r"\\begin\{(\S+?)\}", tex) == re.findall(r"\\end\{(\S+?)\}", tex)[::-1]
    columns = len(there(re.search(r"\\begin\{tabular\}\{([lr]+)\}", tex))[1])
    for line in tex.splitlines():
        if line.endswith(r"\\"):
            spans = [int(n) for n in re.findall(r"\\multicolumn\{(\d+)\}", line)]
            assert len(re.findall(r"(?<!\\)&", line)) + 1 + sum(spans) - len(spans) == columns, line


def test_text_is_escaped_in_every_format() -> None:
    assert latex_text("50 % of a_b & 2° ~ {x}") == r"50 \% of a\_b \& 2$^\circ$ \textasciitilde{} \{x\}"
    grid = Grid("t", "T", "c", (("", "a|b"), ("", "<i>")), (Block("", (Row(("x|y", "1 & 2"), "ours"),)),), 1)
    assert r"x\|y" in markdown(grid) and r"1 \& 2" in latex(grid)
    hostile = Row(("<script>alert(1)</script>", "[x](http://y)\n| `z` \\"), "ours")
    text = markdown(Grid("t", "<b>", "<c>", (("", "a"), ("", "b")), (Block("<d>", (hostile,)),), 1, ("<e>",)))
    assert "<" not in text and "1 &amp; 2" in markdown(grid)
    assert r"| &lt;script&gt;alert(1)&lt;/script&gt; | \[x\](http://y) \| \`z\` \\ |" in text.splitlines()
    with pytest.raises(ValueError, match="cells"):
        Grid("t", "T", "c", (("", "a"),), (Block("", (Row(("x", "y"), "ours"),)),))


class Links(HTMLParser):
    """Every address in a page, and whether its elements close."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href")]
        if tag not in ("meta", "img", "link", "br", "input"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def test_the_page_is_self_contained_and_says_simulated(church: tuple[DataRoot, Path]) -> None:
    _, folder = church
    page = page_of(folder)
    links = Links(page)
    assert not links.open
    for address in links.addresses:
        assert address.startswith(("#", "data:image/")), address
    assert not re.search(r"url\((?!#)|@import|https?://(?!www\.w3\.org|purl\.org|creativecommons\.org)", page)
    assert 'id="simulated"' in page and 'id="meaningless"' not in page
    for text in ("Table IV", "published", "image is broken: truncated after … bytes", "2+2 instead of 6+6"):
        assert text in page
    ids = re.findall(r'\sid="([^"]+)"', page)
    assert len(ids) == len(set(ids))


def test_a_real_capture_of_few_frames_says_that_its_accuracy_means_nothing(chair: tuple[DataRoot, Path]) -> None:
    _, folder = chair
    page = page_of(folder)
    assert 'id="meaningless"' in page and "accuracy means nothing" in page and 'id="simulated"' not in page
    assert "means nothing" in (folder / "tables" / "table2.tex").read_text()
    assert cells_of(folder, source="published").empty
    checks = read_table(folder / "checks.parquet", schema("report", "checks"))
    assert set(checks.loc[checks["check"] == "no_leak", "status"]) == {"caution"}


def test_near_copies_in_training_mean_that_accuracy_means_nothing() -> None:
    copies = "90% of test images show nearly what a training image shows"
    for near, reasons in ((0.9, [copies]), (0.01, []), (None, [])):
        frames = pd.DataFrame({"split": ["train"] * 500})
        made = SimpleNamespace(frames=frames, leak_s=None, near_copies=near, cards=["PN"])
        assert SceneInputs.why_meaningless(cast(SceneInputs, made)) == reasons


def test_support_frames_are_not_counted(chair: tuple[DataRoot, Path]) -> None:
    data, folder = chair
    frames = table_of(data, "chair", "import", "frames")
    images = table_of(data, "chair", "sfm", "images")
    assert len(frames) == 25 and frames["support"].sum() == 1 and len(images) == 25
    page = page_of(folder)
    assert "<b>24</b><span>frames</span>" in page and "25 frames" not in page


def test_the_same_run_gives_the_same_bytes(church: tuple[DataRoot, Path]) -> None:
    data, folder = church
    kinds = (".svg", ".png", ".pdf", ".html", ".parquet")
    outputs = {path: path.read_bytes() for path in folder.rglob("*") if path.suffix in kinds}
    execute(STAGE, "Church", "tiny", data, force=True)
    assert {path: path.read_bytes() for path in outputs} == outputs


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize(
    ("methods", "headline"),
    [
        (["raw", "mine"], ["PN, alone", "PN+my filter"]),
        (["mine"], ["PN+my filter"]),
        (["raw", "smoother"], ["PN, alone"]),
    ],
)
def test_a_run_without_the_papers_rule(make_run: MakeRun, methods: list[str], headline: list[str]) -> None:
    """Fused by any method, or not at all: raw errors in Tables II and III, all methods in Table IV."""
    data = make_run(Bar={"train": 12, "test": 8})
    for table in ("poses", "errors", "intervals", "sessions", "methods"):
        rows = table_of(data, "Bar", "fuse", table)
        rows["method"] = rows["method"].replace("paper_rule", "mine")
        if table == "methods":
            rows["label"] = rows["label"].replace("VIO", "my filter")
        rewrite(data, "Bar", "fuse", table, rows[rows["method"].isin(methods)])
    report = execute(STAGE, "Bar", "tiny", data)
    errors = errors_of(data, "Bar", "PN")
    mean = cells_of(report, source="ours", table="II", model="PN", statistic="mean", quantity="translation")
    assert mean["value"].tolist() == [pytest.approx(errors["raw_position_m"].mean())]
    assert set(cells_of(report, source="ours", table="IV")["method"]) == set(methods)
    names = [row[0] for row in rows_of(report, "headline-Bar")]
    assert [name for name in names if name.startswith("PN")] == headline
    assert "the paper's rule, wasn't run" in (report / "tables" / "table2.md").read_text()


WALKS = ("walk_1", "walk_2", "walk_3", "walk_4")


def test_without_vio_nothing_is_fused_and_the_report_says_so_once(
    make_run: MakeRun, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    drawings: list[str] = []

    def drawn(figure: Figure, folder: Path, name: str) -> str:
        drawings.append(name)
        return "<svg></svg>"

    monkeypatch.setattr(style, "save", drawn)
    data = make_run(simulated=False, Hall={"without_vio": WALKS, "localisers": ("Map",)})
    report = execute(STAGE, "Hall", "tiny", data)
    said = " ".join(capsys.readouterr().err.split())
    assert said.count("no VIO: nothing is fused, and every model stands alone") == 1
    assert said.count(", alone: median") == 3
    page = page_of(report)
    assert page.count('id="alone"') == 1 and "No VIO: nothing is fused" in page
    for absent in ("PN+VIO", "VIO drift", "same frames", "What a user sees", "Fusion", "Only optimised", "no pose"):
        assert absent not in page, absent
    pn = errors_of(data, "Hall", "PN", "raw")
    for table, row in (("II", "rp+opt"), ("IV", "all")):
        cells = cells_of(report, source="ours", table=table, model="PN", statistic="median", quantity="translation")
        of_row = cells[cells["row"] == row]
        assert of_row["value"].tolist() == [pytest.approx(pn["raw_position_m"].median())]
    assert not [name for name in drawings if "vio" in name]
    assert "Hall-error-distribution" in drawings
    table2 = (report / "tables" / "table2.md").read_text()
    assert "All test frames" in table2 and table2.count("no VIO") == 1
    findings = pd.read_parquet(report / "checks.parquet")
    scored = findings[findings["check"] == "all_scored"]
    assert len(scored) == 3 and (scored["status"] == "agrees").all()


@pytest.mark.usefixtures("no_figures")
def test_no_path_is_walked_where_none_is_known(make_run: MakeRun) -> None:
    data = make_run(Bar={"train": 12, "test": 8})
    sessions = table_of(data, "Bar", "import", "sessions")
    for known, path_m in (("4 sessions, 440 m walked", sessions["path_m"]), ("4 sessions", np.nan)):
        rewrite(data, "Bar", "import", "sessions", sessions.assign(path_m=path_m))
        page = page_of(execute(STAGE, "Bar", "tiny", data))
        assert f"<small>{known}; made up</small>" in page
    rewrite(data, "Bar", "import", "sessions", sessions.assign(device="unknown"))
    assert "440 m walked; unknown device</small>" in page_of(execute(STAGE, "Bar", "tiny", data))


@pytest.mark.usefixtures("no_figures")
def test_a_fit_to_a_reference_of_unknown_unit_is_no_metric_scale(make_run: MakeRun) -> None:
    data = make_run(Yard={"train": 12, "test": 8, "scale_source": "reference, unit unknown"})
    page = page_of(execute(STAGE, "Yard", "tiny", data))
    facts = page[page.index('id="verdict"') : page.index('id="capture"')]
    assert "scale against the reference, not metres" in facts and ">metric scale<" not in facts


@pytest.mark.usefixtures("no_figures")
def test_walks_without_vio_beside_others_are_scored_alone(make_run: MakeRun) -> None:
    data = make_run(Hall={"without_vio": ("walk_2", "walk_4")})
    rewrite(data, "Hall", "fuse", "poses", table_of(data, "Hall", "fuse", "poses").assign(reasons="gap"))
    report = execute(STAGE, "Hall", "tiny", data)
    page = page_of(report)
    assert "No VIO in walk_4: nothing is fused there" in page
    assert "100% of its frames aren&#39;t checked" in page[page.index('id="table2"') :]
    raw = errors_of(data, "Hall", "PN", "raw")

    def medians(**keys: str) -> list[float]:
        found = cells_of(report, source="ours", model="PN", method="raw", statistic="median", **keys)
        return found.loc[found["quantity"] == "translation", "value"].tolist()

    # Alone over all frames; and beside methods that fuse, over the frames that these can answer.
    assert medians(table="II", row="rp+opt", over="all") == [pytest.approx(raw["raw_position_m"].median())]
    fusible = raw[raw["session_id"] == "walk_3"]
    assert medians(table="IV", row="all") == [pytest.approx(fusible["raw_position_m"].median())]
    findings = pd.read_parquet(report / "checks.parquet")
    scored = findings[findings["check"] == "all_scored"]
    assert len(scored) == 6 and (scored["status"] == "agrees").all()


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize("alone", [("walk_4",), ("walk_3", "walk_4"), ()])
def test_where_some_test_walks_have_vio_all_figures_are_of_those(
    make_run: MakeRun, alone: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """The regressor is ten times as far off in the walk without VIO."""
    data = make_run(Hall={"without_vio": alone})
    errors = table_of(data, "Hall", "fuse", "errors")
    errors = errors[errors["split"] == "test"].reset_index(drop=True)
    far = [column for column in errors.columns if column.endswith(("position_m", "rotation_deg"))]
    errors.loc[errors["session_id"] == "walk_4", far] *= 10
    rewrite(data, "Hall", "fuse", "errors", errors)
    rewrite(data, "Hall", "fuse", "intervals", intervals(errors))
    folder = execute(STAGE, "Hall", "tiny", data)
    printed, page, verdict = capsys.readouterr().err, page_of(folder), read_json(folder / "verdict.json")
    some = alone == ("walk_4",)
    frames = 29 if some else 59
    assert {row["frames"] for row in verdict["localisers"]} == {frames}
    caption = page[page.index('id="headline-Hall"') :].split("</figcaption>")[0]
    assert f"{frames} of these queries" in caption and "59 test frames with ground truth of 60" in caption
    assert ("over 29 test frames of sessions in which something is fused, of 59" in caption) == some
    assert ("over 29 of 59 test frames" in printed) == some == ("is fused: 29 of 59 frames<" in page)
    assert ("% of 29 test frames have a pose" in "".join(closing_lines(verdict))) == some
    raw = next(row for row in rows_of(folder, "headline-Hall") if row[0] == "PN, alone")
    assert (raw[5] == "–") == some  # one walk has no interval
    shown = json.loads(page.partition('<script type="application/json">')[2].partition("</script>")[0])
    assert len(shown["compared"]) == frames
    assert {shown["session"][row] for row in shown["compared"]} == {"walk_3", *([] if some else ["walk_4"])}


def test_the_interval_is_over_the_walks_that_are_compared(make_run: MakeRun) -> None:
    data = make_run(Hall={"without_vio": ("walk_4",)})
    errors = table_of(data, "Hall", "fuse", "errors")
    errors = errors[errors["split"] == "test"].reset_index(drop=True)
    first = errors["frame_id"].isin(errors.loc[errors["session_id"] == "walk_3", "frame_id"].unique()[:12])
    errors.loc[first, "session_id"] = "walk_5"
    rewrite(data, "Hall", "fuse", "errors", errors)
    fused = intervals(errors[errors["session_id"] != "walk_4"])
    rewrite(data, "Hall", "fuse", "intervals", intervals(errors))
    rows = {row[0]: row[5] for row in rows_of(report_without_figures(data, "Hall"), "headline-Hall")}
    for method, name in (("raw", "PN, alone"), ("paper_rule", "PN+VIO")):
        known = fused[(fused["model"] == "PN") & (fused["method"] == method) & (fused["subset"] == "all")]
        low, high = known.loc[known["figure"] == "position_median_m", ["low", "high"]].iloc[0]
        assert rows[name] == f"{low:.2f} to {high:.2f}"


@pytest.mark.usefixtures("no_figures")
@pytest.mark.parametrize(
    ("ahead", "headline"),
    [("paper_rule", ["PN, alone", "PN+VIO"]), ("raw", ["PN, alone"]), ("smoother", ["PN, alone", "PN+smoother"])],
)
def test_the_headline_has_what_is_ahead_on_held_out_frames_and_by_how_many(
    make_run: MakeRun, ahead: str, headline: list[str]
) -> None:
    data = make_run(Bar={"train": 12, "test": 8})
    figures = {"frames": 4, "coverage_pct": 100.0, "position_mean_m": 1.0, "rotation_mean_deg": 2.0}
    rows = [
        {"method": name, "model": model, "scene": "Bar", "ahead": name == ahead} | figures
        for model in ("PN", "MS-T")
        for name in ("raw", "paper_rule", "smoother")
    ]
    rewrite(data, "Bar", "fuse", "validation", pd.DataFrame(rows))
    page = page_of(execute(STAGE, "Bar", "tiny", data))
    names = [row[0] for row in rows_of(data.run("tiny", "Bar", "report"), "headline-Bar")]
    assert [name for name in names if name.startswith("PN")] == headline
    assert "Methods were chosen by 4 frames held out of training" in page
    assert ("On these no fusion is ahead of PN and MS-T alone" in page) == (ahead == "raw")


@pytest.mark.usefixtures("no_figures")
def test_bad_input_is_a_clear_error(make_run: MakeRun) -> None:
    data = make_run(Bar={"train": 12, "test": 6})
    errors = table_of(data, "Bar", "fuse", "errors")
    rewrite(data, "Bar", "fuse", "errors", errors[errors["split"] != "test"])
    with pytest.raises(UserError, match="no test frame with ground truth"):
        execute(STAGE, "Bar", "tiny", data)
    rewrite(data, "Bar", "fuse", "errors", errors)
    for image in data.captures("Bar").rglob("*.jpg"):
        image.write_bytes(b"not a picture")
    with pytest.raises(UserError, match="an image can't be read"):
        execute(STAGE, "Bar", "tiny", data)
