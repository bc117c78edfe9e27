"""Which attempts are made, which of them is selected, and what each matches by the floor."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.mapping import attempt_models
from groundwalk.sfm.mapping.attempts import Attempt, outcome_of, run_attempts, steps_of
from groundwalk.sfm.pairs.matching import MatchedPairs
from groundwalk.sfm.pairs.odometry import nothing_compared, odometry
from groundwalk.sfm.scene_input import SceneInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.child import Task
from groundwalk.store.choices import AttemptName, AttemptOutcome

_FRAMES = 100
_MISSING, _NO_MODEL = AttemptOutcome.FRAMES_MISSING, AttemptOutcome.NO_MODEL
_ACCEPTED, _TOO_FEW = AttemptOutcome.ACCEPTED, AttemptOutcome.TOO_FEW_REGISTERED
_INCONSISTENT = AttemptOutcome.INCONSISTENT_WITH_VIO


def _attempt(settings: SfmSettings, name: AttemptName, frames: int, consistent: int, fault: str = "") -> Attempt:
    model_frames = [frames] if frames else []
    return Attempt(
        name=name,
        mapper=settings.mapper,
        pairs=9,
        verified=9,
        model_frames=model_frames,
        consistent=consistent,
        outcome=outcome_of(model_frames, consistent, _FRAMES, settings),
        input_fault=fault,
    )


def _run(
    results: Sequence[tuple[int, int]], fault: str = "", settings: SfmSettings | None = None
) -> tuple[list[Attempt], int | None, SfmSettings | None, list[str]]:
    """Attempts that register so many frames, so many of them consistent with VIO; the last result repeats."""
    lines: list[str] = []

    def attempt(number: int, name: AttemptName, tried: SfmSettings) -> tuple[Attempt, SfmSettings]:
        return _attempt(tried, name, *results[min(number, len(results) - 1)], fault), tried

    done = run_attempts(settings or SfmSettings(), attempt, lines.append)
    return done.attempts, done.selected, done.result, lines


def _names(attempts: list[Attempt]) -> list[str]:
    return [attempt.name for attempt in attempts]


def test_too_few_frames_get_more_of_everything_and_vio_comes_last() -> None:
    tried: list[SfmSettings] = []

    def attempt(number: int, name: AttemptName, settings: SfmSettings) -> tuple[Attempt, None]:
        tried.append(settings)
        return _attempt(settings, name, 10, 10), None

    done = run_attempts(SfmSettings(), attempt, print)
    attempts, index = done.attempts, done.selected
    assert _names(attempts) == ["default", "more_pairs", "more_features", "other_mapper", "vio_start"]
    assert index is None
    assert tried[0] == SfmSettings()
    for name in ("sequence_pairs", "vio_pairs", "retrieval_pairs", "transitive_pairs", "max_features"):
        values = [getattr(settings, name) for settings in tried]
        assert values == sorted(values)
        assert values[-1] > values[0]
    assert [settings.mapper for settings in tried] == ["incremental"] * 3 + ["global", "vio"]
    # What no attempt changes stays as it was set.
    assert {settings.min_registered_fraction for settings in tried} == {SfmSettings().min_registered_fraction}


def test_the_first_accepted_attempt_is_the_last() -> None:
    attempts, index, settings, lines = _run([(90, 90)])
    assert (_names(attempts), index, settings, lines) == (["default"], 0, SfmSettings(), [])
    attempts, index, _, lines = _run([(90, 20), (95, 92)])
    assert _names(attempts) == ["default", "stricter_pairs"] and index == 1
    assert [attempt.outcome for attempt in attempts] == [_INCONSISTENT, _ACCEPTED]
    assert lines == [f"{attempts[0]}; trying again: stricter_pairs"]
    assert "22% of them consistent with VIO" in lines[0]


def test_where_frames_are_missing_more_pairs_are_tried_once_and_the_best_is_selected() -> None:
    attempts, index, _, _ = _run([(70, 70), (95, 95)])
    assert [attempt.outcome for attempt in attempts] == [_MISSING, _ACCEPTED] and index == 1
    assert _names(attempts) == ["default", "more_pairs"]
    attempts, index, _, _ = _run([(70, 70), (60, 55)])
    assert [attempt.outcome for attempt in attempts] == [_MISSING, _MISSING] and index == 0
    attempts, index, _, _ = _run([(70, 70), (99, 20), (99, 99)])
    assert [attempt.outcome for attempt in attempts] == [_MISSING, _INCONSISTENT] and index == 0


def test_inconsistent_models_get_stricter_pairs_and_no_more_of_them() -> None:
    attempts, _, settings, _ = _run([(90, 20)])
    assert _names(attempts) == ["default", "stricter_pairs", "more_features", "other_mapper", "vio_start"]
    assert settings == SfmSettings()
    _, _, settings, _ = _run([(90, 20), (90, 90)])
    assert settings is not None and settings.min_inliers == 2 * SfmSettings().min_inliers
    assert settings.vio_max_distance_m == SfmSettings().vio_max_distance_m / 2
    # More pairs may be what ties wrong places together.
    attempts, index, _, _ = _run([(10, 10), (90, 20), (90, 90)])
    assert _names(attempts) == ["default", "more_pairs", "stricter_pairs"] and index == 2


def test_a_step_that_costs_the_frames_is_undone() -> None:
    attempts, index, settings, _ = _run([(90, 20), (30, 30), (90, 90)])
    assert _names(attempts) == ["default", "stricter_pairs", "more_features"] and index == 2
    assert settings is not None and settings.min_inliers == SfmSettings().min_inliers
    assert settings.max_features == 2 * SfmSettings().max_features


def test_where_none_is_accepted_the_one_with_most_consistent_frames_is_selected() -> None:
    attempts, index, settings, _ = _run([(90, 20), (60, 29), (95, 29), (0, 0), (40, 40)])
    assert [attempt.outcome for attempt in attempts] == [
        _INCONSISTENT,
        _INCONSISTENT,
        _INCONSISTENT,
        _NO_MODEL,
        _TOO_FEW,
    ]
    assert index == 1
    assert settings is not None and settings.max_features == SfmSettings().max_features


def test_no_further_attempt_is_made_where_none_would_help() -> None:
    attempts, index, _, lines = _run([(90, 20)], fault="its focal length is wrong")
    assert (_names(attempts), index, lines) == (["default"], 0, [])
    # More pairs may still register more frames.
    attempts, index, _, _ = _run([(40, 20), (90, 20)], fault="its focal length is wrong")
    assert (_names(attempts), index) == (["default", "more_pairs"], 1)


def test_no_attempt_comes_twice() -> None:
    for mapper in ("incremental", "global", "hierarchical", "vio"):
        for frames in (10, 90):
            tried: list[str] = []

            def attempt(
                number: int, name: AttemptName, settings: SfmSettings, frames: int = frames, tried: list[str] = tried
            ) -> tuple[Attempt, None]:
                tried.append(settings.model_dump_json())
                return _attempt(settings, name, frames, 0), None

            done = run_attempts(SfmSettings(mapper=mapper), attempt, print)
            assert len(set(tried)) == len(tried) == len(done.attempts)


def test_without_retry_there_is_one_attempt() -> None:
    assert [step.name for step in steps_of(SfmSettings(retry=False))] == ["default"]
    attempts, index, _, _ = _run([(90, 20)], settings=SfmSettings(retry=False))
    assert len(attempts) == 1 and index == 0


@pytest.mark.parametrize(
    ("model_frames", "consistent", "outcome"),
    [
        ([], 0, _NO_MODEL),
        ([30, 19], 49, _TOO_FEW),
        ([30, 20], 39, _INCONSISTENT),
        ([30, 20], 40, _MISSING),
        ([60, 30], 80, _ACCEPTED),
    ],
)
def test_outcomes(model_frames: list[int], consistent: int, outcome: AttemptOutcome) -> None:
    assert outcome_of(model_frames, consistent, _FRAMES, SfmSettings()) is outcome


def test_the_floor_is_asked_where_a_recording_would_break(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of recording r, whose frames b and c have no verified pair: few inliers, one session, and gravity."""
    pairs = np.array([[0, 1], [0, 2], [1, 2], [2, 3], [2, 4], [5, 6]])
    inliers = np.array([120, 20, 0, 30, 30, 30])
    matched = MatchedPairs(pairs, np.full(6, ""), inliers, inliers, 15, nothing_compared(6))
    gravity = np.tile([0.0, 1.0, 0.0], (7, 1))
    gravity[4] = np.nan
    session = np.array(["s", "s", "s", "other", "s", "q", "q"], object)
    vio = odometry(session, np.arange(7), np.tile(np.eye(4), (7, 1, 1)), gravity, [])
    asked: list[Task] = []
    frames = pd.DataFrame({"frame_id": list("abcdefg"), "t_ns": np.arange(7)})
    scene = SimpleNamespace(
        recording_N=np.array(["r"] * 5 + ["q"] * 2),
        frames=frames,
        vio=vio,
        floor_source=lambda settings: "source",
        in_child=lambda text, task: asked.append(task),
    )
    said: list[str] = []
    after = inliers + 40 * (inliers < 21)
    monkeypatch.setattr(attempt_models, "read_pair_results", lambda database, pairs: (inliers, after))
    run = cast(StageRun[SfmSettings], SimpleNamespace(say=said.append))
    tied = attempt_models._tied_by_floor(run, SfmSettings(), cast(SceneInput, scene), Path("database"), matched)
    (task,) = asked
    assert task.arguments[3].tolist() == [[0, 2], [1, 2]] and task.arguments[4].tolist() == [True, False]
    assert tied.inliers.tolist() == [120, 60, 40, 30, 30, 30]
    assert "b and c, d and e" in said[0] and "tie 2 of 2 pairs" in said[0]


