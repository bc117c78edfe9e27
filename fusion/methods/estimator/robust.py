"""Robust kernels: how much an observation counts, and what it costs.

Under Student's t an observation with squared Mahalanobis length z in d dimensions counts (nu + d) / (nu + z) times a
Gaussian one (iteratively reweighted least squares; Lange, Little and Taylor, JASA 84, 1989). With few degrees of
freedom nu the cost grows with the logarithm of the error, so that neither the share of outliers nor their size has to
be known.

A location hangs less on wrong observations where that weight is raised to the power of nu / 2, which is Barron's
general kernel of shape 2 - nu (CVPR 2019): above nu = 2, where both are the same, the cost is bounded, and the farther
off an observation is, the less it pulls."""

from math import log1p

from groundwalk.fusion.methods.estimator.compiled import compiled


@compiled
def weight(squared: float, dimensions: int, dof: float) -> float:
    """What an observation of a squared Mahalanobis length counts, from 0 to (dof + dimensions) / dof."""
    return (dof + dimensions) / (dof + squared)


@compiled
def bounded(squared: float, dimensions: int, dof: float) -> float:
    """What it counts under Barron's kernel of shape 2 - dof; 1 at the usual length, as under Student's t."""
    return weight(squared, dimensions, dof) ** (dof / 2)


@compiled
def cost(squared: float, dimensions: int, dof: float) -> float:
    """Negative logarithm of the density at a squared Mahalanobis length, up to a constant."""
    return (dof + dimensions) / 2 * log1p(squared / dof)
