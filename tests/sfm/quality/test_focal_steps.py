"""Steps of focal lengths within a session, as adjusted; the logged ones are constant."""

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.quality.focal_steps import focal_step, with_focal_steps


def _noise(count: int, seed: int = 0) -> np.ndarray:
    return np.exp(np.random.default_rng(seed).normal(0, 0.0015, count))


@pytest.mark.parametrize(("first", "factor"), [(12, 1.25), (3, 1.05), (21, 0.5)])
def test_a_zoom_is_found_at_its_frame(first: int, factor: float) -> None:
    scale = _noise(24)
    scale[first:] *= factor
    step = focal_step(scale)
    assert step is not None and step[0] == first
    assert step[1] == pytest.approx(factor, rel=0.01)


@pytest.mark.parametrize("shape", ["noise", "breathing", "drift", "one frame", "short"])
def test_what_is_no_zoom_is_no_step(shape: str) -> None:
    scale = _noise(4 if shape == "short" else 60)
    if shape == "breathing":
        scale *= 1 + 0.02 * np.sin(np.linspace(0, 6 * np.pi, 60))
    elif shape == "drift":
        scale *= np.linspace(1, 1.4, 60)
    elif shape == "one frame":
        scale[30] *= 1.25
    assert focal_step(scale) is None


def test_each_session_of_a_model_is_looked_at_in_the_order_of_time() -> None:
    sessions = np.repeat(["a", "b"], 12)
    frames = pd.DataFrame({"session_id": sessions, "t_ns": np.tile(np.arange(12), 2), "fx": 500.0})
    frames["frame_id"] = [f"{s}/{t:06d}" for s, t in zip(sessions, frames["t_ns"], strict=True)]
    images = pd.DataFrame({"model_id": "incremental/0", "fx": 500 * _noise(24)})
    images.loc[18:, "fx"] *= 1.2
    shuffled = np.random.default_rng(1).permutation(24)
    frames, images = (table.iloc[shuffled].reset_index(drop=True) for table in (frames, images))
    intrinsics = pd.DataFrame({"model_id": "incremental/0", "session_id": ["a", "b"]})
    found = with_focal_steps(intrinsics, frames, images)
    assert found["focal_step_frame_id"].tolist() == [None, "b/000006"]
    assert np.isnan(found["focal_step"][0]) and found["focal_step"][1] == pytest.approx(1.2, rel=0.01)
