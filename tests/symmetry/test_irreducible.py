"""torchqm.symmetry.irreducible: components of exact groups, the even/odd split as a special case, poor symmetries."""

import pytest
import torch
from references.shapes import basis_of, blob, prism
from references.unchecked import unchecked

from torchqm.geometry import laplacian
from torchqm.spectral import SpectralBasis, cluster_end, relative_residuals
from torchqm.symmetry import SymmetryGroup, isotypic_components, projection_matrix, symmetrized_basis

SHAPES = [blob(2), blob(4), blob(8), prism()]
CYCLE = torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
FOUR = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])


def full_basis(shape, k=40):
    basis = basis_of(shape.mesh, k + 2)
    return basis.truncate(cluster_end(basis.evals, k))


def components_of(shape):
    full = full_basis(shape)
    return full, isotypic_components(full, shape.group, shape.group.residuals(shape.mesh.verts).products)


@pytest.fixture(params=SHAPES, ids=["mirror", "two mirrors", "three mirrors", "prism"], scope="module")
def split(request):
    return request.param, *components_of(request.param)


def identity(k):
    return torch.eye(k, dtype=torch.float64)


def orthonormal_and_complete(components, k):
    together = torch.cat([c.coeffs for c in components], 1)
    torch.testing.assert_close(together.T @ together, identity(k), atol=1e-9, rtol=0)


def test_they_split_the_basis(split):
    shape, full, components = split
    orthonormal_and_complete(components, full.k)
    together = torch.cat([c.evals for c in components]).sort().values
    torch.testing.assert_close(together, full.evals, atol=1e-8, rtol=0)
    operator = laplacian(shape.mesh)
    for c in components:
        assert bool((c.evals.diff() >= 0).all())
        assert (c.k, c.coeffs.shape) == (c.basis.k, (full.k, c.k))
        assert c.purity == pytest.approx(1, abs=1e-9)
        assert c.k == 0 or relative_residuals(operator, c.basis).max() < 1e-6


def test_the_trivial_component_is_the_quotient(split):
    shape, full, components = split
    even = symmetrized_basis(full, shape.group)
    torch.testing.assert_close(components[0].basis.evecs, even.even.evecs, atol=1e-8, rtol=0)
    torch.testing.assert_close(components[0].evals, even.even_evals, atol=1e-8, rtol=0)


def test_projectors_keep_their_own_component_only(split):
    shape, _, components = split
    for a in components:
        for b in components:
            projected = sum(w * b.basis.evecs[g] for w, g in zip(a.idempotent, shape.group.maps, strict=True))
            expected = b.basis.evecs if a is b else torch.zeros_like(b.basis.evecs)
            torch.testing.assert_close(projected, expected, atol=1e-6, rtol=0)


def test_dimensions_are_mean_characters(split):
    shape, full, components = split
    traces = torch.stack([full.coefficients(full.evecs[g]).trace() for g in shape.group.maps])
    for c in components:
        assert c.k == pytest.approx(float(c.idempotent @ traces), abs=1e-7)
        assert c.multiplicity == int(c.multiplicity)


def test_one_reflection_gives_even_and_odd():
    shape = blob(2)
    full, components = components_of(shape)
    old = symmetrized_basis(full, shape.group)
    assert [c.degree for c in components] == [1, 1]
    torch.testing.assert_close(components[1].basis.evecs, old.odd.evecs, atol=1e-8, rtol=0)
    torch.testing.assert_close(components[1].evals, old.odd_evals, atol=1e-8, rtol=0)


def test_three_mirrors_give_the_eight_parities():
    """Each function is even or odd in x, y and z apart, with the signs that its idempotent says."""
    shape = blob(8)
    _, components = components_of(shape)
    assert [(c.degree, c.k > 0) for c in components] == [(1, True)] * 8
    for c in components:
        for sign, element in zip(c.idempotent * 8, shape.group.maps, strict=True):
            torch.testing.assert_close(c.basis.evecs[element], sign * c.basis.evecs, atol=1e-7, rtol=0)


def test_equal_eigenvalues_of_a_prism_are_its_representations_of_degree_two():
    shape = prism()
    _, components = components_of(shape)
    assert [c.degree for c in components] == [1] * 8 + [2, 2]
    for c in components[8:]:
        assert c.k > 0
        pairs = c.evals.reshape(-1, 2)
        torch.testing.assert_close(pairs[:, 0], pairs[:, 1], atol=1e-7, rtol=0)
    alone = torch.cat([c.evals for c in components[:8]]).sort().values
    for c in components[:8]:
        assert c.k < 2 or c.evals.diff().min() > 1e-4
    assert alone.shape[0] + sum(c.k for c in components[8:]) == components[0].full.k


