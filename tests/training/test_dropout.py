"""Dropout by vectors of random integers: the same mean, gradients that match, repeatable by the seed."""

import pytest
import torch

from groundwalk.training.models.dropout import Dropout, dropped
from groundwalk.training.models.ms_transformer import Attention


def test_as_many_are_left_out_as_asked_and_the_mean_stays() -> None:
    torch.manual_seed(0)
    x = torch.ones(1000, 1000)
    left = dropped(x, 0.1)
    assert float((left == 0).float().mean()) == pytest.approx(0.1, abs=0.001)
    assert float(left.mean()) == pytest.approx(1, abs=0.001)
    assert left.unique().tolist() == pytest.approx([0, 1 / 0.9], rel=1e-4)


def test_a_seed_repeats_it_and_a_step_changes_it() -> None:
    x = torch.ones(64, 64)
    torch.manual_seed(3)
    first, second = dropped(x, 0.5), dropped(x, 0.5)
    torch.manual_seed(3)
    assert torch.equal(dropped(x, 0.5), first) and not torch.equal(first, second)


def test_gradients_flow_where_the_values_did() -> None:
    x = torch.randn(40, 50, requires_grad=True)
    left = dropped(x, 0.3)
    left.sum().backward()
    assert x.grad is not None
    assert torch.equal(x.grad == 0, left == 0) and x.grad.max().item() == pytest.approx(1 / 0.7, rel=1e-4)


def test_nothing_is_left_out_in_eval_mode() -> None:
    x = torch.randn(5, 5)
    assert torch.equal(Dropout(0.5).eval()(x), x) and torch.equal(Dropout(0.0)(x), x)
    assert not torch.equal(Dropout(0.5)(x), x)


def test_attention_without_what_is_left_out_is_pytorchs(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    attention = Attention(0.1)
    query, key = torch.randn(2, 5, 256), torch.randn(2, 7, 256)
    expected = attention.eval().attend(query, key, key)
    monkeypatch.setattr("groundwalk.training.models.ms_transformer.dropped", lambda x, _: x)
    assert torch.allclose(attention.train().attend(query, key, key), expected, atol=1e-5)
