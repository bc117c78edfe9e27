"""data/runs/index.html: all runs of a data folder, with what each has come to."""

import contextlib
from typing import Any
from urllib.parse import quote

from markupsafe import Markup

from groundwalk.reports.grids import EMPTY, html_table, plain_grid
from groundwalk.reports.templating import plain_page
from groundwalk.store.files import written_aside
from groundwalk.store.runs import RunFiles, runs_in
from groundwalk.store.settings import STAGES, DataRoot

THUMBNAIL = "thumbnail.jpg"
"""In the report's folder: one of the capture's images."""
_HEADS = "run | state | captures | frames | trusted (%) | sigma (cm) | scale ± (%) | best localiser"
_CAPTION = (
    "Trusted: frames of class A or B; sigma: their median, one axis, in the map's unit where that isn't metric. "
    "Best localiser: by the median over test frames. The pages have what stands behind each number."
)


def write_index(data: DataRoot) -> None:
    """Write the page anew, where there are runs; a disk that is full or read-only leaves the one before."""
    runs = list(runs_in(data))
    if not runs:
        return
    table = plain_grid("runs", "Runs", _CAPTION, _HEADS, map(_cells, runs), 3)
    page = plain_page("Runs", "all runs", [_pictures(runs), html_table(table)])
    with contextlib.suppress(OSError), written_aside(data.root / "runs" / "index.html") as path:
        path.write_text(page, encoding="utf-8")


def _pictures(runs: list[RunFiles]) -> Markup:
    """A picture of each run that has a page, which leads to it."""
    out = Markup()
    for run in runs:
        report = "/".join(map(quote, (*run.name[::-1], "report")))
        name = ", ".join(run.name)
        picture = Markup()
        if (run.folder / "report" / THUMBNAIL).is_file():
            picture = Markup('<img src="{}/{}" alt="a frame of {}">').format(report, THUMBNAIL, name)
        if (run.folder / "report" / "page.html").is_file():
            link = Markup('<a href="{}/page.html">{}{}</a>').format(report, picture, name)
            out += Markup("<figure>{}<figcaption>{}</figcaption></figure>").format(link, _state(run))
    return Markup('<div class="sheet">{}</div>').format(out)


def _cells(run: RunFiles) -> list[str]:
    verdict = run.verdict
    headline, metric = verdict.get("headline") or {}, verdict.get("length_unit") == "m"

    def number(name: str, factor: float) -> str:
        value = headline.get(name)
        return EMPTY if value is None else f"{factor * value:.3g}"

    sigma = number("position_sd_median", 100 if metric else 1)
    sigma += "" if metric or not headline else f" {verdict['length_unit']}"
    numbers = [str(headline.get("frames", EMPTY)), number("trusted_share", 100), sigma, number("scale_sd", 100)]
    return [", ".join(run.name), _state(run), "simulated" if run.simulated else "real", *numbers, _best(verdict)]


def _state(run: RunFiles) -> str:
    """The verdict, and how far the run has come."""
    scene = [*run.manifests.values()][-1]["scene"] if run.manifests else {}
    is_group = scene.get("members") and "report" in run.finished
    without = "a group: its page has its scenes' verdicts" if is_group else "no verdict yet"
    parts = [str(run.verdict.get("verdict", without))]
    if run.stopped:
        parts.append(f"stopped at {run.stopped}")
    elif {*(scene.get("stages") or STAGES)} - {*run.finished}:
        parts.append(f"up to {run.finished[-1]}")
    return "; ".join([*parts, *([f"outdated: {', '.join(run.outdated)}"] if run.outdated else [])])


def _best(verdict: dict[str, Any]) -> str:
    known = [row for row in verdict.get("localisers") or () if row["median_position"] is not None]
    if not known:
        return EMPTY
    best = min(known, key=lambda row: row["median_position"])
    figures = f"{best['median_position']:g} {verdict['length_unit']}, {best['median_rotation_deg']:g}°"
    return f"{best['localiser']}: {figures}; {best['coverage']:g} % have a pose"
