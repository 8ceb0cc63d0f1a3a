"""torchqm.fmap.regularized: the minimum of the energy as written, weights, padding, blocks, and where there is none."""

from functools import partial

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import dense
from references.fmap_layers import energy, fmap_by_inverses
from references.unchecked import unchecked

from torchqm.fmap import solve_fmap
from torchqm.fmap.commutativity import COMMUTATIVITY, commutativity_mask
from torchqm.fmap.regularized import descriptor_coefficients, regularized_blocks, regularized_fmap
from torchqm.fmap.rows import UndeterminedRowsError
from torchqm.testing import gradcheck64


def problem(*leading, kx=5, ky=4, c=7, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    a, b = (torch.randn(*leading, k, c, generator=generator, dtype=dtype) for k in (kx, ky))
    x, y = (3 * torch.rand(*leading, k, generator=generator, dtype=dtype).sort(-1).values for k in (kx, ky))
    return a, b, x, y


@pytest.mark.parametrize("kind", COMMUTATIVITY)
@pytest.mark.parametrize(("kx", "ky", "c"), [(5, 5, 9), (6, 3, 4), (3, 6, 2)])
def test_the_minimum_of_the_energy(kind, kx, ky, c):
    """Where the gradient of the energy, written as sums, is zero: nothing of the solver is used to say so."""
    a, b, x, y = problem(kx=kx, ky=ky, c=c)
    fmap = regularized_fmap(a, b, x, y, 0.7, commutativity=kind, ridge=0.1).requires_grad_()
    ridge = 0.1 * a.square().sum() / kx
    (slope,) = torch.autograd.grad(energy(fmap, a, b, commutativity_mask(x, y, kind), 0.7, ridge), fmap)
    assert slope.abs().max() < 1e-12 * a.square().sum()
    assert fmap.detach().abs().max() > 0.01


def test_as_inverses_row_by_row():
    a, b, x, y = problem(3, kx=40, ky=30, c=50)
    for row_chunk in (None, 7):
        fmap = regularized_fmap(a, b, x, y, 5.0, gamma=0.3, row_chunk=row_chunk)
        wanted = fmap_by_inverses(a, b, commutativity_mask(x, y, gamma=0.3), 5.0)
        torch.testing.assert_close(fmap, wanted, atol=1e-11, rtol=1e-10)


@pytest.mark.parametrize(("normalize", "kind"), [(True, "normalized"), (False, "squared")])
def test_the_classical_pipeline_gets_the_same(normalize, kind):
    a, b, x, y = problem(kx=40, ky=35, c=60)
    classical = solve_fmap(a, b, x, y, 2.5, normalize, ridge=1e-3)
    layer = regularized_fmap(a, b, x, y, 2.5, commutativity=kind, ridge=1e-3)
    torch.testing.assert_close(layer, classical, atol=1e-12, rtol=1e-12)
    if not normalize:
        torch.testing.assert_close(
            regularized_fmap(a, b, x, y, 2.5, commutativity=kind), dense.solve_fmap(a, b, x, y, 2.5)
        )


def test_weights():
    a, b, x, y = problem(2)
    twice = torch.tensor([1, 1, 2, 1, 0, 1, 1]).double()
    repeated = [side[..., [0, 1, 2, 2, 3, 5, 6]] for side in (a, b)]
    expected = regularized_fmap(*repeated, x, y)
    torch.testing.assert_close(regularized_fmap(a, b, x, y, weights=twice), expected)
    torch.testing.assert_close(regularized_fmap(a, b, x, y, weights=torch.stack([twice, twice])), expected)
    # trusting the descriptors s times as much is lmbda / s
    s = torch.tensor([0.5, 4.0]).double()
    torch.testing.assert_close(
        regularized_fmap(a, b, x, y, 3.0, sample_weights=s), regularized_fmap(a, b, x, y, 3.0 / s)
    )
    for i in range(2):
        torch.testing.assert_close(
            regularized_fmap(a, b, x, y, 3.0 / s)[i], regularized_fmap(a[i], b[i], x[i], y[i], 3.0 / float(s[i]))
        )


@pytest.mark.parametrize("ridge", [0.0, 0.1])
@pytest.mark.parametrize("kind", COMMUTATIVITY)
def test_a_shape_in_a_padded_batch(kind, ridge):
    """Its result, and its gradients, are those of the shape alone, and zero in the padding, whatever lies there."""
    large, small = problem(kx=6, ky=5), problem(kx=4, ky=3, seed=1)
    for _, _, x, y in (large, small):
        x[0], y[0] = 0, 0  # the constant function, with which eigenvalues of padding would commute
    padded = [side.new_full(side.shape, 7.0) for side in large]
    for tensor, part in zip(padded, small, strict=True):
        tensor[tuple(slice(n) for n in part.shape)] = part
    padded[2][4:], padded[3][3:] = 100.0, -50.0
    batch = [torch.stack(pair).requires_grad_() for pair in zip(padded, large, strict=True)]
    masks = {
        "evals_mask_x": torch.arange(6) < torch.tensor([[4], [6]]),
        "evals_mask_y": torch.arange(5) < torch.tensor([[3], [5]]),
    }
    fmap = regularized_fmap(*batch, commutativity=kind, ridge=ridge, **masks)
    alone = [tensor.clone().requires_grad_() for tensor in small]
    expected = regularized_fmap(*alone, commutativity=kind, ridge=ridge)
    torch.testing.assert_close(fmap[0, :3, :4], expected)
    torch.testing.assert_close(fmap[1], regularized_fmap(*large, commutativity=kind, ridge=ridge))
    assert fmap[0, 3:].abs().max() == 0
    assert fmap[0, :, 4:].abs().max() == 0
    weight = torch.arange(30.0).double().view(5, 6).sin()  # on the padding, too
    for ours, wanted in zip(
        torch.autograd.grad(fmap[0], batch, weight), torch.autograd.grad(expected, alone, weight[:3, :4]), strict=True
    ):
        own = ours[0][tuple(slice(n) for n in wanted.shape)]
        torch.testing.assert_close(own, wanted)
        assert ours[0].abs().sum() - own.abs().sum() < 1e-12


def test_padded_rows_need_no_descriptors():
    """Without them, the entry of two constant functions is undetermined; here only padding would have it."""
    a, b, x, y = problem(2, kx=4, ky=3)
    a[:, 0], x[:, 0] = 0, 0
    mask = torch.arange(3) < torch.tensor([[2], [3]])
    fmap = regularized_fmap(a, b, x, y, evals_mask_y=mask)
    torch.testing.assert_close(fmap[0, :2], regularized_fmap(a[0], b[0, :2], x[0], y[0, :2]))
    with pytest.raises(ValueError, match=r"leave row\(s\) \[2\] of sample 0 of the map"):
        regularized_fmap(a, b, x, y * mask)


def test_blocks_are_those_of_one_map():
    """Two bases, one spectrum: with even and odd descriptors the full map is block-diagonal."""
    a, b, x, y = problem(2, kx=9, ky=8, c=12)
    even_x, even_y = torch.arange(9) % 3 != 1, torch.arange(8) % 3 != 1
    odd = torch.arange(12) >= 6
    a, b = (side * (even[:, None] ^ odd) for side, even in ((a, even_x), (b, even_y)))
    full = regularized_fmap(a, b, x, y, 2.0)
    blocks = regularized_blocks(
        [a[:, even_x], a[:, ~even_x]],
        [b[:, even_y], b[:, ~even_y]],
        [x[:, even_x], x[:, ~even_x]],
        [y[:, even_y], y[:, ~even_y]],
        2.0,
    )
    torch.testing.assert_close(blocks[0], full[:, even_y][:, :, even_x])
    torch.testing.assert_close(blocks[1], full[:, ~even_y][:, :, ~even_x])
    assert full[:, even_y][:, :, ~even_x].abs().max() < 1e-14


@pytest.mark.parametrize("width", [0, 2])
def test_blocks_of_a_shape_without_odd_functions(width):
    a, b, x, y = problem(2)
    empty = torch.ones(2, width, 7).double(), torch.ones(2, width).double()
    none = torch.zeros(2, width, dtype=torch.bool)
    full = [torch.ones_like(evals, dtype=torch.bool) for evals in (x, y)]
    sides = [[a, empty[0]], [b, empty[0]], [x, 100 * empty[1]], [y, empty[1]]]
    even, odd = regularized_blocks(*sides, evals_mask_x=[full[0], none], evals_mask_y=[None, none])
    torch.testing.assert_close(even, regularized_fmap(a, b, x, y))
    assert torch.equal(odd, torch.zeros(2, width, width).double())


def test_ridge_decides_what_nothing_else_does():
    a, b, x, _ = problem(2, ky=5)
    zero = torch.zeros_like(a)
    assert torch.equal(regularized_fmap(zero, b, x, x, ridge=1e-6), torch.zeros(2, 5, 5).double())
    with pytest.raises(ValueError, match=r"row\(s\) \[0, 1, 2, 3, 4\] of sample 0, .* a ridge \(1e-9\), more"):
        regularized_fmap(zero, b, x, x)  # the resolvent leaves the diagonal free
    # one descriptor twice: of all maps that explain it the shortest
    one = a[..., :1].expand(2, 5, 3)
    fmap = regularized_fmap(one, b[..., :1].expand(2, 5, 3), x, x, 0.0, ridge=1e-9)
    shortest = b[..., :1] @ a[..., :1].mT / a[..., :1].square().sum(1, keepdim=True)
    torch.testing.assert_close(fmap, shortest, atol=1e-6, rtol=1e-6)
    with pytest.raises(ValueError, match="of sample 0"):
        regularized_fmap(one, b[..., :3], x, x, 0.0)
    with pytest.raises(ValueError, match="of sample 0"):  # below float32's precision a ridge is none
        regularized_fmap(one.float(), b[..., :3].float(), x.float(), x.float(), 0.0, ridge=1e-9)


@given(
    seed=st.integers(0, 10**6),
    rank=st.integers(0, 6),
    equal=st.booleans(),
    lmbda=st.sampled_from([0.0, 1e-6, 100.0]),
    ridge=st.sampled_from([0.0, 1e-12, 1e-3]),
    scale=st.sampled_from([1e-20, 1.0, 1e12]),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_never_nan(seed, rank, equal, lmbda, ridge, scale, dtype):
    """Whatever the rank: the error that names rows, or a solution of the equations."""
    a, b, x, y = problem(kx=6, ky=6, c=8, seed=seed, dtype=dtype)
    a = scale**0.5 * a[:, :rank] @ torch.randn(rank, 8, dtype=dtype, generator=torch.Generator().manual_seed(seed + 1))
    if equal:
        y = x
    try:
        fmap = regularized_fmap(a, b, x, y, lmbda, ridge=ridge)
    except UndeterminedRowsError:
        assert ridge < 1e-3  # that one determines everything
        return
    assert torch.isfinite(fmap).all()
    gram = (a @ a.T).double()
    total = float(gram.diagonal().mean()) or 1.0
    diagonal = lmbda * commutativity_mask(x, y).double() + ridge * total
    systems = gram + torch.diag_embed(diagonal)
    residual = (systems @ fmap.double()[..., None])[..., 0] - (b @ a.T).double()
    size = systems.abs().sum((-1, -2)) * fmap.double().norm(dim=-1) + (b @ a.T).double().norm(dim=-1)
    assert (residual.norm(dim=-1) <= 100 * torch.finfo(dtype).eps * size).all()


@given(seed=st.integers(0, 10**6), kind=st.sampled_from(COMMUTATIVITY))
def test_signs_of_the_bases(seed, kind):
    a, b, x, y = problem(seed=seed)
    generator = torch.Generator().manual_seed(seed)
    sx, sy = (torch.randint(0, 2, (k,), generator=generator).double() * 2 - 1 for k in (5, 4))
    turned = regularized_fmap(sx[:, None] * a, sy[:, None] * b, x, y, commutativity=kind)
    torch.testing.assert_close(turned, sy[:, None] * regularized_fmap(a, b, x, y, commutativity=kind) * sx)


SPECTRA = {
    "separated": [0.2, 1.0, 2.1, 3.4],
    "clustered": [0.2, 1.0, 1.0 + 1e-7, 3.4],
    "repeated": [0.2, 1.0, 1.0, 1.0],
}


@pytest.mark.parametrize("kind", COMMUTATIVITY)
@pytest.mark.parametrize("spectrum", SPECTRA)
def test_gradients(kind, spectrum):
    a, b, _, _ = problem(kx=4, ky=4, c=5)
    x = torch.tensor(SPECTRA[spectrum]).double()
    y = torch.cat([x[:3], x.new_tensor([5.0])])
    for chunk in (None, 3):
        solve = partial(regularized_fmap, commutativity=kind, row_chunk=chunk)
        assert gradcheck64(solve, a, b, x, y, torch.tensor(2.0))


def test_gradients_of_everything_at_once():
    """Rectangular, masked, weighted, with a ridge."""
    a, b, x, y = problem(2, kx=4, ky=3, c=5)
    mask_x, mask_y = torch.arange(4) < torch.tensor([[4], [3]]), torch.arange(3) < torch.tensor([[2], [3]])

    def solve(a, b, x, y, lmbda, weights, sample_weights):
        options = {"evals_mask_x": mask_x, "evals_mask_y": mask_y, "ridge": 0.2}
        return regularized_fmap(a, b, x, y, lmbda, weights=weights, sample_weights=sample_weights, **options)

    weights = torch.rand(2, 5, generator=torch.Generator().manual_seed(3)) + 0.5
    assert gradcheck64(solve, a, b, x, y, torch.tensor([2.0, 0.3]), weights, torch.tensor([1.5, 0.5]))


def test_gradients_of_blocks():
    even, odd = problem(2, kx=3, ky=2, c=4), problem(2, kx=2, ky=2, c=4, seed=1)

    def solve(*sides):
        return regularized_blocks(*zip(sides[:4], sides[4:], strict=True), 3.0)

    assert gradcheck64(solve, *even, *odd)


def few_descriptors(scale, c, k=50, dtype=torch.float32):
    """Nearly isometric spectra and random descriptors, their coefficients of size ``scale``, given in float32."""
    g = torch.Generator().manual_seed(c)
    a = scale * torch.randn(1, k, c, generator=g)
    truth = torch.linalg.qr(torch.eye(k) + 0.05 * torch.randn(1, k, k, generator=g))[0]
    x = (12.57 * (torch.arange(k) + 0.3 * torch.rand(1, k, generator=g))).sort(-1).values
    y = (x * (1 + 0.003 * torch.randn(1, k, generator=g))).sort(-1).values
    return [tensor.to(dtype) for tensor in (a, truth @ a, x, y)]


def row_errors(found, exact):
    return (found - exact).norm(dim=-1) / exact.norm(dim=-1)


@pytest.mark.parametrize("c", [3, 10, 30, 49])
def test_few_descriptors_in_single_precision(c):
    """Less than functions, at the scale of functions on a shape of area 1: commutativity makes up for them."""
    exact = regularized_fmap(*few_descriptors(1.0, c, dtype=torch.float64))
    assert float(row_errors(regularized_fmap(*few_descriptors(1.0, c)), exact).max()) < 1e-3


@pytest.mark.parametrize("c", [3, 10, 30])
def test_what_single_precision_refuses_is_noise(c):
    """A hundred times as large: of the rows that are refused rounding leaves two digits at best; a ridge helps."""
    given = few_descriptors(100.0, c)
    said = r"undetermined, to the precision of torch\.float32; give .* a ridge \(1e-3\), .* or float64"
    with pytest.raises(UndeterminedRowsError, match=said) as raised:
        regularized_fmap(*given)
    refused = raised.value.undetermined
    exact = regularized_fmap(*few_descriptors(100.0, c, dtype=torch.float64))
    # As ULRSSM does it, an inverse a row: what it would have returned.
    a, b, x, y = given
    systems = (a @ a.mT)[:, None] + torch.diag_embed(100 * commutativity_mask(x, y))
    inverted = (torch.linalg.inv(systems) @ (b @ a.mT)[..., None])[..., 0]
    errors = row_errors(inverted, exact)[refused]
    assert float(errors.median()) > 1e-2
    assert float((errors > 1e-3).float().mean()) > 0.99
    ridge = {"ridge": 1e-3}
    helped = row_errors(regularized_fmap(*given, **ridge), regularized_fmap(*(t.double() for t in given), **ridge))
    assert float(helped.max()) < 1e-2
    with pytest.raises(UndeterminedRowsError):
        regularized_fmap(*given, ridge=1e-7)  # below the precision


def test_under_vmap():
    a, b, x, y = problem(3)
    torch.testing.assert_close(torch.func.vmap(regularized_fmap)(a, b, x, y), regularized_fmap(a, b, x, y))


def test_refusals():
    a, b, x, y = problem(2)
    solve = unchecked(regularized_fmap)
    with pytest.raises(ValueError, match=r"coeffs_y: shape \(2, 4, 6\) given, .* with C = 7 as in coeffs_x"):
        solve(a, b[..., :6], x, y)
    with pytest.raises(ValueError, match=r"evals_x: shape \(2, 4\) given, .* with Kx = 5 as in coeffs_x"):
        solve(a, b, x[:, :4], y)
    with pytest.raises(ValueError, match="evals_y: 8 of 8 entries are NaN"):
        solve(a, b, x, y * torch.nan)
    with pytest.raises(ValueError, match="coeffs_x: 1 of 70"):
        solve(a + spike(a), b, x, y)
    for lmbda in (-1.0, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=f"lmbda is {lmbda}"):
            solve(a, b, x, y, lmbda)
    with pytest.raises(ValueError, match="lmbda: 1 of 2 entries are negative"):
        solve(a, b, x, y, torch.tensor([1.0, -1.0]))
    with pytest.raises(ValueError, match="lmbda: shape"):
        solve(a, b, x, y, torch.ones(3))
    with pytest.raises(ValueError, match="ridge is -1"):
        solve(a, b, x, y, ridge=-1)
    with pytest.raises(ValueError, match="weights: 1 of 7 entries are negative"):
        solve(a, b, x, y, weights=torch.tensor([1.0, 1, 1, -1, 1, 1, 1]))
    with pytest.raises(ValueError, match=r"weights: shape \(2, 3\)"):
        solve(a, b, x, y, weights=torch.ones(2, 3))
    with pytest.raises(ValueError, match="sample_weights"):
        solve(a, b, x, y, sample_weights=torch.ones(3))
    with pytest.raises(ValueError, match=r"evals_mask_x: no true element in row\(s\) \[1\]"):
        solve(a, b, x, y, evals_mask_x=torch.tensor([[True] * 5, [False] * 5]))
    with pytest.raises(ValueError, match=r"evals_mask_y: shape \(2, 5\)"):
        solve(a, b, x, y, evals_mask_y=torch.ones(2, 5, dtype=torch.bool))
    blocks = unchecked(regularized_blocks)
    with pytest.raises(ValueError, match="evals_y: 1 blocks given, coeffs_x has 2"):
        blocks([a, a], [b, b], [x, x], [y])
    none = torch.zeros(2, 5, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"evals_mask_x\[0\]: no true element"):
        blocks([a, a], [b, b], [x, x], [y, y], evals_mask_x=[none, none])


def spike(like):
    out = torch.zeros_like(like)
    out[1, 2, 3] = torch.inf
    return out


def test_coefficients_name_the_side_that_is_not_finite():
    feat, trans = torch.ones(2, 6, 4), torch.ones(2, 4, 6)
    with pytest.raises(ValueError, match=r"feat_y: 1 of 48 entries are NaN or infinite, the first at \(1, 2, 3\)"):
        descriptor_coefficients(feat + spike(feat), trans, ("feat_y", "evecs_trans_y"))
    with pytest.raises(ValueError, match="evecs_trans: 1 of 48"):
        descriptor_coefficients(feat, trans + spike(trans))
    with pytest.raises(ValueError, match=r"evecs_trans: shape \(2, 4, 5\) given, .* with V = 6 as in feat"):
        unchecked(descriptor_coefficients)(feat, trans[..., :5])
