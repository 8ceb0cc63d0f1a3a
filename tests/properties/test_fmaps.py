"""Functional maps: pull-backs compose, the closed form is a minimum, gradients are right."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.shapes import basis_of, blob, renumbered

from torchqm.fmap import (
    commutativity_energy,
    deltas,
    descriptor_energy,
    fmap_to_p2p,
    nearest_isometry,
    orthogonality_energy,
    p2p_to_fmap,
    solve_fmap,
)
from torchqm.geometry import Mesh
from torchqm.spectral import SpectralBasis
from torchqm.symmetry import function_pairs, orientation_coefficients
from torchqm.testing import gradcheck64

seeds = st.integers(0, 2**31)


def noise(generator, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


@given(seeds)
def test_pull_backs_compose(seed):
    """C of T then S is the product of their matrices, the other way round: (f o T) o S = f o (T o S)."""
    shape = blob(2)
    x = basis_of(shape.mesh, 15)
    y = renumbered(shape, 15, seed)
    z = renumbered(y.shape, 15, seed + 1)
    direct = p2p_to_fmap(y.p2p_yx[z.p2p_yx], x, z.basis)
    steps = p2p_to_fmap(z.p2p_yx, y.basis, z.basis) @ p2p_to_fmap(y.p2p_yx, x, y.basis)
    torch.testing.assert_close(direct, steps, atol=1e-8, rtol=0)
    back = p2p_to_fmap(y.p2p_xy, y.basis, x)
    torch.testing.assert_close(
        back @ p2p_to_fmap(y.p2p_yx, x, y.basis), torch.eye(15, dtype=torch.float64), atol=1e-8, rtol=0
    )
    assert torch.equal(fmap_to_p2p(direct, x, z.basis), z.p2p_xy[y.p2p_xy])


@given(seeds)
def test_any_point_map_becomes_a_bounded_operator_that_keeps_constants(seed):
    generator = torch.Generator().manual_seed(seed)
    x, y = basis_of(blob(1).mesh, 15), basis_of(blob(4).mesh, 15)
    fmap = p2p_to_fmap(torch.randint(642, (642,), generator=generator), x, y)
    ratio = (blob(4).mesh.area / blob(1).mesh.area) ** 0.5
    expected = torch.zeros(15, dtype=torch.float64)
    expected[0] = ratio  # constants go to constants
    torch.testing.assert_close(fmap[:, 0], expected, atol=1e-7, rtol=0)


@given(seeds, st.integers(2, 6), st.integers(2, 6), st.integers(1, 8), st.floats(1e-2, 1e2))
def test_solve_fmap_is_the_minimum(seed, kx, ky, c, weight):
    generator = torch.Generator().manual_seed(seed)
    f, g = noise(generator, kx, c + kx), noise(generator, ky, c + kx)
    mu, lam = (noise(generator, k).abs().sort().values for k in (kx, ky))

    def energy(fmap):
        return descriptor_energy(fmap, f, g) + weight * commutativity_energy(fmap, mu, lam)

    best = solve_fmap(f, g, mu, lam, weight, normalize=False).requires_grad_()
    least = energy(best)
    (gradient,) = torch.autograd.grad(least, best)
    assert gradient.abs().max() < 1e-7 * (1 + weight) * (1 + float(least.detach()))
    for size in (1e-2, 1.0, 10.0):
        step = size * noise(generator, ky, kx)
        # strictly convex: moving by d costs || d F ||^2 + w || d ||_com^2
        cost = (step @ f).square().sum() + weight * commutativity_energy(step, mu, lam)
        assert float((energy(best + step) - least).detach()) == pytest.approx(float(cost), rel=1e-5)
        assert cost > 0


@given(seeds)
def test_solve_fmap_is_equivariant(seed):
    """Signs of eigenvectors, the order of descriptors and their mixing by a rotation do not matter."""
    generator = torch.Generator().manual_seed(seed)
    f, g = noise(generator, 5, 9), noise(generator, 4, 9)
    mu, lam = noise(generator, 5).abs().sort().values, noise(generator, 4).abs().sort().values
    plain = solve_fmap(f, g, mu, lam, 2.0)
    sx, sy = torch.sign(noise(generator, 5)), torch.sign(noise(generator, 4))
    torch.testing.assert_close(
        solve_fmap(sx[:, None] * f, sy[:, None] * g, mu, lam, 2.0), sy[:, None] * plain * sx, atol=1e-9, rtol=1e-7
    )
    mix = torch.linalg.qr(noise(generator, 9, 9)).Q
    torch.testing.assert_close(solve_fmap(f @ mix, g @ mix, mu, lam, 2.0), plain, atol=1e-9, rtol=1e-7)


@given(seeds, st.integers(1, 6), st.integers(1, 6))
def test_nearest_isometry_is_equivariant(seed, ky, kx):
    generator = torch.Generator().manual_seed(seed)
    matrix = noise(generator, ky, kx)
    left, right = (torch.linalg.qr(noise(generator, k, k)).Q for k in (ky, kx))
    torch.testing.assert_close(
        nearest_isometry(left @ matrix @ right), left @ nearest_isometry(matrix) @ right, atol=1e-6, rtol=0
    )
    assert float(orthogonality_energy(nearest_isometry(matrix))) < 1e-20


def spectra():
    return (
        torch.tensor([0.0, 0.7, 1.1, 2.3], dtype=torch.float64),
        torch.tensor([0.0, 0.8, 1.4], dtype=torch.float64),
    )


@pytest.mark.parametrize("normalize", [False, True])
def test_gradients_of_solve_fmap(normalize):
    generator = torch.Generator().manual_seed(0)
    mu, lam = spectra()
    f, g = noise(generator, 4, 6), noise(generator, 3, 6)
    assert gradcheck64(lambda a, b, u, v: solve_fmap(a, b, u, v, 0.7, normalize), f, g, mu, lam)


def test_gradients_of_the_energies():
    generator = torch.Generator().manual_seed(0)
    mu, lam = spectra()
    fmap = noise(generator, 3, 4)
    assert gradcheck64(descriptor_energy, fmap, noise(generator, 4, 2), noise(generator, 3, 2))
    assert gradcheck64(commutativity_energy, fmap, mu, lam)
    assert gradcheck64(orthogonality_energy, fmap)
    assert gradcheck64(orthogonality_energy, fmap.T.contiguous())
    assert gradcheck64(nearest_isometry, fmap)


def test_gradients_of_deltas_and_pull_back():
    generator = torch.Generator().manual_seed(0)
    mu, _ = spectra()
    phi, mass = noise(generator, 6, 4), noise(generator, 6).abs()
    p2p = torch.tensor([3, 3, 0, 5, 1])

    def heat(lam, evecs):
        return deltas(SpectralBasis(lam, evecs, mass), 0.3)

    def pull(a, b, m):
        return p2p_to_fmap(p2p, SpectralBasis(mu, a, mass), SpectralBasis(mu, b, m))

    assert gradcheck64(heat, mu, phi)
    assert gradcheck64(pull, phi, noise(generator, 5, 4), noise(generator, 5).abs())


def test_gradients_of_orientation_coefficients():
    generator = torch.Generator().manual_seed(0)
    tetrahedron = Mesh.from_arrays(noise(generator, 4, 3), [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    pairs = function_pairs(4)
    assert gradcheck64(
        lambda values, evecs: orientation_coefficients(tetrahedron, values, pairs, evecs),
        noise(generator, 4, 4),
        noise(generator, 4, 3),
    )
