"""torchqm.symmetry.invariant: what does not depend on the gauge has exact gradients, whatever eigenvalues coincide."""

from math import exp

import pytest
import torch
from references import split_layers as twin

from torchqm.spectral import fix_signs
from torchqm.symmetry.invariant import column_signs, gap_tolerance, invariant_eigh, spectral_projector, split_eigh
from torchqm.testing import gradcheck64

SPECTRA = {
    "separated": [0.3, 1.0, 1.7, 3.0, 5.0],
    "clustered": [1.0, 1.0 + 1e-6, 1.0 + 2e-6, 3.0, 3.0 + 1e-6],
    "repeated": [1.0, 1.0, 1.0, 3.0, 3.0],
}
spectra = pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA.keys())


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def with_spectrum(spectrum, seed=0):
    """A full symmetric matrix with these eigenvalues, and a diagonal one, where they are equal to the last bit."""
    diagonal = torch.diag(torch.tensor(spectrum, dtype=torch.float64))
    q = torch.linalg.qr(noise(len(spectrum), len(spectrum), seed=seed)).Q
    return q @ diagonal @ q.T, diagonal


@spectra
def test_eigenpairs(spectrum):
    for matrix in with_spectrum(spectrum):
        values, vectors = invariant_eigh(torch.stack([matrix, 2 * matrix]))
        torch.testing.assert_close(values[1], 2 * torch.tensor(spectrum, dtype=torch.float64))
        torch.testing.assert_close(vectors[0] @ torch.diag(values[0]) @ vectors[0].T, matrix)


def invariants(matrix):
    """Projectors onto whole clusters, their means, the trace of a function, distances in clusters, a Gram matrix."""
    values, vectors = invariant_eigh(matrix)
    low, high = vectors[..., :3], vectors[..., 3:]
    distance = torch.cdist(2 * low, low).square()
    return (
        low @ low.mT,
        values[..., :3].mean(),
        values[..., 3:].sum(),
        torch.exp(-values).sum(),
        distance,
        high @ high.mT,
    )


@spectra
def test_invariant_losses(spectrum):
    for matrix in with_spectrum(spectrum):
        assert gradcheck64(invariants, matrix)
        assert gradcheck64(invariants, matrix + noise(5, 5, seed=1).triu(1) / 100)  # the symmetric part is what counts


def test_tolerance_and_scale():
    """A single vector's gradient, ``1 / (2 gap)``: there if the gap is above ``rtol scale``, else zero."""
    for rtol, scale, expected in ((None, None, 50.0), (1e-2, None, 50.0), (2e-2, None, 0.0), (2e-2, 0.5, 50.0)):
        matrix = torch.diag(torch.tensor([0.98, 0.99], dtype=torch.float64)).requires_grad_()
        size = None if scale is None else torch.tensor(scale, dtype=torch.float64)
        vectors = invariant_eigh(matrix, rtol, size)[1]
        (grad,) = torch.autograd.grad(vectors[0, 1] * vectors[1, 1].detach().sign(), matrix)
        assert grad[0, 1] == pytest.approx(expected)
        assert grad[0, 1] == grad[1, 0]


def test_torchs_own_gradient_is_not_finite_there():
    """What the backward pass is for: with torch.linalg.eigh the same losses give no number."""
    matrix = with_spectrum(SPECTRA["repeated"])[1].requires_grad_()
    vectors = torch.linalg.eigh(matrix).eigenvectors
    (grad,) = torch.autograd.grad(((vectors[:, :3] @ vectors[:, :3].T) * noise(5, 5)).sum(), matrix)
    assert not bool(torch.isfinite(grad).all())


@pytest.mark.parametrize("seed", range(3))
def test_spectral_filters(seed):
    """Exact where eigenvalues differ by 1e-6; of an exactly repeated one the diagonal part is left, and no more."""
    weight = noise(5, 5, seed=seed)

    def f(x):
        return exp(-x)

    def slope(x):
        return -exp(-x)

    for name, spectrum in SPECTRA.items():
        matrix = with_spectrum(spectrum)[1].requires_grad_()
        values, vectors = invariant_eigh(matrix)
        (grad,) = torch.autograd.grad(((vectors * torch.exp(-values)) @ vectors.T * weight).sum(), matrix)
        exact = twin.filter_gradient(values.detach(), vectors.detach(), weight, f, slope, name != "repeated")
        torch.testing.assert_close(grad, exact, atol=1e-8, rtol=0)


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-5), (torch.float32, 1e-1)])
def test_rounding_is_not_blown_up_just_above_the_tolerance(dtype, atol):
    """The docstring's number: ``eps |G| / rtol`` at most; without the projector's own basis it would be exact."""
    gap = 1.2 * gap_tolerance(dtype)
    spectrum = [1 - 2 * gap, 1 - gap, 1.0, -0.4, 0.3]
    weight = noise(5, 5, seed=4)

    def gradient(matrix, project):
        matrix = matrix.detach().requires_grad_()
        return torch.autograd.grad((project(matrix) * weight.to(matrix.dtype)).sum(), matrix)[0].double()

    def by_vectors(matrix):
        vectors = invariant_eigh(matrix)[1][:, 2:]
        return vectors @ vectors.T

    for seed in range(5):
        matrix = with_spectrum(spectrum, seed)[0].to(dtype)
        exact = gradient(matrix.double(), spectral_projector)
        torch.testing.assert_close(gradient(matrix, by_vectors), exact, atol=atol, rtol=0)


