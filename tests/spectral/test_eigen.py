"""torchqm.spectral.eigen: exact spectra, the dense twin, what happens to odd input."""

import numpy as np
import pytest
import scipy.sparse.linalg as spla
import torch
from references.dense import dense_eigenpairs
from references.shapes import basis_of, blob, grid, icosphere, neumann_spectrum, rotation

from torchqm.geometry import Laplacian, Mesh, laplacian
from torchqm.spectral import (
    SpectralBasis,
    SpectrumError,
    SpectrumWarning,
    cluster_end,
    eigenbasis,
    fix_signs,
    mesh_basis,
)
from torchqm.spectral import relative_residuals as residuals
from torchqm.spectral.lanczos import LanczosError
from torchqm.testing import basis_allclose


def test_sphere_eigenvalues_converge_with_second_order():
    exact = torch.tensor([float(degree * (degree + 1)) for degree in range(4) for _ in range(2 * degree + 1)]).double()
    errors = []
    for level in (2, 3, 4):  # edges are halved each time
        evals = basis_of(icosphere(level), 16).evals
        errors.append(float(((evals - exact).abs() / exact.clamp_min(1)).max()))
    assert errors[2] < 0.01
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.15)


def test_sphere_eigenfunctions_are_spherical_harmonics():
    mesh = icosphere(4)
    basis = basis_of(mesh, 16)
    x, y, z = mesh.verts.T
    for degree, harmonics in ((1, [x, y, z]), (2, [x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1])):
        values = torch.stack(harmonics, 1)
        cluster = basis.evecs[:, degree**2 : (degree + 1) ** 2]
        rest = values - cluster @ (cluster.T @ (basis.mass[:, None] * values))
        norms = (basis.mass @ rest.square()) / (basis.mass @ values.square())
        assert norms.sqrt().max() < 0.01