def test_trivial_group_keeps_the_basis():
    full = full_basis(blob(1))
    (only,) = isotypic_components(full, SymmetryGroup.trivial(642), torch.zeros(1, 1, dtype=torch.int64))
    assert torch.equal(only.basis.evecs, full.evecs)
    assert torch.equal(only.evals, full.evals)
    assert (only.degree, only.purity, only.multiplicity) == (1, 1.0, full.k)


def test_representations_that_do_not_occur_are_empty():
    shape = blob(8)
    full = full_basis(shape).truncate(1)
    components = isotypic_components(full, shape.group, shape.group.residuals(shape.mesh.verts).products)
    assert [c.k for c in components] == [1] + [0] * 7
    assert components[1].basis.evecs.shape == (642, 0)
    assert (components[1].purity, components[1].multiplicity) == (1.0, 0.0)


def test_a_cut_eigenspace_shows_in_the_multiplicity():
    """One of the two functions that a rotation by 120 degrees turns into each other."""
    wave = torch.tensor([1.0, -1.0, 0.0], dtype=torch.float64) * 1.5**0.5
    basis = SpectralBasis(
        torch.tensor([0.0, 3.0], dtype=torch.float64),
        torch.stack([torch.ones_like(wave), wave], 1),
        torch.full((3,), 1 / 3, dtype=torch.float64),
    )
    found = isotypic_components(basis, SymmetryGroup(CYCLE), CYCLE)
    assert [(c.k, c.degree, c.multiplicity) for c in found] == [(1, 1, 1.0), (1, 2, 0.5)]
    assert found[1].purity == pytest.approx(1)


@pytest.mark.parametrize("winner", [1, 2, 3])
def test_a_function_that_no_projector_claims_goes_to_the_strongest(winner):
    parities = torch.tensor([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]], dtype=torch.float64)
    strength = torch.full((4,), 0.3, dtype=torch.float64)
    strength[0], strength[winner] = 0, 0.4
    mixed = parities.T @ strength.sqrt()
    basis = SpectralBasis(
        torch.tensor([0.0, 1.0], dtype=torch.float64),
        torch.stack([parities[0], mixed], 1),
        torch.full((4,), 0.25, dtype=torch.float64),
    )
    found = isotypic_components(basis, SymmetryGroup(FOUR), FOUR)
    assert [c.k for c in found] == [1] + [int(i == winner) for i in (1, 2, 3)]
    assert found[winner].purity == pytest.approx(0.4)


def test_a_poor_symmetry_still_splits_the_basis():
    """Maps that miss by a neighbour or two: the same dimensions, up to little, and an orthonormal basis."""
    shape = blob(8)
    full, exact = components_of(shape)
    generator = torch.Generator().manual_seed(1)
    noisy = shape.mesh.verts + 0.08 * torch.randn(642, 3, dtype=torch.float64, generator=generator)
    maps = torch.stack(
        [shape.group.maps[0]] + [torch.cdist(noisy[g], shape.mesh.verts).argmin(1) for g in shape.group.maps[1:]]
    )
    group = SymmetryGroup(maps)
    found = group.residuals(shape.mesh.verts)
    assert found.closure > 0.05
    components = isotypic_components(full, group, found.products)
    orthonormal_and_complete(components, full.k)
    assert [abs(a.k - b.k) <= 2 for a, b in zip(components, exact, strict=True)] == [True] * 8
    assert 0.5 < min(c.purity for c in components) < 0.99
    even = symmetrized_basis(full, group).even
    torch.testing.assert_close(components[0].basis.evecs, even.evecs, atol=1e-8, rtol=0)


def test_no_symmetry_at_all_still_splits_the_basis():
    generator = torch.Generator().manual_seed(2)
    full = full_basis(blob(8), 20)
    maps = torch.stack([torch.arange(642)] + [torch.randperm(642, generator=generator) for _ in range(3)])
    components = isotypic_components(full, SymmetryGroup(maps), FOUR)
    orthonormal_and_complete(components, full.k)
    assert components[0].k == int(
        (torch.linalg.eigvalsh(_sym(projection_matrix(full, SymmetryGroup(maps)))) > 0.5).sum()
    )


def _sym(matrix):
    return (matrix + matrix.T) / 2


def test_refusals():
    make = unchecked(isotypic_components)
    basis = SpectralBasis(torch.zeros(1), torch.ones(2, 1), torch.full((2,), 0.5))
    swap = SymmetryGroup(torch.tensor([[0, 1], [1, 0]]))
    with pytest.raises(ValueError, match="basis: has 2 vertices, but the group acts on 3"):
        make(basis, SymmetryGroup.trivial(3), FOUR)
    with pytest.raises(ValueError, match="a table of 4 elements, but the group has 2"):
        make(basis, swap, FOUR)
    with pytest.raises(ValueError, match=r"products: row 1 .* Latin square"):
        make(basis, swap, torch.tensor([[0, 1], [1, 1]]))
