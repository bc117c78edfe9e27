"""Constants of robust estimates."""

SIGMA_OF_MEDIAN = 1.4826
"""Sigma of a normal distribution by the median of its absolute values."""
CAUCHY_WIDTH = 2.385
"""Width of Cauchy's loss, in sigmas, that is 95 % efficient (Zhang, "Parameter estimation techniques", 1997)."""
