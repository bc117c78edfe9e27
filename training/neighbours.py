"""Covariances for regressors that state none, from training frames that look alike to the network.

What a pose is computed from, the network's *descriptor* of an image, is compared with those of the training frames.
Where the nearest of them were taken at places far apart, or far from the answer, the network can't tell these places
from each other, and its answer is as uncertain as they are scattered. So the scatter says how the size of errors
differs from frame to frame; held-out frames say how large they are.
"""

import torch
from torch import Tensor

from groundwalk.training.models.uncertainty import FLOOR, CovarianceScale, rotation_vector
from groundwalk.training.poses import PoseBatch, as_matrix

MIN_HELD_OUT = 4
"""With fewer held-out frames there is no covariance: no factor makes up for not knowing the errors' size."""
_NEIGHBOURS = 16


def neighbour_covariances(
    descriptor_ND: Tensor, answers: PoseBatch, truth: PoseBatch, training: Tensor, held_out: Tensor
) -> Tensor | None:
    """Covariances (N, 6, 6) of the answers' errors, rotation (rad) then position (m), in the map frame.

    `training` and `held_out` are row numbers of frames whose `truth` is known. None where too few are held out.
    Standard deviations are proportional to `scatter_sizes`, with a factor for each of the camera's axes such that the
    held-out errors have the right mean square, then scaled as `CovarianceScale` does.
    """
    if len(held_out) < MIN_HELD_OUT:
        return None
    # Single precision leaves a covariance unsymmetric enough to be refused.
    answers, truth = _double(answers), _double(truth)
    size_N = scatter_sizes(descriptor_ND, answers, truth, training)
    map_R_cam = as_matrix(answers.quaternion_B4)
    rotation = rotation_vector(answers.quaternion_B4[held_out], truth.quaternion_B4[held_out])
    error = torch.stack([rotation, truth.position_B3[held_out] - answers.position_B3[held_out]], dim=1)
    in_camera_H6 = (error @ map_R_cam[held_out]).flatten(1)
    variance_6 = (in_camera_H6 / size_N[held_out, None]).square().mean(0)
    map_T_cam_N66 = torch.zeros(len(size_N), 6, 6, dtype=size_N.dtype)
    map_T_cam_N66[:, :3, :3] = map_T_cam_N66[:, 3:, 3:] = map_R_cam
    covariance_N66 = size_N[:, None, None].square() * (map_T_cam_N66 @ torch.diag(variance_6) @ map_T_cam_N66.mT)
    covariance_N66 += torch.diag(FLOOR.to(size_N).square())
    scale = CovarianceScale()
    scale.fit(_rows(answers, held_out)._replace(covariance_B66=covariance_N66[held_out]), _rows(truth, held_out))
    return scale(covariance_N66)


def scatter_sizes(descriptor_ND: Tensor, answers: PoseBatch, truth: PoseBatch, training: Tensor) -> Tensor:
    """How far from the answers the nearest training frames by descriptor were taken, (N,): the root of the product of
    their root mean square distance (m) and angle (rad)."""
    bank_TD = descriptor_ND[training]
    nearest_NK = torch.cdist(descriptor_ND, bank_TD).topk(min(_NEIGHBOURS, len(training)), largest=False).indices
    position, quaternion = truth.position_B3[training][nearest_NK], truth.quaternion_B4[training][nearest_NK]
    squares = (
        (position - answers.position_B3[:, None]).square().sum(-1).mean(-1),
        rotation_vector(answers.quaternion_B4[:, None], quaternion).square().sum(-1).mean(-1),
    )
    return (squares[0] * squares[1]).pow(0.25).clamp_min(1e-6)


def _double(poses: PoseBatch) -> PoseBatch:
    return PoseBatch(poses.position_B3.double(), poses.quaternion_B4.double(), poses.scene_B)


def _rows(poses: PoseBatch, rows: Tensor) -> PoseBatch:
    return PoseBatch(poses.position_B3[rows], poses.quaternion_B4[rows], poses.scene_B[rows])
