"""The page of a scene, or of a group of scenes: one self-contained HTML file with a section of all that exists."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from markupsafe import Markup

from groundwalk.geometry.rows import evenly
from groundwalk.reports import details
from groundwalk.reports.cells import LocaliserErrors
from groundwalk.reports.figures import Picture
from groundwalk.reports.grids import Grid, html_table
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.templating import from_template
from groundwalk.reports.verdict import State, Verdict, usual_drift
from groundwalk.reports.walk_map import data_address, draw, frame_data, thumbnail
from groundwalk.store.choices import MapUnit, QualityClass
from groundwalk.store.tables import scale_warning

_SHEET = 8  # pictures that show what a capture is of


@dataclass(frozen=True)
class SceneSection:
    """What the page shows of one scene: figures by section, its tables by name (empty where there is nothing to show),
    its map with the data of its frames, and each stage's settings."""

    scene: SceneInputs
    verdict: Verdict
    facts: list[tuple[str, str, str]]
    sheet: list[tuple[str, str]]
    walk: str
    frames: str
    checks_plot: str
    control_plot: str
    pictures: dict[str, list[Picture]]
    localiser_errors: list[LocaliserErrors]
    compared_frames: int
    tables: dict[str, Markup]
    settings: list[tuple[str, str]]


def facts(scene: SceneInputs, verdict: Verdict) -> list[tuple[str, str, str]]:
    """The first screen's figures: (number, what it is, more)."""
    unit, per = details.small_unit(scene.unit)
    frames, trusted = verdict.frames, verdict.trusted
    path_m = scene.sessions["path_m"].sum(skipna=False)
    walked = "" if path_m != path_m else f", {path_m:.{0 if path_m >= 10 else 1}f} m walked"
    many = "s" if len(scene.sessions) > 1 else ""
    devices = [device for device in scene.sessions["device"].unique() if device and device != "unknown"]
    captured = f"{len(scene.sessions)} session{many}{walked}; {', '.join(devices) or 'unknown device'}"
    shown = [(f"{len(frames)}", "frames", captured)]
    if "align" not in scene.stages:
        return shown
    share = 100 * len(trusted) / max(len(frames), 1)
    coverage, longest = verdict.coverage()
    by_class = ", ".join(f"{name} {count}" for name, count in frames["quality"].value_counts().sort_index().items())
    classes = f"{len(trusted)} of class A or B; by class: {by_class}"
    shown.append((f"{share:.0f} %", "of frames can be trusted", classes))
    known = trusted if len(trusted) else frames[frames["quality"] != QualityClass.NONE]
    if known["position_sd"].notna().any():
        metres, degrees = (known[c].quantile(0.95) for c in ("position_sd", "rotation_sd_deg"))
        which = "these" if len(trusted) else "those with ground truth"
        what = f"to which 95 % of {which} are known: one sigma, least certain axis"
        half = f"half to ± {per * known['position_sd'].median():.2g} {unit}"
        shown.append((f"± {per * metres:.2g} {unit}, ± {degrees:.2g}°", what, half))
    covered = f"longest stretch without such a frame: {longest:.{1 if longest >= 1 else 2}f} {scene.unit.symbol}"
    if coverage == coverage:
        shown.append((f"{100 * coverage:.0f} %", "of the walk lies between trusted frames", covered))
    figures = scene.manifests["align"]["figures"]
    scale, vertical = figures.get("scale_sd"), figures.get("vertical_sd_deg")
    source = str(figures.get("scale_source")).replace("vio", "VIO")
    upright = "vertical unknown" if vertical is None else f"vertical ± {vertical:.2g}°"
    known_scale = "unknown" if scale is None else f"± {100 * scale:.2g} %"
    what = "scale against the reference, not metres" if scene.unit is MapUnit.REFERENCE else "metric scale"
    shown.append((known_scale, what, f"from {source}; {upright}"))
    if d := usual_drift(scene):
        jumps = f"{len(scene.jumps)} VIO jump{'s' if len(scene.jumps) != 1 else ''}"
        more = f"median; 95th percentile {d['p95_percent']:.2g} %; {jumps}"
        shown.append((f"{d['median_percent']:.2g} %", f"VIO drift over {d['distance_m']:g} m", more))
    elif frames["vio_error"].notna().any():
        rms = per * float((frames["vio_error"] ** 2).mean() ** 0.5)
        more = "no walk is long enough for drift by distance"
        shown.append((f"{rms:.2g} {unit}", "VIO from ground truth, RMS", more))
    if e := verdict.true_errors:
        more = f"stated ± {100 * e.position_stated:.2g} cm (one axis, scale and vertical included)"
        shown.append((f"{100 * e.position:.2g} cm", "from the simulator's truth, median", more))
    return shown


