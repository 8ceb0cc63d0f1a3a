"""torchqm.matching.parity: the true parity of an exact shape costs nothing, and its halves are left and right."""

import pytest
import torch
from references.pairs import K

from torchqm.data.synthetic import creature
from torchqm.fmap import p2p_to_fmap
from torchqm.matching import MatchParameters, nearest_involution, prepare
from torchqm.matching.initial import shared_descriptors
from torchqm.matching.parity import odd_halves, parity_patterns
from torchqm.spectral import SpectralBasis


def true_fmap(pair, k):
    basis = pair.x.basis.truncate(k)
    return p2p_to_fmap(pair.group_x.maps[1], basis, basis)


def descriptors(shape):
    (values,) = shared_descriptors([shape.basis], MatchParameters())
    return shape.basis.coefficients(values)


@pytest.mark.parametrize("n", [4, 8])
def test_the_true_parity_comes_first_and_costs_nothing(exact, n):
    found = parity_patterns(exact.x.basis, descriptors(exact.x), n)
    torch.testing.assert_close(found.fmaps[0], true_fmap(exact, n + 1), atol=1e-6, rtol=0)
    assert float(found.costs[0]) < 1e-9
    assert float(found.costs[1]) > 1e3 * float(found.costs[0])
    assert torch.equal(found.costs, found.costs.sort().values)
    assert len(found.costs) == min(2**n - 1, 48)
    assert not bool((found.signs > 0).all(1).any())  # never the identity
    eye = torch.eye(n + 1, dtype=torch.float64).expand_as(found.fmaps)
    torch.testing.assert_close(found.fmaps @ found.fmaps, eye)


def test_functions_of_equal_eigenvalue_are_a_space(exact):
    """Two functions mixed by a rotation, as an eigensolver may: the pattern is turned back."""
    basis = exact.x.basis.truncate(9)
    true = true_fmap(exact, 9)
    signs = true.diagonal()
    first = next(i for i in range(1, 8) if signs[i] * signs[i + 1] < 0)
    turn = torch.eye(9, dtype=torch.float64)
    turn[first : first + 2, first : first + 2] = torch.tensor([[0.8, -0.6], [0.6, 0.8]])
    evals = basis.evals.clone()
    evals[first + 1] = evals[first] * 1.0001
    mixed = SpectralBasis(evals, basis.evecs @ turn, basis.mass)
    found = parity_patterns(mixed, turn.T @ descriptors(exact.x)[:9])
    torch.testing.assert_close(found.fmaps[0], turn.T @ true @ turn, atol=1e-6, rtol=0)
    with pytest.raises(ValueError, match=r"n_functions=9: must be in 1..12 and below the 9"):
        parity_patterns(mixed, descriptors(exact.x), 9)


def test_halves_of_the_true_reflection(exact):
    sign = odd_halves(exact.x.mesh, exact.x.basis, true_fmap(exact, K))
    side = exact.side_x
    off_axis = side != 0
    assert float((sign * side)[off_axis].mean().abs()) > 0.97
    assert torch.equal(sign[exact.group_x.maps[1]], -sign)


def test_halves_of_a_map_that_leaves_some_limbs_where_they_are():
    """Of the odd functions all but the lowest three are called even: left and right are told all the same."""
    body = creature("quadruped", 1000)
    shape = prepare(body.mesh, K)
    fmap = nearest_involution(p2p_to_fmap(body.base_group[1], shape.basis, shape.basis))
    weights, vectors = torch.linalg.eigh(fmap)
    odd = vectors[:, weights < 0]
    energy = odd.T @ (shape.basis.evals[:, None] * odd)
    low = odd @ torch.linalg.eigh(energy)[1][:, :3]
    partial = torch.eye(K, dtype=torch.float64) - 2 * low @ low.T
    side = torch.sign(shape.mesh.verts[:, 0]) * (body.base_group[1] != torch.arange(shape.n_verts))
    agreement = float((odd_halves(shape.mesh, shape.basis, partial) * side * shape.mesh.vertex_areas).sum().abs())
    assert agreement > 0.8
    nothing = odd_halves(shape.mesh, shape.basis, torch.eye(K, dtype=torch.float64))
    assert torch.equal(nothing, torch.zeros(shape.n_verts, dtype=torch.float64))
