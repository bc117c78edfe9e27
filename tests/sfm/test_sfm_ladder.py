"""The ladder: which attempts are made, and which of them is taken."""

from collections.abc import Sequence

import pytest

from groundwalk.sfm.ladder import MISSING, NO_MODEL, OTHERWISE, TAKEN, TOO_FEW, Attempt, climb, ladder, outcome_of
from groundwalk.sfm.settings import SfmSettings

_FRAMES = 100


def _climbed(
    results: Sequence[tuple[int, int]], no_help: str = "", settings: SfmSettings | None = None
) -> tuple[list[Attempt], int | None, SfmSettings | None, list[str]]:
    """A climb whose attempts register so many frames, of which so many move as VIO does; the last one goes on."""
    said: list[str] = []

    def attempt(number: int, name: str, tried: SfmSettings) -> tuple[Attempt, SfmSettings]:
        registered, agreeing = results[min(number, len(results) - 1)]
        kept = [registered] if registered else []
        told = Attempt(name, tried.mapper, 9, 9, kept, agreeing, outcome_of(kept, agreeing, _FRAMES, tried), no_help)
        return told, tried

    return *climb(settings or SfmSettings(), attempt, said.append), said


def _names(attempts: list[Attempt]) -> list[str]:
    return [attempt.name for attempt in attempts]


def test_too_few_frames_get_more_of_everything_and_vio_comes_last() -> None:
    tried: list[SfmSettings] = []

    def attempt(number: int, name: str, settings: SfmSettings) -> tuple[Attempt, None]:
        tried.append(settings)
        return Attempt(name, settings.mapper, 0, 0, [10], 10, TOO_FEW), None

    attempts, index, _ = climb(SfmSettings(), attempt, print)
    assert _names(attempts) == ["as set", "more pairs", "more features", "other mapper", "from VIO"]
    assert index is None
    assert tried[0] == SfmSettings()
    for name in ("sequence_pairs", "vio_pairs", "retrieval_pairs", "transitive_pairs", "max_features"):
        values = [getattr(settings, name) for settings in tried]
        assert values == sorted(values)
        assert values[-1] > values[0]
    assert [settings.mapper for settings in tried] == ["incremental"] * 3 + ["global", "vio"]
    # What isn't a matter of trying stays as it was set.
    assert {settings.min_registered for settings in tried} == {SfmSettings().min_registered}


def test_the_first_attempt_that_passes_ends_the_climb() -> None:
    attempts, index, found, said = _climbed([(90, 90)])
    assert (_names(attempts), index, found, said) == (["as set"], 0, SfmSettings(), [])
    attempts, index, _, said = _climbed([(90, 20), (95, 92)])
    assert _names(attempts) == ["as set", "surer pairs"] and index == 1
    assert [attempt.outcome for attempt in attempts] == [OTHERWISE, TAKEN]
    assert said == [f"{attempts[0]}; trying again: surer pairs"]
    assert "22% of which move as VIO does" in said[0]


def test_where_frames_are_missing_more_pairs_are_tried_once_and_the_best_is_taken() -> None:
    attempts, index, _, _ = _climbed([(70, 70), (95, 95)])
    assert [attempt.outcome for attempt in attempts] == [MISSING, TAKEN] and index == 1
    assert _names(attempts) == ["as set", "more pairs"]
    attempts, index, _, _ = _climbed([(70, 70), (60, 55)])
    assert [attempt.outcome for attempt in attempts] == [MISSING, MISSING] and index == 0
    attempts, index, _, _ = _climbed([(70, 70), (99, 20), (99, 99)])
    assert [attempt.outcome for attempt in attempts] == [MISSING, OTHERWISE] and index == 0


def test_models_that_move_otherwise_get_surer_pairs_and_no_more_of_them() -> None:
    attempts, _, found, _ = _climbed([(90, 20)])
    assert _names(attempts) == ["as set", "surer pairs", "more features", "other mapper", "from VIO"]
    assert found == SfmSettings()
    _, _, found, _ = _climbed([(90, 20), (90, 90)])
    assert found is not None and found.min_inliers == 2 * SfmSettings().min_inliers
    assert found.vio_max_distance_m == SfmSettings().vio_max_distance_m / 2
    # More pairs may be what ties wrong places together.
    attempts, index, _, _ = _climbed([(10, 10), (90, 20), (90, 90)])
    assert _names(attempts) == ["as set", "more pairs", "surer pairs"] and index == 2


def test_a_step_that_costs_the_frames_isnt_kept() -> None:
    attempts, index, found, _ = _climbed([(90, 20), (30, 30), (90, 90)])
    assert _names(attempts) == ["as set", "surer pairs", "more features"] and index == 2
    assert found is not None and found.min_inliers == SfmSettings().min_inliers
    assert found.max_features == 2 * SfmSettings().max_features


def test_where_none_passes_the_one_of_which_most_frames_move_as_vio_does_is_taken() -> None:
    attempts, index, found, _ = _climbed([(90, 20), (60, 29), (95, 29), (0, 0), (40, 40)])
    assert [attempt.outcome for attempt in attempts] == [OTHERWISE, OTHERWISE, OTHERWISE, NO_MODEL, TOO_FEW]
    assert index == 1
    assert found is not None and found.max_features == SfmSettings().max_features


def test_no_further_attempt_is_made_where_none_would_help() -> None:
    attempts, index, _, said = _climbed([(90, 20)], no_help="its focal length is wrong")
    assert (_names(attempts), index, said) == (["as set"], 0, [])
    # More pairs may still register more frames.
    attempts, index, _, _ = _climbed([(40, 20), (90, 20)], no_help="its focal length is wrong")
    assert (_names(attempts), index) == (["as set", "more pairs"], 1)


def test_no_attempt_comes_twice() -> None:
    for mapper in ("incremental", "global", "hierarchical", "vio"):
        for agreeing in (0, 10):
            tried: list[str] = []

            def attempt(
                number: int, name: str, settings: SfmSettings, agreeing: int = agreeing, tried: list[str] = tried
            ) -> tuple[Attempt, None]:
                tried.append(settings.model_dump_json())
                return Attempt(name, settings.mapper, 0, 0, [10], agreeing, OTHERWISE if agreeing else TOO_FEW), None

            attempts, _, _ = climb(SfmSettings(mapper=mapper), attempt, print)
            assert len(set(tried)) == len(tried) == len(attempts)


def test_without_retries_there_is_one_attempt() -> None:
    assert [step.name for step in ladder(SfmSettings(retries=False))] == ["as set"]
    attempts, index, _, _ = _climbed([(90, 20)], settings=SfmSettings(retries=False))
    assert len(attempts) == 1 and index == 0


@pytest.mark.parametrize(
    ("kept", "agreeing", "outcome"),
    [
        ([], 0, NO_MODEL),
        ([30, 19], 49, TOO_FEW),
        ([30, 20], 39, OTHERWISE),
        ([30, 20], 40, MISSING),
        ([60, 30], 80, TAKEN),
    ],
)
def test_outcomes(kept: list[int], agreeing: int, outcome: str) -> None:
    assert outcome_of(kept, agreeing, _FRAMES, SfmSettings()) == outcome
