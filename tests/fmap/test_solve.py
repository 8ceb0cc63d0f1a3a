"""torchqm.fmap.solve: the closed form against least squares, against the truth, and where there is no answer."""

import pytest
import torch
from references import dense
from references.shapes import basis_of, renumbered
from references.unchecked import unchecked

from torchqm.fmap import p2p_to_fmap, solve_fmap
from torchqm.spectral import split_descriptors, unit_columns, wave_energies, wave_kernel_signature
from torchqm.symmetry import symmetrized_basis


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("kx", "ky", "c"), [(6, 6, 9), (8, 4, 5), (4, 7, 3)])
@pytest.mark.parametrize("weight", [0.1, 30.0])
def test_agrees_with_row_by_row_least_squares(kx, ky, c, weight):
    f, g = noise(kx, c), noise(ky, c, seed=1)
    mu, lam = noise(kx, seed=2).abs().sort().values, noise(ky, seed=3).abs().sort().values
    torch.testing.assert_close(
        solve_fmap(f, g, mu, lam, weight, normalize=False), dense.solve_fmap(f, g, mu, lam, weight)
    )
    scale = max(float(mu.max()), float(lam.max()))
    torch.testing.assert_close(
        solve_fmap(f, g, mu, lam, weight), dense.solve_fmap(f, g, mu / scale, lam / scale, weight)
    )


def test_weight_without_unit():
    f, g, mu, lam = noise(5, 8), noise(5, 8, seed=1), torch.arange(5.0).double(), torch.arange(5.0).double() + 0.1
    torch.testing.assert_close(solve_fmap(f, g, mu, lam, 3.0), solve_fmap(f, g, 1e6 * mu, 1e6 * lam, 3.0))


def test_enough_descriptors_give_the_map_back():
    truth, f = noise(4, 6), noise(6, 10, seed=1)
    spectrum = torch.arange(6.0).double()
    torch.testing.assert_close(solve_fmap(f, truth @ f, spectrum, spectrum[:4], weight=0.0), truth)


def test_exact_copy(mirror_blob):
    """On isometric shapes the symmetric part is recovered from intrinsic descriptors alone (section 4)."""
    basis = basis_of(mirror_blob.mesh, 30)
    copy = renumbered(mirror_blob, 30)
    x, y = symmetrized_basis(basis, mirror_blob.group).even, symmetrized_basis(copy.basis, copy.shape.group).even
    energies = wave_energies([basis, copy.basis], 100)
    values = split_descriptors([wave_kernel_signature(b, energies) for b in (basis, copy.basis)], 5)
    f, g = unit_columns([x.coefficients(values[0]), y.coefficients(values[1])])
    fmap = solve_fmap(f, g, x.evals, y.evals, weight=1e-3)
    torch.testing.assert_close(fmap, p2p_to_fmap(copy.p2p_yx, x, y), atol=1e-4, rtol=0)


def test_undetermined_rows_are_named():
    spectrum = torch.arange(4.0).double()
    with pytest.raises(ValueError, match=r"rank 2 of 4\) and weight=0.0 leave row\(s\) \[0, 1, 2, 3\]"):
        solve_fmap(noise(4, 2), noise(4, 2, seed=1), spectrum, spectrum, weight=0.0)
    # the weight of entry (i, i) is zero: with no descriptor row i stays undetermined
    with pytest.raises(ValueError, match=r"rank 0 of 4.* row\(s\) \[0, 1, 2, 3\]"):
        solve_fmap(torch.zeros(4, 1).double(), noise(4, 1), spectrum, spectrum, weight=1.0)
    with pytest.raises(ValueError, match=r"row\(s\) \[2\] "):
        solve_fmap(
            torch.ones(4, 1).double().cumsum(0) * torch.tensor([[1.0], [1], [0], [1]]).double(),
            noise(4, 1),
            spectrum,
            spectrum,
        )


def test_refusals():
    f, mu = noise(4, 3), torch.arange(4.0).double()
    solve = unchecked(solve_fmap)
    with pytest.raises(ValueError, match="coeffs_x has 3 descriptors, coeffs_y has 2"):
        solve(f, f[:, :2], mu, mu)
    for spectra in ((mu[:3], mu), (mu, mu[:3])):
        with pytest.raises(ValueError, match="do not fit"):
            solve(f, f, *spectra)
    with pytest.raises(ValueError, match=r"weight=-1\.0"):
        solve(f, f, mu, mu, -1.0)
