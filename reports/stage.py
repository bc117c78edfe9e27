"""Stage report: tables beside the paper's, figures, checks and one page."""

from pathlib import Path

import pandas as pd

from groundwalk.reports import cells, details, page, style
from groundwalk.reports.checks import AGREES, as_table, check_tables
from groundwalk.reports.definition import ReportSettings
from groundwalk.reports.figures import scene_figures
from groundwalk.reports.grids import OURS, Grid, html_table, latex, markdown
from groundwalk.reports.inputs import SceneInputs, read_scene
from groundwalk.reports.published import load_claims, load_published
from groundwalk.reports.recording import blueprint, record
from groundwalk.reports.run_checks import run_findings
from groundwalk.reports.tables import Tables
from groundwalk.store import StageRun


def run(r: StageRun[ReportSettings]) -> None:
    r.warn_of_scale()
    scenes = [read_scene(r, leaf) for leaf in r.leaves]
    files = r.data.files("published")
    published = load_published(files)
    with r.step("tables"):
        ours = cells.our_cells(scenes)
        parts = [ours, cells.published_cells(published, scenes)] if r.settings.published else [ours]
        all_cells = pd.concat([part for part in parts if len(part)], ignore_index=True)
        grids = Tables(all_cells, scenes).all()
        of_run = as_table([finding for scene in scenes for finding in run_findings(scene)], OURS)
        checked = [of_run, check_tables(cells.printed_tables(ours))]
        if r.settings.published:
            checked.append(check_tables(published, load_claims(files)))
        findings = pd.concat(checked, ignore_index=True)
        _write_tables(r.work / "tables", grids)
    r.write("cells", all_cells)
    r.write("checks", findings)
    with r.step("figures"):
        sections = [_section(r, scene, all_cells) for scene in r.track(scenes, "drawing figures")]
    with r.step("page"):
        html = page.render(r.scene.name, r.scene.environment, r.profile, sections, grids, _checked(findings))
        (r.work / "page.html").write_text(html, encoding="utf-8")
    with r.step("recording"), r.recording(blueprint(scenes, grids)) as stream:
        record(stream, scenes, grids)
    for outcome in _checked(findings):
        r.figure(f"checks_{outcome.source}", outcome.count)
        r.figure(f"checks_{outcome.source}_not_agreeing", outcome.failed)
    _say(r, scenes, sections)


def _checked(findings: pd.DataFrame) -> list[page.Checked]:
    checked = []
    for source, of_source in findings.groupby("source", sort=False):
        failed = int((of_source["status"] != AGREES).sum())
        checked.append(page.Checked(str(source), len(of_source), failed, details.checks(findings, str(source))))
    return checked


def _write_tables(folder: Path, grids: list[Grid]) -> None:
    folder.mkdir(exist_ok=True)
    for grid in grids:
        for suffix, write in (("md", markdown), ("tex", latex), ("html", html_table)):
            (folder / f"{grid.key}.{suffix}").write_text(write(grid), encoding="utf-8")


def _section(r: StageRun[ReportSettings], scene: SceneInputs, all_cells: pd.DataFrame) -> page.SceneSection:
    folder = r.work / "figures"
    folder.mkdir(exist_ok=True)
    # Before the figures, which take longer: what can fail for a user's reasons fails first.
    sheet = page.thumbnails(scene, lambda image: r.image_path(image, scene.name), folder)
    pictures = {}
    for part, figures in scene_figures(scene).items():
        pictures[part] = [
            page.Picture(style.save(f.figure, folder, f"{scene.name}-{f.name}"), f.caption) for f in figures
        ]
    grids = {
        "sessions": details.sessions(scene),
        "rejects": details.rejects(scene),
        "quality": details.quality(scene),
        "alignment": details.alignment(scene),
        "drift": details.drift(scene),
        "consistency": details.consistency(scene),
        "models": details.models(scene),
        "localisers": details.localisers(scene),
        "users": details.users(scene),
        "walks": details.walks(scene),
    }
    return page.SceneSection(
        scene=scene,
        headline=details.headline(scene, all_cells),
        thumbnails=sheet,
        pictures=pictures,
        grids=grids | {"provenance": details.provenance(scene)},
        versions=details.versions(scene),
        settings=details.stage_settings(scene),
    )


def _say(r: StageRun[ReportSettings], scenes: list[SceneInputs], sections: list[page.SceneSection]) -> None:
    for scene, section in zip(scenes, sections, strict=True):
        if scene.simulated:
            r.say(f"{scene.name} is simulated, and so are its numbers")
        for reason in scene.why_meaningless():
            r.say(f"{scene.name}: the regressors' accuracy means nothing: {reason}")
        if why := scene.why_alone():
            r.say(f"{scene.name}: {why}")
        for value, what, more in section.headline:
            r.say(f"{scene.name}: {what}: {value} ({more})")
    r.say(f"page: {r.data.run(r.profile, r.scene.name, 'report') / 'page.html'}")