@pytest.mark.parametrize("second", [(90, 78), (85, 78)])
def test_a_consistent_attempt_goes_before_a_larger_one_that_is_not(second: tuple[int, int]) -> None:
    attempts, selected, _, _ = _run([(100, 79), second])
    assert attempts[0].outcome is _INCONSISTENT and selected == 1
    attempts, selected, _, _ = _run([(70, 70), (99, 75)])
    assert [a.outcome for a in attempts[:2]] == [_MISSING, _INCONSISTENT] and selected == 0


def test_an_error_of_a_further_attempt_leaves_the_one_before_and_the_first_ones_is_raised() -> None:
    def attempt(number: int, name: AttemptName, tried: SfmSettings) -> tuple[Attempt, int]:
        if number == ends_at:
            raise UserError("mapping: its process died (SIGKILL)")
        return _attempt(tried, name, 85, 85), number

    lines: list[str] = []
    ends_at = 1
    done = run_attempts(SfmSettings(), attempt, lines.append)
    assert (done.selected, done.result) == (0, 0) and "SIGKILL" in lines[-1]
    ends_at = 0
    with pytest.raises(UserError):
        run_attempts(SfmSettings(), attempt, lines.append)


def test_an_attempt_without_vio_says_nothing_of_it() -> None:
    attempt = _attempt(SfmSettings(), AttemptName.DEFAULT, 100, 100)
    assert "100% of them consistent with VIO" in str(attempt)
    assert str(replace(attempt, has_vio=False)).endswith("models of 100 frames")
