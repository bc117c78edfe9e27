"""What every causal method promises: a state that can be saved at any frame, odometry at 60 Hz, bounded memory."""

import base64
import io
import json
import pickle

import numpy as np
import pytest

from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.methods.localiser import Estimate, Localiser
from groundwalk.geometry.poses import interpolate
from groundwalk.scoring.errors import position_error
from groundwalk.store import UserError
from tests.fusion.random_walks import random_walk
from tests.fusion.upright_walks import upright_walk

CAUSAL = [name for name, method in METHODS.items() if method.causal]
RATE = 60
# A method that keeps predictions grows until it has as many as it ever will: 64 of them, one a second.
FULL_AT = {"drift_aware": 5_000}


def made(name: str) -> Localiser:
    localiser = METHODS[name].make(METHODS[name].options())
    assert isinstance(localiser, Localiser)
    return localiser


def in_full(estimate: Estimate) -> bytes:
    """Everything that an estimate says, to the bit."""
    arrays = (estimate.map_T_cam, estimate.covariance, estimate.map_T_vio)
    confirmed = [(t_ns, np.asarray(pose).tobytes()) for t_ns, pose in estimate.confirms]
    plain = (str(estimate.status), confirmed, estimate.reasons, sorted(estimate.signals.items()))
    return pickle.dumps((plain, [None if a is None else np.asarray(a, dtype=float).tobytes() for a in arrays]))


@pytest.mark.parametrize("name", CAUSAL)
@pytest.mark.parametrize("seed", [0, 2, 5])
def test_a_state_restored_at_any_frame_goes_on_to_the_bit(name: str, seed: int) -> None:
    walk = random_walk(seed, 60)
    rng = np.random.default_rng(seed)
    down = rng.normal(size=(60, 3))
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    frames = list(zip(map(int, walk.t_ns), walk.vio, walk.apr, down, strict=True))
    whole = made(name)
    answers = [whole.step(*frame) for frame in frames]
    assert all(e.map_T_cam is None or np.isfinite(e.map_T_cam).all() for e in answers)
    expected = [in_full(estimate) for estimate in answers]
    stopped, found = made(name), []
    for frame in frames:
        if rng.random() < 0.5:
            text = json.dumps(stopped.save(), allow_nan=False)
            stopped = made(name)
            stopped.restore(json.loads(text))
        found.append(in_full(stopped.step(*frame)))
    assert found == expected
    assert stopped.save() == whole.save()


def test_a_state_that_was_made_up_runs_no_code_and_is_refused() -> None:
    localiser = made("drift_aware")
    file = io.BytesIO()
    np.save(file, np.array([print]), allow_pickle=True)
    state = localiser.save()
    with pytest.raises(ValueError, match="allow_pickle"):
        localiser.restore(state | {"_drift": {"npy": base64.b64encode(file.getvalue()).decode()}})
    for other in (made("window30").save(), state | {"_advance": "os.system"}, state | {"_keyframes": {}}):
        with pytest.raises(UserError, match="another method"):
            localiser.restore(other)


@pytest.mark.parametrize("name", CAUSAL)
def test_odometry_at_60_hz_with_a_prediction_a_second(name: str) -> None:
    """10,000 frames: answers stay as good as at one frame a second, and neither saved state nor object grows."""
    t_ns, truth, vio, apr = upright_walk(3, 168, noise_m=0.1, noise_deg=1.0, outliers=0.05)
    slow = made(name)
    once = [slow.step(int(t), v, a) for t, v, a in zip(t_ns, vio, apr, strict=True)]
    fine_ns = t_ns[0] + np.round(np.arange(10_000) * 1e9 / RATE).astype(np.int64)
    odometry = interpolate(t_ns, vio, fine_ns)
    localiser, sizes, estimates = made(name), [], []
    for i, t in enumerate(fine_ns):
        estimates.append(localiser.step(int(t), odometry[i], None if i % RATE else apr[i // RATE]))
        if i in (FULL_AT.get(name, 3_000), 9_999):
            sizes.append(len(json.dumps(localiser.save())))
    # Less than a byte for each of the 5,000 or more frames in between.
    assert sizes[1] - sizes[0] < 1_000
    answered = [e.map_T_cam is not None for e in estimates]
    if name == "raw":
        assert answered == [i % RATE == 0 for i in range(10_000)]
        return
    # From the first frame that odometry carries each has an answer; checks of pairs wait for predictions that agree.
    carried = next(i for i, there in enumerate(answered) if there and i % RATE)
    assert all(answered[carried:]) and carried <= 30 * RATE
    there = [i for i in range(len(once) - 1) if answered[i * RATE] and once[i].map_T_cam is not None]
    fine, coarse = (
        np.array([e.map_T_cam for e in part])
        for part in zip(*((estimates[i * RATE], once[i]) for i in there), strict=True)
    )
    assert position_error(fine, truth[there]).mean() <= 1.1 * position_error(coarse, truth[there]).mean()
    if name in ("paper_rule", "last_good"):
        # What only looks at pairs of predictions isn't changed by frames without one.
        assert [e.status for e in estimates[::RATE]] == [e.status for e in once[: len(estimates[::RATE])]]
        assert np.allclose(fine, coarse, atol=1e-9)
