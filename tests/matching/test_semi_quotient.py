"""torchqm.matching.semi_quotient: on exact pairs, Lemma 5.1 to rounding."""

import pytest
import torch
from references.pairs import FAST, exact_pair

from torchqm.fmap import p2p_to_fmap
from torchqm.matching import match_semi_quotient, pull_back
from torchqm.matching.semi_quotient import sharpen_orbit_map
from torchqm.symmetry import symmetrized_basis
from torchqm.testing import assert_orbit_equal


@pytest.fixture(scope="module", params=[1, 2, 4, 8], ids=lambda order: f"group{order}")
def pair(request):
    return exact_pair(request.param)


@pytest.fixture(scope="module")
def semi(pair):
    return match_semi_quotient(pair.x, pair.y, pair.group_y, FAST)


def identity(k):
    return torch.eye(k, dtype=torch.float64)


def test_the_kernel_gives_the_sources_symmetric_functions(pair, semi):
    """Lemma 5.1 ii: the complement of the kernel is L2+ of the source, of which the method was told nothing."""
    truth = symmetrized_basis(pair.x.basis.truncate(FAST.k), pair.group_x)
    assert semi.source.even.k == truth.even.k
    assert semi.source.odd.k == truth.odd.k
    projector = semi.source.even_coeffs @ semi.source.even_coeffs.T
    torch.testing.assert_close(projector, truth.even_coeffs @ truth.even_coeffs.T, atol=1e-6, rtol=0)
    torch.testing.assert_close(semi.source.even_evals, truth.even_evals, atol=1e-4, rtol=0)


def test_it_is_an_isometry_there(semi):
    """Lemma 5.1 iii."""
    k = semi.even.shape[0]
    assert semi.even.shape == (k, k)
    torch.testing.assert_close(semi.even @ semi.even.T, identity(k), atol=1e-8, rtol=0)
    torch.testing.assert_close(semi.fmap @ semi.fmap.T, identity(k), atol=1e-8, rtol=0)
    torch.testing.assert_close(semi.even, semi.fmap @ semi.source.even_coeffs)


def test_it_is_the_exact_map(pair, semi):
    basis_x, even_y = pair.x.basis.truncate(FAST.k), semi.target.even
    torch.testing.assert_close(semi.fmap, p2p_to_fmap(pair.p2p_yx, basis_x, even_y), atol=1e-6, rtol=0)
    assert_orbit_equal(semi.orbit_map, pair.p2p_xy, pair.group_y.orbits)


def test_from_a_few_samples_the_mask_keeps_the_iteration_in_place(exact):
    """As printed it drifts, even from the true map; 150 vertices are a rough integral."""
    few = FAST.changed(n_samples=150)
    basis_x = exact.x.basis.truncate(FAST.k)
    drift = []
    for width in (0.2, None):
        found = match_semi_quotient(exact.x, exact.y, exact.group_y, few.changed(semi_width=width))
        drift.append(float((found.fmap - p2p_to_fmap(exact.p2p_yx, basis_x, found.target.even)).norm()))
    assert drift[0] < drift[1]
    assert drift[0] < 0.5


def test_sharpened_orbit_map(exact):
    semi = match_semi_quotient(exact.x, exact.y, exact.group_y, FAST.changed(n_samples=300))
    found = sharpen_orbit_map(semi, exact.x, exact.y, exact.group_y, FAST.changed(n_samples=300), 50)
    assert_orbit_equal(found, exact.p2p_xy, exact.group_y.orbits)
    beyond = sharpen_orbit_map(semi, exact.x, exact.y, exact.group_y, FAST, 10_000)  # as far as the bases go
    assert_orbit_equal(beyond, exact.p2p_xy, exact.group_y.orbits)


def test_symmetric_functions_come_back(exact):
    semi = match_semi_quotient(exact.x, exact.y, exact.group_y, FAST)
    x, y, z = exact.y.mesh.verts.T
    symmetric = torch.stack([x.abs(), y, x * x * z], 1)
    wanted = symmetric[exact.p2p_xy]
    torch.testing.assert_close(pull_back(symmetric, semi.orbit_map), wanted, atol=1e-12, rtol=0)
