"""torchqm.nn.soft_map: ULRSSM's Similarity, and the layer over soft_map with its temperature."""

import pytest
import torch

from torchqm.fmap.soft import soft_map
from torchqm.nn.soft_map import Similarity, SoftPointMap
from torchqm.spectral import SoftMap


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("dim", [-1, 1])
@pytest.mark.parametrize("hard", [False, True])
def test_similarity_as_in_ulrssm(dim, hard):
    log_alpha = noise(2, 5, 6).requires_grad_()
    weights = noise(2, 5, 6, seed=1)
    got = Similarity(normalise_dim=dim, tau=0.3, hard=hard)(log_alpha)
    # exp(a / tau - logsumexp(a / tau)); hard: one at the largest entry, plus the soft one minus its detached self
    scaled = log_alpha / 0.3
    soft = (scaled - scaled.logsumexp(dim, keepdim=True)).exp()
    one_hot = (soft == soft.amax(dim, keepdim=True)).double()
    expected = one_hot - soft.detach() + soft if hard else soft
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)
    grads = [torch.autograd.grad((out * weights).sum(), log_alpha)[0] for out in (got, expected)]
    torch.testing.assert_close(*grads, rtol=1e-12, atol=1e-12)


def test_similarity_by_default():
    layer = Similarity()
    assert (layer.dim, layer.tau, layer.hard) == (-1, 0.2, False)
    assert repr(layer) == "Similarity(normalise_dim=-1, tau=0.2, hard=False)"


@pytest.mark.parametrize("k", [None, 3])
def test_the_layer_is_the_function(k):
    x, y = noise(2, 5, 4), noise(2, 6, 4, seed=1)
    mask_x, mask_y = torch.arange(5) < torch.tensor([[5], [3]]), torch.arange(6) < torch.tensor([[4], [6]])
    include = torch.full((2, 5, 1), 3) if k else None
    layer = SoftPointMap(0.4, k=k, kind="distance", normalize=True, chunk=2 if k else None)
    got = layer(x, y, mask_x, mask_y, include)
    options = {"kind": "distance", "normalize": True, "include": include, "chunk": 2 if k else None}
    expected = soft_map(x, y, 0.4, k, mask_x, mask_y, **options)
    for a, b in zip(
        *((m.indices, m.weights) if isinstance(m, SoftMap) else (m,) for m in (got, expected)), strict=True
    ):
        assert torch.equal(a, b)
    assert list(layer.parameters()) == []


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("k", [None, 3])
def test_a_learned_temperature(k, dtype):
    x, y = noise(1, 5, 4).to(dtype), noise(1, 6, 4, seed=1).to(dtype)
    layer = SoftPointMap(0.4, learn_tau=True, k=k)
    out = layer(x, y)
    weights = out.weights if k else out
    assert weights.dtype == dtype
    entropy = -(weights * weights.clamp_min(1e-9).log()).sum()
    entropy.backward()
    assert layer.log_tau.grad.item() > 0.1  # warmer is more even
    assert layer.tau.item() == pytest.approx(0.4)
    assert "learn_tau=True" in repr(layer)
    again = SoftPointMap(0.1, learn_tau=True)
    again.load_state_dict(layer.state_dict())
    assert again.tau.item() == pytest.approx(0.4)


def test_bad_options():
    with pytest.raises(ValueError, match="chunk: 5 given, but only of use together with k"):
        SoftPointMap(chunk=5)
    with pytest.raises(ValueError, match="dim: 2 given, but log_alpha has 2 dimensions"):
        Similarity(normalise_dim=2)(torch.zeros(2, 2))
    with pytest.raises(ValueError, match=r"log_alpha: shape \(2, 0\) given, expected entries along dimension -1"):
        Similarity()(torch.zeros(2, 0))
    with pytest.raises(ValueError, match="log_alpha: 1 of 2 entries are NaN"):
        Similarity()(torch.tensor([0.0, torch.nan]))
