"""Covariances from the scatter of training frames that look alike."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from groundwalk.training.data import pose_batch
from groundwalk.training.models.uncertainty import rotation_vector, widening
from groundwalk.training.neighbours import MIN_HELD_OUT, neighbour_covariances
from groundwalk.training.poses import PoseBatch

TRAINING, HELD_OUT, TEST = 400, 40, 400
N = TRAINING + HELD_OUT + TEST


def walk(seed: int = 0) -> tuple[Tensor, PoseBatch, PoseBatch]:
    """Descriptors, answers and truth of frames along a corridor. Towards its end places look ever more alike, and the
    answers are wrong by as much."""
    rng = np.random.default_rng(seed)
    along = rng.uniform(0, 20, N)
    blur = 0.05 + 0.1 * along
    descriptor = np.column_stack([along + blur * rng.normal(size=N), np.ones(N)])
    position = np.column_stack([along, np.full(N, 1.5), rng.normal(0, 0.3, N)])
    turn = Rotation.from_rotvec(np.column_stack([np.zeros(N), along / 10 + rng.normal(0, 0.1, N), np.zeros(N)]))
    error = rng.normal(size=(N, 6)) * blur[:, None] * [0.01, 0.1, 0.01, 1, 0.05, 0.5]
    # Errors are along the camera's axes.
    answered = Rotation.from_rotvec(turn.apply(error[:, :3])).inv() * turn
    zeros, cpu = np.zeros(N, np.int64), torch.device("cpu")
    truth = pose_batch(position, turn.as_quat(), zeros, cpu)
    answers = pose_batch(position - turn.apply(error[:, 3:]), answered.as_quat(), zeros, cpu)
    return torch.tensor(descriptor, dtype=torch.float32), answers, truth


def normalised(covariance: Tensor, answers: PoseBatch, truth: PoseBatch) -> list[Tensor]:
    """Squared errors of the test frames in units of the covariances: rotation, position."""
    errors = rotation_vector(answers.quaternion_B4, truth.quaternion_B4), truth.position_B3 - answers.position_B3
    blocks = covariance[:, :3, :3], covariance[:, 3:, 3:]
    return [
        (e * torch.linalg.solve(c.double(), e.double())).sum(-1)[-TEST:] for e, c in zip(errors, blocks, strict=True)
    ]


def stated(held_out: int, seed: int = 0) -> tuple[Tensor | None, PoseBatch, PoseBatch]:
    descriptor, answers, truth = walk(seed)
    rows = torch.arange(TRAINING), torch.arange(TRAINING, TRAINING + held_out)
    return neighbour_covariances(descriptor, answers, truth, *rows), answers, truth


def test_bounds_hold_the_errors_and_tell_large_from_small_ones() -> None:
    covariance, answers, truth = stated(HELD_OUT)
    assert covariance is not None
    assert np.allclose(covariance, covariance.mT, rtol=1e-9)  # fusion refuses what isn't
    for squared in normalised(covariance, answers, truth):
        assert 0.85 < float((squared < 7.81).double().mean()) < 0.995
    error = torch.linalg.vector_norm(truth.position_B3 - answers.position_B3, dim=-1)[-TEST:].numpy()
    size = torch.diagonal(covariance, dim1=1, dim2=2)[-TEST:, 3:].sum(-1).numpy()
    assert np.corrcoef(np.argsort(np.argsort(size)), np.argsort(np.argsort(error)))[0, 1] > 0.4
    yaw, pitch = covariance[:, 1, 1].mean(), covariance[:, 0, 0].mean()
    assert yaw > 20 * pitch  # each axis has its own size


def test_few_held_out_frames_widen_and_too_few_say_nothing() -> None:
    assert stated(MIN_HELD_OUT - 1)[0] is None
    assert widening(0) == widening(3) > widening(5) > widening(10) > widening(40) > 1
    assert widening(100_000) == pytest.approx(1, abs=1e-3)
    inside = []
    for seed in range(20):
        covariance, answers, truth = stated(6, seed)
        assert covariance is not None
        inside += [float((squared < 7.81).double().mean()) for squared in normalised(covariance, answers, truth)]
    assert np.mean(inside) > 0.95


def test_alike_training_frames_give_positive_definite_covariances() -> None:
    descriptor, _, truth = walk()
    same = PoseBatch(truth.position_B3[:1].expand(N, 3), truth.quaternion_B4[:1].expand(N, 4), truth.scene_B)
    rows = torch.arange(TRAINING), torch.arange(TRAINING, TRAINING + HELD_OUT)
    covariance = neighbour_covariances(torch.zeros_like(descriptor), same, same, *rows)
    assert covariance is not None and bool((torch.linalg.eigvalsh(covariance.double()) > 0).all())