@pytest.mark.parametrize("spectrum", [[0, 0, 0, 1, 1], [-0.02, 0.0, 0.1, 0.93, 0.93 + 1e-7], [0, 1, 1, 1, 1], [1] * 5])
def test_projector(spectrum):
    for matrix in with_spectrum(spectrum):
        skew = matrix + noise(5, 5, seed=3).triu(1) / 50
        for given in (matrix, skew):
            found = spectral_projector(torch.stack([given, given]))[1]
            torch.testing.assert_close(found, twin.projector(given, 0.5), atol=1e-12, rtol=0)
            assert gradcheck64(spectral_projector, given)

            def subspaces(x):
                values, vectors = split_eigh(x)
                low = vectors * (values <= 0.5)
                return low @ low.mT, values.exp().sum(), torch.cdist(low, low).square()

            assert gradcheck64(subspaces, given)


def test_inside_a_half_there_is_no_gradient():
    """A vector's turn towards one of its own half is gauge, at any gap; towards the other half it counts."""
    matrix = torch.diag(torch.tensor([0.0, 0.1, 0.8, 0.9], dtype=torch.float64)).requires_grad_()
    vectors = split_eigh(matrix)[1]
    inside, across = (torch.autograd.grad(vectors[i, 3], matrix, retain_graph=True)[0] for i in (2, 0))
    assert inside.abs().max() == 0
    assert across[0, 3].abs() == pytest.approx(1 / (2 * 0.9))


def test_nothing_above_the_threshold():
    matrix = with_spectrum([0.0, 0.1, 0.2, 0.3, 0.4])[0].requires_grad_()
    projector = spectral_projector(matrix)
    assert projector.abs().max() == 0
    assert torch.autograd.grad(projector.sum(), matrix)[0].abs().max() == 0


def test_a_pair_at_the_threshold_is_left_out():
    """The cut goes through a pair 2e-13 apart: what belongs to other pairs stays, exactly."""
    matrix = torch.diag(torch.tensor([0.0, 0.5 - 1e-13, 0.5 + 1e-13, 1.0], dtype=torch.float64)).requires_grad_()
    weight = noise(4, 4)
    (grad,) = torch.autograd.grad((spectral_projector(matrix) * weight).sum(), matrix)
    expected = torch.zeros(4, 4, dtype=torch.float64)
    for below, above, gap in ((0, 2, 0.5), (0, 3, 1.0), (1, 3, 0.5)):
        expected[below, above] = expected[above, below] = (weight[below, above] + weight[above, below]) / 2 / gap
    torch.testing.assert_close(grad, expected, atol=1e-11, rtol=0)


@pytest.mark.parametrize("function", [invariant_eigh, split_eigh, lambda x: (x.new_zeros(()), spectral_projector(x))])
def test_a_second_derivative_raises(function):
    """Also where only part of the graph is asked for; torch's ``once_differentiable`` then leaves that part out."""
    matrix = with_spectrum(SPECTRA["separated"])[0].requires_grad_()

    def loss(x):
        values, vectors = function(x)
        return (values**3).sum() + (vectors[..., :2] ** 4).sum() + (x**3).sum()

    (grad,) = torch.autograd.grad(loss(matrix), matrix, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiated once, not twice"):
        torch.autograd.grad(grad.sum(), matrix)
    with pytest.raises(RuntimeError, match="differentiated once, not twice"):
        torch.func.grad(lambda x: torch.func.grad(loss)(x).square().sum())(matrix.detach())


def test_under_vmap():
    batch = torch.stack([with_spectrum(s)[k] for s in SPECTRA.values() for k in (0, 1)])
    weight = noise(5, 5)

    def loss(x):
        return sum((part * weight[0, 0]).sum() + (part**2).sum() for part in invariants(x))

    one_by_one = torch.stack([torch.func.grad(loss)(x) for x in batch])
    # Rounding differs, and gaps are 1e-6.
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(loss))(batch), one_by_one, atol=1e-8, rtol=0)


def test_signs():
    """The rule of ``fix_signs``, for a batch; near ties go to the first entry."""
    columns = noise(3, 7, 5)
    columns[0, :2, 0] = torch.tensor([-9.0, 9.0 + 1e-6])
    columns[1, :, 1] = 0.0
    signs = column_signs(columns.requires_grad_())
    assert signs[0, 0, 0] == -1
    assert signs[1, 0, 1] == 1
    assert not signs.requires_grad
    for batch in range(3):
        torch.testing.assert_close(columns[batch] * signs[batch], fix_signs(columns[batch]), atol=0, rtol=0)


def test_single_precision():
    matrix = with_spectrum(SPECTRA["repeated"])[0].float().requires_grad_()
    values, vectors = invariant_eigh(matrix)
    (values.sum() + (vectors[:, :3] @ vectors[:, :3].T)[0, 1]).backward()
    exact = with_spectrum(SPECTRA["repeated"])[0].requires_grad_()
    (exact.trace() + spectral_projector(-exact, -2.0)[0, 1]).backward()
    assert values.dtype == vectors.dtype == matrix.grad.dtype == torch.float32
    torch.testing.assert_close(matrix.grad.double(), exact.grad, atol=1e-5, rtol=0)


def test_a_negative_tolerance_is_refused():
    """With one, an eigenvalue would have a gap to itself, and the gradient be infinite."""
    for function in (invariant_eigh, split_eigh, spectral_projector):
        with pytest.raises(ValueError, match=r"rtol: -0\.1 given, expected a number from 0 on"):
            function(torch.eye(2), rtol=-0.1)
