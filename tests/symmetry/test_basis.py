"""torchqm.symmetry.basis: Lemma 3.1 for exact groups, Lemma 3.2 between two copies."""

import pytest
import torch
from references.shapes import basis_of, blob, prism, renumbered
from references.unchecked import unchecked

from torchqm.fmap import p2p_to_fmap
from torchqm.geometry import laplacian
from torchqm.spectral import cluster_end, relative_residuals
from torchqm.symmetry import SymmetryGroup, even_part, projection_matrix, split_by_projector, symmetrized_basis

SHAPES = [blob(2), blob(4), blob(8), prism()]


def full_basis(shape, k=30):
    basis = basis_of(shape.mesh, k + 2)
    return basis.truncate(cluster_end(basis.evals, k))


@pytest.fixture(params=SHAPES, ids=["mirror", "two mirrors", "three mirrors", "prism"])
def shape(request):
    return request.param


def identity(k):
    return torch.eye(k, dtype=torch.float64)


def test_lemma_3_1(shape):
    """Even and odd functions are Laplacian eigenvectors with their own eigenvalues; dimensions add up."""
    full = full_basis(shape)
    split = symmetrized_basis(full, shape.group)
    operator = laplacian(shape.mesh)
    for half in (split.even, split.odd):
        assert relative_residuals(operator, half).max() < 1e-7
        assert bool((half.evals.diff() >= 0).all())
        torch.testing.assert_close(half.coefficients(half.evecs), identity(half.k), atol=1e-9, rtol=0)
    assert split.even.k + split.odd.k == full.k
    together = torch.cat([split.even.evals, split.odd.evals]).sort().values
    torch.testing.assert_close(together, full.evals, atol=1e-8, rtol=0)
    assert split.even.coefficients(split.odd.evecs).abs().max() < 1e-9


def test_even_functions_are_invariant_and_odd_ones_have_no_mean(shape):
    split = symmetrized_basis(full_basis(shape), shape.group)
    for element in shape.group.maps:
        torch.testing.assert_close(split.even.evecs[element], split.even.evecs, atol=1e-7, rtol=0)
    assert even_part(split.odd.evecs, shape.group).abs().max() < 1e-7


def test_dimension_is_the_mean_character(shape):
    full = full_basis(shape)
    split = symmetrized_basis(full, shape.group)
    traces = [float(full.coefficients(full.evecs[g]).trace()) for g in shape.group.maps]
    assert split.even.k == pytest.approx(sum(traces) / shape.group.order, abs=1e-8)
    assert ((split.spectrum - split.spectrum.round()).abs() < 1e-8).all()


def test_odd_functions_of_a_mirror_change_sign():
    shape = blob(2)
    odd = symmetrized_basis(full_basis(shape), shape.group).odd
    torch.testing.assert_close(odd.evecs[shape.group.maps[1]], -odd.evecs, atol=1e-7, rtol=0)


def test_coefficients_belong_to_the_full_basis(shape):
    full = full_basis(shape)
    split = symmetrized_basis(full, shape.group)
    rotation = torch.cat([split.even_coeffs, split.odd_coeffs], 1)
    torch.testing.assert_close(rotation.T @ rotation, identity(full.k), atol=1e-9, rtol=0)
    torch.testing.assert_close(full.evecs @ split.even_coeffs, split.even.evecs)


def test_split_by_the_functional_map_of_a_reflection():
    shape = blob(2)
    full = full_basis(shape)
    fmap = full.coefficients(full.evecs[shape.group.maps[1]])
    split = split_by_projector(full, (identity(full.k) + fmap) / 2)
    other = symmetrized_basis(full, shape.group)
    torch.testing.assert_close(split.even.evecs, other.even.evecs, atol=1e-8, rtol=0)
    torch.testing.assert_close(split.odd.evals, other.odd.evals, atol=1e-8, rtol=0)


def test_an_approximate_projector_is_cut_between_zero_and_one():
    shape = blob(2)
    full = full_basis(shape)
    noise = torch.randn(full.k, full.k, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    split = split_by_projector(full, projection_matrix(full, shape.group) + 0.02 * noise)
    assert split.even.k == symmetrized_basis(full, shape.group).even.k
    assert split.spectrum.sub(split.spectrum.round()).abs().max() > 0.01  # and it tells that it was inexact


def test_trivial_group_keeps_the_basis():
    full = full_basis(blob(1))
    split = symmetrized_basis(full, SymmetryGroup.trivial(642))
    assert torch.equal(split.even.evecs, full.evecs)
    assert torch.equal(split.even.evals, full.evals)
    assert split.odd.evecs.shape == (642, 0)
    nothing_odd = split_by_projector(full, identity(full.k))
    assert (nothing_odd.even.k, nothing_odd.odd.k) == (full.k, 0)


def test_refusals():
    full = full_basis(blob(2))
    with pytest.raises(ValueError, match=r"expected shape \(30, 30\), got \(29, 29\)"):
        unchecked(split_by_projector)(full, identity(29))
    with pytest.raises(ValueError, match=r"largest eigenvalue is 0\.4, so no function counts as symmetric"):
        split_by_projector(full, 0.4 * identity(30))
    for group in (SymmetryGroup.trivial(5), SymmetryGroup.from_reflection(torch.tensor([1, 0]))):
        with pytest.raises(ValueError, match=f"group acts on {group.n_verts} vertices"):
            symmetrized_basis(full, group)


@pytest.mark.parametrize("order", [2, 4, 8])
def test_lemma_3_2(order):
    """The maps of all isometries between two copies have one even block; a mirror's odd block changes sign."""
    shape = blob(order)
    full = full_basis(shape)
    copy = renumbered(shape, full.k)
    x, y = symmetrized_basis(full, shape.group), symmetrized_basis(copy.basis, copy.shape.group)
    direct = p2p_to_fmap(copy.p2p_yx, x.even, y.even)
    torch.testing.assert_close(direct @ direct.T, identity(x.even.k), atol=1e-8, rtol=0)
    for element in shape.group.maps[1:]:
        other = p2p_to_fmap(element[copy.p2p_yx], x.even, y.even)
        torch.testing.assert_close(other, direct, atol=1e-8, rtol=0)
        whole = p2p_to_fmap(element[copy.p2p_yx], full, copy.basis)
        assert (whole - p2p_to_fmap(copy.p2p_yx, full, copy.basis)).abs().max() > 1.9  # the full maps differ
        assert p2p_to_fmap(element[copy.p2p_yx], x.even, y.odd).abs().max() < 1e-8  # and are block diagonal
    if order == 2:
        torch.testing.assert_close(
            p2p_to_fmap(shape.group.maps[1][copy.p2p_yx], x.odd, y.odd),
            -p2p_to_fmap(copy.p2p_yx, x.odd, y.odd),
            atol=1e-8,
            rtol=0,
        )


def test_functions_are_made_once():
    split = symmetrized_basis(basis_of(blob(2).mesh, 12), blob(2).group)
    assert split.even is split.even
    assert split.odd is split.odd
    assert (split.even.k, split.odd.k) == (split.even_coeffs.shape[1], split.odd_coeffs.shape[1])
