"""Poses and rotations inside the networks: xyzw quaternions as tensors and their logarithms.

The logarithm of a unit quaternion (v, w) with w >= 0 is the axis times half the rotation angle, at most pi/2 long
(the rotation code of MapNet, Brahmbhatt et al., 2018).
"""

from typing import NamedTuple

import torch
from torch import Tensor

_SMALL = 1e-4


class PoseBatch(NamedTuple):
    """Camera poses map_T_cam of a batch: positions (m), unit xyzw quaternions, and the index of each one's scene.

    covariance_B66: of each pose's error in the map frame, rotation (rad) then translation (m), from a regressor that
    gives one.
    """

    position_B3: Tensor
    quaternion_B4: Tensor
    scene_B: Tensor
    covariance_B66: Tensor | None = None


def canonical(q_B4: Tensor) -> Tensor:
    """The same rotations as unit quaternions with w >= 0; differentiable except at zero length."""
    q_B4 = q_B4 / torch.linalg.vector_norm(q_B4, dim=-1, keepdim=True).clamp_min(1e-12)
    return torch.where(q_B4[..., 3:] < 0, -q_B4, q_B4)


def log_quaternion(q_B4: Tensor) -> Tensor:
    """Logarithms (..., 3) of unit quaternions (..., 4), taken on the hemisphere w >= 0."""
    q_B4 = canonical(q_B4)
    v, w = q_B4[..., :3], q_B4[..., 3:]
    sine = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    # Where the angle vanishes, angle / sine has the limit 1 / w.
    ratio = torch.where(sine > _SMALL, torch.atan2(sine, w) / sine.clamp_min(_SMALL), 1 / w.clamp_min(_SMALL))
    return v * ratio


def exp_quaternion(log_B3: Tensor) -> Tensor:
    """Unit quaternions (..., 4) with w >= 0 of logarithms (..., 3) of any length."""
    angle = torch.linalg.vector_norm(log_B3, dim=-1, keepdim=True)
    # torch.sinc(x) is sin(pi x) / (pi x), and 1 at 0.
    return canonical(torch.cat([log_B3 * torch.sinc(angle / torch.pi), torch.cos(angle)], dim=-1))


def multiply(a_B4: Tensor, b_B4: Tensor) -> Tensor:
    """Quaternion products (..., 4): the rotation b followed by the rotation a."""
    av, aw = a_B4[..., :3], a_B4[..., 3:]
    bv, bw = b_B4[..., :3], b_B4[..., 3:]
    v = aw * bv + bw * av + torch.linalg.cross(av, bv)
    return torch.cat([v, aw * bw - (av * bv).sum(-1, keepdim=True)], dim=-1)


def conjugate(q_B4: Tensor) -> Tensor:
    """Inverse rotations of unit quaternions (..., 4)."""
    return torch.cat([-q_B4[..., :3], q_B4[..., 3:]], dim=-1)


def rotation_vector(q_from_B4: Tensor, q_to_B4: Tensor) -> Tensor:
    """The rotations (..., 3), rad, in the axes of the reference frame, after which `q_from` becomes `q_to`."""
    return 2 * log_quaternion(multiply(q_to_B4, conjugate(q_from_B4)))
