import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from groundwalk.consistency.decisions import Status, beyond, decide, fraction_sd, within

_SIZE = st.floats(0, 100)


@given(value=_SIZE, limit=_SIZE, sds=st.tuples(_SIZE, _SIZE), at_least=st.booleans())
def test_less_certain_is_never_decided_more_easily(
    value: float, limit: float, sds: tuple[float, float], at_least: bool
) -> None:
    sure, unsure = (decide(value, sd, limit, at_least=at_least) for sd in sorted(sds))
    assert unsure in (sure, Status.UNDECIDED)


def test_two_standard_errors_on_either_side_decide() -> None:
    assert [decide(v, 1.0, 10.0) for v in (7.9, 8.1, 11.9, 12.1)] == ["passed", "undecided", "undecided", "failed"]
    assert [decide(v, 1.0, 10.0, at_least=True) for v in (7.9, 8.1, 11.9, 12.1)] == [
        *("failed", "undecided", "undecided", "passed")
    ]
    assert decide(0.5, 0.0, 0.5) is Status.PASSED and decide(float("nan"), 0.0, 0.5) is Status.UNDECIDED
    values = np.array([7.9, 11.0, 12.1])
    assert within(values, 1.0, 10.0).tolist() == [True, False, False]
    assert beyond(values, 1.0, 10.0).tolist() == [False, False, True]


@given(count=st.integers(0, 500), data=st.data())
def test_the_error_of_a_share_is_that_of_its_posterior(count: int, data: st.DataObject) -> None:
    alike = data.draw(st.integers(0, count))
    expected = beta(alike + 1, count - alike + 1).std()
    assert fraction_sd(alike / max(count, 1), count) == pytest.approx(expected)
