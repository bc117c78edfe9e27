"""Sampling and splits as properties."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import Image, ImageCheck, Recording, Session
from groundwalk.capture_import.sampling import density_for, motion_steps, sample_between, sample_rate, select
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.capture_import.splits import LEAK_S, refuse_lists, split_frames
from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from groundwalk.store.choices import Clock
from groundwalk.store.settings import SplitRules


def frames_of(**recordings: np.ndarray) -> pd.DataFrame:
    """Frames at the given seconds, one recording a keyword; `walk__part2` is a part of `walk`."""
    parts = []
    for session, seconds in ((name.replace("__", "."), np.asarray(s)) for name, s in recordings.items()):
        names = {"session_id": session, "recording": session.split(".")[0], "stated_split": None, "clock": "boot"}
        parts.append(pd.DataFrame({"t_ns": np.round(seconds * 1e9).astype(np.int64)}).assign(**names))
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


def straight(metres: np.ndarray) -> np.ndarray:
    return make_pose(np.eye(3), np.stack([metres, 0 * metres, 0 * metres], axis=-1))


def walk_of(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 4, 4) of a walk that stands, strolls, runs and turns, and how sharp its images are (N,)."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.choice([0.0, 0.02, 0.1, 0.5], count // 10 + 1), 10)[:count]
    turn = np.repeat(rng.choice([0.0, 1.0, 8.0], count // 7 + 1), 7)[:count] * rng.choice([-1, 1])
    yaw = np.radians(np.cumsum(turn))
    step = speed[:, None] * np.stack([np.sin(yaw), 0 * yaw, np.cos(yaw)], axis=1)
    return make_pose(Rotation.from_euler("y", yaw[:, None]).as_matrix(), np.cumsum(step, axis=0)), rng.random(count)


@given(st.integers(2, 150), st.integers(1, 30), st.integers(0, 150), st.integers(0, 2**32 - 1))
def test_support_frames_keep_steps_small_wherever_there_are_images(
    count: int, every: int, most: int, seed: int
) -> None:
    poses, sharpness = walk_of(count, seed)
    kept = np.arange(0, count, every)
    support = sample_between(poses, sharpness, kept, 0.3, 15.0, most)
    assert len(support) <= most
    assert np.intersect1d(support, kept).size == 0 and ((support > kept[0]) & (support < kept[-1])).all()
    used = np.sort(np.concatenate([kept, support]))
    large = motion_steps(poses[used[:-1]], poses[used[1:]], 0.3, 15.0) > 1 + 1e-6
    assert len(support) == most or (np.diff(used)[large] == 1).all()
    # Each was needed: it's in a gap between frames that was too large.
    gaps = motion_steps(poses[kept[:-1]], poses[kept[1:]], 0.3, 15.0) > 1
    assert gaps[np.searchsorted(kept, support) - 1].all()


def test_support_frames_are_few_even_and_sharp_and_cut_the_largest_steps_where_not_all_can_be() -> None:
    poses, kept, sharpness = straight(np.arange(101) * 0.01), np.array([0, 100]), np.zeros(101)
    assert sample_between(poses, sharpness, kept, 0.3, 15.0, 100).tolist() == [25, 50, 75]
    sharpness[[28, 52, 80, 99]] = 1.0
    assert sample_between(poses, sharpness, kept, 0.3, 15.0, 100).tolist() == [28, 52, 80]
    metres = np.concatenate([np.arange(10) * 0.1, 1 + np.arange(41) * 0.1])  # 1 m, then 4 m
    kept = np.array([0, 10, 50])
    assert sample_between(straight(metres), np.zeros(51), kept, 0.3, 15.0, 3).tolist() == [20, 30, 40]


@pytest.mark.parametrize("every", [1, 2, 3])
def test_thinning_to_a_number_is_even_whatever_the_rate(every: int) -> None:
    session = session_of(np.arange(0, 34, 0.1)[::every])  # at 1 Hz 34 images
    settings = ImportSettings()
    selection = select([session], settings, density_for([session], settings))["walk"]
    t_s = np.array([i.t_ns for i in selection.images])[~selection.support] * 1e-9
    assert 60 <= len(t_s) <= 66
    steps = np.diff(t_s)[:-1]  # the last image has no window to choose from
    assert steps.max() <= 1.6 * 34 / 60 and steps.min() >= 0.4 * 34 / 60
    assert density_for([session], settings.model_copy(update={"min_frames": 20})) == 1
    assert np.isinf(density_for([session], settings.model_copy(update={"min_frames": 1000})))


def session_of(seconds: np.ndarray) -> Session:
    """A straight walk with an image at each of the seconds, equally sharp."""
    poses = straight(seconds)
    check = ImageCheck(96, 72, 0.5, 50.0, "", "")
    frames = [
        Image(round(1e9 * s), p, number=i, check=check) for i, (s, p) in enumerate(zip(seconds, poses, strict=True))
    ]
    return Session("walk", Recording("", Clock.BOOT, Path(), frames), [*frames])


def test_a_single_walk_is_split_in_time_with_validation_between() -> None:
    frames = frames_of(walk=np.arange(0, 100, 1.0))
    split = split_frames(frames, SplitRules(), by_time=False)
    assert split.leak_s is not None and split.leak_s >= LEAK_S
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


@pytest.mark.parametrize(
    ("sizes", "tested"),
    [
        ({"a": 50, "b": 50, "c": 50, "d": 50}, "d"),
        ({"a": 3, "b": 39}, "a"),
        ({"a": 30, "b": 40, "c": 100}, "b"),
        ({"walk2": 40, "walk10": 10, "walk9": 40}, "walk10"),
    ],
)
def test_other_names_are_split_by_fraction_and_the_last_do_not_test_where_they_are_most(
    sizes: dict[str, int], tested: str
) -> None:
    split = split_frames(frames_of(**{name: np.arange(n) for name, n in sizes.items()}), SplitRules(), by_time=False)
    assert (split.of_frame == "test").sum() == sizes[tested] < (split.of_frame == "train").sum()


def test_without_times_there_is_no_leak_in_seconds() -> None:
    frames = frames_of(photos=np.arange(100)).assign(clock="name_order")
    split = split_frames(frames, SplitRules(val_fraction=0), by_time=False)
    assert split.leak_s is None and split.how == "the last images of each recording by their names"
    with pytest.raises(UserError, match="too close in time"):
        split_frames(frames.assign(clock="boot", stated_split=["train", "test"] * 50), SplitRules(), by_time=False)
    stated = split_frames(frames.assign(stated_split=["train", "test"] * 50), SplitRules(), by_time=False)
    assert stated.leak_s is None and (stated.of_frame[1::2] == "test").all()


def test_lists_decide_and_those_that_cannot_fit_are_refused_before_images_are_read() -> None:
    t = np.arange(0, 50, 1.0)
    frames = frames_of(a=t, b=t, c=t)
    split = split_frames(frames, SplitRules(test=["b"], train=["a"], val_fraction=0), by_time=False)
    assert dict(zip(frames["session_id"], split.of_frame, strict=True)) == {"a": "train", "b": "test", "c": "unused"}
    with pytest.raises(UserError, match="no such session"):
        split_frames(frames, SplitRules(test=["z"]), by_time=False)
    with pytest.raises(UserError, match=r"(?s)no frame to test on.*1 frames, split by time"):
        split_frames(frames_of(walk=np.array([0.0])), SplitRules(), by_time=False)
    with pytest.raises(UserError, match="no frame to train on"):
        split_frames(frames_of(walk=t, walk__part2=t + 60), SplitRules(test=["walk", "walk.part2"]), by_time=False)
    refuse_lists(SplitRules(), ["a"])
    refuse_lists(SplitRules(test=["a", "b.part2"]), ["a", "b", "c"])
    refuse_lists(SplitRules(test=["b.part2"]), ["a", "b.part2"])  # a folder's own name
    for rules, refusal in (
        (SplitRules(test=["a"], train=["z"]), r"(?s)no such session.*one of a, b\n.*found: +z"),
        (SplitRules(test=["a", "b"]), "no frame to train on"),
        (SplitRules(train=["a", "b"]), "no frame to test on"),
    ):
        with pytest.raises(UserError, match=refusal):
            refuse_lists(rules, ["a", "b"])


def test_a_leak_between_listed_parts_is_refused_unless_allowed() -> None:
    frames = frames_of(walk=np.arange(0, 50, 1.0), walk__part2=np.arange(51, 90, 1.0), other=np.arange(0, 9, 1.0))
    with pytest.raises(UserError, match="too close in time"):
        split_frames(frames, SplitRules(test=["walk.part2"], val_fraction=0), by_time=False)
    rules = SplitRules(test=["walk.part2"], val_fraction=0, allow_leak=True)
    assert split_frames(frames, rules, by_time=False).leak_s == pytest.approx(2.0)
