"""torchqm.symmetry.split and halves: as the split of one shape, in batches, with gradients at repeated eigenvalues."""

from itertools import permutations, product

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import split_layers as twin
from references.shapes import Shape, basis_of, blob, box, group_of, icosphere
from references.unchecked import unchecked

from torchqm import checks
from torchqm.data.collate import collate
from torchqm.spectral import SpectralBasis, cluster_end
from torchqm.symmetry import SymmetryGroup, symmetrized_basis
from torchqm.symmetry.halves import symmetrized_projector
from torchqm.symmetry.soft import projection_matrices
from torchqm.symmetry.split import split_bases, symmetrized_bases
from torchqm.testing import basis_allclose, gradcheck64


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def cube():
    """A cube and its 48 symmetries: eigenspaces of up to three dimensions."""
    mesh = box((4, 4, 4), (1.0, 1.0, 1.0)).mesh
    matrices = [np.diag(s) @ np.eye(3)[list(p)] for s in product((1, -1), repeat=3) for p in permutations(range(3))]
    return Shape(mesh, group_of(mesh.verts.numpy(), matrices))


def mirrored_sphere():
    """Eigenvalues repeated 1, 3, 5, ... times; each eigenspace has even and odd functions of the mirror plane x = 0."""
    mesh = icosphere(3)
    return Shape(mesh, group_of(mesh.verts.numpy(), [np.eye(3), np.diag([-1.0, 1.0, 1.0])]))


def truncated(shape, k):
    basis = basis_of(shape.mesh, k + 2)
    return basis.truncate(cluster_end(basis.evals, k))


def clusters(evals):
    """Where each cluster of equal eigenvalues begins, and the end."""
    ends = [k for k in range(1, len(evals)) if evals[k] - evals[k - 1] > 1e-3 * evals[k].abs()]
    return list(zip([0, *ends], [*ends, len(evals)], strict=True))


def same(split, basis, group, atol=1e-8):
    """Whether one shape's result is that of the classical function, up to the gauge, with zeros after it."""
    expected = symmetrized_basis(basis, group)
    n, k = basis.n_verts, basis.k
    halves = [
        (expected.even, split.evals_even, split.evecs_even, split.coeffs_even, split.evals_even_mask),
        (expected.odd, split.evals_odd, split.evecs_odd, split.coeffs_odd, split.evals_odd_mask),
    ]
    for own, evals, evecs, coeffs, mask in halves:
        assert mask.tolist() == [True] * own.k + [False] * (len(evals) - own.k)
        torch.testing.assert_close(evals[: own.k], own.evals, atol=1e-9, rtol=0)
        torch.testing.assert_close(basis.evecs @ coeffs[:k], evecs[:n], atol=1e-10, rtol=0)
        assert evals[own.k :].abs().sum() + evecs[:, own.k :].abs().sum() + evecs[n:].abs().sum() == 0
        assert coeffs[:, own.k :].abs().sum() + coeffs[k:].abs().sum() == 0
        assert own.k == 0 or basis_allclose(evecs[:n, : own.k], own.evecs, own.evals, basis.mass, atol=atol)
    torch.testing.assert_close(split.spectrum[:k], expected.spectrum, atol=1e-10, rtol=0)
    return bool(split.spectrum[k:].abs().sum() == 0)


def test_one_shape(blob):
    basis = basis_of(blob.mesh, 20)
    split = symmetrized_bases(basis.evals, basis.evecs, basis.mass, group=blob.group.maps)
    assert same(split, basis, blob.group)
    assert split.evals_even.shape[0] + split.evals_odd.shape[0] == 20
    for evecs, trans in ((split.evecs_even, split.evecs_trans_even), (split.evecs_odd, split.evecs_trans_odd)):
        torch.testing.assert_close(trans @ evecs, torch.eye(evecs.shape[1]).double(), atol=1e-10, rtol=0)


@pytest.mark.parametrize("shape", [mirrored_sphere(), cube()], ids=["sphere", "cube"])
def test_repeated_eigenvalues(shape):
    basis = truncated(shape, 30)
    split = symmetrized_bases(basis.evals, basis.evecs, basis.mass, group=shape.group.maps)
    assert max(b - a for a, b in clusters(split.evals_odd)) > 2
    assert same(split, basis, shape.group)


