import torch

from torchqm.geometry.mean_square import unit_mean_square
from torchqm.testing import gradcheck64


def test_mean_square_is_one_whatever_the_size_and_the_padding():
    values, mass = torch.rand(2, 5, 3, dtype=torch.float64), torch.rand(2, 5, dtype=torch.float64)
    mass[1, 3:], values[1, 3:] = 0.0, 7.0  # padding, whatever it holds
    found = unit_mean_square(torch.tensor([1e-4, 1e4])[:, None, None] * values, mass)
    square = (mass * found.square().sum(-1)).sum(-1) / mass.sum(-1)
    torch.testing.assert_close(square, torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(found[..., 0] / found[..., 1], values[..., 0] / values[..., 1])


def test_zero_stays_zero_with_a_finite_gradient():
    values = torch.zeros(4, 2, requires_grad=True)
    unit_mean_square(values, torch.ones(4)).sum().backward()
    assert values.grad.isfinite().all()
    assert unit_mean_square(values, torch.ones(4)).abs().max() == 0


def test_gradient():
    values, mass = torch.rand(5, 2, dtype=torch.float64), torch.rand(5, dtype=torch.float64)
    gradcheck64(unit_mean_square, values, mass)
