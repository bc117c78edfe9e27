"""Which fault the benchmark of gates takes an error for."""

import pytest

from benchmarks.gates import _named
from groundwalk.artefacts.choices import FailureCause
from groundwalk.consistency.motions import MIRRORED, MISTAKE_ADVICE, MISTAKE_REASONS, UNRELATED, UPSIDE_DOWN


@pytest.mark.parametrize(
    ("mistake", "cause"),
    [
        (MIRRORED, FailureCause.MIRRORED_IMAGES),
        (UPSIDE_DOWN, FailureCause.MIRRORED_IMAGES),
        (UNRELATED, FailureCause.MISMATCHED_IMAGES),
    ],
)
def test_an_error_is_taken_for_what_it_says(mistake: str, cause: FailureCause) -> None:
    assert _named(f"images and VIO are inconsistent {MISTAKE_REASONS[mistake]} do: {MISTAKE_ADVICE[mistake]}") == cause


def test_a_cause_is_taken_from_its_words() -> None:
    assert _named(f"the SfM model is wrong: {FailureCause.WRONG_INTRINSICS}") == FailureCause.WRONG_INTRINSICS
    assert _named("no images") == "refused without a name"
