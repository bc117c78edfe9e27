"""Smooth noise over time: of hands, gazes and focus."""

import math

import numpy as np

from groundwalk.geometry.poses import Array


def wander(t_s: Array, low_hz: float, high_hz: float, rng: np.random.Generator) -> Array:
    """Smooth noise (N,) of about unit deviation with frequencies from low to high."""
    n = 9
    frequency = np.exp(rng.uniform(math.log(low_hz), math.log(high_hz), n))
    phase = rng.uniform(0, 2 * math.pi, n)
    return np.sin(2 * math.pi * np.outer(t_s, frequency) + phase).sum(axis=1) * math.sqrt(2 / n)
