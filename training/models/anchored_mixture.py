"""A mixture of poses: several places that an image may be of, each with how likely and how certain it is.

Mixture density networks (Bishop, 1994) over poses, with the components at anchors among the training poses. Where two
places look alike, a single pose lies between them; a mixture has both, and its covariance says so.
"""

import warnings
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from groundwalk.geometry.poses import Array
from groundwalk.training.poses import PoseBatch, canonical, exp_quaternion, multiply, rotation_vector

OUTPUTS = 9  # of the network a component: logit, position and rotation beside the anchor's, logarithms of both scales
_MEDIAN_STEPS = 12
_FIRST_LOG_SCALE = -1.5  # of positions in standard deviations, and of rotations in radians
_LOG_SCALES = (-6.0, 3.0)
VARIANCE = 4.0  # a coordinate's, in squared scales, of a density that falls as exp(-distance / scale) in space


class Components(NamedTuple):
    """Of each of the K components: log probability, position, rotation (unit xyzw), logarithms of the scales."""

    log_weight_BK: Tensor
    position_BK3: Tensor
    quaternion_BK4: Tensor
    log_position_scale_BK: Tensor
    log_rotation_scale_BK: Tensor


class PoseMixture(nn.Module):
    """Turns a network's outputs (B, components * OUTPUTS) into poses with covariances, in the frame of `SceneFrames`.

    Anchors are held as buffers, one set a scene.
    """

    position_SK3: Tensor
    quaternion_SK4: Tensor

    def __init__(self, scenes: int, components: int) -> None:
        super().__init__()
        self.components = components
        self.register_buffer("position_SK3", torch.zeros(scenes, components, 3))
        self.register_buffer("quaternion_SK4", torch.tensor([0.0, 0, 0, 1]).repeat(scenes, components, 1))

    def fit(self, position_N3: Tensor, quaternion_N4: Tensor, scene_N: Tensor) -> None:
        """Put each scene's anchors at the means of clusters of its training poses."""
        for scene in range(len(self.position_SK3)):
            mine = scene_N == scene
            position, quaternion = position_N3[mine].double().numpy(), quaternion_N4[mine].double().numpy()
            label = _clusters(position, quaternion, self.components)
            for k in range(self.components):
                inside = label == k if (label == k).any() else np.arange(len(label)) == k % len(label)
                self.position_SK3[scene, k] = torch.from_numpy(position[inside].mean(axis=0))
                mean = Rotation.from_quat(quaternion[inside]).mean()
                self.quaternion_SK4[scene, k] = torch.from_numpy(mean.as_quat())

    def decode(self, outputs: Tensor, scene_B: Tensor) -> Components:
        """The components of network outputs, of each sample's scene."""
        o = outputs.unflatten(-1, (self.components, OUTPUTS))
        return Components(
            o[..., 0].log_softmax(-1),
            self.position_SK3[scene_B] + o[..., 1:4],
            multiply(exp_quaternion(0.5 * o[..., 4:7]), self.quaternion_SK4[scene_B]),
            *(o[..., 7:9] + _FIRST_LOG_SCALE).clamp(*_LOG_SCALES).unbind(-1),
        )

    def loss(self, outputs: Tensor, position_B3: Tensor, quaternion_B4: Tensor, scene_B: Tensor) -> Tensor:
        """Mean negative log-likelihood (without its constant) of the true poses; each component's density falls as
        exp(-distance / scale), in position and in rotation, so that outliers weigh as little as in an L1 loss."""
        c = self.decode(outputs, scene_B)
        metres = torch.linalg.vector_norm(c.position_BK3 - position_B3[:, None], dim=-1)
        radians = torch.linalg.vector_norm(rotation_vector(c.quaternion_BK4, quaternion_B4[:, None]), dim=-1)
        density = -metres * torch.exp(-c.log_position_scale_BK) - 3 * c.log_position_scale_BK
        density = density - radians * torch.exp(-c.log_rotation_scale_BK) - 3 * c.log_rotation_scale_BK
        return -(c.log_weight_BK + density).logsumexp(-1).mean()

    def poses(self, c: Components, scene_B: Tensor) -> PoseBatch:
        """The pose with the smallest expected position and rotation error (geometric medians of the mixture), and the
        covariance of its error: rotation, then position."""
        weight = c.log_weight_BK.exp()
        spread = (2 * c.log_position_scale_BK).exp()
        position = (weight[..., None] * c.position_BK3).sum(1)
        for _ in range(_MEDIAN_STEPS):
            pull = weight / ((c.position_BK3 - position[:, None]).square().sum(-1) + spread).sqrt()
            position = (pull[..., None] * c.position_BK3).sum(1) / pull.sum(-1, keepdim=True)

        turn_spread = (2 * c.log_rotation_scale_BK).exp()
        likeliest = weight.argmax(dim=-1)[:, None, None].expand(-1, 1, 4)
        quaternion = c.quaternion_BK4.gather(1, likeliest).squeeze(1)
        for _ in range(_MEDIAN_STEPS):
            turn = rotation_vector(quaternion[:, None], c.quaternion_BK4)
            pull = weight / (turn.square().sum(-1) + turn_spread).sqrt()
            mean = (pull[..., None] * turn).sum(1) / pull.sum(-1, keepdim=True)
            quaternion = canonical(multiply(exp_quaternion(0.5 * mean), quaternion))

        errors = _offsets(c, position, quaternion)
        covariance = torch.einsum("bk,bki,bkj->bij", weight, errors, errors)
        variances = [(weight * s).sum(-1, keepdim=True).expand(-1, 3) for s in (turn_spread, spread)]
        covariance = covariance + VARIANCE * torch.diag_embed(torch.cat(variances, dim=-1))
        return PoseBatch(position, quaternion, scene_B, covariance)

    def error_sizes(self, c: Components, answer: PoseBatch) -> Tensor:
        """Expected sizes (B, 2) of an answer's rotation error (rad) and position error: geometric means, over the
        components, of two deviations with equal weight, each component's own and its root mean square distance from the
        answer. A far and unlikely component adds less to such a mean than to a covariance, which takes its square."""
        squares = _offsets(c, answer.position_B3, answer.quaternion_B4).square().unflatten(-1, (2, 3)).sum(-1)
        log_scale = torch.stack([c.log_rotation_scale_BK, c.log_position_scale_BK], dim=-1)
        variance = 3 * VARIANCE * (2 * log_scale).exp()
        logs = variance.log() + (variance + squares).log()
        return (c.log_weight_BK.exp()[..., None] * logs / 4).sum(1).exp()


def _offsets(c: Components, position_B3: Tensor, quaternion_B4: Tensor) -> Tensor:
    """The components' poses (B, K, 6) from a pose: rotation (rad), then position."""
    turn = rotation_vector(quaternion_B4[:, None], c.quaternion_BK4)
    return torch.cat([turn, c.position_BK3 - position_B3[:, None]], dim=-1)


def _clusters(position_N3: Array, quaternion_N4: Array, components: int) -> NDArray[np.int64]:
    """A cluster's number for each pose, by position and viewing direction; a cluster can be without poses."""
    points = np.hstack([position_N3, Rotation.from_quat(quaternion_N4).apply([0, 0, 1])])
    if len(np.unique(points, axis=0)) <= components:
        return np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # an empty cluster: its anchor is a pose
        return np.asarray(kmeans2(points, components, minit="++", seed=0)[1], np.int64)
