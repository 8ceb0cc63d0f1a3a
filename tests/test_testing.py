"""torchqm.testing: each helper accepts what is equal and refuses what is not."""

from math import cos, sin

import pytest
import torch
from references.shapes import basis_of
from references.unchecked import unchecked
from torch.autograd.gradcheck import GradcheckError

from torchqm.testing import assert_orbit_equal, basis_allclose, gradcheck64


@pytest.fixture(scope="module")
def basis(prism):
    """Eigenvalues 2, 3 and 4, 5 are equal in pairs."""
    return basis_of(prism.mesh, 8)


def turned(evecs, i, j, angle):
    c, s = cos(angle), sin(angle)
    out = evecs.clone()
    out[:, i], out[:, j] = c * evecs[:, i] - s * evecs[:, j], s * evecs[:, i] + c * evecs[:, j]
    return out


def close(basis, other, **options):
    return basis_allclose(basis.evecs, other, basis.evals, basis.mass, **options)


def test_basis_allclose_forgives_the_gauge(basis):
    signs = torch.tensor([1.0, -1, 1, -1, -1, 1, 1, -1], dtype=torch.float64)
    assert close(basis, basis.evecs)
    assert close(basis, basis.evecs * signs)
    assert close(basis, turned(turned(basis.evecs * signs, 2, 3, 0.7), 4, 5, 2.0), atol=1e-10)
    assert close(basis, basis.evecs[:, [0, 1, 3, 2, 4, 5, 6, 7]])


def test_basis_allclose_refuses_what_differs(basis):
    assert not close(basis, turned(basis.evecs, 1, 2, 1e-3))  # across clusters
    assert not close(basis, basis.evecs[:, [0, 2, 1, 3, 4, 5, 6, 7]])
    assert not close(basis, basis.evecs * 1.001)
    assert not close(basis, basis.evecs + 1e-4)
    assert close(basis, basis.evecs + 1e-4, atol=1e-2)
    spoilt = basis.evecs.clone()
    spoilt[3, 4] = torch.nan
    assert not close(basis, spoilt)


def test_basis_allclose_needs_the_whole_cluster_and_skips_vertices_without_mass(basis):
    cut = slice(0, 3)  # in the middle of the pair 2, 3
    other = turned(basis.evecs, 2, 3, 0.7)
    assert not basis_allclose(basis.evecs[:, cut], other[:, cut], basis.evals[cut], basis.mass)
    mass = basis.mass.clone()
    mass[5] = 0
    other = basis.evecs.clone()
    other[5] = torch.nan
    assert basis_allclose(basis.evecs, other, basis.evals, mass)


def test_basis_allclose_names_shapes_that_do_not_fit(basis):
    check = unchecked(basis_allclose)
    with pytest.raises(ValueError, match=r"b has \(342, 7\)"):
        check(basis.evecs, basis.evecs[:, :7], basis.evals, basis.mass)
    with pytest.raises(ValueError, match=r"evals \(7,\)"):
        check(basis.evecs, basis.evecs, basis.evals[:7], basis.mass)


class WrongSquare(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x * x

    @staticmethod
    def backward(ctx, grad):
        (x,) = ctx.saved_tensors
        return 2.01 * x * grad


def test_gradcheck64():
    x = torch.linspace(0.5, 1.5, 4)  # float32: differences would be far too coarse
    assert gradcheck64(lambda a, b: (a.sin() * b, a + b), x, x.flip(0))
    assert gradcheck64(lambda a, ids, scale: scale * a[ids], x, torch.tensor([2, 0]), 3.0)
    assert not x.requires_grad
    with pytest.raises(GradcheckError):
        gradcheck64(WrongSquare.apply, x)
    with pytest.raises(ValueError, match="no gradient to check"):
        gradcheck64(lambda ids: ids, torch.tensor([1]))


def test_assert_orbit_equal(mirror_blob):
    orbits = mirror_blob.group.orbits
    identity, mirror = mirror_blob.group.maps
    mixed = torch.where(torch.arange(len(identity)) % 3 == 0, identity, mirror)
    assert_orbit_equal(identity, mixed, orbits)
    assert_orbit_equal(mixed, mirror, orbits)
    wrong = identity.clone()
    wrong[[7, 9]] = wrong[[9, 7]]
    with pytest.raises(AssertionError, match=r"2 of 642 points .* first is point 7: 7 .* against 9"):
        assert_orbit_equal(identity, wrong, orbits)
    with pytest.raises(AssertionError, match="642 and 2 points"):
        unchecked(assert_orbit_equal)(identity, identity[:2], orbits)
