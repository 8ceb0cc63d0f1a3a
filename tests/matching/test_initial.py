import pytest
import torch
from references import dense
from references.pairs import FAST, exact_pair, with_loose_vertices
from references.shapes import basis_of, blob, prism

from torchqm.fmap import p2p_to_fmap, solve_fmap
from torchqm.matching import MatchParameters, prepare
from torchqm.matching.initial import basis_size, initial_fmap, shared_descriptors, split_bases, unit_columns_pair
from torchqm.spectral import heat_times, wave_energies
from torchqm.symmetry import symmetrized_basis

SMALL = MatchParameters(k=4, n_descriptors=3, splits=2)


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("descriptor", ["wks", "hks"])
def test_energies_and_ranges_are_shared(descriptor):
    """Of two different shapes, against loops: cut at the smaller basis, one list of energies, one range."""
    bases = [basis_of(blob(2, 2).mesh, 12), basis_of(blob(4, 2).mesh.normalized(), 9)]
    found = shared_descriptors(bases, SMALL.changed(descriptor=descriptor))
    small = [b.truncate(9) for b in bases]
    if descriptor == "wks":
        energies = wave_energies(small, 3)
        values = [dense.wave_kernel_signature(b, energies.log_energies, energies.sigma) for b in small]
    else:
        values = [dense.heat_kernel_signature(b, heat_times(small, 3)) for b in small]
    for mine, wanted in zip(found, dense.split_descriptors(values, 2), strict=True):
        assert mine.shape == (162, 6)
        torch.testing.assert_close(mine, wanted, atol=1e-9, rtol=1e-9)


def test_without_splitting():
    bases = [basis_of(blob(2).mesh, 9)]
    assert shared_descriptors(bases, SMALL.changed(splits=0))[0].shape == (642, 3)


def test_vertices_without_area_do_not_widen_the_ranges():
    """Their eigenfunctions are 0, so their signatures would be the least of all."""
    mesh = blob(2).mesh
    loose, ids = with_loose_vertices(mesh, [5, 600])
    plain, more = (shared_descriptors([prepare(m, 20).basis], FAST)[0] for m in (mesh, loose))
    torch.testing.assert_close(more[ids], plain, atol=1e-7, rtol=0)


@pytest.mark.parametrize("order", [1, 2, 8])
def test_exact_descriptors_give_the_exact_even_block(order):
    """Both terms of the energy vanish at the true map, so the least squares solution is the true map."""
    pair = exact_pair(order)
    even_x = symmetrized_basis(pair.x.basis.truncate(30), pair.group_x).even
    even_y = symmetrized_basis(pair.y.basis.truncate(30), pair.group_y).even
    values = shared_descriptors([pair.x.basis, pair.y.basis], FAST)
    torch.testing.assert_close(values[1][pair.p2p_xy], values[0], atol=1e-7, rtol=0)
    found = initial_fmap(even_x, even_y, *values, FAST.commutativity)
    torch.testing.assert_close(found, p2p_to_fmap(pair.p2p_yx, even_x, even_y), atol=1e-6, rtol=0)


def test_weights_do_not_depend_on_the_number_or_the_units_of_the_descriptors():
    basis_x, basis_y = basis_of(blob(2).mesh, 10), basis_of(blob(4).mesh, 8)
    f, g = noise(642, 15), noise(642, 15, seed=1)
    once = initial_fmap(basis_x, basis_y, f, g, 3.0)
    twice = initial_fmap(basis_x, basis_y, f.repeat(1, 2), g.repeat(1, 2), 3.0)
    torch.testing.assert_close(twice, once)
    units = torch.logspace(-3, 3, 15, dtype=torch.float64)
    torch.testing.assert_close(initial_fmap(basis_x, basis_y, f * units, g * units, 3.0), once)
    assert (initial_fmap(basis_x, basis_y, f, g, 0.3) - once).norm() > 0.1 * once.norm()


def test_it_is_the_weighted_least_squares_problem():
    basis_x, basis_y = basis_of(blob(2).mesh, 10), basis_of(blob(4).mesh, 8)
    f, g = noise(642, 15), noise(642, 15, seed=1)
    a, b = unit_columns_pair(basis_x.coefficients(f), basis_y.coefficients(g))
    torch.testing.assert_close((a.square().sum(0) + b.square().sum(0)) / 2, torch.ones(15, dtype=torch.float64))
    wanted = solve_fmap(a, b, basis_x.evals, basis_y.evals, 3.0 * 15 / 10)
    torch.testing.assert_close(initial_fmap(basis_x, basis_y, f, g, 3.0), wanted)


def test_what_nothing_determines_is_zero():
    """Odd functions of exactly symmetric twins have no descriptors, and at equal frequency nothing weighs on them."""
    basis = basis_of(blob(2).mesh, 20)
    values = shared_descriptors([basis], FAST.changed(k=20))[0]
    found = initial_fmap(basis, basis, values, values, 100.0)
    parity = basis.coefficients(basis.evecs[blob(2).group.maps[1]]).diagonal()
    assert 5 < int((parity < 0).sum()) < 15
    torch.testing.assert_close(found, torch.diag((parity > 0).double()), atol=1e-4, rtol=0)


def test_no_cluster_is_cut():
    simple, paired = basis_of(blob(2).mesh, 30), basis_of(prism().mesh, 30)
    same = paired.evals[1:].diff().abs() < 1e-6 * paired.evals[2:]
    assert int(same.sum()) > 5
    for k in range(4, 30):
        size = basis_size([simple, paired], k)
        assert k - 1 <= size <= k
        assert not same[size - 2]  # function number `size` is another frequency than the last one kept
        assert size == k or same[k - 2]
        assert basis_size([simple], k) == k
    assert basis_size([simple, paired.truncate(10)], 25) == 10


def test_split_bases_are_those_of_each_shape():
    pair = exact_pair()
    group_y = pair.group_y
    found = split_bases(pair.x, pair.y, 12, pair.group_x, group_y)
    for split, shape, group in zip(found, (pair.x, pair.y), (pair.group_x, group_y), strict=True):
        wanted = symmetrized_basis(shape.basis.truncate(12), group)
        assert torch.equal(split.even_coeffs, wanted.even_coeffs)
        assert torch.equal(split.odd.evecs, wanted.odd.evecs)
