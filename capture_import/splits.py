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
    recordings, stated = frames["recording"], frames["stated_split"].to_numpy(dtype=object)
    is_in_time = False
    if rules.test is not None or rules.train is not None:
        split, how = _listed(frames, rules), "listed in the scene's config"
    elif not by_time and set(stated) == {"train", "test"}:
        split, how = stated.copy(), "as the data set states"
    elif by_time or len(recordings.unique()) == 1:
        is_in_time, split = True, np.full(len(frames), "train", dtype=object)
        for rows in frames.groupby("recording", sort=False).indices.values():
            split[rows] = _ordered_split(frames.iloc[rows], rules)
        in_time = have_times(frames).all()
        how = "by time within each recording" if in_time else "the last images of each recording by their names"
    else:
        tested, how = _named_for_testing(recordings) or _last_of(recordings, rules.test_fraction)
        split = np.where(recordings.isin(tested), "test", "train").astype(object)
    if not is_in_time:
        _hold_out(frames, split, rules.val_fraction)
    leak = leak_seconds(frames, split)
    if not is_in_time and leak is not None and leak < LEAK_S and not rules.allow_leak:
        raise UserError(
            "test frames are too close in time to training frames of the same recording",
            where="[split] of the scene's config",
            expected=f"at least {LEAK_S:g} s",
            found=f"{leak:.2f} s",
            do=f"put whole recordings on one side, or set {setting_of('split', 'allow_leak = true')}",
        )
    for side in ("train", "test"):
        if not (split == side).any():
            raise _no_side(side, f"{len(split)} frames, split {how}")
    return SplitResult(split, how, leak)


def refuse_lists(rules: SplitRules, recordings: Sequence[str]) -> None:
    """UserError where the lists of `rules` can't fit a capture of these recordings, before their images are read: they
    name others, or leave none to train or to test on. Parts of a recording (walk.part2) are known later."""
    listed = [*(rules.test or []), *(rules.train or [])]
    if unknown := [name for name in listed if not {name, re.sub(r"\.(part|camera)\d+$", "", name)} & {*recordings}]:
        raise _no_session(unknown[0], recordings)
    if listed and not (rules.test and rules.train) and set(recordings) <= set(listed):
        side = "train" if rules.test else "test"
        raise _no_side(side, f"all {len(recordings)} recordings are listed for the other side")


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
    gaps = list[float]()
    timed = have_times(frames)
    frames, split = frames[timed], split[timed]
    for rows in frames.groupby("recording", sort=True).indices.values():
        t_s = frames["t_ns"].to_numpy()[rows] * 1e-9
        train, test = t_s[split[rows] == "train"], t_s[split[rows] == "test"]
        if len(train) and len(test):
            gaps.append(float(np.abs(np.subtract.outer(test, train)).min()))
    return min(gaps, default=None)


def _listed(frames: pd.DataFrame, rules: SplitRules) -> NDArray[np.object_]:
    sessions, recordings = frames["session_id"], frames["recording"]
    test, train = rules.test or [], rules.train or []
    names = {*sessions, *recordings}
    if unknown := sorted({*test, *train} - names):
        raise _no_session(unknown[0], names)
    # One list alone defines the other one; with both, what neither names is unused.
    rest = "unused" if test and train else ("train" if test else "test")
    side_of = dict.fromkeys(train, "train") | dict.fromkeys(test, "test")
    # A part's name goes before its recording's.
    sides = [side_of.get(s, side_of.get(r, rest)) for s, r in zip(sessions, recordings, strict=True)]
    return np.array(sides, dtype=object)


def _named_for_testing(recordings: pd.Series) -> tuple[list[str], str] | None:
    """The recordings that test by their names; None where not all names begin with train or test, on both sides."""
    sides = [name.lower().startswith("test") for name in recordings.unique()]
    named = recordings.str.lower().str.startswith(("train", "test")).all() and len(set(sides)) == 2
    tested = [name for name, tests in zip(recordings.unique(), sides, strict=True) if tests]
    return (tested, "by the sessions' names") if named else None


def _last_of(recordings: pd.Series, fraction: float) -> tuple[list[str], str]:
    """As many recordings from the end as come nearest to the fraction; one is left to train on. Where they are most of
    the frames, the single one that comes nearest."""
    counts = recordings.value_counts()
    names = sorted(counts.index, key=natural_order)

    def off(tested: list[str]) -> float:
        return abs(counts[tested].sum() / len(recordings) - fraction)

    last = min((names[-n:] for n in range(1, len(names))), key=off)
    if counts[last].sum() <= len(recordings) / 2:
        return last, f"the last {len(last)} of the recordings"
    nearest = min(names, key=lambda name: off([name]))
    return [nearest], f"recording {nearest} alone, as the last one has most of the frames"


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
    is_training, session = split == "train", frames["session_id"].to_numpy()
    training = [np.flatnonzero(is_training & (session == name)) for name in dict.fromkeys(session[is_training])]
    for k, rows in enumerate(training):
        size = round(len(rows) * fraction)
        centre = (k + 0.5) / len(training) * len(rows)
        first = int(np.clip(round(centre - size / 2), 0, len(rows) - size))
        split[rows[first : first + size]] = "val"