def test_neumann_spectrum_of_a_rectangle_converges():
    exact = neumann_spectrum(12, 1.5, 1.0)
    errors = []
    for n in (12, 24, 48):
        evals = mesh_basis(grid(3 * n // 2, n, 1.5, 1.0), 12).evals.numpy()
        errors.append(np.abs(evals - exact)[1:].max() / exact[-1])
    assert errors[2] < 0.005
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.15)


@pytest.mark.parametrize("mesh", [blob(1).mesh, icosphere(3), grid(24, 16, 1.5, 1.0)], ids=lambda m: m.name)
@pytest.mark.parametrize("solver", ["lanczos", "arpack", "dense"])
def test_agrees_with_the_dense_solver(mesh, solver):
    operator = laplacian(mesh)
    fast = eigenbasis(operator, 30, tol=1e-10, solver=solver)
    evals, evecs = dense_eigenpairs(operator, 30)
    torch.testing.assert_close(fast.evals, evals, atol=1e-10, rtol=1e-10)
    k = cluster_end(evals, 28)  # the sphere's last cluster may be cut
    assert basis_allclose(fast.evecs[:, :k], evecs[:, :k], evals[:k], operator.mass, atol=1e-7)
    assert residuals(operator, fast).max() < 1e-9


def test_dense_and_sparse_branch_agree():
    mesh = icosphere(2)  # 162 vertices: solved densely
    stretched = mesh.moved(mesh.verts * torch.tensor([1.0, 0.8, 1.3], dtype=torch.float64))
    dense = mesh_basis(stretched, 20)
    evals, evecs = dense_eigenpairs(laplacian(stretched), 20)
    torch.testing.assert_close(dense.evals, evals, atol=1e-10, rtol=1e-10)
    assert basis_allclose(dense.evecs, evecs, evals, dense.mass)
    everything = mesh_basis(stretched, 162)
    torch.testing.assert_close(everything.evals[:20], evals, atol=1e-10, rtol=1e-10)


def test_first_pair_is_constant(blob):
    basis = basis_of(blob.mesh, 12)
    assert float(basis.evals[0]) < 1e-10
    assert bool((basis.evals[1:].diff() >= 0).all())
    torch.testing.assert_close(
        basis.evecs[:, 0], torch.full((642,), blob.mesh.area**-0.5, dtype=torch.float64), atol=1e-8, rtol=0
    )


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_eigenvalues_scale_with_the_inverse_area(factor, mirror_blob):
    basis = basis_of(mirror_blob.mesh, 12)
    other = mesh_basis(mirror_blob.mesh.moved(mirror_blob.mesh.verts * factor), 12)
    torch.testing.assert_close(other.evals[1:] * factor**2, basis.evals[1:], rtol=1e-9, atol=0)
    torch.testing.assert_close(other.evecs * factor, basis.evecs, rtol=0, atol=1e-7)


def test_same_input_same_bits_and_rigid_motion(mirror_blob):
    mesh = mirror_blob.mesh
    first, again = mesh_basis(mesh, 12), mesh_basis(mesh, 12)
    assert torch.equal(first.evecs, again.evecs)
    assert torch.equal(first.evals, again.evals)
    moved = mesh_basis(mesh.moved(mesh.verts @ rotation(3).T + 5), 12)
    assert basis_allclose(moved.evecs, first.evecs, first.evals, first.mass)


@pytest.mark.parametrize("level", [2, 3])
def test_vertices_without_faces_take_no_part(level):
    plain = blob(2, level).mesh
    verts = torch.cat([torch.full((2, 3), 9.0, dtype=torch.float64), plain.verts, torch.zeros(1, 3).double()])
    basis = mesh_basis(Mesh(verts, plain.faces + 2), 12)
    other = mesh_basis(plain, 12)
    assert basis.evecs[[0, 1, -1]].abs().max() == 0
    assert basis.mass[[0, 1, -1]].abs().max() == 0
    torch.testing.assert_close(basis.evals, other.evals, atol=1e-9, rtol=1e-9)
    assert basis_allclose(basis.evecs[2:-1], other.evecs, other.evals, other.mass)


def test_robust_laplacian_gives_nearly_the_same(mirror_blob):
    robust = mesh_basis(mirror_blob.mesh, 12, "robust")
    torch.testing.assert_close(robust.evals[1:], basis_of(mirror_blob.mesh, 12).evals[1:], rtol=0.02, atol=0)


def test_too_few_vertices():
    mesh = icosphere(1)
    for k in (0, 43):
        with pytest.raises(SpectrumError, match=rf"tiny\.off: {k} eigenpairs asked for, .* 42 vertices .* 1\.\.42"):
            eigenbasis(laplacian(mesh), k, "tiny.off")
    assert eigenbasis(laplacian(mesh), 42).k == 42
    assert issubclass(SpectrumError, ValueError)


def test_no_convergence_is_reported_with_numbers(monkeypatch, mirror_blob):
    def fail(*args, **options):
        raise spla.ArpackNoConvergence("ARPACK error -1", np.zeros(3), np.zeros((642, 3)))

    monkeypatch.setattr(spla, "eigsh", fail)
    with pytest.raises(SpectrumError, match="blob2: ARPACK found 3 of 12 eigenpairs"):
        eigenbasis(laplacian(mirror_blob.mesh), 12, "blob2", solver="arpack")


def test_where_block_lanczos_fails_arpack_is_asked_and_that_is_said(monkeypatch, mirror_blob):
    def fail(*args, **options):
        raise LanczosError("block Lanczos: 3 of 12 pairs within 1e-08 from 96 vectors")

    expected = mesh_basis(mirror_blob.mesh, 12)
    monkeypatch.setattr("torchqm.spectral.eigen.lowest_eigenpairs", fail)
    with pytest.warns(SpectrumWarning, match="blob2: block Lanczos: 3 of 12 pairs .* ARPACK was asked"):
        found = mesh_basis(mirror_blob.mesh, 12)
    torch.testing.assert_close(found.evals, expected.evals, rtol=1e-10, atol=1e-10)
    with pytest.raises(SpectrumError, match="blob2: block Lanczos: 3 of 12"):
        eigenbasis(laplacian(mirror_blob.mesh), 12, "blob2", solver="lanczos")


@pytest.mark.parametrize(
    ("options", "text"), [({"solver": "qr"}, "'qr' given, allowed are auto"), ({"tol": 0.1}, "0.1")]
)
def test_wrong_options(mirror_blob, options, text):
    with pytest.raises(ValueError, match=text):
        eigenbasis(laplacian(mirror_blob.mesh), 12, **options)


def test_residuals_see_a_wrong_pair(mirror_blob):
    operator = laplacian(mirror_blob.mesh)
    basis = basis_of(mirror_blob.mesh, 12)
    evals = basis.evals.clone()
    evals[4] *= 1.01
    found = residuals(operator, SpectralBasis(evals, basis.evecs, basis.mass))
    assert found[4] == pytest.approx(0.01 / 1.01, rel=1e-3)
    assert found[torch.arange(12) != 4].max() < 1e-9
    one = SpectralBasis(basis.evals[:1], basis.evecs[:, :1], basis.mass)
    assert residuals(operator, one).max() < 1e-9


def test_fix_signs():
    evecs = torch.tensor([[1.0, -2.0, 0.0, 3.0], [-2.0, 2.0, 0.0, 1.0]])
    fixed = fix_signs(evecs)
    assert fixed.tolist() == [[-1.0, 2.0, 0.0, 3.0], [2.0, -2.0, 0.0, 1.0]]  # a tie goes to the first; zeros stay
    assert torch.equal(fix_signs(-evecs), fixed)
    assert torch.equal(fix_signs(fixed), fixed)
    odd = torch.tensor([[0.1], [-1.0], [1.0 + 1e-9]], dtype=torch.float64)  # rounding does not choose the peak
    assert torch.equal(fix_signs(odd), -odd)


def test_laplacian_with_negative_noise_gives_no_negative_eigenvalue():
    n = 30
    noise = torch.diag(torch.full((n,), -1e-13, dtype=torch.float64)).to_sparse()
    basis = eigenbasis(Laplacian(noise, torch.ones(n, dtype=torch.float64), "cotan", ""), 5)
    assert basis.evals.tolist() == [0.0] * 5
