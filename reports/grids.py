"""A table as it is read, and the same as Markdown, LaTeX and HTML."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby

from markupsafe import Markup

from groundwalk.reports.templating import fragment

PUBLISHED, OURS = "published", "ours"
_PAGE_COLUMNS = 11  # of numbers, side by side on a page
EMPTY = "–"


@dataclass(frozen=True)
class Row:
    """One line: its cells as text, whose numbers they are (`source`), and whether it's an average over scenes."""

    cells: tuple[str, ...]
    source: str
    average: bool = False


@dataclass(frozen=True)
class Block:
    """Lines under one heading."""

    title: str
    rows: tuple[Row, ...]


@dataclass(frozen=True)
class Grid:
    """A table: `key` names its files; columns are (group, name), neighbours of one group share a heading.

    The first `labels` columns hold words, the others numbers. `notes` stand below.
    """

    key: str
    title: str
    caption: str
    columns: tuple[tuple[str, str], ...]
    blocks: tuple[Block, ...]
    labels: int = 2
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for block in self.blocks:
            for row in block.rows:
                if len(row.cells) != len(self.columns):
                    raise ValueError(f"{self.key}: {len(row.cells)} cells in {len(self.columns)} columns: {row.cells}")

    @property
    def groups(self) -> list[tuple[str, int]]:
        """The headings over the columns, each with the number of columns under it."""
        return [(name, len(list(members))) for name, members in groupby(group for group, _ in self.columns)]


def plain_grid(
    key: str, title: str, caption: str, heads: str, rows: Iterable[Sequence[object]], labels: int = 1
) -> Grid | None:
    """A table of one block of ours, with ` | ` between its headings; None where there are no rows."""
    lines = tuple(Row(tuple(map(str, row)), OURS) for row in rows)
    columns = tuple(("", name) for name in heads.split(" | "))
    return Grid(key, title, caption, columns, (Block("", lines),), labels) if lines else None


def markdown(grid: Grid) -> str:
    """The table in GitHub's Markdown: a table a block, as Markdown has no headings that span."""
    names = [f"{group}: {name}" if group else name for group, name in grid.columns]
    rule = ["---"] * grid.labels + ["---:"] * (len(names) - grid.labels)
    lines = [f"### {_md_text(grid.title)}", "", _md_text(grid.caption), ""]
    for block in grid.blocks:
        lines += [f"**{_md_text(block.title)}**", ""] if block.title else []
        lines += [_md_line(names), _md_line(rule)]
        lines += [_md_line([f"*{cell}*" for cell in r.cells] if r.source == PUBLISHED else r.cells) for r in block.rows]
        lines.append("")
    lines += [f"- {_md_text(note)}" for note in grid.notes]
    return "\n".join(lines).rstrip() + "\n"


def _md_line(cells: list[str] | tuple[str, ...]) -> str:
    return "| " + " | ".join(_md_text(cell).replace("|", "\\|") for cell in cells) + " |"


def _md_text(text: str) -> str:
    """Text that Markdown shows as it is: without HTML, links and code, on one line."""
    escaped = text.replace("\\", "\\\\").replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    for character in "[]`":
        escaped = escaped.replace(character, f"\\{character}")
    return " ".join(escaped.splitlines())


_LATEX = {character: f"\\{character}" for character in "&%#$_{}"} | {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "°": r"$^\circ$",
    "×": r"$\times$",
    "≤": r"$\leq$",
    "–": "--",
    "·": r"$\cdot$",
}


def latex_text(text: str) -> str:
    """Plain text as LaTeX."""
    return re.sub("|".join(map(re.escape, _LATEX)), lambda m: _LATEX[m.group()], text)


def latex(grid: Grid) -> str:
    """The table as a LaTeX float that needs the package booktabs; published numbers are in italics."""
    count = len(grid.columns)
    lines = [
        r"% needs \usepackage{booktabs}",
        r"\begin{table*}",
        r"\centering",
        rf"\caption{{{latex_text(grid.caption)}}}",
        rf"\label{{tab:{grid.key}}}",
        r"\scriptsize\setlength{\tabcolsep}{2pt}",
        rf"\begin{{tabular}}{{{'l' * grid.labels}{'r' * (count - grid.labels)}}}",
        r"\toprule",
    ]
    if any(group for group, _ in grid.groups):
        start, spans, rules = 1, [], []
        for group, width in grid.groups:
            spans.append(rf"\multicolumn{{{width}}}{{c}}{{{latex_text(group)}}}")
            rules += [rf"\cmidrule(lr){{{start}-{start + width - 1}}}"] if group else []
            start += width
        lines += [" & ".join(spans) + r" \\", " ".join(rules)]
    lines.append(" & ".join(latex_text(name) for _, name in grid.columns) + r" \\")
    for block in grid.blocks:
        lines.append(r"\midrule")
        if block.title:
            lines.append(rf"\multicolumn{{{count}}}{{l}}{{\textbf{{{latex_text(block.title)}}}}} \\")
        for row in block.rows:
            cells = [latex_text(cell) for cell in row.cells]
            if row.source == PUBLISHED:
                cells = [rf"\emph{{{cell}}}" for cell in cells]
            lines.append(" & ".join(cells) + r" \\")
    lines += [r"\bottomrule", r"\end{tabular}", r"\par\smallskip\raggedright\footnotesize"]
    lines += [latex_text(note) + r"\par" for note in grid.notes]
    lines.append(r"\end{table*}")
    return "\n".join(lines) + "\n"


def html_table(grid: Grid | None) -> Markup:
    """The table as an HTML fragment, empty without one; rows have the class of their source, the page's style tells
    them apart. One that is wider than a page has its columns as rows, a table a block: no cell is out of sight."""
    if grid is None:
        return Markup()
    is_turned = len(grid.columns) > _PAGE_COLUMNS and max(len(b.rows) for b in grid.blocks) < len(grid.columns)
    return fragment("table.html.j2", grid=grid, is_turned=is_turned)
