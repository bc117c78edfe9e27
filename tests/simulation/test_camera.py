"""The camera's own effects: focus, exposure, blur, noise."""

import numpy as np

from groundwalk.geometry.poses import make_pose
from groundwalk.simulation.camera import Exposure, auto_exposure, expose
from groundwalk.simulation.view import Rendering, View

VIEW = View(make_pose(np.eye(3), np.zeros(3)), 240.0, 240.0, 160.0, 120.0, 320, 240)
PLAIN = (1.0, 1.0, 1.0)


def bar() -> np.ndarray:
    image = np.full((240, 320, 3), 60, np.float32)
    image[:, 158:162] = 200
    return image


def test_exposure_follows_the_light_with_a_lag() -> None:
    grey = np.concatenate([np.full(50, 150.0), np.full(100, 60.0)])
    gains = np.array([e.gain_bgr[1] for e in auto_exposure(grey, 0.1, True, np.random.default_rng(0))])
    assert gains[49] < gains[52] < gains[60] < gains[140]
    assert abs(gains[52] - gains[49]) < 0.5 * (gains[140] - gains[49])
    durations = [e.duration_s for e in auto_exposure(grey, 0.1, False, np.random.default_rng(0))]
    assert max(durations) <= 1 / 60


def test_blur_spreads_along_the_motion_and_keeps_the_middle() -> None:
    """Turning at w rad/s for t s moves the picture by w t f pixels, centred on the middle of the exposure."""
    spin = np.array([0.0, 1.5, 0.0])
    exposure = Exposure(1 / 60, PLAIN, 0.0)
    sharp = Rendering(bar(), np.full((240, 320), 5.0, np.float32))
    row = expose(sharp, VIEW, np.zeros(3), spin, exposure, np.random.default_rng(0))[120, :, 1].astype(float)
    weight = np.clip(row - 63, 0, None)
    x = np.arange(320) + 0.5
    mean = (weight * x).sum() / weight.sum()
    spread = np.sqrt((weight * (x - mean) ** 2).sum() / weight.sum())
    assert abs(mean - 160) < 0.1
    # Variances add: the bar's own width 4 and the path's length, here 6 pixels.
    assert abs(spread - np.sqrt(16 / 12 + 36 / 12)) < 0.25
