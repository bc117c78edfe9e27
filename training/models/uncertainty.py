"""Covariances of poses in the map frame: rotation (rad) first, then position (m), of errors `true rotation =
exp(rotation) estimated rotation`, as in the tables of poses."""

import torch
from scipy.special import fdtri
from torch import Tensor, nn

from groundwalk.scoring.errors import BOUND_95
from groundwalk.training.poses import PoseBatch, conjugate, log_quaternion, multiply

_MIN_FRAMES = 3  # from which on errors of three axes have a covariance
_QUANTILE = 0.9
_CHI2_QUANTILE = 6.25  # of three degrees of freedom at _QUANTILE
_FACTORS = (0.01, 100.0)


def rotation_vector(q_from_B4: Tensor, q_to_B4: Tensor) -> Tensor:
    """The rotations (..., 3), rad, in the axes of the reference frame, after which `q_from` becomes `q_to`."""
    return 2 * log_quaternion(multiply(q_to_B4, conjugate(q_from_B4)))


def resized(covariance_B66: Tensor, sd_B2: Tensor) -> Tensor:
    """Covariances with these root mean square errors, in rotation and in position, and the shapes and correlations
    that they had."""
    squares = covariance_B66.diagonal(dim1=1, dim2=2).unflatten(1, (2, 3)).sum(-1)
    by = (sd_B2 / squares.sqrt()).repeat_interleave(3, dim=1)
    return by[:, None] * covariance_B66 * by[..., None]


def calibration_factors(answers: PoseBatch, truth: PoseBatch) -> Tensor:
    """By what to multiply the covariances' rotation and position parts, (2,), so that nine in ten held-out frames lie
    within their bounds of that size, and for how little so many frames say of others (`widening`)."""
    assert answers.covariance_B66 is not None
    covariance = answers.covariance_B66.double()
    factors = []
    rotation = rotation_vector(answers.quaternion_B4, truth.quaternion_B4)
    for i, error in enumerate((rotation, truth.position_B3 - answers.position_B3)):
        block = covariance[:, 3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        squared = (error.double() * torch.linalg.solve(block, error.double())).sum(-1)
        factors.append((torch.quantile(squared, _QUANTILE) / _CHI2_QUANTILE).clamp(*_FACTORS))
    return torch.stack(factors).float() * widening(len(truth.position_B3))


def widening(frames: int) -> float:
    """By what 95 % bounds of three numbers grow since their variances are known from so many frames only: those of
    Hotelling's distribution over those of chi square. Fewer than three frames count as three."""
    n = max(frames, _MIN_FRAMES)
    return float(3 * n / (n - 2) * fdtri(3, n - 2, 0.95) / BOUND_95)


class CovarianceScale(nn.Module):
    """Scales covariances (B, 6, 6) by what held-out frames say of them."""

    factor: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("factor", torch.ones(2))  # rotation, position

    def forward(self, covariance_B66: Tensor) -> Tensor:
        by = self.factor.repeat_interleave(3).sqrt()
        return by[:, None] * covariance_B66 * by

    def fit(self, answers: PoseBatch, truth: PoseBatch) -> None:
        """Make the scale fit these answers too, which were made with the scale as it is."""
        self.factor *= calibration_factors(answers, truth).to(self.factor)