def section(
    scene: SceneInputs,
    verdict: Verdict,
    image_path: Callable[[str], Path],
    pictures: dict[str, list[Picture]],
    localiser_errors: list[LocaliserErrors],
) -> SceneSection:
    """A scene's part of the page, as far as its stages are finished. UserError where an image can't be read."""
    frames = scene.frames.sort_values(["session_id", "t_ns"], kind="stable")
    chosen = frames.iloc[evenly(len(frames), _SHEET)] if len(frames) else frames
    meanings = [
        f"no ground truth: {reason}" if quality == QualityClass.NONE else f"class {quality}"
        for quality, reason in zip(verdict.frames["quality"], verdict.frames["reason"], strict=True)
    ]
    aligned, fused = "align" in scene.stages, "fuse" in scene.stages
    grids: dict[str, Grid | None] = {
        "headline": details.headline(scene, localiser_errors),
        "problems": details.problems(scene.name, verdict.problems),
        "classes": details.classes(scene, verdict) if aligned else None,
        "truth": details.true_errors(scene, verdict),
        "sessions": details.sessions(scene),
        "rejects": details.rejects(scene),
        "alignment": details.alignment(scene),
        "consistency": details.consistency(scene),
        "control": details.control(scene),
        "drift": details.drift(scene) if aligned else None,
        "localisers": details.localisers(scene),
        "walks": details.walks(scene) if fused else None,
        "users": details.users(scene) if fused else None,
        "provenance": details.provenance(scene),
    }
    return SceneSection(
        scene=scene,
        verdict=verdict,
        facts=facts(scene, verdict),
        sheet=[
            (thumbnail(image_path(frame["image"]), frame["gravity_x"], frame["gravity_y"]), str(frame["frame_id"]))
            for _, frame in chosen.iterrows()
        ],
        walk=draw(scene.name, scene.unit.symbol, verdict.frames.assign(meaning=meanings)),
        frames=frame_data(scene, verdict, image_path),
        checks_plot=data_address("png", scene.checks_plot.read_bytes()) if scene.checks_plot else "",
        control_plot=data_address("png", scene.control_plot.read_bytes()) if scene.control_plot else "",
        pictures=pictures,
        localiser_errors=localiser_errors,
        compared_frames=scene.compared["frame_id"].nunique(),
        tables={name: html_table(grid) for name, grid in grids.items()},
        settings=[
            (stage, json.dumps(manifest["settings"], indent=1, ensure_ascii=False))
            for stage, manifest in scene.manifests.items()
        ],
    )


def render(
    name: str, environment: str, profile: str, sections: list[SceneSection], grids: list[Grid], findings: pd.DataFrame
) -> str:
    """The page as HTML; `grids` are the tables over all scenes, `findings` the rows of report.checks."""
    scenes = [section.scene for section in sections]
    return from_template(
        "page.html.j2",
        name=name,
        environment=environment,
        profile=profile,
        sections=sections,
        State=State,
        simulated=[scene.name for scene in scenes if scene.simulated],
        without_scale={scene.name: warning for scene in scenes if (warning := scale_warning(scene.unit))},
        alone={scene.name: reason for scene in scenes if (reason := scene.why_alone())},
        fuses=any(scene.fuses for scene in scenes),
        meaningless={scene.name: why for scene in scenes if (why := scene.why_meaningless())},
        tables={grid.key: html_table(grid) for grid in grids},
        overview_heads=details.OVERVIEW,
        overview=[details.overview(s.scene, s.verdict, s.localiser_errors) for s in sections],
        checks=len(findings),
        disagreeing=html_table(details.checks(findings)),
    )
