import pytest
import torch
from references import dense

from torchqm.spectral.splitting import Splitting


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("s", [0, 1, 2, 5, 24, 30])
def test_equals_the_split_descriptors_times_the_weights(s):
    """Against bumps made one by one; 1300 vertices are several blocks, and the second shape has the larger range."""
    values = [noise(1300, 3), 2 * noise(700, 3, seed=1)]
    weights = [noise(1300, 4, seed=2), noise(700, 4, seed=3)]
    splitting = Splitting.of(values, s)
    wanted = dense.split_descriptors(values, s) if s else values
    for v, w, full in zip(values, weights, wanted, strict=True):
        torch.testing.assert_close(splitting.coefficients(v, w), w.T @ full, atol=1e-11, rtol=1e-11)


@pytest.mark.parametrize("s", [5, 9, 10, 11, 15, 24])
def test_single_precision_keeps_its_digits(s):
    """Products of the first bump are of no use where it is below the smallest number."""
    values, weights = noise(900, 3).float(), noise(900, 4, seed=2).float()
    found = Splitting.of([values], s).coefficients(values, weights)
    assert found.dtype == torch.float32
    wanted = weights.double().T @ dense.split_descriptors([values.double()], s)[0]
    torch.testing.assert_close(found.double(), wanted, atol=2e-4, rtol=0)


def test_a_constant_descriptor_is_finite():
    flat = torch.full((10, 2), 3.0, dtype=torch.float64)
    assert bool(torch.isfinite(Splitting.of([flat], 5).coefficients(flat, noise(10, 2))).all())


def test_the_values_stay_as_they_are():
    values = noise(600, 2)
    before = values.clone()
    Splitting.of([values], 5).coefficients(values, noise(600, 3))
    assert torch.equal(values, before)


def test_a_negative_number_of_intervals_is_refused():
    with pytest.raises(ValueError, match="s=-1: the number of intervals is 0"):
        Splitting.of([noise(3, 1)], -1)
