"""Which attempts are made, which of them is selected, and where the floor is matched."""

from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.mapping.attempts import Attempt, run_attempts, settings_of_size
from groundwalk.sfm.model import BuiltModel
from groundwalk.sfm.pairs import verification
from groundwalk.sfm.pairs.matched import matched_pairs
from groundwalk.sfm.pairs.odometry import odometry
from groundwalk.sfm.pairs.verification import with_floor_matches
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import UserError
from groundwalk.store.child import Task
from groundwalk.store.choices import AttemptName, AttemptOutcome

_FRAMES = 100
_PAIRS = matched_pairs(np.array([[0, 1]]), np.array(["vio"]), np.array([90]), np.array([90]))
_MISSING, _NO_MODEL = AttemptOutcome.FRAMES_MISSING, AttemptOutcome.NO_MODEL
_ACCEPTED, _TOO_FEW = AttemptOutcome.ACCEPTED, AttemptOutcome.TOO_FEW_REGISTERED
_INCONSISTENT = AttemptOutcome.INCONSISTENT_WITH_VIO


def _attempt(
    settings: SfmSettings, name: AttemptName, sizes: Sequence[int], consistent: int, fault: str = ""
) -> Attempt:
    """An attempt with models of so many frames, so many of which are consistent with VIO."""
    built = [BuiltModel("m", k, size, 9, 9, 3.0, 0.5, folder=f"model_{k}") for k, size in enumerate(sizes)]
    return Attempt(
        name=name,
        settings=settings,
        matched=_PAIRS,
        built=built,
        folder=Path("mapping"),
        model=SimpleNamespace() if built else None,  # type: ignore[arg-type]
        consistent=np.arange(_FRAMES) < consistent,
        has_vio=True,
        input_fault=fault,
    )


def _run(
    results: Sequence[tuple[int, int]], fault: str = "", settings: SfmSettings | None = None
) -> tuple[list[Attempt], Attempt]:
    """Attempts that register so many frames, so many of them consistent with VIO; the last result repeats."""

    def attempt(number: int, name: AttemptName, tried: SfmSettings) -> Attempt:
        frames, consistent = results[min(number, len(results) - 1)]
        return _attempt(tried, name, [frames] if frames else [], consistent, fault)

    return run_attempts(settings or SfmSettings(), attempt, print)


@pytest.mark.parametrize(
    ("sizes", "consistent", "outcome"),
    [
        ([], 0, _NO_MODEL),
        ([30, 19], 49, _TOO_FEW),
        ([30, 20], 39, _INCONSISTENT),
        ([30, 20], 40, _MISSING),
        ([60, 30], 80, _ACCEPTED),
    ],
)
def test_outcomes(sizes: list[int], consistent: int, outcome: AttemptOutcome) -> None:
    assert _attempt(SfmSettings(), AttemptName.DEFAULT, sizes, consistent).outcome is outcome


@pytest.mark.parametrize(
    ("results", "names", "best"),
    [
        ([(90, 90)], ["default"], 0),
        # Too few: more of everything; the one of most consistent frames.
        ([(10, 10), (30, 30), (20, 20)], ["default", "more_pairs", "more_features", "vio_start"], 1),
        ([(0, 0)], ["default", "more_pairs", "more_features", "vio_start"], 0),
        # Most of the frames: more pairs once, and what they made or what was there.
        ([(85, 85), (92, 92)], ["default", "more_pairs"], 1),
        ([(85, 85), (85, 85)], ["default", "more_pairs"], 0),
        ([(70, 70), (99, 75)], ["default", "more_pairs"], 0),
        # Inconsistent: stricter pairs; consistent ones go before larger ones that aren't.
        ([(90, 20), (95, 92)], ["default", "stricter_pairs"], 1),
        ([(100, 79), (85, 78)], ["default", "stricter_pairs"], 1),
        ([(90, 20), (90, 30), (90, 10)], ["default", "stricter_pairs", "more_features", "vio_start"], 1),
        ([(90, 20), (90, 30), (90, 10), (90, 90)], ["default", "stricter_pairs", "more_features", "vio_start"], 3),
        ([(90, 20), (20, 20), (90, 85)], ["default", "stricter_pairs", "more_pairs"], 2),
    ],
)
def test_what_is_tried_and_selected(results: list[tuple[int, int]], names: list[str], best: int) -> None:
    attempts, selected = _run(results)
    assert [attempt.name for attempt in attempts] == names
    assert selected is attempts[best]


