"""Robust estimates: constants and weights."""

import numpy as np

from groundwalk.geometry.poses import Array

SIGMA_OF_MEDIAN = 1.4826
"""Sigma of a normal distribution by the median of its absolute values."""
CAUCHY_WIDTH = 2.385
"""Width of Cauchy's loss, in sigmas, that is 95 % efficient (Zhang, "Parameter estimation techniques", 1997)."""


def cauchy_weights(residual_MD: Array, width: float) -> Array:
    """Weights (M,) of residuals (M, D) in Cauchy's loss of a width in the residuals' unit."""
    return np.asarray(1 / (1 + np.sum(residual_MD**2, axis=1) / width**2))
