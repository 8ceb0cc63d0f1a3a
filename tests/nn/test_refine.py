"""torchqm.nn.refine: the layers are the functions with their options, and learn their temperature."""

import pytest
import torch

from torchqm.fmap.unrolled import soft_icp, soft_upsample
from torchqm.nn.refine import QuotientICP, SpectralUpsampling


def inputs():
    generator = torch.Generator().manual_seed(0)
    x, y = (torch.randn(2, n, 6, generator=generator, dtype=torch.float64) for n in (30, 40))
    return torch.eye(4, dtype=torch.float64).expand(2, 4, 4), x, y, torch.rand(2, 30, generator=generator).double()


def test_layers_are_the_functions():
    fmap, x, y, mass = inputs()
    mask = torch.arange(40) < torch.tensor([[40], [25]])
    found = QuotientICP(2, 0.5, neighbours=5).double()(fmap, x[..., :4], y[..., :4], mass, mask)
    expected = soft_icp(fmap, x[..., :4], y[..., :4], 2, 0.5, 5, mass, mask)
    torch.testing.assert_close(found, expected)
    found = SpectralUpsampling((5, 6), 2, 0.5).double()(fmap, x, y, mass, mask)
    torch.testing.assert_close(found, soft_upsample(fmap, x, y, (5, 6), 2, 0.5, None, mass, mask))


@pytest.mark.parametrize("make", [lambda **o: QuotientICP(1, **o), lambda **o: SpectralUpsampling((4,), **o)])
def test_the_temperature_is_learned(make):
    fmap, x, y, mass = inputs()
    layer = make(tau=0.3, learn_tau=True)
    assert not list(make(tau=0.3).parameters())
    layer(fmap, x[..., :4], y[..., :4], mass)[:, 0, 0].sum().backward()
    assert float(layer.log_tau.grad.abs()) > 0
    assert "tau=0.3" in repr(layer)


def test_shapes_of_a_batch_may_have_different_numbers_of_functions():
    fmap, x, y, mass = inputs()
    masks = torch.arange(6) < torch.tensor([[6], [5]]), torch.arange(6) < torch.tensor([[4], [6]])
    layer = SpectralUpsampling((5, 6), 2, 0.5)
    found = layer(fmap, x, y, mass, evals_mask_x=masks[0], evals_mask_y=masks[1])
    torch.testing.assert_close(found, soft_upsample(fmap, x, y, (5, 6), 2, 0.5, None, mass, None, *masks))
    assert not found[0, 4:].any()
    assert not found[1, :, 5:].any()
