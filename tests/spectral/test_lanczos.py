"""torchqm.spectral.lanczos: complete multiplicities, wrong guesses, what happens when it cannot work."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from references.shapes import icosphere
from torch.overrides import TorchFunctionMode

import torchqm.spectral.lanczos as module
from torchqm.data.synthetic import creature
from torchqm.geometry import Mesh, laplacian, to_scipy
from torchqm.spectral import eigenbasis, relative_residuals
from torchqm.spectral.lanczos import LanczosError, lowest_eigenpairs
from torchqm.spectral.sparse_solve import factorize


def scaled(mesh: Mesh) -> sp.csc_array:
    """``M^-1/2 W M^-1/2`` at unit area."""
    operator = laplacian(mesh)
    mass = operator.mass.numpy()
    root = sp.diags_array(np.sqrt(mass.sum() / mass))
    return sp.csc_array(root @ to_scipy(operator.stiffness) @ root)


def copies(mesh: Mesh, count: int) -> Mesh:
    verts = torch.cat([mesh.verts + 10.0 * i for i in range(count)])
    return Mesh(verts, torch.cat([mesh.faces + i * mesh.n_verts for i in range(count)]))


def cube(n: int) -> sp.csc_array:
    """The finite-difference Laplacian of a flat 3-torus with ``n^3`` points: eigenvalues known, often 24 equal ones."""
    ring = sp.csc_array(2 * np.eye(n) - np.roll(np.eye(n), 1, 0) - np.roll(np.eye(n), -1, 0))
    eye = sp.eye_array(n)
    return sp.csc_array(
        sp.kron(sp.kron(ring, eye), eye) + sp.kron(sp.kron(eye, ring), eye) + sp.kron(eye, sp.kron(eye, ring))
    )


def torus_spectrum(n: int, k: int) -> np.ndarray:
    ring = 2 - 2 * np.cos(2 * np.pi * np.arange(n) / n)
    return np.sort((ring[:, None, None] + ring[:, None] + ring).ravel())[:k]


@pytest.mark.parametrize(
    ("factor", "k"),
    [(1.0, 40), (0.2, 40), (0.01, 40), (8.0, 40), (100.0, 40), (1.0, 1), (1.0, 2), (1.0, 7), (1.0, 150)],
)
def test_agrees_with_the_dense_solver_whatever_the_guess(mirror_blob, factor, k):
    matrix = scaled(mirror_blob.mesh)
    evals, evecs = np.linalg.eigh(matrix.toarray())
    pairs = lowest_eigenpairs(matrix, k, 1e-10, factor * float(evals[k]))
    np.testing.assert_allclose(pairs.evals[1:], evals[1:k], rtol=1e-11)
    assert abs(pairs.evals[0]) < 1e-9
    overlap = pairs.evecs.numpy() @ evecs[:, :k]
    np.testing.assert_allclose(np.abs(np.linalg.det(overlap)), 1, atol=1e-7)  # the same space
    np.testing.assert_allclose((pairs.evecs @ pairs.evecs.T).numpy(), np.eye(k), atol=1e-10)
    assert pairs.residuals.max() < 1e-10 + 1e-12 * evals[-1] / evals[1]
    assert (pairs.attempts > 1) == (factor < 1)  # the filter began below the last eigenvalue wanted


def test_residuals_are_those_of_the_matrix(mirror_blob):
    matrix = scaled(mirror_blob.mesh)
    pairs = lowest_eigenpairs(matrix, 20, 1e-4, 4 * np.pi * 20)
    rows = pairs.evecs.numpy()
    applied = rows @ matrix.toarray() - pairs.evals[:, None] * rows
    expected = np.linalg.norm(applied, axis=1) / np.maximum(pairs.evals, pairs.evals[1])
    np.testing.assert_allclose(pairs.residuals, expected, rtol=1e-3, atol=1e-13)
    assert 1e-12 < expected.max() <= 1e-4


def test_clusters_wider_than_a_block_are_complete():
    found = lowest_eigenpairs(cube(12), 81, 1e-9, float(torus_spectrum(12, 81)[-1]))
    np.testing.assert_allclose(found.evals, torus_spectrum(12, 81), atol=1e-9)
    assert found.attempts > 1  # up to 24 equal eigenvalues do not come out of blocks of 16
    assert np.diff(found.evals).max() > 0.1


@pytest.mark.parametrize("mesh", [icosphere(3), creature("octopus", 600).mesh], ids=["sphere", "octopus"])
def test_equal_eigenvalues_of_a_symmetric_shape_are_complete(mesh):
    matrix = scaled(mesh)
    evals, evecs = np.linalg.eigh(matrix.toarray())
    ends = np.flatnonzero(np.diff(evals) > 1e-3 * evals[1:])  # cut where no cluster goes on
    k = int(ends[ends < 60][-1]) + 1
    pairs = lowest_eigenpairs(matrix, k, 1e-10, 4 * np.pi * k)
    np.testing.assert_allclose(pairs.evals[1:], evals[1:k], rtol=1e-11)
    missed = evecs[:, :k] - pairs.evecs.numpy().T @ (pairs.evecs.numpy() @ evecs[:, :k])
    assert np.linalg.norm(missed, axis=0).max() < 1e-7
    assert (np.diff(evals[1:k]) < 1e-6 * evals[2:k]).sum() >= 10  # there is something to be missed


def test_every_component_has_its_constant():
    pairs = lowest_eigenpairs(scaled(copies(icosphere(2), 6)), 40, 1e-9, 4 * np.pi * 40)
    single = np.linalg.eigvalsh(scaled(icosphere(2)).toarray())[:8]
    np.testing.assert_allclose(pairs.evals, 6 * np.repeat(single, 6)[:40], atol=1e-6 * pairs.evals[-1])


def test_residuals_of_what_comes_out_are_checked(monkeypatch, mirror_blob):
    """Bounds that are too small by far: what comes out does not keep them, and is not handed out."""
    monkeypatch.setattr(module._Run, "_bounds", lambda self, rest: np.full(self.k, 1e-30))
    with pytest.raises(LanczosError, match=r"pair \d+ of 40 has a residual of \S+, not 1e-08"):
        lowest_eigenpairs(scaled(mirror_blob.mesh), 40, 1e-8, 4 * np.pi * 40)


@pytest.mark.parametrize("count", [20, 70])
def test_more_components_than_a_block_has_vectors(count):
    mesh = copies(icosphere(2), count)
    basis = eigenbasis(laplacian(mesh), count + 10, solver="lanczos")
    area = float(basis.mass.sum())
    assert basis.evals[:count].max() * area < 1e-6
    single = np.linalg.eigvalsh(scaled(icosphere(2)).toarray())[1]
    np.testing.assert_allclose(basis.evals[count:].numpy() * area, count * single, rtol=1e-9)
    assert relative_residuals(laplacian(mesh), basis).max() < 1e-7


@pytest.mark.parametrize("tol", [1e-3, 1e-6])
def test_a_loose_tolerance_makes_no_clusters_of_ordinary_eigenvalues(tol):
    matrix = scaled(creature("biped", 2000).mesh)
    pairs = lowest_eigenpairs(matrix, 300, tol, 4 * np.pi * 300)
    exact = np.linalg.eigvalsh(matrix.toarray())[:300]
    assert pairs.attempts == 1
    assert pairs.residuals.max() <= tol
    np.testing.assert_allclose(pairs.evals[1:], exact[1:], rtol=10 * tol**2 + 1e-11)


def test_equal_input_equal_output(mirror_blob):
    matrix = scaled(mirror_blob.mesh)
    first, again = (lowest_eigenpairs(matrix, 20, 1e-8, 250.0) for _ in range(2))
    assert torch.equal(first.evecs, again.evecs)


def test_more_copies_than_the_widest_blocks_have_is_an_error():
    """All in one component: nothing says beforehand that there are so many."""
    chain = 2.5 * np.eye(100) - np.eye(100, k=1) - np.eye(100, k=-1)
    matrix = sp.csc_array(np.kron(np.eye(10), chain) + 1e-12)
    with pytest.raises(LanczosError, match=r"equal eigenvalues in blocks of"):
        lowest_eigenpairs(matrix, 100, 1e-8, 1.0, block=2)


@pytest.mark.parametrize(
    ("change", "text"),
    [({"k": 0}, "k: 0 given"), ({"guess": float("nan")}, "guess: nan given"), ({"tol": -1.0}, "tol: -1.0 given")],
)
def test_wrong_arguments(mirror_blob, change, text):
    with pytest.raises(ValueError, match=text):
        lowest_eigenpairs(**{"matrix": scaled(mirror_blob.mesh), "k": 5, "tol": 1e-8, "guess": 60.0, **change})


def test_entries_that_are_not_finite(mirror_blob):
    matrix = scaled(mirror_blob.mesh)
    matrix.data[7] = np.nan
    with pytest.raises(ValueError, match="matrix: has entries that are NaN"):
        lowest_eigenpairs(matrix, 5, 1e-8, 60.0)


def test_no_convergence_says_how_far_it_came(mirror_blob):
    with pytest.raises(LanczosError, match=r"block Lanczos: \d+ of 400 pairs within 1e-08 from \d+ vectors"):
        lowest_eigenpairs(scaled(mirror_blob.mesh), 400, 1e-8, 1e-3)


def test_a_matrix_without_factor_is_an_error():
    matrix = sp.csc_array(sp.diags_array(np.r_[-5.0, np.arange(1.0, 500)]))
    with pytest.raises(LanczosError, match="no Cholesky factor"):
        lowest_eigenpairs(matrix, 10, 1e-8, 10.0)


class TwoPlaces(TorchFunctionMode):
    """A second device, played on the CPU: its tensors meet no others, and NumPy only after ``.cpu()``."""

    def __init__(self):
        super().__init__()
        self.moved, self.there = 0, set()

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs, name = kwargs or {}, getattr(func, "__name__", "")
        tensors = [a for a in (*args, *kwargs.values()) if isinstance(a, torch.Tensor) and a.ndim]
        places = {hasattr(a, "there") for a in tensors}
        if len(places) > 1:
            raise TypeError(f"{name}: tensors of two devices")
        if name == "numpy" and places == {True}:
            raise TypeError("numpy: a tensor of the other device")
        found = func(*args, **kwargs)
        if isinstance(found, torch.Tensor) and name != "from_numpy":
            if name == "cpu":
                return found.detach().clone()  # no longer marked
            if name == "to" and places == {False}:
                self.moved += 1
                found = found.clone()
            if name == "to" or kwargs.get("device") is not None or places == {True}:
                found.there = True
        return found


def test_long_vectors_stay_on_the_device(mirror_blob, monkeypatch):
    matrix = scaled(mirror_blob.mesh)
    wanted = lowest_eigenpairs(matrix, 40, 1e-9, 4 * np.pi * 40)

    class There:
        def __init__(self, *given):
            self.factor = factorize(*given)
            self.order = self.factor.order

        def filtered(self, rows, *options):
            assert hasattr(rows, "there")
            return self.factor.filtered(rows, *options)

    monkeypatch.setattr(module, "factorize", There)
    with TwoPlaces() as places:
        found = lowest_eigenpairs(matrix, 40, 1e-9, 4 * np.pi * 40)
    assert places.moved > 10
    assert not hasattr(found.evecs, "there")
    assert np.array_equal(found.evals, wanted.evals)
    assert torch.equal(found.evecs, wanted.evecs)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_the_basis_of_a_gpu_is_that_of_the_cpu(mirror_blob):
    operator = laplacian(mirror_blob.mesh)
    there, here = (eigenbasis(operator, 40, solver="lanczos", device=device) for device in ("cuda", "cpu"))
    assert there.evecs.device.type == "cpu"
    torch.testing.assert_close(there.evals, here.evals, rtol=1e-9, atol=1e-9)
    assert float(relative_residuals(operator, there).max()) < 1e-8


@pytest.mark.parametrize(("device", "fault"), [("tpu", "allowed are 'cpu' and 'cuda'"), ("cuda:7", "sees no CUDA")])
def test_a_device_that_is_not_there_is_named(mirror_blob, device, fault, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=f"device: '{device}' given, .*{fault}"):
        eigenbasis(laplacian(mirror_blob.mesh), 12, device=device)
