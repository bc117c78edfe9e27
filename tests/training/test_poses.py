import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.training.poses import conjugate, exp_quaternion, log_quaternion, multiply

numbers = st.floats(-1, 1, allow_subnormal=False)
quaternions = st.tuples(*[numbers] * 4).filter(lambda q: sum(x * x for x in q) > 1e-2)
small = st.floats(-1e-7, 1e-7)


def unit(q: tuple[float, ...]) -> torch.Tensor:
    tensor = torch.tensor([q], dtype=torch.float64)
    return tensor / tensor.norm()


@given(quaternions)
def test_log_and_exp_are_inverse_and_agree_with_scipy(q: tuple[float, ...]) -> None:
    quaternion = unit(q)
    log = log_quaternion(quaternion)
    assert float((exp_quaternion(log) * quaternion).sum().abs()) > 1 - 1e-12
    half_rotvec = Rotation.from_quat(quaternion.numpy()).as_rotvec() / 2
    if abs(quaternion[0, 3]) > 1e-6:  # at a half turn both axes are right
        assert torch.allclose(log, torch.tensor(half_rotvec), atol=1e-8)
        assert torch.allclose(log_quaternion(-quaternion), log, atol=1e-8)


@given(st.tuples(small, small, small))
def test_logarithm_is_safe_at_the_identity(v: tuple[float, float, float]) -> None:
    log = torch.tensor([v], dtype=torch.float64, requires_grad=True)
    back = log_quaternion(exp_quaternion(log))
    assert torch.allclose(back, log, atol=1e-12)
    (gradient,) = torch.autograd.grad(back.sum(), log)
    assert torch.isfinite(gradient).all()


@given(quaternions, quaternions)
def test_product_is_the_product_of_rotations(a: tuple[float, ...], b: tuple[float, ...]) -> None:
    expected = Rotation.from_quat(unit(a)[0].numpy()) * Rotation.from_quat(unit(b)[0].numpy())
    found = Rotation.from_quat(multiply(unit(a), unit(b))[0].numpy())
    assert (expected.inv() * found).magnitude() < 1e-7
    identity = multiply(unit(a), conjugate(unit(a)))
    assert torch.allclose(identity, torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64), atol=1e-12)
