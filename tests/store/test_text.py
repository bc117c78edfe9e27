"""What strangers' captures say reaches a terminal as text."""

from pathlib import Path

import pytest

from groundwalk.store import UserError
from groundwalk.store.cli import new_app
from groundwalk.store.text import printable


def test_terminal_codes_are_escaped_and_text_stays() -> None:
    assert printable("\x1b[31mred\x07\r\u202eright\udcff\x00") == r"\x1b[31mred\x07\r\u202eright\udcff\x00"
    text = "Träume · 漢字 → 1.5 m\n±2°"
    assert printable(text) == text


def test_errors_show_no_terminal_codes(capsys: pytest.CaptureFixture[str]) -> None:
    app = new_app("")

    @app.command()
    def main() -> None:
        raise UserError("wrong", where=Path("\x1b]0;title\x07"), found="a\nb")

    with pytest.raises(SystemExit):
        app([])
    said = capsys.readouterr().err
    assert r"\x1b]0;title\x07" in said and "\x1b" not in said and "a\nb" in said
