"""The notebook of the first look runs from top to bottom; in git it has no outputs."""

from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import pytest

from tests.groundwalk.made_up_run import MadeUpRun

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "first_look.ipynb"


def test_the_notebook_runs_and_has_no_outputs(
    make_run: Callable[..., MadeUpRun], capfd: pytest.CaptureFixture[str]
) -> None:
    """On a made-up run; tests/docs runs it on one of the simulator, word by word."""
    cells = [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    assert len(cells) > 5
    assert all(not cell.outputs and cell.execution_count is None for cell in cells), "clear the outputs before a commit"
    program = "\n".join(cell.source for cell in cells)
    here = f'open("place", profile="tiny", data={str(make_run().data.root)!r})'
    assert program.count('open("Church")') == 1
    capfd.readouterr()
    plt.close("all")
    plt.switch_backend("Agg")
    exec(compile(program.replace('open("Church")', here), str(NOTEBOOK), "exec"), {})
    assert len(plt.get_fignums()) == 3 and not capfd.readouterr().err
    plt.close("all")
