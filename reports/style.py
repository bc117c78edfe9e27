"""One look for all figures: thin axes, no boxes, and colours that mean the same here and in the recordings."""

import io
import re
import textwrap
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import style as matplotlib_style
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from groundwalk.reports.inputs import SceneInputs
from groundwalk.store import colours


def _hex(rgb: tuple[int, int, int]) -> str:
    return "#{:02x}{:02x}{:02x}".format(*rgb)


VIO = _hex(colours.VIO)
NEUTRAL = _hex(colours.NEUTRAL)

WIDTH = 3.6  # inches: a column of a paper, and of the page
# Text and axes; no data has this colour, so that in SVG it can become the page's own text colour.
INK = "#1a1a1b"

_WIDE_RANGE = 3000.0  # of a logarithmic axis: its largest over its smallest value, from where ticks at 2 and 5 overlap
_STYLE: Any = {
    "figure.constrained_layout.use": True,
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "font.family": "sans-serif",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.facecolor": "none",
    "axes.edgecolor": INK,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": NEUTRAL,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "pdf.fonttype": 42,
}


def applied() -> AbstractContextManager[None]:
    """Draw in this style, whatever a matplotlibrc says: matplotlib looks settings up as each part is drawn."""
    return matplotlib_style.context(["default", _STYLE])


def new_figure(panels: int, height: float, **options: Any) -> tuple[Figure, list[Axes]]:
    """A figure of a column's width, and its axes, each `height` inches, from top to bottom."""
    figure = Figure(figsize=(WIDTH, panels * height))
    axes = figure.subplots(panels, 1, squeeze=False, **options)
    return figure, list(axes.ravel())


def model_colours(scene: SceneInputs) -> dict[str, str]:
    models = dict.fromkeys([*scene.models, *scene.localisers["model"], *scene.cards["model"]])
    return {name: _hex(colour) for name, colour in colours.localiser_colours(map(str, models)).items()}


def mark(figure: Figure, text: str) -> None:
    """Small print on a figure: what its data is."""
    figure.supxlabel(textwrap.fill(text, 80), x=0.995, ha="right", fontsize=5.5, color=NEUTRAL)


def log_axis(axis: Axis) -> None:
    """A logarithmic axis with ticks, written out, at powers of ten and, over a few of these, 2 and 5 times them."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < _WIDE_RANGE * low else (1.0,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def save(figure: Figure, folder: Path, name: str) -> str:
    """Write <name>.png (on white), <name>.pdf with its fonts, and <name>.svg, which is returned, too: `inline_svg`. The
    same figure gives the same bytes."""
    svg = inline_svg(figure, name)  # lays the figure out
    background = figure.get_facecolor()
    with applied():
        # By the canvases, as savefig draws everything twice.
        figure.set_dpi(150)
        figure.set_facecolor("white")
        FigureCanvasAgg(figure).print_png(folder / f"{name}.png", metadata={"Software": None})
        figure.set_facecolor(background)
        FigureCanvasPdf(figure).print_pdf(folder / f"{name}.pdf", metadata={"CreationDate": None})
    (folder / f"{name}.svg").write_text(svg, encoding="utf-8")
    return svg


def inline_svg(figure: Figure, name: str) -> str:
    """A figure as SVG that can stand in HTML; its text takes the colour of the page around it. Lays the figure out."""
    with applied(), mpl.rc_context({"svg.hashsalt": name}):
        # The layout alone is worked out twice: the first changes which ticks an axis has, and so how wide they are.
        layout = figure.get_layout_engine()
        if layout is not None:
            layout.execute(figure)
            layout.execute(figure)
        # The layout stands now, and takes as long as drawing.
        figure.set_layout_engine("none")
        buffer = io.StringIO()
        FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    svg = buffer.getvalue()
    # Inside HTML there's no place for an XML prologue, and no name may be that of another figure's element.
    svg = svg[svg.index("<svg") :].replace(INK, "currentColor")
    return re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
