"""PN with a mixture of poses as its answer (Bui et al., "6D camera relocalization in ambiguous scenes via continuous
multimodal inference", ECCV 2020): where images look alike at several places, each may have a component of its own.

Its parts on PN's ResNet-34: a mixture density head trained by likelihood. Rotations have a Gaussian of the rotation
vector instead of a Bingham distribution, which is the same where deviations are small.
"""

import torch
from torch import Tensor, nn

from groundwalk.training.models.posenet import HIDDEN, PoseNet, single_scene
from groundwalk.training.models.regressor import PoseBatch
from groundwalk.training.models.uncertainty import rotation_vector, with_scatter
from groundwalk.training.regressor_settings import MixtureSettings
from groundwalk.training.rotations import exp_quaternion

_LOG_SD = (-7.0, 3.0)


class MixturePoseNet(PoseNet):
    """One scene's poses: `components` of position, log-quaternion, the deviation of each, and a weight."""

    def __init__(self, components: int, dropout: float = 0.5, sx: float = 0.0, sq: float = -3.0) -> None:
        super().__init__(dropout, sx, sq)
        self.components = components
        self.position = nn.Linear(HIDDEN, 3 * components)
        self.rotation = nn.Linear(HIDDEN, 3 * components)
        self.likelihood = nn.Linear(HIDDEN, 3 * components)  # weight, log deviations of rotation and position
        for layer in (self.position, self.rotation):
            nn.init.kaiming_normal_(layer.weight)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.likelihood.weight)
        self.likelihood.bias = nn.Parameter(torch.tensor([0.0, sq, sx]).repeat_interleave(components))
        self.loss_weights.requires_grad_(False)  # the likelihood weighs

    def _mixture(self, image_B3HW: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Positions and log-quaternions (K, B, 3), log weights, log deviations of rotation and of position (K, B)."""
        features = self.backbone(image_B3HW)
        with torch.autocast(image_B3HW.device.type, enabled=False):
            hidden = self.dropout(torch.relu(self.hidden(features.float())))
            position, log_q, likelihood = (
                layer(hidden).unflatten(1, (3, self.components)).permute(2, 0, 1)
                for layer in (self.position, self.rotation, self.likelihood)
            )
        weight, rotation_log_sd, position_log_sd = likelihood.unbind(-1)
        return position, log_q, weight.log_softmax(0), rotation_log_sd.clamp(*_LOG_SD), position_log_sd.clamp(*_LOG_SD)

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        """The component of the largest weight; its own deviations and the others' distance make the covariance."""
        position, log_q, log_weight, rotation_log_sd, position_log_sd = self._mixture(image_B3HW)
        count, batch = log_weight.shape
        scene = torch.zeros(batch, dtype=torch.long, device=position.device)
        every = self.frames.to_map(position.flatten(0, 1), exp_quaternion(log_q.flatten(0, 1)), scene.repeat(count))
        positions, quaternions = (
            every.position_B3.unflatten(0, (count, batch)),
            every.quaternion_B4.unflatten(0, (count, batch)),
        )
        best, row = log_weight.argmax(0), torch.arange(batch, device=position.device)
        answer = with_scatter(
            PoseBatch(positions[best, row], quaternions[best, row], scene), positions, quaternions, log_weight.exp()
        )
        mean_variance = [(log_weight + 2 * log_sd).logsumexp(0).exp() for log_sd in (rotation_log_sd, position_log_sd)]
        mean_variance[1] = mean_variance[1] * self.frames.scale[0].square()
        spread = torch.diag_embed(torch.stack([mean_variance[0]] * 3 + [mean_variance[1]] * 3, dim=1))
        assert answer.covariance_B66 is not None
        return answer._replace(covariance_B66=answer.covariance_B66 + spread)

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        """The mean negative logarithm of the likelihood (constants left out)."""
        position, log_q, log_weight, rotation_log_sd, position_log_sd = self._mixture(image_B3HW)
        true_position, true_quaternion = self.frames.from_map(poses)
        rotation = rotation_vector(exp_quaternion(log_q), true_quaternion.expand(len(log_q), -1, -1))
        log_likelihood = log_weight
        for error, log_sd in ((rotation, rotation_log_sd), (position - true_position, position_log_sd)):
            log_likelihood = log_likelihood - error.square().sum(-1) * (-2 * log_sd).exp() / 2 - 3 * log_sd
        return -log_likelihood.logsumexp(0).mean()

    def curves(self) -> dict[str, float]:
        return {}


def make_mixture(settings: MixtureSettings, scenes: int, outdoor: bool) -> MixturePoseNet:
    """A mixture PoseNet with random weights."""
    single_scene("PN-mixture", scenes)
    return MixturePoseNet(settings.components, settings.dropout, settings.sx, settings.sq)
