"""Intrinsic descriptors do not see symmetries, numbering, position or (up to units) scale; gradients are right."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.shapes import basis_of, blob, prism, renumbered, rotation

from torchqm.geometry import Mesh
from torchqm.spectral import (
    SpectralBasis,
    WaveEnergies,
    heat_kernel_signature,
    heat_times,
    mesh_basis,
    split_descriptors,
    unit_columns,
    wave_energies,
    wave_kernel_signature,
)
from torchqm.testing import gradcheck64

K = 20  # cuts no pair of the prism


def signatures(basis, energies, times):
    return torch.cat([wave_kernel_signature(basis, energies), heat_kernel_signature(basis, times)], 1)


def settings_of(basis):
    return wave_energies([basis], 15), heat_times([basis], 15)


def whole(shape):
    basis = basis_of(shape.mesh, K)
    gap = basis_of(shape.mesh, K + 1).evals[-1] / basis.evals[-1]
    return basis if gap > 1.001 else basis.truncate(K - 1)


@pytest.mark.parametrize("shape", [blob(2), blob(8), prism()], ids=["mirror", "three mirrors", "prism"])
def test_descriptors_are_symmetric(shape):
    basis = whole(shape)
    values = signatures(basis, *settings_of(basis))
    for element in shape.group.maps:
        torch.testing.assert_close(values[element], values, atol=1e-8, rtol=1e-8)
    bumps = split_descriptors([values], 5)[0]
    torch.testing.assert_close(bumps[shape.group.maps[1]], bumps, atol=1e-6, rtol=0)


@given(st.integers(0, 2**31))
def test_renumbering(seed):
    shape = blob(1)
    basis = basis_of(shape.mesh, K)
    copy = renumbered(shape, K, seed)
    energies, times = settings_of(basis)
    torch.testing.assert_close(
        signatures(copy.basis, energies, times), signatures(basis, energies, times)[copy.p2p_yx], atol=1e-8, rtol=1e-8
    )


@given(st.integers(0, 2**31), st.booleans(), st.floats(-3, 3))
def test_rigid_motion_mirror_and_scale(seed, mirrored, exponent):
    mesh = blob(1).mesh
    scale = 10.0**exponent
    verts = scale * (mesh.verts @ rotation(seed).T + 3)
    faces = mesh.faces
    if mirrored:
        verts, faces = verts * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64), faces.flip(1)
    basis, other = basis_of(mesh, K), mesh_basis(Mesh(verts, faces), K)
    values = signatures(basis, *settings_of(basis))
    torch.testing.assert_close(scale**2 * signatures(other, *settings_of(other)), values, atol=1e-7, rtol=1e-7)


@given(st.permutations(range(3)), st.integers(1, 6))
def test_split_does_not_depend_on_the_order_of_shapes(order, s):
    values = [torch.rand(5 + m, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(m)) for m in range(3)]
    plain = split_descriptors(values, s)
    mixed = split_descriptors([values[m] for m in order], s)
    assert all(torch.equal(mixed[i], plain[m]) for i, m in enumerate(order))
    assert all(bool(((v > 0) & (v <= 1)).all()) for v in plain)


@given(st.floats(0.1, 10), st.floats(-5, 5))
def test_split_has_no_unit(scale, shift):
    values = [torch.rand(9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))]
    torch.testing.assert_close(
        split_descriptors([scale * values[0] + shift], 4)[0], split_descriptors(values, 4)[0], atol=1e-8, rtol=0
    )


def small_basis():
    generator = torch.Generator().manual_seed(0)
    evals = torch.tensor([0.0, 1.0, 1.7, 3.2, 5.1], dtype=torch.float64)
    return evals, torch.randn(7, 5, dtype=torch.float64, generator=generator), torch.ones(7, dtype=torch.float64)


def test_gradients_of_the_signatures():
    evals, evecs, mass = small_basis()
    energies = WaveEnergies(torch.linspace(0.1, 1.4, 6, dtype=torch.float64), 0.3)
    times = torch.logspace(-1, 1, 6, dtype=torch.float64)

    def wave(lam, phi):
        return wave_kernel_signature(SpectralBasis(torch.cat([evals[:1], lam]), phi, mass), energies)

    def heat(lam, phi, t):
        return heat_kernel_signature(SpectralBasis(torch.cat([evals[:1], lam]), phi, mass), t)

    assert gradcheck64(wave, evals[1:], evecs)
    assert gradcheck64(heat, evals[1:], evecs, times)


def test_gradients_of_the_splitting():
    generator = torch.Generator().manual_seed(3)
    # the least and the greatest value are unique, so that small steps change neither
    a = torch.randn(6, 2, dtype=torch.float64, generator=generator)
    b = torch.randn(4, 2, dtype=torch.float64, generator=generator)
    assert gradcheck64(lambda x, y: tuple(split_descriptors([x, y], 3)), a, b)
    assert gradcheck64(lambda x, y: tuple(unit_columns([x, y])), a, b)
