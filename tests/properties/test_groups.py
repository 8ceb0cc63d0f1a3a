"""What holds for every finite group acting on a shape, whatever the functions."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.shapes import basis_of, blob, prism

from torchqm.geometry import laplacian
from torchqm.symmetry import SymmetryGroup, even_part, odd_part, projection_matrix, symmetrized_basis

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
