"""torchqm.nn.descriptors: the layers give what the classical functions give, for shapes of any size, in any batch."""

from functools import partial

import pytest
import torch
from references.shapes import basis_of, blob, icosphere
from references.unchecked import unchecked

from torchqm.nn import HeatKernelSignature, OrientationDescriptors, WaveKernelSignature
from torchqm.spectral import (
    WaveEnergies,
    heat_kernel_signature,
    heat_times,
    wave_energies,
    wave_kernel_signature,
)
from torchqm.symmetry import even_part, function_pairs, orientation_coefficients
from torchqm.testing import gradcheck64


@pytest.fixture(scope="module")
def shape():
    return blob(2)


@pytest.fixture(scope="module")
def basis(shape):
    found = basis_of(shape.mesh, 12)
    return found.scaled(float(found.mass.sum()) ** -0.5)


def inputs(basis, k=None):
    small = basis if k is None else basis.truncate(k)
    return small.evals[None], small.evecs[None], small.mass[None]


def wave(basis, **options):
    return WaveKernelSignature(energies=wave_energies([basis], 9), **options).double()


def heat(basis, **options):
    return HeatKernelSignature(times=heat_times([basis], 9), **options).double()


def test_as_the_classical_signatures(basis):
    expected = wave_kernel_signature(basis, wave_energies([basis], 9))
    torch.testing.assert_close(wave(basis)(*inputs(basis))[0], expected, rtol=1e-5, atol=1e-7)
    expected = heat_kernel_signature(basis, heat_times([basis], 9))
    torch.testing.assert_close(heat(basis)(*inputs(basis))[0], expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("make", [wave, heat])
def test_size_does_not_matter(basis, make):
    layer = make(basis)
    torch.testing.assert_close(layer(*inputs(basis.scaled(7.0))), layer(*inputs(basis)))


@pytest.mark.parametrize("make", [wave, heat])
def test_padding_does_not_matter(basis, make):
    layer = make(basis)
    evals, evecs, mass = inputs(basis, 9)
    pad = torch.nn.functional.pad
    mask = torch.arange(12)[None] < 9
    padded = layer(pad(evals, (0, 3)), pad(evecs, (0, 3, 0, 20)), pad(mass, (0, 20)), mask)
    torch.testing.assert_close(padded[:, :-20], layer(evals, evecs, mass))
    assert not padded[:, -20:].any()


@pytest.mark.parametrize("make", [wave, heat])
def test_learns_energies_and_widths(basis, make):
    layer = make(basis)
    assert {p.requires_grad for p in layer.parameters()} == {True}
    assert not list(make(basis, learnable=False).parameters())
    few = basis.truncate(6).restricted(torch.arange(0, 642, 20))
    names = list(dict(layer.named_parameters()))

    def loss(evals, evecs, *parameters):
        named = dict(zip(names, parameters, strict=True))
        return torch.func.functional_call(layer, named, (evals, evecs, few.mass)).square().sum()

    gradcheck64(loss, few.evals, few.evecs, *layer.parameters())


def test_energies_start_in_the_range_of_weyls_law():
    layer = WaveKernelSignature(n=20, k=100)
    energies = layer.log_energies.detach()
    assert energies.dtype == torch.float32
    assert float(energies[0]) > torch.tensor(4 * torch.pi).log()
    assert float(energies[-1]) < torch.tensor(4 * torch.pi * 99).log()
    assert float(layer.log_sigma.detach().exp()[0]) == pytest.approx(
        7 * float(energies[1] - energies[0]) * 19 / 20, rel=1e-4
    )


@pytest.mark.parametrize("make", [wave, heat])
def test_bad_input_is_named(basis, make):
    made = make(basis)
    layer = partial(unchecked(type(made).forward), made)
    evals, evecs, mass = inputs(basis)
    with pytest.raises(ValueError, match=r"evals: shape \(1, 11\) given, expected \(1, K\) with K = 12 as in evecs"):
        layer(evals[:, 1:], evecs, mass)
    with pytest.raises(ValueError, match="mass: 1 of 642 entries are negative"):
        layer(evals, evecs, mass.clone().index_fill_(1, torch.tensor([5]), -1.0))
    with pytest.raises(ValueError, match="evecs: 642 of 7704 entries are NaN"):
        layer(evals, evecs * torch.tensor([1.0] * 11 + [torch.nan]), mass)
    with pytest.raises(ValueError, match="not constant: no true element"):
        layer(evals, evecs, mass, torch.arange(12)[None] < 1)
    with pytest.raises(ValueError, match="2 functions given; a signature needs at least 3"):
        layer(*inputs(basis, 2))


def test_bad_options_are_named():
    with pytest.raises(ValueError, match="n: 1 given, expected a whole number from 2 on"):
        WaveKernelSignature(n=1)
    with pytest.raises(ValueError, match="k: 2 given, expected a whole number from 3 on"):
        HeatKernelSignature(n=4, k=2)
    with pytest.raises(ValueError, match=r"n_pairs: 4 given, but 3 features make 1\.\.3 pairs"):
        OrientationDescriptors(3, 4)
    with pytest.raises(ValueError, match="n_features: 1 given"):
        OrientationDescriptors(1)
    with pytest.raises(ValueError, match="times: 1 of 1 entries are negative"):
        HeatKernelSignature(times=torch.tensor([-1.0]))
    assert WaveKernelSignature(energies=WaveEnergies(torch.zeros(3), 1.0)).extra_repr() == "n=3"


def test_orientation_has_the_coefficients_of_the_classical_function(shape, basis):
    even = even_part(basis.evecs, shape.group)[:, 1:5]
    layer = OrientationDescriptors(4)
    mesh = shape.mesh
    found = layer(even[None], mesh.faces[None], basis.mass[None])[0]
    expected = orientation_coefficients(mesh, even, layer.pairs, basis.evecs)
    torch.testing.assert_close(basis.evecs_trans @ found, expected)
    assert torch.equal(layer.pairs + 1, function_pairs(5))


def test_orientation_of_even_features_is_odd_and_turns_with_the_surface(shape, basis):
    mirror = shape.group.maps[1]
    even = even_part(basis.evecs, shape.group)[:, 1:5]
    layer = OrientationDescriptors(4)
    found = layer(even, shape.mesh.faces, basis.mass)
    torch.testing.assert_close(found[mirror], -found, atol=1e-9 * float(found.abs().max()), rtol=0)
    turned = layer(even, shape.mesh.faces.flip(-1), basis.mass)
    torch.testing.assert_close(turned, -found)


def test_orientation_in_a_batch_with_padding(shape, basis):
    layer = OrientationDescriptors(3, 2, seed=1)
    pad = torch.nn.functional.pad
    feat = basis.evecs[:, 1:4]
    alone = layer(feat, shape.mesh.faces, basis.mass)
    batch = layer(
        torch.stack([pad(feat, (0, 0, 0, 7)), pad(2 * feat, (0, 0, 0, 7))]),
        torch.stack([pad(shape.mesh.faces, (0, 0, 0, 9))] * 2),
        torch.stack([pad(basis.mass, (0, 7))] * 2),
    )
    torch.testing.assert_close(batch[0, :-7], alone)
    torch.testing.assert_close(batch[1], 4 * batch[0])
    assert not batch[:, -7:].any()


def test_orientation_names_faces_out_of_range(shape, basis):
    layer = OrientationDescriptors(3)
    with pytest.raises(ValueError, match=r"faces: ids from 2 to 643 given, allowed are 0\.\.641"):
        layer(basis.evecs[:, 1:4], shape.mesh.faces + 2, basis.mass)


def test_heat_that_is_gone_everywhere_leaves_the_constant():
    """All exponentials underflow in float32."""
    layer = HeatKernelSignature(times=torch.tensor([10.0]))
    evals, evecs = torch.tensor([700.0, 800.0, 900.0]), torch.arange(6.0).view(2, 3)
    found = layer(evals, evecs, torch.full((2,), 0.5))
    torch.testing.assert_close(found, evecs[:, :1].square())


def test_orientation_gradients():
    mesh = icosphere(0)
    layer = OrientationDescriptors(3)
    generator = torch.Generator().manual_seed(0)
    mass = torch.rand(12, dtype=torch.float64, generator=generator) + 0.1
    feat = torch.randn(12, 3, dtype=torch.float64, generator=generator)
    gradcheck64(lambda f, m: layer(f, mesh.faces, m).square().sum(), feat, mass)
