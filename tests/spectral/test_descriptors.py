"""torchqm.spectral.descriptors: the formulas written out, and what they conserve."""

from math import log

import pytest
import torch
from references import dense
from references.shapes import basis_of, blob, icosphere

from torchqm.spectral import (
    SpectralBasis,
    heat_kernel_signature,
    heat_times,
    split_descriptors,
    unit_columns,
    wave_energies,
    wave_kernel_signature,
)


@pytest.fixture(scope="module")
def bases():
    return [basis_of(blob(order).mesh, 20) for order in (1, 2)]


def single(basis):
    return SpectralBasis(basis.evals.float(), basis.evecs.float(), basis.mass.float())


def test_wave_energies_follow_the_rule_of_aubry(bases):
    energies = wave_energies(bases, 100)
    low = (log(bases[0].evals[1]) + log(bases[1].evals[1])) / 2
    high = (log(bases[0].evals[-1]) + log(bases[1].evals[-1])) / 2
    grid = energies.log_energies
    delta = (grid[-1] - grid[0]) / 100
    assert grid.shape == (100,)
    assert energies.sigma == pytest.approx(7 * float(delta))
    assert float(grid[0]) == pytest.approx(low + 2 * energies.sigma)
    assert float(grid[-1]) == pytest.approx(high - 2 * energies.sigma)


def test_wave_kernel_signature_is_the_formula(bases):
    energies = wave_energies(bases, 12)
    for basis in bases:
        slow = dense.wave_kernel_signature(basis, energies.log_energies, energies.sigma)
        torch.testing.assert_close(wave_kernel_signature(basis, energies), slow)


def test_heat_kernel_signature_is_the_formula(bases):
    times = heat_times(bases, 7)
    for basis in bases:
        torch.testing.assert_close(heat_kernel_signature(basis, times), dense.heat_kernel_signature(basis, times))


def test_signatures_integrate_to_one(bases):
    basis = bases[0]
    for values in (
        wave_kernel_signature(basis, wave_energies([basis], 30)),
        heat_kernel_signature(basis, heat_times([basis], 30)),
    ):
        torch.testing.assert_close(basis.mass @ values, torch.ones(30, dtype=torch.float64))
        assert values.min() >= 0


def test_heat_times(bases):
    times = heat_times(bases[:1], 5)
    assert float(times[0] * bases[0].evals[-1]) == pytest.approx(4 * log(10))
    assert float(times[-1] * bases[0].evals[1]) == pytest.approx(4 * log(10))
    assert times.log().diff().std() < 1e-12
    flat = heat_kernel_signature(bases[0], torch.tensor([1e3], dtype=torch.float64))
    torch.testing.assert_close(flat, torch.full_like(flat, 1 / float(bases[0].mass.sum())))


def test_signatures_of_the_sphere_are_constant():
    basis = basis_of(icosphere(4), 25)  # whole clusters
    for values in (
        wave_kernel_signature(basis, wave_energies([basis], 10)),
        heat_kernel_signature(basis, heat_times([basis], 10)),
    ):
        assert (values * float(basis.mass.sum()) - 1).abs().max() < 0.02


def test_single_precision(bases):
    basis = single(bases[0])
    wave = wave_kernel_signature(basis, wave_energies([basis], 10))
    heat = heat_kernel_signature(basis, heat_times([basis], 10))
    assert (wave.dtype, heat.dtype) == (torch.float32, torch.float32)
    exact = wave_kernel_signature(bases[0], wave_energies(bases[:1], 10))
    torch.testing.assert_close(wave.double(), exact, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("s", [1, 2, 5])
def test_split_is_the_formula_on_the_common_range(bases, s):
    energies = wave_energies(bases, 3)
    values = [wave_kernel_signature(b, energies)[::9] for b in bases]
    values[1] = values[1][:40]  # shapes may differ in size
    for fast, slow in zip(split_descriptors(values, s), dense.split_descriptors(values, s), strict=True):
        torch.testing.assert_close(fast, slow)


def test_split_means_the_same_on_each_shape():
    a = torch.tensor([[0.0], [1.0]], dtype=torch.float64)
    b = torch.tensor([[1.0], [5.0], [2.0]], dtype=torch.float64)
    first, second = split_descriptors([a, b], 5)
    assert (first.shape, second.shape) == ((2, 5), (3, 5))
    torch.testing.assert_close(first[1], second[0])  # equal values, equal bumps
    assert first[1, 0] == 1  # the first centre lies at 0 + 1
    assert second[1].argmax() == 4


def test_split_zero_returns_the_input(bases):
    values = [b.evecs for b in bases]
    assert all(x is y for x, y in zip(split_descriptors(values, 0), values, strict=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_constant_descriptors_stay_finite(dtype):
    flat = torch.full((4, 1), 3.0, dtype=dtype)
    assert all(bool(torch.isfinite(v).all()) for v in split_descriptors([flat, flat], 5))
    assert all(bool((c == 0).all()) for c in unit_columns([0 * flat, 0 * flat]))


def test_unit_columns_use_one_factor_for_all():
    a = torch.tensor([[3.0, 0.0], [4.0, 2.0]], dtype=torch.float64)
    b = torch.tensor([[5.0, 2.0], [5.0, 0.0], [0.0, 0.0]], dtype=torch.float64)
    first, second = unit_columns([a, b])
    torch.testing.assert_close(first, a / torch.tensor([37.5**0.5, 2.0], dtype=torch.float64))
    torch.testing.assert_close(second, b / torch.tensor([37.5**0.5, 2.0], dtype=torch.float64))


def test_refusals(bases):
    tiny = bases[0].truncate(2)
    apart = SpectralBasis(torch.tensor([0.0, 0.0, 1.0]).double(), bases[0].evecs[:, :3], bases[0].mass)
    with pytest.raises(ValueError, match=r"n=1: .* at least 2 energies"):
        wave_energies(bases, 1)
    with pytest.raises(ValueError, match="n=0: at least one diffusion time"):
        heat_times(bases, 0)
    for scale in (wave_energies, heat_times):
        with pytest.raises(ValueError, match=r"bases: .* at least 3 functions, given \[20, 2\]"):
            scale([bases[0], tiny], 10)
        with pytest.raises(ValueError, match=r"bases: .* given \[\]"):
            scale([], 10)
        with pytest.raises(ValueError, match="several components"):
            scale([apart], 10)
    with pytest.raises(ValueError, match="s=-1"):
        split_descriptors([bases[0].evecs], -1)