BATCH = [(blob(4), 16), (cube(), 9), (blob(1), 7), (blob(8), 16)]


@pytest.fixture(scope="module")
def batch():
    """Unequal V, K, order of the group and number of even functions; one shape without symmetry."""
    items = []
    for shape, k in BATCH:
        basis = basis_of(shape.mesh, k)
        items.append({"evals": basis.evals, "evecs": basis.evecs, "mass": basis.mass, "group": shape.group.maps})
        items[-1]["verts"] = shape.mesh.verts
    return collate(items)


def split_batch(batch, **options):
    names = ("group", "group_mask", "verts_mask", "evals_mask")
    given = {name: batch[name] for name in names}
    return symmetrized_bases(batch["evals"], batch["evecs"], batch["mass"], **given, **options)


def row(split, b):
    return type(split)(*(value[b] for value in vars(split).values()))


def test_a_batch_of_unequal_shapes(batch):
    split = split_batch(batch)
    for b, (shape, k) in enumerate(BATCH):
        assert same(row(split, b), basis_of(shape.mesh, k), shape.group)
    assert split.evals_odd_mask[2].sum() == 0  # the trivial group: all is even


def test_what_stands_in_the_padding_does_not_matter(batch):
    dirty = dict(batch)
    for name, mask in (("mass", "verts_mask"), ("evals", "evals_mask")):
        dirty[name] = torch.where(batch[mask], batch[name], 7.0)
    evecs = torch.where(batch["verts_mask"][..., None], batch["evecs"], -3.0)
    dirty["evecs"] = torch.where(batch["evals_mask"][:, None], evecs, 5.0)
    for found, expected in zip(vars(split_batch(dirty)).values(), vars(split_batch(batch)).values(), strict=True):
        torch.testing.assert_close(found, expected, atol=0, rtol=0)


def test_fixed_widths(batch):
    full, fixed = split_batch(batch), split_batch(batch, k_even=4, k_odd=20)
    assert fixed.evecs_even.shape[2] == 4
    assert fixed.evecs_odd.shape[2] == fixed.coeffs_odd.shape[2] == fixed.evals_odd_mask.shape[1] == 20
    torch.testing.assert_close(fixed.evals_even, full.evals_even[:, :4], atol=0, rtol=0)
    torch.testing.assert_close(fixed.evecs_even, full.evecs_even[..., :4], atol=1e-12, rtol=0)
    n = full.evals_odd.shape[1]
    torch.testing.assert_close(fixed.coeffs_odd[..., :n], full.coeffs_odd, atol=0, rtol=0)
    assert not bool(fixed.evals_odd_mask[:, n:].any())
    empty = split_batch(batch, k_even=0, k_odd=0)
    assert empty.evecs_even.shape[2] == empty.evals_odd.shape[1] == 0


def test_gradients_of_a_batch_are_those_of_its_shapes(batch):
    """Masked entries get zero, the others what they get alone."""
    names = ("evals", "evecs", "mass")
    together = {name: batch[name].clone().requires_grad_() for name in names}
    split = split_batch(batch | together)
    weight = noise(*batch["evecs"].shape[:2])

    def loss(split, weight):
        low, odd = split.evecs_even[..., :1], split.evecs_odd
        heat = torch.where(split.evals_even_mask, torch.exp(-split.evals_even), 0.0)
        return (low**2 * weight[..., None]).sum() + heat.sum() + (split.mass * weight * odd.square().sum(-1)).sum()

    grads = dict(zip(names, torch.autograd.grad(loss(split, weight), list(together.values())), strict=True))
    for b, (shape, k) in enumerate(BATCH):
        basis, n = basis_of(shape.mesh, k), shape.mesh.n_verts
        own = [basis.evals.clone(), basis.evecs.clone(), basis.mass.clone()]
        own = [value.requires_grad_() for value in own]
        alone = symmetrized_bases(*own, group=shape.group.maps)
        expected = torch.autograd.grad(loss(alone, weight[b, :n]), own)
        for name, want in zip(names, expected, strict=True):
            got, scale = grads[name][b], float(want.abs().max())
            inside = got[tuple(slice(size) for size in want.shape)]
            torch.testing.assert_close(inside, want, atol=1e-8 * scale, rtol=0)
            assert float(got.abs().sum() - inside.abs().sum()) == pytest.approx(0, abs=1e-9 * scale)


