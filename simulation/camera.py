"""A phone's camera: autofocus, auto exposure, motion blur, noise."""

import math
import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from groundwalk.geometry.lens import k1_k2_of_k3
from groundwalk.geometry.poses import Array
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.view import RadialDistortion, Rendering, View
from groundwalk.simulation.walks import wander

FOCAL = 1447.65 / 1920  # of the image width: a phone's wide camera, 4:3
_CENTRE = (967.5 / 1920, 692.5 / 1920)
_BREATHING = 0.0022  # standard deviation of the focal length, as a fraction of it
_BREATH_S = 20.0  # period of the focus breathing that isn't in the log
_WANDER_PX = 1.2  # standard deviation of the principal point, at 1920 pixels
_TARGET = 118.0  # mean grey level that auto exposure aims at
_LAG_S = 0.8
_MAX_EXPOSURE_S = 1 / 60
_MAX_BLUR_TAPS = 9


@dataclass(frozen=True)
class Phone:
    """The camera of the phone that walks all sessions of a scene.

    Row y is exposed `readout_s` (y / height - 0.5) after the middle row, whose time is the logged one minus
    `time_offset_s`.
    """

    lens: RadialDistortion
    readout_s: float
    time_offset_s: float


@dataclass(frozen=True)
class Exposure:
    """How one image is exposed: seconds, gain on display values a channel, noise in grey levels at mid grey."""

    duration_s: float
    gain_bgr: tuple[float, float, float]
    noise: float


def intrinsics(t_s: Array, width: int, height: int, rng: np.random.Generator) -> Array:
    """fx, fy, cx, cy (N, 4) in pixels: the focal length breathes with focus, stabilisation moves the centre."""
    focal = FOCAL * width * (1 + _BREATHING * np.clip(wander(t_s, 0.01, 0.12, rng), -2.2, 2.2))
    scale = width / 1920
    cx = _CENTRE[0] * width + scale * _WANDER_PX * wander(t_s, 0.05, 0.5, rng)
    cy = _CENTRE[1] * width + (height - 0.75 * width) / 2 + scale * _WANDER_PX * 0.7 * wander(t_s, 0.05, 0.5, rng)
    return np.stack([focal, focal, cx, cy], axis=1)


def draw_phone(settings: SimulateSettings, scene: str, seed: int) -> Phone:
    """The phone of a scene and seed: what the settings state, and the rest drawn from the spread of real ones."""
    rng = np.random.default_rng([seed, zlib.crc32(f"{scene}/phone".encode())])
    k1, off_line, readout_s, k3 = (rng.uniform(*of) for of in ((0.05, 0.12), (-0.03, 0.03), (0.010, 0.030), (0.0, 0.5)))
    if settings.lens == "drawn":
        # k1 and k2 were measured without a k3: with one, they are what all three together come nearest to. Measured
        # pairs lie along a line that falls with k1.
        of_k3 = k3 * k1_k2_of_k3(math.hypot(1, settings.height / settings.width) / 2 / FOCAL)
        k1 -= of_k3[0]
        k2 = np.clip(-0.125 - 1.6 * (k1 + of_k3[0] - 0.085) + off_line, -0.20, -0.05) - of_k3[1]
        lens = RadialDistortion(float(k1), float(k2), float(k3))
    else:
        lens = RadialDistortion(*settings.lens)
    readout_s = readout_s if settings.readout_s == "drawn" else settings.readout_s
    return Phone(lens, readout_s, settings.time_offset_s)


def focus_breathing(t_s: Array, settings: SimulateSettings, rng: np.random.Generator) -> Array:
    """True focal length over the logged one (N,): swings once in about 20 s, which isn't in the log."""
    drawn = rng.uniform(0.0, 0.003)
    amplitude = drawn if settings.focus_breathing == "drawn" else settings.focus_breathing
    phase = rng.uniform(0, 2 * math.pi) + 0.8 * wander(t_s, 0.01, 0.04, rng)
    return 1 + amplitude * np.sin(2 * math.pi / _BREATH_S * t_s + phase)


