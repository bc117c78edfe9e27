"""Bayesian PoseNet: PN with dropout at test time (Kendall and Cipolla, "Modelling uncertainty in deep learning for
camera relocalization", ICRA 2016)."""

import torch
from torch import Tensor

from groundwalk.training.models.posenet import HIDDEN, PoseNet
from groundwalk.training.models.uncertainty import CovarianceScale, mean_with_scatter
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import PoseNetSettings

SAMPLES = 40  # dropout masks whose answers are averaged at test time


class BayesianPoseNet(PoseNet):
    """PN that answers with the mean over SAMPLES of its head's dropout masks, and their scatter as its covariance.

    The masks are drawn once and kept with the weights, so that an answer is the same each time.
    """

    masks: Tensor

    def __init__(self, settings: PoseNetSettings, scenes: int = 1, outdoor: bool = False) -> None:
        super().__init__(settings, scenes, outdoor)
        generator = torch.Generator().manual_seed(0)
        kept = torch.rand(SAMPLES, 1, HIDDEN, generator=generator) >= settings.dropout
        self.register_buffer("masks", kept / (1 - settings.dropout))
        self.covariance_scale = CovarianceScale()

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        features = self.backbone(image_B3HW)
        with torch.autocast(image_B3HW.device.type, enabled=False):
            hidden = torch.relu(self.hidden(features.float())) * self.masks
            position, log_q = self.position(hidden), self.rotation(hidden)
        return mean_with_scatter(self.frames, position, log_q, self.covariance_scale)

    def calibrate(self, answers: PoseBatch, truth: PoseBatch) -> None:
        self.covariance_scale.fit(answers, truth)
