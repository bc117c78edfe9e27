"""Sampling and splits as properties."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from artefacts import UserError
from artefacts.settings import SplitRules
from capture_import.sampling import sample_motion, sample_rate
from capture_import.splits import LEAK_S, leak_seconds, split_frames
from geometry.poses import make_pose


def frames_of(**recordings: np.ndarray) -> pd.DataFrame:
    """Frames at the given seconds, one recording a keyword; `walk__part2` is a part of `walk`."""
    parts = []
    for name, seconds in recordings.items():
        session = name.replace("__", ".")
        t_ns = np.round(np.asarray(seconds) * 1e9).astype(np.int64)
        parts.append(
            pd.DataFrame({"session_id": session, "recording": session.split(".")[0], "said": None, "t_ns": t_ns})
        )
    return pd.concat(parts, ignore_index=True)


@given(st.lists(st.floats(0, 60), min_size=1, max_size=200, unique=True), st.floats(0.2, 5))
def test_sampling_by_rate_keeps_at_most_one_a_tick(seconds: list[float], rate_hz: float) -> None:
    t_ns = np.unique(np.round(np.array(seconds) * 1e9).astype(np.int64))
    sharpness = np.random.default_rng(0).random(len(t_ns))
    kept = sample_rate(t_ns, sharpness, rate_hz)
    assert (np.diff(kept) > 0).all()
    ticks = np.floor((t_ns - t_ns[0]) * 1e-9 * rate_hz + 0.5)
    np.testing.assert_array_equal(np.unique(ticks), ticks[kept])


def test_the_sharpest_image_around_a_tick_is_taken() -> None:
    t_ns = (np.arange(101) * 10**8).astype(np.int64)
    sharpness = np.zeros(101)
    sharpness[[2, 12, 16, 33]] = [1, 2, 1, 5]
    kept = sample_rate(t_ns, sharpness, 1.0)
    assert {2, 12}.issubset(kept) and 16 not in kept and 33 not in kept


def test_sampling_by_motion_keeps_steps() -> None:
    x = np.cumsum(np.r_[np.zeros(20), np.full(80, 0.125)])
    poses = make_pose(np.eye(3), np.stack([x, 0 * x, 0 * x], axis=-1))
    kept = sample_motion(poses, np.ones(len(x)), 0.5, 20.0)
    np.testing.assert_allclose(np.diff(x[kept]), 0.5)


def test_a_single_walk_is_split_in_time_with_validation_between() -> None:
    frames = frames_of(walk=np.arange(0, 100, 1.0))
    split = split_frames(frames, SplitRules(), by_time=False)
    assert split.leak_s is not None and split.leak_s >= LEAK_S
    # train, then val, then test
    order = [k for k, _ in zip(*np.unique(split.of_frame, return_index=True), strict=True)]
    assert set(order) == {"train", "val", "test"}
    changes = split.of_frame[np.r_[True, split.of_frame[1:] != split.of_frame[:-1]]]
    assert changes.tolist() == ["train", "val", "test"]
    assert (split.of_frame == "test").sum() == 25


def test_names_decide_and_validation_is_elsewhere_in_each_walk() -> None:
    t = np.arange(0, 50, 1.0)
    frames = frames_of(train_a=t, train_b=t, test_a=t)
    frames["recording"] = frames["session_id"]
    split = split_frames(frames, SplitRules(), by_time=False)
    by_session = {s: split.of_frame[rows] for s, rows in frames.groupby("session_id").indices.items()}
    assert set(by_session["test_a"]) == {"test"}
    held_a, held_b = (np.flatnonzero(by_session[s] == "val") for s in ("train_a", "train_b"))
    assert len(held_a) == len(held_b) == 5 and not set(held_a) & set(held_b)
    assert (np.diff(held_a) == 1).all() and split.leak_s is None


def test_other_names_are_split_by_fraction() -> None:
    t = np.arange(0, 50, 1.0)
    split = split_frames(frames_of(a=t, b=t, c=t, d=t), SplitRules(), by_time=False)
    assert (split.of_frame == "test").mean() == 0.25


def test_listed_sessions() -> None:
    t = np.arange(0, 50, 1.0)
    frames = frames_of(a=t, b=t, c=t)
    split = split_frames(frames, SplitRules(test=["b"], train=["a"], val_fraction=0), by_time=False)
    assert dict(zip(frames["session_id"], split.of_frame, strict=True)) == {"a": "train", "b": "test", "c": "unused"}
    with pytest.raises(UserError, match="no such session"):
        split_frames(frames, SplitRules(test=["z"]), by_time=False)
    with pytest.raises(UserError, match="for training and testing"):
        split_frames(frames, SplitRules(test=["a"], train=["a"]), by_time=False)


def test_a_leak_between_listed_parts_is_refused_unless_allowed() -> None:
    frames = frames_of(walk=np.arange(0, 50, 1.0), walk__part2=np.arange(51, 90, 1.0), other=np.arange(0, 9, 1.0))
    with pytest.raises(UserError, match="too close in time"):
        split_frames(frames, SplitRules(test=["walk.part2"], val_fraction=0), by_time=False)
    rules = SplitRules(test=["walk.part2"], val_fraction=0, allow_leak=True)
    assert split_frames(frames, rules, by_time=False).leak_s == pytest.approx(2.0)


@given(st.lists(st.floats(0, 100), min_size=2, max_size=50), st.integers(0, 2**32 - 1))
def test_leak_is_the_shortest_time(seconds: list[float], seed: int) -> None:
    frames = frames_of(walk=np.sort(seconds))
    split = np.random.default_rng(seed).choice(np.array(["train", "test"], dtype=object), len(frames))
    t = frames["t_ns"].to_numpy() * 1e-9
    apart = [abs(a - b) for a in t[split == "train"] for b in t[split == "test"]]
    leak = leak_seconds(frames, split)
    assert leak == (pytest.approx(min(apart), abs=1e-6) if apart else None)