def auto_exposure(brightness: Array, step_s: float, indoor: bool, rng: np.random.Generator) -> list[Exposure]:
    """Exposures that follow the mean grey level (N,), sampled each step_s, with the lag of a real loop."""
    wish = np.log(_TARGET / np.maximum(brightness, 8)) * 0.75
    keep = math.exp(-step_s / _LAG_S)
    log_gain, _ = lfilter([1 - keep], [1, -keep], wish, zi=[keep * wish[0]])
    daylight = rng.uniform(-0.12, 0.12)
    balance = np.exp(rng.normal(0, 0.025, 3))
    base_s = _MAX_EXPOSURE_S * (0.75 if indoor else 0.3)
    exposures = []
    for value in log_gain:
        light = math.exp(2 * value)  # display values go with the root of light
        duration = min(base_s * light, _MAX_EXPOSURE_S)
        amplified = base_s * light / duration
        noise = (2.2 if indoor else 1.3) * math.sqrt(amplified)
        blue, green, red = math.exp(value + daylight) * balance
        exposures.append(Exposure(duration, (blue, green, red), noise))
    return exposures


def expose(
    rendering: Rendering, view: View, velocity_cam: Array, spin_cam: Array, exposure: Exposure, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The 8-bit BGR image of a sharp rendering from the middle of the exposure.

    `velocity_cam` (m/s) and `spin_cam` (rad/s) are the camera's motion in its axes.
    """
    image = _motion_blur(rendering, view, velocity_cam, spin_cam, exposure.duration_s)
    image = image * (np.array(exposure.gain_bgr, np.float32) * _vignette(view)[..., None])
    # Highlights roll off instead of clipping hard.
    image = np.where(image > 205, 205 + 50 * np.tanh((image - 205) / 50), image)
    sigma = np.float32(exposure.noise) * np.sqrt(0.35 + np.maximum(image, 0) / 180)
    image += sigma * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def _vignette(view: View) -> NDArray[np.float32]:
    columns, rows = np.arange(view.width, dtype=np.float32) + 0.5, np.arange(view.height, dtype=np.float32) + 0.5
    x, y = view.points(columns[None, :], rows[:, None])
    if not view.lens.is_pinhole:
        x, y, _ = view.lens.undistort(x, y)
    return np.float32(1) - np.float32(0.11) * (x**2 + y**2)


def _motion_blur(
    rendering: Rendering, view: View, velocity_cam: Array, spin_cam: Array, duration_s: float
) -> NDArray[np.float32]:
    """Average the image along each pixel's path over the exposure, from depth and the camera's motion."""
    x = ((np.arange(view.width, dtype=np.float32) + 0.5 - view.cx) / view.fx)[None, :].astype(np.float32)
    y = ((np.arange(view.height, dtype=np.float32) + 0.5 - view.cy) / view.fy)[:, None].astype(np.float32)
    near = 1 / rendering.depth
    vx, vy, vz = velocity_cam.astype(np.float32)
    wx, wy, wz = spin_cam.astype(np.float32)
    flow_x = (x * vz - vx) * near + x * y * wx - (1 + x * x) * wy + y * wz
    flow_y = (y * vz - vy) * near + (1 + y * y) * wx - x * y * wy - x * wz
    flow_x = (flow_x * np.float32(view.fx * duration_s)).astype(np.float32)
    flow_y = (flow_y * np.float32(view.fy * duration_s)).astype(np.float32)
    reach = float(np.percentile(np.hypot(flow_x[::8, ::8], flow_y[::8, ::8]), 98))
    taps = min(_MAX_BLUR_TAPS, 2 * math.ceil(reach / 2) + 1)
    if reach < 0.25:
        return rendering.image
    taps = max(taps, 3)
    column, row = np.meshgrid(np.arange(view.width, dtype=np.float32), np.arange(view.height, dtype=np.float32))
    total = np.zeros_like(rendering.image)
    for k in range(taps):
        offset = np.float32((k + 0.5) / taps - 0.5)
        at_x, at_y = column + offset * flow_x, row + offset * flow_y
        total += cv2.remap(rendering.image, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / np.float32(taps)
