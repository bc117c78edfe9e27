"""Stage report: the verdict on a capture, tables beside the paper's, figures, checks: one page of what is finished."""

from base64 import b64decode

import pandas as pd

from groundwalk.reports import cells, page
from groundwalk.reports.definition import ReportSettings
from groundwalk.reports.figures import scene_figures
from groundwalk.reports.grids import Grid, html_table, latex, markdown
from groundwalk.reports.inputs import SceneInputs, read_scene
from groundwalk.reports.published import load_published
from groundwalk.reports.run_checks import AGREES, run_findings
from groundwalk.reports.runs_index import THUMBNAIL
from groundwalk.reports.tables import Tables
from groundwalk.reports.verdict import as_json, judge
from groundwalk.store import StageRun
from groundwalk.store.files import write_json
from groundwalk.store.schemas import schema
from groundwalk.store.tables import scale_warning


def run(r: StageRun[ReportSettings]) -> None:
    scenes = [read_scene(r, leaf) for leaf in r.leaves]
    grids: list[Grid] = []
    all_cells, findings = (schema("report", name).arrow().empty_table().to_pandas() for name in ("cells", "checks"))
    if all("fuse" in scene.stages for scene in scenes):
        with r.step("tables"):
            parts = [cells.our_cells(scenes)]
            if r.settings.published:
                parts.append(cells.published_cells(load_published(r.data.files("published")), scenes))
            all_cells = pd.concat([part for part in parts if len(part)], ignore_index=True)
            findings = pd.concat([run_findings(scene) for scene in scenes], ignore_index=True)
            grids = Tables(all_cells, scenes).all()
            (r.work / "tables").mkdir(exist_ok=True)
            for grid in grids:
                for suffix, write in (("md", markdown), ("tex", latex), ("html", html_table)):
                    (r.work / "tables" / f"{grid.key}.{suffix}").write_text(write(grid), encoding="utf-8")
    r.write("cells", all_cells)
    r.write("checks", findings)
    with r.step("sections"):
        sections = [_section(r, scene, all_cells) for scene in r.track(scenes, "drawing figures")]
    with r.step("page"):
        html = page.render(r.scene.name, r.scene.environment, r.profile, sections, grids, findings)
        (r.work / "page.html").write_text(html, encoding="utf-8")
        for section in sections:
            file = "verdict.json" if len(sections) == 1 else f"verdict-{section.scene.name}.json"
            write_json(r.work / file, as_json(section.scene, section.verdict, section.localiser_errors))
        if images := [image for section in sections for image, _ in section.sheet]:
            (r.work / THUMBNAIL).write_bytes(b64decode(images[len(images) // 2].partition(",")[2]))
    r.figure("checks", len(findings))
    r.figure("checks_not_agreeing", int((findings["status"] != AGREES).sum()))
    _say(r, sections)


def _section(r: StageRun[ReportSettings], scene: SceneInputs, all_cells: pd.DataFrame) -> page.SceneSection:
    (r.work / "figures").mkdir(exist_ok=True)
    pictures, errors = scene_figures(scene, r.work / "figures"), list(cells.localiser_errors(scene, all_cells))
    return page.section(scene, judge(scene), lambda image: r.image_path(image, scene.name), pictures, errors)


def _say(r: StageRun[ReportSettings], sections: list[page.SceneSection]) -> None:
    for section in sections:
        scene, verdict = section.scene, section.verdict
        r.say(f"{scene.name}: {verdict.state}: {verdict.why}")
        if scene.simulated:
            r.say(f"{scene.name} is simulated, and so are its numbers")
        if warning := scale_warning(scene.unit):
            r.say(f"warning: {scene.name}: {warning}")
        for reason in scene.why_meaningless():
            r.say(f"{scene.name}: the regressors' accuracy means nothing: {reason}")
        if why := scene.why_alone():
            r.say(f"{scene.name}: {why}")
        for of in section.localiser_errors:
            figures = f"median {of.position} {scene.unit.symbol}, {of.rotation}°; {of.coverage} % have a pose"
            over = f", over {of.frames} of {scene.scored_frames} test frames" * (of.frames < scene.scored_frames)
            r.say(f"{scene.name}: {of.name}: {figures}{over}")
    r.say(f"page: {r.data.run(r.profile, r.scene.name, 'report') / 'page.html'}")
