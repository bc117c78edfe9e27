"""The page in a real browser: nothing is fetched, nothing overflows, and its controls show what the tables hold."""

import csv
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundwalk.reports.definition import STAGE
from groundwalk.scoring.errors import rotation_error_deg
from groundwalk.store.schemas import schema
from groundwalk.store.settings import DataRoot
from groundwalk.store.stage import execute
from groundwalk.store.tables import poses_of, read_table

BROWSER = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install -e '.[page]'")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe-core: pip install -e '.[page]'")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser: apt-get install chromium")


_PATIENCE_MS = 240_000  # a busy machine's browser is slow


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"], timeout=_PATIENCE_MS)
        yield browser
        browser.close()


def opened(context: Any, run: Path) -> Any:
    page = context.new_page()
    page.set_default_timeout(_PATIENCE_MS)
    page.goto((run / "report" / "page.html").as_uri())
    return page


@pytest.fixture(scope="module")
def run(make_run: Callable[..., DataRoot]) -> Path:
    data = make_run(Yard={"train": 30, "test": 20, "uncertain": 0.2, "localisers": ("Map",)})
    execute(STAGE, "Yard", "tiny", data)
    return data.run("tiny", "Yard")


@pytest.fixture(scope="module")
def aligned(make_run: Callable[..., DataRoot]) -> Path:
    """A run that ended with align, of sessions with long names."""
    data = make_run(simulated=False, Yard={"train": 30, "test": 20})
    for stage in ("localise", "train", "fuse"):
        shutil.rmtree(data.run("tiny", "Yard", stage))
    execute(STAGE, "Yard", "tiny", data)
    return data.run("tiny", "Yard")


@pytest.mark.parametrize("width", [360, 768, 1280])
@pytest.mark.parametrize("which", ["run", "aligned"])
def test_nothing_is_fetched_and_nothing_overflows(
    browser: Any, request: pytest.FixtureRequest, which: str, width: int
) -> None:
    context = browser.new_context(viewport={"width": width, "height": 800}, color_scheme="dark")
    said: list[str] = []
    asked: list[str] = []
    context.on("console", lambda message: said.append(message.text))
    context.on("weberror", lambda error: said.append(str(error.error)))
    context.on("request", lambda r: asked.append(r.url) if not r.url.startswith(("file:", "data:")) else None)
    page = opened(context, request.getfixturevalue(which))
    assert page.evaluate("document.documentElement.scrollWidth") == width
    right = "[...document.querySelectorAll('td, th, svg, img, dd, caption')].map(e => e.getBoundingClientRect().right)"
    assert max(page.evaluate(right)) <= width
    assert not said and not asked
    context.close()


def test_a_frame_can_be_asked_what_it_is(browser: Any, run: Path) -> None:
    truth = read_table(run / "align" / "ground_truth.parquet", schema("align", "ground_truth"))
    truth = truth.sort_values(["session_id", "t_ns"]).set_index("frame_id")
    errors = read_table(run / "fuse" / "errors.parquet", schema("fuse", "errors"))
    alone = errors[errors["model"] == "PN"].drop_duplicates("frame_id").set_index("frame_id")["raw_position_m"]
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = opened(context, run)

    def shown() -> dict[str, str]:
        names, texts = page.locator(".frame dt").all_text_contents(), page.locator(".frame dd").all_text_contents()
        return {"id": page.locator(".frame h3").inner_text(), **dict(zip(names, texts, strict=True))}

    slider = page.locator(".frames > .controls input")
    slider.focus()
    for _ in range(5):
        page.keyboard.press("ArrowRight")
    found = shown()
    assert found["id"] == truth.index[5] and found["split"] == truth["split"].iloc[5]
    assert float(found["PN alone (m)"]) == pytest.approx(alone[found["id"]], rel=0.01)
    assert float(found["sigma, position (m)"]) == pytest.approx(truth["position_sd_m"].iloc[5])
    assert page.locator(".frame img").first.get_attribute("src").startswith("data:image/jpeg")
    placed = truth[truth["map_cam_tx"].notna()]
    poses, row = poses_of(placed, "map_cam"), placed.index.get_loc(found["id"])
    apart = np.linalg.norm(poses[:, :3, 3] - poses[row, :3, 3], axis=1)
    apart[
        (placed["split"] != "train") | (rotation_error_deg(poses, poses[row]) > 45) | (np.arange(len(poses)) == row)
    ] = 99
    best, near = apart.argmin(), found["nearest training frame"].split(", ")
    assert near[0] == placed.index[best] and float(near[1].split()[0]) == pytest.approx(apart[best], rel=0.01)
    inliers = read_table(run / "localise" / "predictions.parquet", schema("localise", "predictions"))
    assert float(found["Map, inliers"]) == inliers.set_index("frame_id")["inliers"][found["id"]]
    mark = page.locator('circle[data-row="40"]')
    mark.click(force=True)
    assert shown()["id"] == truth.index[40] and "chosen" in mark.get_attribute("class")
    fill = "e => getComputedStyle(e).fill"
    before = mark.evaluate(fill)
    page.locator(".frames > .controls select").select_option("PN alone (m)")
    assert mark.evaluate(fill) != before and page.locator(".legend").is_visible()
    answered = alone.reindex(truth[truth["map_cam_tx"].notna()].index).notna().sum()
    assert page.locator(".answers").get_attribute("d").count("M") == answered
    strip = page.locator(".map .strip").bounding_box()
    page.mouse.click(strip["x"] + strip["width"] * 12.5 / len(truth), strip["y"] + 20)
    assert shown()["id"] == truth.index[12]
    page.locator(".frames > .controls select").select_option("")
    assert mark.evaluate(fill) == before and not page.locator(".legend").is_visible()
    context.close()


