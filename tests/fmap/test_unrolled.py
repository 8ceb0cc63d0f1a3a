"""torchqm.fmap.unrolled: with a temperature near zero the classical refinement, and gradients through all steps."""

import pytest
import torch
from references.pairs import exact_pair
from references.unchecked import unchecked

from torchqm.fmap import nearest_isometry, quotient_icp, upsample
from torchqm.fmap.unrolled import soft_icp, soft_upsample
from torchqm.testing import gradcheck64

COLD = 1e-7
"""All weight goes to the nearest."""


def blurred(size, seed=0, amount=0.15):
    noise = torch.randn(size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return nearest_isometry(torch.eye(size, dtype=torch.float64) + amount * noise)


@pytest.fixture(scope="module")
def pair():
    exact = exact_pair()
    return exact.x.basis.truncate(20), exact.y.basis.truncate(20)


@pytest.mark.parametrize("neighbours", [None, 4])
def test_cold_is_icp(pair, neighbours):
    x, y = (basis.truncate(8) for basis in pair)
    samples = torch.arange(0, x.n_verts, 3)
    start = blurred(8)
    found = soft_icp(start, x.evecs[samples], y.evecs, 3, COLD, neighbours)
    torch.testing.assert_close(found, quotient_icp(start, x, y, samples, 3))
    assert not torch.allclose(found, start, atol=1e-2)


def test_cold_is_upsampling(pair):
    x, y = pair
    samples = torch.arange(0, x.n_verts, 3)
    start = blurred(8)
    found = soft_upsample(start, x.evecs[samples], y.evecs, [12, 20], 2, COLD)
    torch.testing.assert_close(found, upsample(start, x, y, samples, [12, 20], 2))


def test_a_batch_is_each_alone_and_padding_stays_empty(pair):
    x, y = pair
    first = soft_icp(blurred(8), x.evecs[:60, :8], y.evecs[:, :8], 2, mass_x=x.mass[:60])
    second = soft_icp(blurred(6, 1), x.evecs[:90, :6], y.evecs[:500, :6], 2, mass_x=x.mass[:90])
    pad = torch.nn.functional.pad
    n = y.n_verts
    masks = torch.arange(8) < torch.tensor([[8], [6]])
    both = soft_icp(
        torch.stack([blurred(8), pad(blurred(6, 1), (0, 2, 0, 2))]),
        torch.stack([pad(x.evecs[:60, :8], (0, 0, 0, 30)), pad(x.evecs[:90, :6], (0, 2))]),
        torch.stack([y.evecs[:, :8], pad(y.evecs[:500, :6], (0, 2, 0, n - 500))]),
        2,
        mass_x=torch.stack([pad(x.mass[:60], (0, 30)), x.mass[:90]]),
        verts_mask_y=torch.arange(n) < torch.tensor([[n], [500]]),
        evals_mask_x=masks,
        evals_mask_y=masks,
    )
    torch.testing.assert_close(both[0], first)
    torch.testing.assert_close(both[1, :6, :6], second)
    assert not both[1, 6:].any()
    assert not both[1, :, 6:].any()


@pytest.mark.parametrize("neighbours", [None, 4])
def test_upsampling_of_unequal_numbers_of_functions_is_each_alone(pair, neighbours):
    """Padding holds anything finite, on the functions, the vertices and the map; gradients do not reach it."""
    x, y = pair
    counts_x, counts_y, points_x, points_y = (20, 9, 6), (20, 12, 5), (60, 90, 80), (642, 300, 500)
    start, sizes = 8, [10, 16, 20]
    alone, batch = [], {name: [] for name in ("fmap", "x", "y", "mass")}
    for i, (kx, ky, nx, ny) in enumerate(zip(counts_x, counts_y, points_x, points_y, strict=True)):
        fmap = blurred(start, i)[:ky, :kx]
        given = fmap, x.evecs[:nx, :kx], y.evecs[:ny, :ky]
        grown = None
        # Alone a shape has no functions beyond its own: sizes end there, on each side.
        for size in sizes:
            grown = rectangular(
                fmap if grown is None else grown, *given[1:], min(size, ky), min(size, kx), neighbours, x.mass[:nx]
            )
        alone.append(grown)
        for name, value, shape in (
            ("fmap", fmap, (start, start)),
            ("x", given[1], (90, 20)),
            ("y", given[2], (642, 20)),
            ("mass", x.mass[:nx], (90,)),
        ):
            padded = torch.full(shape, 0.0 if name == "mass" else 3.0, dtype=torch.float64)
            padded[tuple(slice(n) for n in value.shape)] = value
            batch[name].append(padded)
    fmaps, at_x, at_y, mass = (torch.stack(batch[name]) for name in ("fmap", "x", "y", "mass"))
    at_x[..., 60:, :][0] = at_x[2, 80:] = 0.0  # padded vertices are told by their area of 0 and by the mask of y
    fmaps, at_x, at_y = (tensor.requires_grad_() for tensor in (fmaps, at_x, at_y))
    found = soft_upsample(
        *(fmaps, at_x, at_y, sizes, 1, 0.05, neighbours, mass),
        torch.arange(642) < torch.tensor(points_y)[:, None],
        torch.arange(20) < torch.tensor(counts_x)[:, None],
        torch.arange(20) < torch.tensor(counts_y)[:, None],
    )
    for i, (kx, ky) in enumerate(zip(counts_x, counts_y, strict=True)):
        torch.testing.assert_close(found[i, :ky, :kx], alone[i], atol=1e-9, rtol=0)
        assert not found[i, ky:].any()
        assert not found[i, :, kx:].any()
    grads = torch.autograd.grad(found.square().mul(torch.arange(20)).sum(), (fmaps, at_x, at_y))
    assert all(bool(torch.isfinite(grad).all()) for grad in grads)
    assert not grads[0][2, 5:].any()
    assert not grads[1][1, :, 9:].any()
    assert not grads[2][1, :, 12:].any()


def rectangular(fmap, at_x, at_y, size_y, size_x, neighbours, mass):
    """One step from a map of any size to another, written with dense matrices."""
    ky, kx = fmap.shape
    gaps = torch.cdist(at_x[:, :kx] @ fmap.T, at_y[:, :ky]).square() / ky
    if neighbours is not None:
        gaps = gaps.masked_fill(gaps > gaps.sort(1).values[:, neighbours - 1, None], torch.inf)
    partners = torch.softmax(-gaps / 0.05, 1) @ at_y[:, :size_y]
    left, _, right = torch.linalg.svd(partners.T @ (mass[:, None] * at_x[:, :size_x]), full_matrices=False)
    return left @ right


def test_masks_of_functions_are_checked(pair):
    x, y = pair
    none = torch.arange(20) >= 9
    grow = unchecked(soft_upsample)
    with pytest.raises(ValueError, match=r"evals_mask_x\[\.\.\., :8\]: no true element"):
        grow(blurred(8), x.evecs, y.evecs, [10, 20], evals_mask_x=none)
    with pytest.raises(
        ValueError, match=r"evals_mask_y: shape \(8,\) given, expected \(K,\) with K = 20 as in evecs_y"
    ):
        grow(blurred(8), x.evecs, y.evecs, [10, 20], evals_mask_y=none[:8])
    with pytest.raises(TypeError, match=r"sizes\[0\]: 9.5 \(float\) given"):
        grow(blurred(8), x.evecs, y.evecs, [9.5])


@pytest.mark.parametrize("neighbours", [None, 3])
def test_gradients(pair, neighbours):
    x, y = pair
    at_x, at_y, weights = x.evecs[:9, :4], y.evecs[40:52, :4], x.mass[:9]
    gradcheck64(
        lambda c, a, b, w, t: soft_icp(c, a, b, 2, t, neighbours, w).square().mul(torch.arange(4.0)).sum(),
        *(blurred(4), at_x, at_y, weights, torch.tensor(0.3)),
    )
    gradcheck64(
        lambda c, a, b: soft_upsample(c, a, b, [3, 4], 1, 0.3, neighbours).square().mul(torch.arange(4.0)).sum(),
        *(blurred(2), at_x, at_y),
    )


def test_a_semi_quotient_map_keeps_its_shape(pair):
    x, y = pair
    start = nearest_isometry(blurred(8)[:5])
    found = soft_icp(start, x.evecs[:, :8], y.evecs[:, :5], 2)
    torch.testing.assert_close(found @ found.T, torch.eye(5, dtype=torch.float64))


def test_bad_input_is_named(pair):
    x, y = pair
    start = blurred(8)
    at_x, at_y = x.evecs[:, :8], y.evecs[:, :8]
    icp, grow = unchecked(soft_icp), unchecked(soft_upsample)
    with pytest.raises(ValueError, match=r"evecs_x: shape \(642, 9\) given, .* Kx = 8 as in fmap_xy"):
        icp(start, x.evecs[:, :9], at_y)
    with pytest.raises(ValueError, match="tau: 0 given, expected a positive number"):
        icp(start, at_x, at_y, tau=0)
    with pytest.raises(ValueError, match=r"neighbours: 700 given, but y has 642 vertices, so 1\.\.642 is allowed"):
        icp(start, at_x, at_y, neighbours=700)
    with pytest.raises(ValueError, match="mass_x: 642 of 642 entries are negative"):
        icp(start, at_x, at_y, mass_x=-x.mass)
    with pytest.raises(ValueError, match="mass_x > 0: no true element"):
        icp(start, at_x, at_y, mass_x=0 * x.mass)
    with pytest.raises(ValueError, match=r"evals_mask_x: dtype torch\.float64 given"):
        icp(start, at_x, at_y, evals_mask_x=torch.ones(8, dtype=torch.float64))
    with pytest.raises(ValueError, match="steps: -1 given, expected a whole number from 0 on"):
        icp(start, at_x, at_y, -1)
    with pytest.raises(ValueError, match="fmap_xy: 64 of 64 entries are NaN"):
        icp(start * torch.nan, at_x, at_y)
    with pytest.raises(ValueError, match=r"sizes: \[21\] given, but the bases have 20 and 20 functions"):
        grow(start, x.evecs, y.evecs, [10, 21])
    with pytest.raises(ValueError, match=r"fmap_xy: shape \(8, 8\) given, but the bases have 5 and 20"):
        grow(start, x.evecs, at_y[:, :5], [5])