def test_each_attempt_keeps_what_the_ones_before_changed() -> None:
    before, more_pairs, more_features, _ = (attempt.settings for attempt in _run([(10, 10)])[0])
    for name in ("sequence_pairs", "vio_pairs", "retrieval_pairs"):
        assert getattr(before, name) < getattr(more_pairs, name) == getattr(more_features, name)
    assert before.max_features == more_pairs.max_features < more_features.max_features
    _, stricter, *_ = (attempt.settings for attempt in _run([(90, 20)])[0])
    assert stricter.vio_max_distance_m == before.vio_max_distance_m / 2


def test_few_frames_get_more_features() -> None:
    usual = SfmSettings(max_features=1000, max_image_size=1120, few_frames=40)
    few = settings_of_size(usual, 40)
    assert (few.max_features, few.max_image_size) == (3000, 1680)
    assert settings_of_size(usual, 41) == usual


def test_nothing_more_is_tried_where_the_input_is_at_fault_or_the_setting_says_so() -> None:
    assert len(_run([(90, 20)], fault="its focal length is wrong")[0]) == 1
    assert len(_run([(10, 10)], settings=SfmSettings(retry=False))[0]) == 1


def test_an_error_of_a_further_attempt_leaves_the_one_before_and_the_first_ones_is_raised() -> None:
    def attempt(number: int, name: AttemptName, tried: SfmSettings) -> Attempt:
        if number == ends_at:
            raise UserError("mapping: its process died (SIGKILL)")
        return _attempt(tried, name, [85], 85)

    lines: list[str] = []
    ends_at = 1
    attempts, best = run_attempts(SfmSettings(), attempt, lines.append)
    assert attempts == [best] and "SIGKILL" in lines[-1]
    ends_at = 0
    with pytest.raises(UserError):
        run_attempts(SfmSettings(), attempt, lines.append)


def test_the_floor_is_matched_where_a_recording_would_break(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of recording r, whose frames b and c have no verified pair: few inliers, one session, and gravity."""
    pairs = np.array([[0, 1], [0, 2], [1, 2], [2, 3], [2, 4], [5, 6]])
    inliers = np.array([120, 20, 0, 30, 30, 30])
    matched = matched_pairs(pairs, np.full(6, "vio"), inliers, inliers)
    gravity = np.tile([0.0, 1.0, 0.0], (7, 1))
    gravity[4] = np.nan
    session = np.array(["s", "s", "s", "other", "s", "q", "q"], object)
    recording = np.array(["r"] * 5 + ["q"] * 2, object)
    vio = odometry(session, recording, np.arange(7), np.tile(np.eye(4), (7, 1, 1)), gravity, [])
    tasks: list[Task] = []
    said: list[str] = []
    work = SimpleNamespace(in_child=lambda text, task: tasks.append(task))
    frames = pd.DataFrame({"frame_id": list("abcdefg")})
    source: Any = SimpleNamespace(frames=frames, vio=vio, work=work, database=Path("database"))
    after = inliers + 40 * (inliers < 21)
    monkeypatch.setattr(verification, "read_pair_results", lambda database, pairs: (inliers, after))
    tied = with_floor_matches(matched, source, said.append)
    (task,) = tasks
    assert task.arguments[1].tolist() == [[0, 2], [1, 2]] and task.arguments[2].tolist() == [True, False]
    assert tied["inliers"].tolist() == [120, 60, 40, 30, 30, 30]
    assert "b and c, d and e" in said[0] and "to 2 of 2 pairs" in said[0]