def test_recall_follows_threshold_session_and_localiser(browser: Any, run: Path) -> None:
    errors = read_table(run / "fuse" / "errors.parquet", schema("fuse", "errors"))
    tested = errors[(errors["split"] == "test") & (errors["model"] == "PN")].drop_duplicates("frame_id")
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = opened(context, run)
    recall = page.locator(".recall")
    shown = recall.locator(".key", has_text="PN alone").locator("b")
    for session, step in (("", 47), ("", 90), (tested["session_id"].iloc[0], 60)):
        recall.locator("select").select_option(session)
        recall.locator("input[type=range]").fill(str(step))
        asked = tested[tested["session_id"] == session] if session else tested
        within = (asked["raw_position_m"] <= 10 ** (3 * step / 100 - 2)).mean()
        assert shown.inner_text() == f"{100 * within:.1f} %"
    drawn = "paths => paths.filter(path => path.getAttribute('d')?.includes('L')).length"
    before = recall.locator("path").evaluate_all(drawn)
    recall.locator(".key input").first.uncheck()
    assert recall.locator("path").evaluate_all(drawn) == before - 1 == recall.locator(".key").count() - 1
    context.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("which", ["run", "aligned"])
def test_the_page_is_accessible(browser: Any, request: pytest.FixtureRequest, which: str, scheme: str) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme=scheme)
    page = opened(context, request.getfixturevalue(which))
    wanted = {"runOnly": ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa"]}
    found = axe.Axe().run(page, options=wanted).response["violations"]
    assert not [(v["id"], v["nodes"][0]["html"], v["nodes"][0]["failureSummary"]) for v in found]
    context.close()


def test_tables_sort_and_copy(browser: Any, run: Path) -> None:
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    page = opened(context, run)
    table = page.locator("#headline-Yard table")
    column = "rows => rows.map(row => Number(row.cells[1].textContent))"
    head = table.locator("th button").nth(1)
    head.focus()
    for order, reverse in (("ascending", False), ("descending", True)):
        page.keyboard.press("Enter")
        values = table.locator("tbody tr").evaluate_all(column)
        assert len(values) == 6 and values == sorted(values, reverse=reverse)
        assert table.locator("th").nth(1).get_attribute("aria-sort") == order
    cells = table.locator("tbody tr").evaluate_all("rows => rows.map(row => [...row.cells].map(c => c.textContent))")
    heads = table.locator("th").evaluate_all("heads => heads.map(head => head.textContent)")
    page.evaluate("document.addEventListener('copy', () => window.copied = document.activeElement.value)")
    copied = {}
    for name in ("CSV", "Markdown", "LaTeX"):
        page.locator("#headline-Yard .copies button", has_text=name).click()
        assert page.locator("#headline-Yard [role=status]").inner_text() == "copied"
        copied[name] = page.evaluate("window.copied")
    assert list(csv.reader(copied["CSV"].splitlines())) == [heads, *cells]
    lines = copied["Markdown"].splitlines()
    assert [line.strip("| ").split(" | ") for line in (lines[0], *lines[2:])] == [heads, *cells]
    assert copied["LaTeX"].count(r" \\") == 1 + len(cells) and r"coverage (\%) & " in copied["LaTeX"]
    context.close()


def test_without_script_all_tables_and_drawings_stand(browser: Any, run: Path) -> None:
    context = browser.new_context(java_script_enabled=False, viewport={"width": 1280, "height": 900})
    page = opened(context, run)
    assert page.locator(".walk circle").count() > 90 and page.locator(".picture svg").count() == 3
    for table in ("headline-Yard", "problems-Yard", "quality-Yard", "table1", "table4"):
        assert page.locator(f"#{table} table").first.is_visible()
    assert not page.locator(".controls, .copies").first.is_visible()
    context.close()
