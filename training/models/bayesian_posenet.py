"""Bayesian PoseNet: PN with dropout at test time (Kendall and Cipolla, "Modelling uncertainty in deep learning for
camera relocalization", ICRA 2016)."""

import torch
from torch import Tensor

from groundwalk.training.models.posenet import HIDDEN, PoseNet, loss_weights
from groundwalk.training.models.uncertainty import CovarianceScale, mean_with_scatter
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import PoseNetSettings

SAMPLES = 40  # dropout masks whose answers are averaged at test time


class BayesianPoseNet(PoseNet):
    """PN that answers with the mean over `samples` of its head's dropout masks, and their scatter as its covariance.

    The masks are drawn once and kept with the weights, so that an answer is the same each time.
    """

    masks: Tensor

    def __init__(self, dropout: float = 0.5, sx: float = 0.0, sq: float = -3.0, samples: int = SAMPLES) -> None:
        super().__init__(dropout, sx, sq)
        generator = torch.Generator().manual_seed(0)
        kept = torch.rand(samples, 1, HIDDEN, generator=generator) >= dropout
        self.register_buffer("masks", kept / (1 - dropout))
        self.covariance_scale = CovarianceScale()

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        features = self.backbone(image_B3HW)
        with torch.autocast(image_B3HW.device.type, enabled=False):
            hidden = torch.relu(self.hidden(features.float())) * self.masks
            position, log_q = self.position(hidden), self.rotation(hidden)
        answer = mean_with_scatter(self.frames, position, log_q)
        assert answer.covariance_B66 is not None
        return answer._replace(covariance_B66=self.covariance_scale(answer.covariance_B66))

    def calibrate(self, answers: PoseBatch, truth: PoseBatch) -> None:
        self.covariance_scale.fit(answers, truth)


def make_bayesian_posenet(settings: PoseNetSettings, scenes: int, outdoor: bool) -> BayesianPoseNet:
    """Bayesian PoseNet with random weights."""
    return BayesianPoseNet(settings.dropout, *loss_weights(settings))
