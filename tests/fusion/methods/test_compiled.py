"""Compiled code is kept, and compiled anew where any source of the estimator has changed."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from groundwalk.fusion.methods.estimator import compiled as module


def test_kept_code_is_of_the_sources_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = tmp_path / "numbers_of_a_test.py"
    source.write_text("def twice(x):\n    return 2.0 * x\n", encoding="utf-8")
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def read_from_cache(stamp: str) -> int:
        monkeypatch.setattr(module, "_STAMP", stamp)
        spec = importlib.util.spec_from_file_location("numbers_of_a_test", source)
        assert spec is not None and spec.loader is not None
        loaded = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(loaded)
        function: Any = module.compiled(loaded.twice)
        assert function(3.0) == 6.0
        return sum(function.stats.cache_hits.values())

    assert [read_from_cache(stamp) for stamp in ("a", "a", "b", "b")] == [0, 1, 0, 1]
