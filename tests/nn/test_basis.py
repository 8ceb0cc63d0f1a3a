"""torchqm.nn.basis: the layer is the classical split, learns a symmetry, compiles, exports and vmaps."""

import pytest
import torch
from references.shapes import basis_of, blob
from references.unchecked import unchecked

from torchqm.nn.basis import SymmetrizedBasis
from torchqm.spectral import SoftMap
from torchqm.symmetry import symmetrized_basis
from torchqm.symmetry.split import symmetrized_bases
from torchqm.testing import basis_allclose, gradcheck64


def batched(shape, k):
    basis = basis_of(shape.mesh, k)
    return basis.evals[None], basis.evecs[None], basis.mass[None]


def test_the_classical_split(blob):
    """Groups of 1, 2, 4 and 8 elements: what `torchqm.symmetry.symmetrized_basis` gives, up to the gauge."""
    inputs, expected = batched(blob, 24), symmetrized_basis(basis_of(blob.mesh, 24), blob.group)
    found = SymmetrizedBasis()(*inputs, group=blob.group.maps[None])
    for half, evals, evecs in (
        (expected.even, found.evals_even, found.evecs_even),
        (expected.odd, found.evals_odd, found.evecs_odd),
    ):
        torch.testing.assert_close(evals[0], half.evals, atol=1e-10, rtol=0)
        assert half.k == 0 or basis_allclose(evecs[0], half.evecs, half.evals, half.mass, atol=1e-9)


def test_options_reach_the_function(mirror_blob):
    inputs, group = batched(mirror_blob, 12), mirror_blob.group.maps[None]
    layer = SymmetrizedBasis(k_even=5, k_odd=9, rtol=1e-3)
    expected = symmetrized_bases(*inputs, group=group, k_even=5, k_odd=9)
    for a, b in zip(vars(layer(*inputs, group=group)).values(), vars(expected).values(), strict=True):
        torch.testing.assert_close(a, b, atol=0, rtol=0)
    assert repr(layer) == "SymmetrizedBasis(k_even=5, k_odd=9, rtol=0.001)"
    # rtol: if every gap counts as zero, vectors have no gradient left
    reflection = torch.tensor([[[1.0, 0.1], [0.1, -1.0]]]).double()
    sizes = []
    for rtol in (None, 10.0):
        fmaps = reflection.clone().requires_grad_()
        eye = torch.eye(2).double()[None]
        coeffs = SymmetrizedBasis(rtol=rtol)(eye[:, 0], eye, eye[:, 0], fmaps=fmaps).coeffs_even
        sizes.append(float(torch.autograd.grad(coeffs.sum(), fmaps)[0].abs().max()))
    assert sizes[0] > 0.1
    assert sizes[1] == 0


def test_projector_and_parts(mirror_blob):
    """The basis-free variant agrees with the bases, and parts add up."""
    evals, evecs, mass = batched(mirror_blob, 12)
    group, layer = mirror_blob.group.maps[None], SymmetrizedBasis()
    split = layer(evals, evecs, mass, group=group)
    projector = layer.projector(evecs, mass, group=group)
    torch.testing.assert_close(projector, split.coeffs_even @ split.coeffs_even.mT, atol=1e-10, rtol=0)
    coeffs = torch.randn(1, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    even, odd = layer.parts(coeffs, evecs, mass, group=group)
    torch.testing.assert_close(even + odd, coeffs)
    torch.testing.assert_close((evecs @ even)[0, group[0, 1]], (evecs @ even)[0], atol=1e-9, rtol=0)
    torch.testing.assert_close((evecs @ odd)[0, group[0, 1]], -(evecs @ odd)[0], atol=1e-9, rtol=0)


def test_gradient_of_a_soft_map():
    """Dense and sparse, at a nearly exact reflection: through projector and bases to the logits of the map."""
    torch.manual_seed(0)
    n, k = 8, 4
    swap = torch.arange(n).roll(n // 2)
    evecs = torch.randn(n, k, dtype=torch.float64)
    evecs[n // 2 :] = evecs[: n // 2] * torch.tensor([1.0, 1, -1, -1])
    evecs = torch.linalg.qr(evecs).Q[None]
    evals, mass, weight = torch.arange(k).double()[None], torch.ones(1, n).double(), torch.randn(n, n).double()
    near = 6.0 * torch.nn.functional.one_hot(swap, n)[None]
    layer = SymmetrizedBasis()

    def loss(logits, few):
        sparse = SoftMap(torch.stack([swap, (swap + 1) % n], 1)[None], few.softmax(-1), n)
        out = []
        for soft in (logits.softmax(-1), sparse):
            split = layer(evals, evecs, mass, soft_map=soft)
            even = split.evecs_even @ split.evecs_trans_even
            projector = layer.projector(evecs, mass, soft_map=soft)
            out += [(even * weight).sum(), split.evals_odd.sum(), projector[0, 0, 1], split.spectrum.square().sum()]
        return tuple(out)

    assert gradcheck64(loss, near, torch.tensor([6.0, 0.0]).repeat(1, n, 1))


def test_a_soft_symmetry_is_learned():
    """From a wrong guess, gradients of the spectrum's distance from 0 and 1 lead to an exact reflection."""
    shape = blob(2)
    evals, evecs, mass = batched(shape, 8)
    exact = torch.diag_embed((evecs[0].T * mass[0] @ evecs[0][shape.group.maps[1]]).diagonal().sign())[None]
    fmap = (exact + 0.15 * torch.randn(1, 8, 8, generator=torch.Generator().manual_seed(1)).double()).requires_grad_()
    layer, optimizer = SymmetrizedBasis(k_even=8, k_odd=8), torch.optim.Adam([fmap], lr=0.03)
    history = []
    for _ in range(40):
        spectrum = layer(evals, evecs, mass, fmaps=fmap).spectrum
        loss = (spectrum * (1 - spectrum)).square().sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        history.append(float(loss.detach()))
    assert history[-1] < history[0] / 100


def test_errors_come_from_the_function(mirror_blob):
    evals, evecs, mass = batched(mirror_blob, 6)
    layer = SymmetrizedBasis()
    with pytest.raises(ValueError, match="exactly one of group, fmaps, soft_map"):
        unchecked(layer.forward)(layer, evals, evecs, mass)
    with pytest.raises(ValueError, match=r"mass: shape \(1, 641\) given, expected \(1, V\) with V = 642 as in evecs"):
        unchecked(symmetrized_bases)(evals, evecs, mass[:, 1:], group=mirror_blob.group.maps[None])
