"""Training, validation and test: as stated, by session where there are several, within it where there is one."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.store import UserError
from groundwalk.store.hints import setting_of
from groundwalk.store.settings import SplitRules
from groundwalk.store.tables import have_times
from groundwalk.store.text import natural_order

# Frames of one walk this close in time show the same place from the same side: testing on one after training on the
# other measures memory.
LEAK_S = 5.0


@dataclass(frozen=True)
class SplitResult:
    """The split of each frame (or "unused"), how it was made, and how near test frames come in
    time to training frames of the same recording (None where no recording has both)."""

    of_frame: NDArray[np.object_]
    how: str
    leak_s: float | None


def split_frames(frames: pd.DataFrame, rules: SplitRules, by_time: bool) -> SplitResult:
    """Split frames (columns session_id, recording, stated_split, t_ns, clock; sorted by session and time).

    Sessions are split as `rules` lists them; else frames as a public data set states, or sessions by their names where
    these begin with train and test; else the last sessions, about `test_fraction` of the frames, are for testing. A
    single recording, or any with `by_time`, is split in time: its last `test_fraction` is for testing. Where its images
    have no times it is the last in the order of their names, which keeps together what was taken together as often as
    not. Validation is a block of each training walk, at another place in each; in a walk split in time it's the block
    before the test frames, at least five seconds where the walk allows, and so keeps training and test apart.

    UserError for unknown sessions, for listed ones that leak, and where no frame is left to train or to test on.
    """
    recordings = frames["recording"].unique()
    stated = None if by_time else _as_stated(frames)
    if rules.test is not None or rules.train is not None:
        of_session, how = _listed(frames, rules), "listed in the scene's config"
        split = frames["session_id"].map(of_session).to_numpy(dtype=object)
    elif stated is not None:
        split, how = stated, "as the data set states"
    elif by_time or len(recordings) == 1:
        split = np.full(len(frames), "train", dtype=object)
        for recording in recordings:
            rows = np.flatnonzero(frames["recording"] == recording)
            split[rows] = _ordered_split(frames.iloc[rows], rules)
        in_time = have_times(frames).all()
        how = "by time within each recording" if in_time else "the last images of each recording by their names"
        return _with_both_sides(SplitResult(split, how, leak_seconds(frames, split)))
    else:
        of_session, how = _by_name(frames) or _by_fraction(frames, rules.test_fraction)
        split = frames["session_id"].map(of_session).to_numpy(dtype=object)
    _hold_out(frames, split, rules.val_fraction)
    leak = leak_seconds(frames, split)
    if leak is not None and leak < LEAK_S and not rules.allow_leak:
        raise UserError(
            "test frames are too close in time to training frames of the same recording",
            where="[split] of the scene's config",
            expected=f"at least {LEAK_S:g} s",
            found=f"{leak:.2f} s",
            do=f"put whole recordings on one side, or set {setting_of('split', 'allow_leak = true')}",
        )
    return _with_both_sides(SplitResult(split, how, leak))


def refuse_lists(rules: SplitRules, recordings: Sequence[str]) -> None:
    """UserError where the lists of `rules` can't fit a capture of these recordings, before their images are read: they
    name others, or leave none to train or to test on. Parts of a recording (walk.part2) are known later."""
    listed = [*(rules.test or []), *(rules.train or [])]
    if unknown := [name for name in listed if re.sub(r"\.(part|camera)\d+$", "", name) not in recordings]:
        raise _no_session(unknown[0], recordings)
    if listed and not (rules.test and rules.train) and set(recordings) <= set(listed):
        side = "train" if rules.test else "test"
        raise _no_side(side, f"all {len(recordings)} recordings are listed for the other side")


def _with_both_sides(result: SplitResult) -> SplitResult:
    for side in ("train", "test"):
        if not (result.of_frame == side).any():
            raise _no_side(side, f"{len(result.of_frame)} frames, split {result.how}")
    return result


def _no_side(side: str, what: str) -> UserError:
    return UserError(
        f"the split leaves no frame to {side} on",
        where="[split] of the scene's config",
        found=what,
        do=f"list other sessions there, or capture more: {setting_of('split', 'test')}",
    )


def _no_session(name: str, names: Iterable[str]) -> UserError:
    return UserError(
        "there is no such session",
        where="[split] of the scene's config",
        found=name,
        expected="one of " + ", ".join(sorted(names)),
    )


def nearest_split(frames: pd.DataFrame, split_frames: pd.DataFrame) -> NDArray[np.object_]:
    """For each of `frames` the split of that of `split_frames` (with a column split) which is nearest in time in its
    session, which has one."""
    split = np.empty(len(frames), dtype=object)
    t_ns, split_t_ns = frames["t_ns"].to_numpy(), split_frames["t_ns"].to_numpy()
    splits, near = split_frames["split"].to_numpy(dtype=object), split_frames.groupby("session_id").indices
    for session_id, rows in frames.groupby("session_id").indices.items():
        apart = np.abs(t_ns[rows, None] - split_t_ns[near[session_id]])
        split[rows] = splits[near[session_id]][apart.argmin(axis=1)]
    return split


def leak_seconds(frames: pd.DataFrame, split: NDArray[np.object_]) -> float | None:
    """The shortest time between a test and a training frame of a recording with times; None where none has both."""
    shortest = None
    timed = have_times(frames)
    frames, split = frames[timed], split[timed]
    for rows in frames.groupby("recording", sort=True).indices.values():
        t_s = frames["t_ns"].to_numpy()[rows] * 1e-9
        train, test = np.sort(t_s[split[rows] == "train"]), t_s[split[rows] == "test"]
        if len(train) and len(test):
            after = np.searchsorted(train, test)
            gaps = np.minimum(
                np.abs(test - train[np.minimum(after, len(train) - 1)]), np.abs(test - train[np.maximum(after - 1, 0)])
            )
            shortest = min(float(gaps.min()), np.inf if shortest is None else shortest)
    return shortest


def _listed(frames: pd.DataFrame, rules: SplitRules) -> dict[str, str]:
    names = {s: {s, r} for s, r in zip(frames["session_id"], frames["recording"], strict=True)}
    all_names = set().union(*names.values())
    test, train = set(rules.test or []), set(rules.train or [])
    for name in sorted(test | train):
        if name not in all_names:
            raise _no_session(name, all_names)
    # One list alone defines the other one; with both, what neither names is unused.
    rest = "unused" if test and train else ("train" if test else "test")
    # A part's name goes before its recording's.
    return {s: _side(s, test, train) or _side(r, test, train) or rest for s, r in _pairs(frames)}


def _side(name: str, test: set[str], train: set[str]) -> str | None:
    return "test" if name in test else "train" if name in train else None


def _as_stated(frames: pd.DataFrame) -> NDArray[np.object_] | None:
    stated = frames["stated_split"].to_numpy(dtype=object)
    return stated.copy() if {"train", "test"} == set(stated) else None


def _by_name(frames: pd.DataFrame) -> tuple[dict[str, str], str] | None:
    sides = {s: "test" if r.lower().startswith("test") else "train" for s, r in _pairs(frames)}
    recordings = [r.lower() for _, r in _pairs(frames)]
    named = all(r.startswith(("train", "test")) for r in recordings)
    return (sides, "by the sessions' names") if named and len(set(sides.values())) == 2 else None


def _by_fraction(frames: pd.DataFrame, fraction: float) -> tuple[dict[str, str], str]:
    counts = frames["recording"].value_counts()
    names = sorted(counts.index, key=natural_order)
    # As many recordings from the end as come nearest to the fraction; one is left to train on. Where they are most of
    # the frames, the single one that comes nearest.
    choices = [(names[-n:], f"the last {n} of the recordings") for n in range(1, len(names))]
    best = min(choices, key=lambda choice: abs(counts[choice[0]].sum() / len(frames) - fraction))
    if counts[best[0]].sum() > len(frames) / 2:
        nearest = min(names, key=lambda name: abs(counts[name] / len(frames) - fraction))
        best = [nearest], f"recording {nearest} alone, as the last one has most of the frames"
    return {s: "test" if r in best[0] else "train" for s, r in _pairs(frames)}, best[1]


def _pairs(frames: pd.DataFrame) -> Sequence[tuple[str, str]]:
    unique = frames[["session_id", "recording"]].drop_duplicates()
    return list(zip(unique["session_id"], unique["recording"], strict=True))


def _ordered_split(frames: pd.DataFrame, rules: SplitRules) -> NDArray[np.object_]:
    """The split of one recording's frames in the order of their times, or names."""
    t_ns = frames["t_ns"].to_numpy()
    start, end = int(t_ns.min()), int(t_ns.max())
    test_from = end - (end - start) * rules.test_fraction
    split = np.full(len(t_ns), "train", dtype=object)
    if rules.val_fraction > 0:
        block = (test_from - start) * rules.val_fraction
        if have_times(frames).all():
            # The held-out block is the gap as well, unless that would take more than a quarter of the training walk.
            block = max(block, min(LEAK_S * 1e9, (test_from - start) / 4))
        split[t_ns > test_from - block] = "val"
    split[t_ns > test_from] = "test"
    return split


def _hold_out(frames: pd.DataFrame, split: NDArray[np.object_], fraction: float) -> None:
    """Turn a contiguous block of each training session into validation, in place; the block wanders from session to
    session, so that another walk shows the place."""
    if fraction == 0:
        return
    sessions = sorted(frames.groupby("session_id").indices.values(), key=lambda rows: int(rows[0]))
    training = [rows[split[rows] == "train"] for rows in sessions if (split[rows] == "train").any()]
    for k, rows in enumerate(training):
        size = round(len(rows) * fraction)
        centre = (k + 0.5) / len(training) * len(rows)
        first = int(np.clip(round(centre - size / 2), 0, len(rows) - size))
        split[rows[first : first + size]] = "val"
