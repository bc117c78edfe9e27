"""Cores that a process may use."""

import pytest

from groundwalk.store.cores import usable_cores


def test_openmps_limit_is_a_limit_and_never_more_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    cores = usable_cores()
    for limit, expected in (("1", 1), ("999", cores), ("0", cores), ("many", cores), ("", cores)):
        monkeypatch.setenv("OMP_NUM_THREADS", limit)
        assert usable_cores() == expected
