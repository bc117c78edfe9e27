"""Covariances of poses in the map frame: rotation (rad) first, then position (m), of errors `true rotation =
exp(rotation) estimated rotation`, as in the tables of poses."""

import torch
from torch import Tensor

from groundwalk.training.models.regressor import PoseBatch, SceneFrames
from groundwalk.training.rotations import conjugate, log_quaternion, multiply

# Below a millimetre and a hundredth of a degree a covariance from samples says nothing.
_FLOOR = torch.tensor([2e-4] * 3 + [1e-3] * 3)


def rotation_vector(q_from_B4: Tensor, q_to_B4: Tensor) -> Tensor:
    """The rotations (..., 3), rad, in the axes of the reference frame, after which `q_from` becomes `q_to`."""
    return 2 * log_quaternion(multiply(q_to_B4, conjugate(q_from_B4)))


def with_scatter(answer: PoseBatch, position_SB3: Tensor, quaternion_SB4: Tensor, weight_SB: Tensor) -> PoseBatch:
    """The answer with the scatter of S weighted poses around it as its covariance (B, 6, 6), all in the map frame;
    weights sum to one over S."""
    rotation = rotation_vector(answer.quaternion_B4.expand_as(quaternion_SB4), quaternion_SB4)
    error = torch.cat([rotation, position_SB3 - answer.position_B3], dim=-1)
    covariance = torch.einsum("sb,sbi,sbj->bij", weight_SB, error, error)
    return answer._replace(covariance_B66=covariance + torch.diag(_FLOOR.to(covariance.device).square()))


def diagonal_in_map(frames: SceneFrames, scene_B: Tensor, rotation_sd_B3: Tensor, position_sd_B3: Tensor) -> Tensor:
    """Covariances (B, 6, 6) in the map frame of standard deviations by axis in the frame that the network regresses
    in."""
    axes = torch.eye(3, device=scene_B.device).expand(len(scene_B), 3, 3)
    turn = frames.turn[scene_B][:, None].expand(-1, 3, 4)
    as_quaternion = torch.cat([axes, torch.zeros_like(axes[..., :1])], dim=-1)
    map_R_net = multiply(multiply(turn, as_quaternion), conjugate(turn))[..., :3].mT
    rotation = map_R_net @ torch.diag_embed(rotation_sd_B3.square()) @ map_R_net.mT
    position = torch.diag_embed((position_sd_B3 * frames.scale[scene_B]).square())
    zero = torch.zeros_like(rotation)
    return torch.cat([torch.cat([rotation, zero], -1), torch.cat([zero, position], -1)], -2)
