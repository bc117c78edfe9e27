"""Pages from the folder templates, each one file with its style and script."""

from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

_FOLDER = Path(__file__).parent / "templates"
_PARTS = {"style": "page.css", "script": "page.js"}
_JINJA = Environment(
    loader=FileSystemLoader(_FOLDER),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
    keep_trailing_newline=True,
)
_JINJA.filters["svg"] = Markup


def from_template(template: str, **values: Any) -> str:
    """A page as HTML. Values are text, and escaped, but for Markup."""
    parts = {name: Markup((_FOLDER / file).read_text(encoding="utf-8")) for name, file in _PARTS.items()}
    return fragment(template, **values, **parts)


def fragment(template: str, **values: Any) -> Markup:
    """A part of a page; values as of `from_template`."""
    return Markup(_JINJA.get_template(template).render(**values))


def plain_page(name: str, kicker: str, parts: list[Markup]) -> str:
    """A page of some parts under one heading, in the look of the report's."""
    return from_template("plain.html.j2", name=name, kicker=kicker, parts=parts)
