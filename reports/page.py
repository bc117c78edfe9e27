"""The page of a scene, or of a group of scenes: one self-contained HTML file beside its figures."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from groundwalk.geometry.rows import evenly
from groundwalk.reports.grids import Grid, html_table
from groundwalk.reports.inputs import SceneInputs
from groundwalk.store.images import read_image
from groundwalk.store.tables import scale_warning

_TEMPLATES = Path(__file__).parent / "templates"
_THUMBNAIL_PX = 300
_THUMBNAILS = 12


@dataclass(frozen=True)
class Picture:
    """A figure in the page: its SVG, and what it shows."""

    svg: str
    caption: str


@dataclass(frozen=True)
class Thumbnail:
    """A frame on the contact sheet; `file` is relative to the page."""

    file: str
    frame_id: str
    split: str


@dataclass(frozen=True)
class SceneSection:
    """What the page shows of one scene: figures by section, the smaller tables by name (None where there is nothing to
    show), and each stage's settings."""

    scene: SceneInputs
    headline: list[tuple[str, str, str]]
    thumbnails: list[Thumbnail]
    pictures: dict[str, list[Picture]]
    grids: dict[str, Grid | None]
    versions: str
    settings: list[tuple[str, str]]

    @property
    def tables(self) -> dict[str, Markup]:
        return {name: Markup(html_table(grid) if grid else "") for name, grid in self.grids.items()}


@dataclass(frozen=True)
class Checked:
    """How the checks of one source's tables ended: how many there were, how many don't agree, and these in a table."""

    source: str
    count: int
    failed: int
    grid: Grid | None

    @property
    def table(self) -> Markup:
        return Markup(html_table(self.grid) if self.grid else "")


def render(
    name: str, environment: str, profile: str, sections: list[SceneSection], grids: list[Grid], checked: list[Checked]
) -> str:
    """The page as HTML; `grids` are the tables over all scenes."""
    jinja = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    jinja.filters["svg"] = Markup
    scenes = [section.scene for section in sections]
    return jinja.get_template("page.html.j2").render(
        name=name,
        environment=environment,
        profile=profile,
        sections=sections,
        simulated=[scene.name for scene in scenes if scene.simulated],
        without_scale={scene.name: warning for scene in scenes if (warning := scale_warning(scene.unit))},
        alone={scene.name: reason for scene in scenes if (reason := scene.why_alone())},
        fuses=any(scene.fuses for scene in scenes),
        meaningless={scene.name: why for scene in scenes if (why := scene.why_meaningless())},
        tables={grid.key: Markup(html_table(grid)) for grid in grids},
        checked=checked,
        style=Markup((_TEMPLATES / "page.css").read_text(encoding="utf-8")),
    )


def thumbnails(scene: SceneInputs, image_path: Callable[[str], Path], folder: Path) -> list[Thumbnail]:
    """Small upright JPEGs of frames spread evenly over the capture, written into `folder`/frames.

    `image_path` turns an entry of frames.image into a path. UserError where an image can't be read any more.
    """
    frames = scene.frames.sort_values(["session_id", "t_ns"])
    (folder / "frames").mkdir(parents=True, exist_ok=True)
    sheet = []
    for number, (_, frame) in enumerate(frames.iloc[evenly(len(frames), _THUMBNAILS)].iterrows()):
        image = cv2.cvtColor(read_image(image_path(frame["image"])), cv2.COLOR_RGB2BGR)
        scale = _THUMBNAIL_PX / max(image.shape[:2])
        small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        file = folder / "frames" / f"{scene.name}-{number:02d}.jpg"
        cv2.imwrite(str(file), upright(small, frame["gravity_x"], frame["gravity_y"]), [cv2.IMWRITE_JPEG_QUALITY, 82])
        sheet.append(Thumbnail(f"figures/frames/{file.name}", str(frame["frame_id"]), str(frame["split"])))
    return sheet


def upright(image: np.ndarray, gravity_x: float, gravity_y: float) -> np.ndarray:
    """An image turned by quarters so that gravity (camera axes, x right, y down) points down in it as far as it can."""
    if math.isnan(gravity_x) or math.isnan(gravity_y):
        return image
    quarters = round(math.degrees(math.atan2(gravity_x, gravity_y)) / 90) % 4
    turns = {1: cv2.ROTATE_90_CLOCKWISE, 2: cv2.ROTATE_180, 3: cv2.ROTATE_90_COUNTERCLOCKWISE}
    return cv2.rotate(image, turns[quarters]) if quarters else image
