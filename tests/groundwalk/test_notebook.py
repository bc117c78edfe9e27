"""The notebook of the first look runs from top to bottom; in git it has no outputs."""

from collections.abc import Callable
from pathlib import Path

import nbclient
import nbformat
import pytest

from tests.groundwalk.made_up_run import MadeUpRun

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "first_look.ipynb"


def test_the_notebook_has_no_outputs() -> None:
    cells = [cell for cell in nbformat.read(NOTEBOOK, as_version=4).cells if cell.cell_type == "code"]
    assert len(cells) > 5
    assert all(not cell.outputs and cell.execution_count is None for cell in cells), "clear the outputs before a commit"


def test_the_notebook_runs(make_run: Callable[..., MadeUpRun], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a made-up run; tests/docs runs it on one of the simulator, word by word."""
    made = make_run()
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    opening = next(cell for cell in notebook.cells if 'open("Church")' in cell.source)
    here = f'open("place", profile="tiny", data={str(made.data.root)!r})'
    opening.source = opening.source.replace('open("Church")', here)
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    client = nbclient.NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    shown = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in shown) == 3
    assert not [output for output in shown if output.output_type == "stream" and output.name == "stderr"]
