"""HDR video as SDR images: ITU-R BT.2100's transfer functions, BT.2390's tone curve, and BT.2087's primaries.

HLG is shown on a display of 1,000 cd/m2, where light ends, and SDR's white is HDR's reference white of 203 cd/m2
(BT.2408).
"""

import functools
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array

# Perceptual quantiser and hybrid log-gamma, by their numbers in ITU-T H.273.
PQ, HLG = 16, 18
_WHITE_NITS, _PEAK_NITS = 203.0, 1000.0
_LUMINANCE = np.array([[0.2627, 0.6780, 0.0593]])
_BT2020_TO_BT709 = np.array([[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]])
_HLG_GAMMA = 1.2
# Steps of tables over the root of light, in which dark colours are as fine as they look.
_STEPS = 1 << 16
_ROWS = 16


def sdr_pixels(rgb: NDArray[np.uint16], transfer: int) -> NDArray[np.uint8]:
    """An image (H, W, 3) in sRGB of one in BT.2100's colours, 10 bits each. Up to 0.43 of the reference white colours
    stay as they are; brighter ones keep their hue."""
    sdr, light_of, (gain_of, srgb_of) = np.empty(rgb.shape, np.uint8), _light_of(transfer), _tone_tables()
    # Few rows at once stay in the processor's cache.
    for top in range(0, len(rgb), _ROWS):
        light: Any = np.take(light_of, rgb[top : top + _ROWS], mode="clip")
        if transfer == HLG:
            # What is displayed grows faster than what was seen, by its luminance.
            shown = cv2.pow(cv2.transform(light, _LUMINANCE), _HLG_GAMMA - 1)
            light = cv2.multiply(light, cv2.merge([shown] * 3))
        light = np.maximum(cv2.transform(light, _BT2020_TO_BT709), 0)
        red, green, blue = cv2.split(light)
        gain = np.take(gain_of, _step(cv2.max(cv2.max(red, green), blue)))
        sdr[top : top + _ROWS] = np.take(srgb_of, _step(cv2.multiply(light, cv2.merge([gain] * 3))))
    return sdr


def _step(light: Any) -> NDArray[np.uint16]:
    """Where light, 1 at the peak, is in the tables."""
    return (np.minimum(cv2.sqrt(light), 1) * np.float32(_STEPS - 1) + np.float32(0.5)).astype(np.uint16)


def _pq_nits(code: Array) -> Array:
    """PQ's light, cd/m2, of codes from 0 to 1 (BT.2100, table 4)."""
    power = code ** (1 / 78.84375)
    return 10_000.0 * (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)


def _pq_code(nits: Array) -> Array:
    power = (nits / 10_000.0) ** 0.1593017578125
    return np.asarray((0.8359375 + 18.8515625 * power) / (1 + 18.6875 * power)) ** 78.84375


def _hlg_seen(code: Array) -> Array:
    """HLG's light in front of the camera, 1 at most, of codes from 0 to 1 (BT.2100, table 5)."""
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12)


def _tone_mapped(nits: Array) -> Array:
    """What SDR shows, 0 to 1, of light up to the peak: the curve of BT.2390, section 5.4.1."""
    peak, white = _pq_code(np.array([_PEAK_NITS, _WHITE_NITS]))
    code, most = _pq_code(nits) / peak, white / peak
    knee = 1.5 * most - 0.5
    t = np.maximum(code - knee, 0) / (1 - knee)
    spline = (2 * t**3 - 3 * t**2 + 1) * knee + (t**3 - 2 * t**2 + t) * (1 - knee) + (3 * t**2 - 2 * t**3) * most
    return _pq_nits(np.where(code < knee, code, spline) * peak) / _WHITE_NITS


@functools.cache
def _light_of(transfer: int) -> Any:
    """Light of each code, 1 at the peak: of HLG as it was in front of the camera, of PQ as it is displayed."""
    codes = np.arange(1024) / 1023
    light = _hlg_seen(codes) if transfer == HLG else np.minimum(_pq_nits(codes) / _PEAK_NITS, 1)
    return light.astype(np.float32)


@functools.cache
def _tone_tables() -> tuple[Any, Any]:
    """By the steps of light (`_step`): what its brightest colour is multiplied by, and sRGB's code."""
    light = np.linspace(0, 1, _STEPS)[1:] ** 2
    gain = np.append(_PEAK_NITS / _WHITE_NITS, _tone_mapped(_PEAK_NITS * light) / light).astype(np.float32)
    srgb = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return gain, np.append(0, np.round(255 * srgb)).astype(np.uint8)
