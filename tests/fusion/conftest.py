"""Evaluations of the tests sweep fewer thresholds."""

import pytest

from groundwalk.fusion.evaluation.sweep import VALUES


@pytest.fixture(autouse=True)
def _few_thresholds(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, values in VALUES.items():
        monkeypatch.setitem(VALUES, name, values[:3] if name == "n" else values[2:4])
