"""Sequences for formats in which one is wholly for training or for testing: a session, or its part in a split."""

import numpy as np

from groundwalk.export.dataset import Dataset


def sequences(dataset: Dataset) -> list[tuple[bool, np.ndarray]]:
    """(for testing, rows of the frames in order of time) of each sequence; by session, training first.

    Validation frames are part of the training walks, so they count as training.
    """
    frames, result = dataset.frames, []
    for session_id in sorted(frames["session_id"].unique()):
        for test in (False, True):
            rows = np.flatnonzero((frames["session_id"] == session_id) & (dataset.in_test == test))
            if len(rows):
                result.append((test, rows[np.argsort(frames["t_ns"].to_numpy()[rows], kind="stable")]))
    return result
