"""The page and verdict.json of a capture that import refuses: what is missing, and what to do."""

from pathlib import Path

from markupsafe import Markup

from groundwalk.reports.details import problems
from groundwalk.reports.grids import html_table
from groundwalk.reports.templating import plain_page
from groundwalk.reports.verdict import State, problem_of
from groundwalk.store.files import write_json


def write_unreadable(folder: Path, name: str, stopped: dict[str, str]) -> None:
    """Write page.html and verdict.json into a folder; `stopped` has `what`, `where`, `expected`, `found` and `do` of
    the error."""
    problem, what = problem_of(stopped), stopped["what"]
    lead = Markup('<p class="verdict refused"><strong>Unreadable.</strong> {}.</p>').format(what)
    page = plain_page(name, "capture", [lead, html_table(problems(name, [problem]))])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "page.html").write_text(page, encoding="utf-8")
    verdict = {"scene": name, "verdict": State.UNREADABLE.value, "why": what, "problems": [vars(problem)], "frames": []}
    write_json(folder / "verdict.json", verdict)
