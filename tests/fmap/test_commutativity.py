"""torchqm.fmap.commutativity: the three kinds against the formulas as written, gradients where powers have none."""

import pytest
import torch
from references.fmap_layers import resolvent_mask

from torchqm.fmap import commutativity_energy
from torchqm.fmap.commutativity import COMMUTATIVITY, commutativity_mask, spectral_scale
from torchqm.testing import gradcheck64

X, Y = torch.tensor([0.0, 1.0, 3.0, 7.5]).double(), torch.tensor([0.0, 1.5, 2.0]).double()


def test_resolvent_as_real_and_imaginary_parts():
    for gamma in (0.3, 0.5, 1.0):
        torch.testing.assert_close(commutativity_mask(X, Y, "resolvent", gamma), resolvent_mask(X, Y, gamma))


def test_squared_is_the_commutator():
    fmap = torch.arange(12.0).double().view(3, 4).sin()
    commutator = fmap @ torch.diag(X) - torch.diag(Y) @ fmap
    squared = commutativity_mask(X, Y, "squared")
    torch.testing.assert_close((squared * fmap.square()).sum(), commutator.square().sum())
    torch.testing.assert_close((squared * fmap.square()).sum(), commutativity_energy(fmap, X, Y))
    torch.testing.assert_close(commutativity_mask(X, Y, "normalized"), squared / 7.5**2)


@pytest.mark.parametrize("kind", COMMUTATIVITY)
def test_batches_and_given_scales(kind):
    x, y = torch.stack([X, 2 * X]), torch.stack([Y, 10 * Y])
    both = commutativity_mask(x, y, kind)
    for i in range(2):
        torch.testing.assert_close(both[i], commutativity_mask(x[i], y[i], kind))
    assert torch.equal(spectral_scale(x, y), torch.tensor([7.5, 20.0]).double())
    given = commutativity_mask(x, y, kind, scale=torch.tensor([7.5, 7.5]).double())
    torch.testing.assert_close(given[0], both[0])
    assert torch.equal(given, both) == (kind == "squared")


@pytest.mark.parametrize("kind", COMMUTATIVITY)
def test_gradients_also_at_equal_eigenvalues(kind):
    x = torch.tensor([0.5, 1.0, 1.0, 1.0 + 1e-9, 4.0]).double()
    assert gradcheck64(lambda a, b: commutativity_mask(a, b, kind), x, torch.tensor([0.25, 1.0, 1.0, 2.0]).double())


def test_the_constant_function_has_no_infinite_slope():
    x = torch.tensor([-1e-17, 0.0, 1.0]).double().requires_grad_()
    mask = commutativity_mask(x, Y)
    (slope,) = torch.autograd.grad(mask.sum(), x)
    assert torch.equal(mask[:, 0], mask[:, 1])
    assert slope[:2].tolist() == [0, 0]
    assert torch.isfinite(slope).all()
    zero = torch.zeros(3)
    assert commutativity_mask(zero, zero, "normalized").abs().max() == 0  # not 0 / 0


@pytest.mark.parametrize("rounding", [0.0, 1e-27, 1e-16, -1e-17])
def test_rounding_of_zero_has_a_value_and_no_slope(rounding):
    """The Rayleigh quotient of the constant function comes out as 1e-30 or so: the slope there would be 1e15."""
    x = X.clone().index_fill_(0, torch.tensor(0), rounding).requires_grad_()
    mask = commutativity_mask(x, Y)
    torch.testing.assert_close(mask.detach(), commutativity_mask(X, Y), atol=1e-7, rtol=0)
    (grad,) = torch.autograd.grad(mask.sum(), x)
    assert float(grad[0]) == 0.0
    assert float(grad.abs().max()) < 10


def test_refusals():
    with pytest.raises(ValueError, match="commutativity is 'cubic'; allowed are squared, normalized, resolvent"):
        commutativity_mask(X, Y, "cubic")
    with pytest.raises(ValueError, match="gamma is 0"):
        commutativity_mask(X, Y, gamma=0)