def test_against_the_naive_twin_where_that_is_finite():
    """All outputs, single vectors too, by autograd's own eigh: at an inexact projection and simple eigenvalues.

    Of an exact symmetry the naive gradient is not finite, or what rounding makes of it: its projection has the
    eigenvalues 0 and 1 only.
    """
    basis = basis_of(blob(2).mesh, 10)
    projection = twin.projection(basis.evecs, basis.mass, blob(2).group.maps) + noise(10, 10, seed=3) / 30
    weights = [noise(10), noise(10, 10, seed=1), noise(10), noise(10, 10, seed=2)]

    def gradients(split, start):
        inputs = [basis.evals.clone().requires_grad_(), start.clone().requires_grad_()]
        parts = split(*inputs)
        total = [(part * w[tuple(map(slice, part.shape))]).sum() for part, w in zip(parts, weights, strict=True)]
        return [part.detach() for part in parts], torch.autograd.grad(sum(total), inputs)

    def ours(evals, projection):
        found = split_bases(evals, basis.evecs, basis.mass, projection)
        return found.evals_even, found.coeffs_even, found.evals_odd, found.coeffs_odd

    (got, got_grads), (want, want_grads) = gradients(ours, projection), gradients(twin.split, projection)
    torch.testing.assert_close(got, want, atol=1e-10, rtol=0)
    torch.testing.assert_close(got_grads, want_grads, atol=1e-8, rtol=0)
    exact = twin.projection(basis.evecs, basis.mass, blob(2).group.maps)
    grads, naive = gradients(ours, exact)[1], gradients(twin.split, exact)[1]
    assert bool(torch.isfinite(grads[1]).all())
    assert not bool(torch.isfinite(naive[1]).all()) or (naive[1] - grads[1]).abs().max() > 0.1 * grads[1].abs().max()


def invariants(split, bounds_even, bounds_odd, points):
    """Of each half, summed over clusters: projectors of coefficients, distances, means; and heat traces."""
    out = []
    for evals, coeffs, evecs, bounds in (
        (split.evals_even, split.coeffs_even, split.evecs_even, bounds_even),
        (split.evals_odd, split.coeffs_odd, split.evecs_odd, bounds_odd),
    ):
        k, n = coeffs.shape[0], len(points)
        kernels, distances, means = [], [], []
        for c, (a, b) in enumerate(bounds[:4]):
            low, at = coeffs[:, a:b], evecs[points, a:b]
            kernels.append((low @ low.T * noise(k, k, seed=c)).sum())
            distances.append((torch.cdist(at, at).square() * noise(n, n, seed=10 + c)).sum())
            means.append(evals[a:b].mean() * (c + 1))
        out += [sum(kernels), sum(distances), sum(means), torch.exp(-0.1 * evals).sum()]
    return tuple(out)


@pytest.mark.parametrize("gap", [0.0, 1e-6, 0.1], ids=["repeated", "clustered", "separated"])
@pytest.mark.parametrize("shape", [mirrored_sphere(), cube()], ids=["sphere", "cube"])
def test_gauge_invariant_losses_on_symmetric_shapes(shape, gap):
    """Moved in random directions from where eigenvalues coincide exactly, by functional matrices, basis and all."""
    basis = truncated(shape, 16)
    k, n = basis.k, basis.n_verts
    group, points = shape.group.maps, torch.arange(0, n, 61)
    spread = gap * torch.arange(k).double()  # what was one cluster becomes neighbours with this gap
    evals = torch.stack([basis.evals[a:b].mean() for a, b in clusters(basis.evals) for _ in range(b - a)])
    split = symmetrized_bases(evals, basis.evecs, basis.mass, group=group)
    bounds = (clusters(split.evals_even), clusters(split.evals_odd))
    assert max(b - a for a, b in bounds[1]) >= 2
    fmaps = torch.stack([basis.coefficients(basis.evecs[g]) for g in group])
    d_evals, d_fmaps = noise(3, k), noise(3, k, k, seed=1) / 10
    d_evecs, d_mass = noise(3, n, k, seed=2) / 10, noise(3, n, seed=3) * basis.mass

    def by_group(t, evals):
        evecs = basis.evecs + torch.einsum("i,ivk->vk", t, d_evecs)
        mass = basis.mass + torch.einsum("i,iv->v", t, d_mass)
        return invariants(symmetrized_bases(evals + t @ d_evals, evecs, mass, group=group), *bounds, points)

    def by_fmaps(t):
        moved = fmaps + torch.einsum("i,ijk->jk", t, d_fmaps)
        split = symmetrized_bases(evals + spread, basis.evecs, basis.mass, fmaps=moved)
        return invariants(split, *bounds, points)

    assert gradcheck64(by_fmaps, torch.zeros(3))
    assert gradcheck64(by_group, torch.zeros(3), evals + spread)


