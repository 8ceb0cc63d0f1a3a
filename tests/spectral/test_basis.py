"""torchqm.spectral.basis: coefficients, cuts, clusters."""

import pytest
import torch
from references.dense import dense_eigenpairs
from references.shapes import basis_of

from torchqm.geometry import laplacian
from torchqm.spectral import SpectralBasis, cluster_end


@pytest.fixture(scope="module")
def basis(mirror_blob):
    return basis_of(mirror_blob.mesh, 20)


def test_orthonormal_in_the_mass(basis):
    gram = basis.evecs.T @ torch.diag(basis.mass) @ basis.evecs
    torch.testing.assert_close(gram, torch.eye(20, dtype=torch.float64), atol=1e-12, rtol=0)
    torch.testing.assert_close(basis.evecs_trans, basis.evecs.T @ torch.diag(basis.mass))
    assert (basis.k, basis.n_verts) == (20, 642)


def test_coefficients_are_the_orthogonal_projection(basis):
    wanted = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(basis.coefficients(basis.evecs @ wanted), wanted)
    values = torch.sin(torch.arange(642.0, dtype=torch.float64))[:, None]
    rest = values - basis.evecs @ basis.coefficients(values)
    assert basis.coefficients(rest).abs().max() < 1e-12


def test_truncate(basis):
    small = basis.truncate(7)
    assert torch.equal(small.evecs, basis.evecs[:, :7])
    assert torch.equal(small.evals, basis.evals[:7])
    torch.testing.assert_close(small.coefficients(basis.evecs), basis.coefficients(basis.evecs)[:7])
    assert basis.truncate(20) is basis
    for k in (0, -1, 21):
        with pytest.raises(ValueError, match=rf"k={k}: .* 1\.\.20"):
            basis.truncate(k)


def test_low_pass(basis):
    values = basis.evecs[:, [3]] + 2 * basis.evecs[:, [5]]
    torch.testing.assert_close(basis.low_pass(values), values)
    damped = torch.exp(-0.1 * basis.evals)
    torch.testing.assert_close(
        basis.low_pass(values, 0.1), damped[3] * basis.evecs[:, [3]] + 2 * damped[5] * basis.evecs[:, [5]]
    )


def test_cluster_end_on_the_sphere(sphere):
    evals = basis_of(sphere, 26).evals
    # clusters of 1, 3, 5, 7, 9 functions end at 1, 4, 9, 16, 25
    assert [cluster_end(evals, k, rtol=0.02) for k in (1, 2, 3, 4, 8, 9, 15, 16, 24, 25)] == [
        *(1, 1, 1, 4, 4, 9, 9, 16, 16, 25)
    ]


def test_cluster_end_at_the_borders():
    equal = torch.tensor([2.0, 2.0, 2.0, 3.0])
    assert cluster_end(equal, 2) == 2  # no better cut below
    assert cluster_end(equal, 4) == 4
    assert cluster_end(torch.tensor([1.0, 1.1, 2.0]), 2) == 2
    assert cluster_end(torch.tensor([1.0, 2.0, 2.1]), 2, rtol=0.1) == 1
    for k in (0, 5):
        with pytest.raises(ValueError, match=rf"k={k}: .* 1\.\.4"):
            cluster_end(equal, k)


def test_rows_of_the_biharmonic_embedding_have_biharmonic_distances(mirror_blob):
    """With all functions: the distances of the squared pseudo-inverse of the Laplacian."""
    mesh = mirror_blob.mesh.normalized()
    operator = laplacian(mesh, "cotan")
    evals, evecs = dense_eigenpairs(operator, mesh.n_verts)
    full = SpectralBasis(evals.clamp_min(0), evecs, operator.mass)
    half = operator.mass.sqrt()
    matrix = operator.stiffness.to_dense() / half[:, None] / half
    inverse = torch.linalg.pinv(matrix, hermitian=True, rtol=1e-9)
    kernel = inverse @ inverse / half[:, None] / half
    wanted = (kernel.diagonal()[:, None] + kernel.diagonal() - 2 * kernel).clamp_min(0).sqrt()
    points = full.biharmonic()
    torch.testing.assert_close(torch.cdist(points, points), wanted, atol=1e-6, rtol=1e-4)
    assert full.biharmonic(20).shape == (mesh.n_verts, 19)
    torch.testing.assert_close(full.biharmonic(20), points[:, :19])
