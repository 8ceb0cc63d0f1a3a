"""What holds for every finite group acting on a shape, whatever the functions."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.shapes import basis_of, blob, prism

from torchqm.geometry import laplacian
from torchqm.spectral import SpectralBasis
from torchqm.symmetry import (
    SymmetryGroup,
    central_idempotents,
    conjugacy_classes,
    element_orders,
    even_part,
    fundamental_domains,
    inverses,
    isotypic_components,
    odd_part,
    projection_matrix,
    real_degrees,
    subgroup,
    symmetrized_basis,
)

SHAPES = {"mirror": blob(2), "two mirrors": blob(4), "three mirrors": blob(8), "prism": prism(), "none": blob(1)}
shapes = st.sampled_from(list(SHAPES)).map(SHAPES.get)
seeds = st.integers(0, 2**31)


def functions(shape, seed, c=2):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(shape.mesh.n_verts, c, dtype=torch.float64, generator=generator)


def inner(f, g, mass):
    return (f * mass[:, None]).T @ g


@st.composite
def permutation_groups(draw):
    """A cyclic group: the powers of a random permutation made of cycles of equal length, and fixed points."""
    length = draw(st.integers(1, 6))
    n_cycles, n_fixed = draw(st.integers(1, 4)), draw(st.integers(0, 3))
    n = length * n_cycles + n_fixed
    names = torch.tensor(draw(st.permutations(range(n))))
    turn = torch.arange(n)
    for c in range(n_cycles):
        ring = names[c * length : (c + 1) * length]
        turn[ring] = ring.roll(-1)
    maps = [torch.arange(n)]
    for _ in range(length - 1):
        maps.append(turn[maps[-1]])
    return SymmetryGroup(torch.stack(maps))


def closure(generators, n):
    """All products of some permutations, by composing everything with everything until nothing is new."""
    found, size = {tuple(range(n))} | {tuple(g) for g in generators}, 0
    while size < len(found):
        size = len(found)
        found |= {tuple(g[x] for x in h) for g in generators for h in found}
    return found


@st.composite
def generators(draw):
    """One to three permutations of up to five points, and their number: any subgroup of S5, up to 120 elements."""
    n = draw(st.integers(1, 5))
    return draw(st.lists(st.permutations(range(n)), min_size=1, max_size=3)), n


def generated(drawn):
    """The group and its table, permutations told apart by the corners of a simplex."""
    maps, n = drawn
    corners = torch.eye(n, dtype=torch.float64)
    group = SymmetryGroup.from_generators([torch.tensor(m) for m in maps], corners, tolerance=0.1)
    return group, group.residuals(corners).products


@given(generators())
def test_generated_groups(drawn):
    group, products = generated(drawn)
    assert {tuple(m) for m in group.maps.tolist()} == closure(*drawn)
    assert group.order == len(closure(*drawn))
    for g, row in enumerate(products):
        assert torch.equal(group.maps[row], group.maps[g][group.maps])
    inverse, orders = inverses(products), element_orders(products)
    assert torch.equal(group.maps.gather(1, group.maps[inverse]), group.maps[:1].expand_as(group.maps))
    assert bool((group.order % orders == 0).all())
    numbers = {tuple(m): i for i, m in enumerate(group.maps.tolist())}
    assert subgroup(products, [numbers[tuple(m)] for m in drawn[0]]) == list(range(group.order))
    cyclic = subgroup(products, [group.order - 1])
    assert len(cyclic) == int(orders[-1])
    part = group.subset(cyclic)
    assert {tuple(m) for m in part.maps.tolist()} == closure([group.maps[-1].tolist()], drawn[1])


@given(generators())
def test_idempotents_split_the_group_algebra(drawn):
    _, products = generated(drawn)
    found, inverse = central_idempotents(products), inverses(products)
    product = torch.einsum("ig,jgh->ijh", found, found[:, products[inverse]])
    expected = torch.diag_embed(found.T).movedim(0, 2)  # e_i e_j = delta_ij e_i
    torch.testing.assert_close(product, expected, atol=1e-10, rtol=0)
    torch.testing.assert_close(found.sum(0), torch.eye(len(products), dtype=torch.float64)[0], atol=1e-10, rtol=0)
    for c in conjugacy_classes(products):
        assert torch.equal(found[:, c], found[:, c[:1]].expand(-1, len(c)))  # class functions
    regular = found[:, 0] * len(products)
    degrees = real_degrees(products, found)
    # A representation of degree n occurs n, n / 2 or n / 4 times (real, complex, quaternionic type).
    assert set((degrees**2 / regular).round(decimals=6).tolist()) <= {1.0, 2.0, 4.0}


@given(generators(), seeds, st.data())
def test_isotypic_components_split_any_basis(drawn, seed, data):
    group, products = generated(drawn)
    n = group.n_verts
    k = data.draw(st.integers(1, n))
    generator = torch.Generator().manual_seed(seed)
    random = torch.randn(n, n, dtype=torch.float64, generator=generator)
    random[:, 0] = 1  # the first is constant, the others know nothing of the symmetry
    basis = SpectralBasis(
        torch.arange(k, dtype=torch.float64), torch.linalg.qr(random).Q[:, :k], torch.ones(n, dtype=torch.float64)
    )
    components = isotypic_components(basis, group, products)
    assert sum(c.k for c in components) == k
    together = torch.cat([c.coeffs for c in components], 1)
    torch.testing.assert_close(together.T @ together, torch.eye(k, dtype=torch.float64), atol=1e-10, rtol=0)
    assert all(len(c.idempotent) == group.order for c in components)
    if k == n:  # all functions: every component is kept by the group, and the dimensions are mean characters
        fixed = (group.maps == group.maps[:1]).sum(1).double()
        for c in components:
            assert c.k == round(float(c.idempotent @ fixed))
            assert c.k % c.degree == 0
            projected = sum(w * c.basis.evecs[g] for w, g in zip(c.idempotent, group.maps, strict=True))
            torch.testing.assert_close(projected, c.basis.evecs, atol=1e-9, rtol=0)


@given(permutation_groups(), seeds)
def test_domains_are_images_of_each_other(group, seed):
    """In any points, as long as the maps are a group."""
    products = group.residuals(torch.eye(group.n_verts, dtype=torch.float64)).products
    points = torch.randn(group.n_verts, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    found = fundamental_domains(group, points, torch.ones(group.n_verts), products=products)
    inside = ~found.boundary
    assert torch.equal(found.element[group.maps][:, inside], products[:, found.element][:, inside])
    assert bool((inside == (group.maps[1:] != group.maps[:1]).all(0)).all())
    torch.testing.assert_close(found.shares, torch.full((group.order,), 1 / group.order))


@given(permutation_groups())
def test_group_laws(group):
    found = group.residuals(torch.eye(group.n_verts, dtype=torch.float64))
    assert (found.closure, found.inverse) == (0, 0)
    table = found.products
    everyone = torch.arange(group.order)
    assert torch.equal(table[0], everyone)  # the identity
    assert torch.equal(table[:, 0], everyone)
    assert torch.equal(table[table[:, :, None], everyone], table[everyone[:, None, None], table[None]])  # associative
    assert bool((table.sort(dim=1).values == everyone).all())
    assert torch.equal(table, table.T)  # cyclic, so it commutes


@given(permutation_groups())
def test_orbits_partition_the_vertices(group):
    orbits = [frozenset(row) for row in group.orbits.tolist()]
    assert all(orbits[x] == orbits[y] for x in range(group.n_verts) for y in orbits[x])


@given(shapes, seeds)
def test_projections(shape, seed):
    f, g, mass = functions(shape, seed), functions(shape, seed + 1), shape.mesh.vertex_areas
    even, odd = even_part(f, shape.group), odd_part(f, shape.group)
    torch.testing.assert_close(even + odd, f)
    torch.testing.assert_close(even_part(even, shape.group), even)
    torch.testing.assert_close(odd_part(odd, shape.group), odd)
    assert even_part(odd, shape.group).abs().max() < 1e-12
    # self-adjoint in the mass, which an exact symmetry keeps
    torch.testing.assert_close(inner(even, g, mass), inner(f, even_part(g, shape.group), mass), atol=1e-10, rtol=1e-10)
    assert inner(even, odd_part(g, shape.group), mass).abs().max() < 1e-10
    for element in shape.group.maps:
        torch.testing.assert_close(even[element], even)


@given(shapes, seeds)
def test_projection_commutes_with_the_laplacian(shape, seed):
    f, operator = functions(shape, seed), laplacian(shape.mesh)

    def applied(values):
        return operator.stiffness @ values / operator.mass[:, None]

    torch.testing.assert_close(
        even_part(applied(f), shape.group), applied(even_part(f, shape.group)), atol=1e-9, rtol=1e-9
    )


@pytest.mark.parametrize("name", list(SHAPES))
def test_projection_commutes_with_the_laplacian_in_the_basis(name):
    shape = SHAPES[name]
    basis = basis_of(shape.mesh, 20)
    matrix = projection_matrix(basis, shape.group)
    commutator = matrix * basis.evals[None] - basis.evals[:, None] * matrix
    assert commutator.abs().max() < 1e-7


@given(permutation_groups(), seeds)
def test_projection_of_any_table_has_the_orbit_means(group, seed):
    values = torch.randn(group.n_verts, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    means = values[group.orbits].mean(1)
    torch.testing.assert_close(even_part(values, group), means)


@given(seeds)
def test_renumbering_moves_the_split_along(seed):
    shape = blob(2)
    order = torch.randperm(642, generator=torch.Generator().manual_seed(seed))
    back = torch.argsort(order)
    basis = basis_of(shape.mesh, 12)
    other = type(basis)(basis.evals, basis.evecs[order], basis.mass[order])
    split = symmetrized_basis(basis, shape.group)
    moved = symmetrized_basis(other, SymmetryGroup(back[shape.group.maps[:, order]]))
    gram = moved.even.coefficients(split.even.evecs[order])
    torch.testing.assert_close(gram.abs(), torch.eye(split.even.k, dtype=torch.float64), atol=1e-7, rtol=0)
    torch.testing.assert_close(moved.odd.evals, split.odd.evals, atol=1e-8, rtol=0)
