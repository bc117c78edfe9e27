"""Attention with dropout: true values and gradients of what it leaves out."""

import pytest
import torch
from torch import Tensor, nn

from groundwalk.training.models.attention import attention
from groundwalk.training.models.ms_transformer import Attention


def tensors(*counts: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(2, 3, n, 4, dtype=torch.float64, generator=generator, requires_grad=True) for n in counts]


def test_attention_has_the_values_and_gradients_of_what_it_computes() -> None:
    """With the mask that the same seed gives equal weights, which values of one cell each show."""
    torch.manual_seed(0)
    like = torch.zeros(2, 3, 5, 7), torch.zeros(2, 3, 7, 7), torch.eye(7).expand(2, 3, -1, -1)
    mask = (attention(*like, 0.5) > 0).double()
    assert 0.3 < float(mask.mean()) < 0.7 and not torch.equal(mask[0, 0], mask[0, 1])
    mine, plain = tensors(5, 7, 7), tensors(5, 7, 7)
    q, k, v = mine
    torch.manual_seed(0)
    answer = attention(q, k, v, 0.5)
    q, k, v = plain
    expected = (torch.softmax(q @ k.transpose(-1, -2) / 2, dim=-1) * mask * 2) @ v
    assert torch.allclose(answer, expected, atol=1e-6)
    weight = torch.randn(answer.shape, dtype=torch.float64)
    (answer * weight).sum().backward()
    (expected * weight).sum().backward()
    for one, other in zip(mine, plain, strict=True):
        assert one.grad is not None and other.grad is not None
        assert torch.allclose(one.grad, other.grad, atol=1e-5)


def test_attention_of_scores_far_apart_is_finite_and_of_nan_is_nan() -> None:
    q, k, v = torch.tensor([[3e3], [-3e3], [float("nan")]]), torch.tensor([[1.0], [-1.0]]), torch.tensor([[2.0], [5.0]])
    answer = attention(q[None], k[None], v[None], 1e-6)[0, :, 0]
    assert answer[:2].tolist() == [2, 5] and answer[2].isnan()


def test_attention_that_leaves_nothing_out_is_pytorchs(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    module = Attention(0.1)
    query, key = torch.randn(2, 5, 256), torch.randn(2, 7, 256)
    expected = module.eval().attend(query, key, key)
    module.train().dropout = 1e-6
    assert torch.allclose(module.attend(query, key, key), expected, atol=1e-5)


@pytest.mark.parametrize("queries", [1, 7, 40])
def test_few_queries_attend_as_many_do(queries: int) -> None:
    """Values and gradients; a bias of the keys has none."""
    torch.manual_seed(0)
    module = Attention(0.1).double().eval()
    nn.init.normal_(module.in_proj_bias)
    parts = [torch.randn(2, n, 256, dtype=torch.float64, requires_grad=True) for n in (queries, 50, 50)]
    weight = torch.randn(2, queries, 256, dtype=torch.float64)
    gradients = []
    for attend in (module.attend, module.attend_from_few):
        answer = attend(*parts)
        (answer * weight).sum().backward()
        every = [*parts, *module.parameters()]
        gradients.append([answer, *(x.grad.clone() for x in every if x.grad is not None)])
        for x in every:
            x.grad = None
    assert len(gradients[0]) == len(gradients[1]) == 8
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other, atol=1e-10)


def test_few_queries_keep_the_mean_with_dropout() -> None:
    torch.manual_seed(0)
    module = Attention(0.5)
    nn.init.normal_(module.in_proj_bias)
    query, key = torch.randn(1, 1, 256).expand(2000, -1, -1), torch.randn(1, 30, 256).expand(2000, -1, -1)
    with torch.no_grad():
        mean = module.train().attend_from_few(query, key, key).mean(0)
        assert torch.allclose(mean, module.eval().attend(query[:1], key[:1], key[:1])[0], atol=0.05)
