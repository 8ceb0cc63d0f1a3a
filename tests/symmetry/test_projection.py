"""torchqm.symmetry.projection: Reynolds' operator against its loop, and its matrix."""

import pytest
import torch
from references.dense import reynolds
from references.shapes import basis_of

import torchqm.symmetry.projection as projection
from torchqm.symmetry import SymmetryGroup, even_part, odd_part, projection_matrix


def noise(n, c=3):
    return torch.randn(n, c, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_even_part_is_the_mean_over_orbits(blob, prism):
    for shape in (blob, prism):
        values = noise(shape.mesh.n_verts, 2)
        torch.testing.assert_close(even_part(values, shape.group), reynolds(values, shape.group))


def test_even_and_odd_functions_of_a_mirror(mirror_blob):
    x, y, _ = mirror_blob.mesh.verts.T
    values = torch.stack([x, x * y, y, x * x], 1)
    even = even_part(values, mirror_blob.group)
    assert even[:, :2].abs().max() < 1e-15
    torch.testing.assert_close(even[:, 2:], values[:, 2:])
    torch.testing.assert_close(odd_part(values, mirror_blob.group)[:, :2], values[:, :2])


def test_input_is_left_alone(mirror_blob):
    values = noise(642)
    before = values.clone()
    even_part(values, mirror_blob.group)
    assert torch.equal(values, before)


def test_projection_matrix_of_an_exact_group_is_a_projector(blob):
    matrix = projection_matrix(basis_of(blob.mesh, 20), blob.group)
    torch.testing.assert_close(matrix, matrix.T, atol=1e-9, rtol=0)
    torch.testing.assert_close(matrix @ matrix, matrix, atol=1e-9, rtol=0)
    dims = float(matrix.trace())
    assert dims == pytest.approx(round(dims), abs=1e-9)


def test_projection_matrix_of_a_cut_cluster_is_none(prism):
    matrix = projection_matrix(basis_of(prism.mesh, 3), prism.group)  # cuts the pair 2, 3
    assert projection_matrix(basis_of(prism.mesh, 4), prism.group)[2:, 2:].abs().max() < 1e-9
    assert matrix[2].abs().max() < 1e-9  # the mean over the group kills either of the pair


def test_wrong_number_of_vertices(mirror_blob):
    for project in (even_part, odd_part):
        with pytest.raises(ValueError, match="values: 7 rows, but the group acts on 642 vertices"):
            project(noise(7), mirror_blob.group)


def test_projection_matrix_is_that_of_the_mean_over_orbits(blob, monkeypatch):
    """By blocks of 100 of the 642 vertices and at once."""
    basis = basis_of(blob.mesh, 20)
    wanted = basis.coefficients(even_part(basis.evecs, blob.group))
    for rows in (100, 1000):
        monkeypatch.setattr(projection, "_ROWS", rows)
        torch.testing.assert_close(projection_matrix(basis, blob.group), wanted, atol=1e-13, rtol=0)
    with pytest.raises(ValueError, match="values: 642 rows, but the group acts on 7 vertices"):
        projection_matrix(basis, SymmetryGroup.trivial(7))