@given(st.integers(0, 10**6))
def test_a_rotation_inside_eigenspaces_changes_nothing(seed):
    """Another basis of the same eigenspaces: the same halves, and of an invariant loss the same gradient, rotated."""
    shape = mirrored_sphere()
    basis = truncated(shape, 9)
    evals = torch.tensor([0.0, *[2.0] * 3, *[6.0] * 5], dtype=torch.float64)
    rotation = torch.block_diag(*(torch.linalg.qr(noise(d, d, seed=seed + d)).Q for d in (1, 3, 5)))
    weight = noise(642)
    results = []
    for evecs in (basis.evecs, basis.evecs @ rotation):
        evecs = evecs.clone().requires_grad_()
        split = symmetrized_bases(evals, evecs, basis.mass, group=shape.group.maps)
        kernel = split.evecs_even[:, 1:3].square().sum(1) + split.evecs_odd[:, :1].square().sum(1)
        (grad,) = torch.autograd.grad((kernel * weight).sum(), evecs)
        results.append((split.evals_even, split.evals_odd, kernel.detach(), grad))
    torch.testing.assert_close(results[0][:3], results[1][:3], atol=1e-8, rtol=0)
    torch.testing.assert_close(results[0][3] @ rotation, results[1][3], atol=1e-7, rtol=0)


def test_the_choice_of_halves_and_spectrum():
    """What is above one half is even; the spectrum has a gradient, so that a loss can push it to 0 and 1."""
    projection = torch.diag(torch.tensor([0.2, 0.9, 0.49, 0.51], dtype=torch.float64)).requires_grad_()
    evals = torch.tensor([0.0, 1.0, 2.0, 3.0], dtype=torch.float64)
    split = split_bases(evals, torch.eye(4).double(), torch.ones(4).double(), projection)
    assert split.evals_even.tolist() == [1.0, 3.0]
    assert split.evals_odd.tolist() == [0.0, 2.0]
    inexact = (split.spectrum * (1 - split.spectrum)).sum()
    (grad,) = torch.autograd.grad(inexact, projection)
    torch.testing.assert_close(grad, torch.diag(1 - 2 * projection.detach().diagonal()), atol=1e-12, rtol=0)


def test_projector_alone(batch):
    """Without the Laplacian: the projector onto the even half, and its gradient at repeated eigenvalues."""
    masks = {name: batch[name] for name in ("verts_mask", "evals_mask")}
    projection = projection_matrices(
        batch["evecs"], batch["mass"], group=batch["group"], group_mask=batch["group_mask"], **masks
    )
    split = split_bases(batch["evals"], batch["evecs"], batch["mass"], projection, **masks)
    found = symmetrized_projector(projection, evals_mask=batch["evals_mask"])
    torch.testing.assert_close(found, split.coeffs_even @ split.coeffs_even.mT, atol=1e-10, rtol=0)
    real = torch.tensor([[True] * 5, [True] * 3 + [False] * 2])
    small = torch.stack([torch.diag(torch.tensor([1.0, 0, 1, 0, 0])), torch.diag(torch.tensor([0.0, 1, 1, 1, 1]))])
    assert gradcheck64(lambda x: symmetrized_projector(x, evals_mask=real), small)


def test_single_precision_keeps_low_eigenvalues():
    """In single precision an eigenvalue 0 next to one of 2000 would come out at 1e-4, with either sign."""
    shape = blob(2)
    basis = basis_of(shape.mesh, 40)
    scaled = SpectralBasis(basis.evals * 20, basis.evecs, basis.mass)  # to 2000
    exact = symmetrized_basis(scaled, shape.group)
    given = (scaled.evals.float().clamp_min(0), scaled.evecs.float(), scaled.mass.float())
    split = symmetrized_bases(*given, group=shape.group.maps)
    assert {value.dtype for value in vars(split).values()} == {torch.float32, torch.bool}
    assert 0 <= float(split.evals_even[0]) < 1e-6
    torch.testing.assert_close(split.evals_even.double(), exact.even_evals, atol=1e-6, rtol=1e-5)
    assert bool((split.evals_odd.diff() >= 0).all())


def test_second_derivatives_raise():
    basis, group = basis_of(blob(2).mesh, 6), blob(2).group.maps
    evecs = basis.evecs.clone().requires_grad_()
    split = symmetrized_bases(basis.evals, evecs, basis.mass, group=group)
    (grad,) = torch.autograd.grad(split.evals_even.square().sum() + evecs.square().sum(), evecs, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiated once, not twice"):
        torch.autograd.grad(grad.sum(), evecs)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"evals": torch.zeros(2, 3).double()},
            r"evals: shape \(2, 3\) given, expected \(2, K\) with K = 2 as in evecs",
        ),
        ({"evals": torch.full((2, 2), torch.nan).double()}, "evals: 4 of 4 entries are NaN or infinite"),
        ({"projection": torch.zeros(2, 3, 3).double()}, r"projection: shape \(2, 3, 3\) given"),
        ({"projection": torch.full((2, 2, 2), torch.inf).double()}, "projection: 8 of 8 entries are NaN or infinite"),
        (
            {"projection": torch.tensor([[[1.0, 0], [0, 1]], [[0.4, 0], [0, 0.1]]]).double()},
            r"is 0\.4, sample 1, so no",
        ),
        ({"k_even": -1}, "k_even is -1: allowed are 0 and more"),
        ({"k_odd": -2}, "k_odd is -2: allowed are 0 and more"),
        ({"evals_mask": torch.zeros(2, 2).bool()}, r"evals_mask: no true element in row\(s\) \[0, 1\]"),
    ],
)
def test_what_is_wrong_is_named(change, message):
    eye = torch.eye(2, dtype=torch.float64).repeat(2, 1, 1)
    arguments = {
        "evals": torch.zeros(2, 2).double(),
        "evecs": eye,
        "mass": torch.ones(2, 2).double(),
        "projection": eye,
    }
    with pytest.raises(ValueError, match=message):
        unchecked(split_bases)(**(arguments | change))


def test_no_even_function_without_checks_is_an_empty_half():
    eye = torch.eye(2, dtype=torch.float64)
    with checks.disabled():
        split = split_bases(torch.zeros(2).double(), eye, torch.ones(2).double(), 0.4 * eye, k_even=1, k_odd=2)
    assert split.evals_even_mask.tolist() == [False]
    assert split.evecs_even.abs().sum() == 0


def test_the_trivial_group_changes_nothing():
    basis = basis_of(blob(1).mesh, 12)
    group = SymmetryGroup.trivial(642).maps
    split = symmetrized_bases(basis.evals, basis.evecs, basis.mass, group=group)
    torch.testing.assert_close(split.evecs_even, basis.evecs, atol=1e-10, rtol=0)  # the signs, too
    assert split.evecs_odd.shape == (642, 0)


def test_no_shape_and_no_function():
    evals, evecs, mass = torch.zeros(0, 3), torch.zeros(0, 5, 3), torch.ones(0, 5)
    split = symmetrized_bases(evals, evecs, mass, fmaps=torch.zeros(0, 3, 3))
    assert split.evecs_even.shape == split.evecs_odd.shape == (0, 5, 0)
    assert symmetrized_bases(evals, evecs, mass, fmaps=torch.zeros(0, 3, 3), k_even=2).evecs_even.shape == (0, 5, 2)
    with pytest.raises(ValueError, match=r"evecs: shape \(5, 0\) given, expected at least one function"):
        symmetrized_bases(torch.zeros(0), torch.zeros(5, 0), torch.ones(5), fmaps=torch.zeros(0, 0))
    with pytest.raises(ValueError, match=r"projection: shape \(0, 0\) given, expected at least one function"):
        symmetrized_projector(torch.zeros(0, 0))
    with pytest.raises(ValueError, match=r"mass > 0: no true element in row\(s\) \[0\]"):
        symmetrized_bases(torch.zeros(3), torch.eye(5)[:, :3], torch.zeros(5), fmaps=torch.eye(3))
