"""torchqm.nn.solver: what ULRSSM's layer returns, in both precisions, and what that one cannot do."""

from functools import partial

import pytest
import torch
from references.fmap_layers import regularized_fmap_net
from references.unchecked import unchecked

from torchqm.fmap.compiled import kernel_for
from torchqm.fmap.regularized import regularized_fmap
from torchqm.nn.solver import FunctionalMapSolver


def pair(b=3, k=40, c=60, v=200, dtype=torch.float64, kx=None, seed=0):
    generator = torch.Generator().manual_seed(seed)
    kx = kx or k
    feats = [torch.randn(b, v + i, c, generator=generator, dtype=dtype) for i in range(2)]
    evals = [0.3 + 12 * (torch.arange(n) + torch.rand(b, n, generator=generator, dtype=dtype)) for n in (kx, k)]
    trans = [
        torch.linalg.qr(torch.randn(b, v + i, n, generator=generator, dtype=dtype))[0].mT for i, n in enumerate((kx, k))
    ]
    return [*feats, *evals, *trans]


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_as_the_layer_of_ulrssm(dtype, bound):
    """The map and its gradients for all six inputs, against inverses row by row (in float64 on the same numbers)."""
    given = [tensor.requires_grad_() for tensor in pair(dtype=dtype)]
    exact = [tensor.detach().double().requires_grad_() for tensor in given]
    fmap_xy, fmap_yx = FunctionalMapSolver(lmbda=100, resolvant_gamma=0.5, bidirectional=True)(*given)
    x_first, y_first = exact, [exact[i] for i in (1, 0, 3, 2, 5, 4)]
    wanted_xy, wanted_yx = regularized_fmap_net(*x_first), regularized_fmap_net(*y_first)
    assert fmap_xy.dtype == dtype
    for ours, wanted in ((fmap_xy, wanted_xy), (fmap_yx, wanted_yx)):
        assert (ours - wanted).norm() < bound * wanted.norm()
    weight = torch.randn(wanted_xy.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(9))
    ours = torch.autograd.grad(((fmap_xy + fmap_yx) * weight).sum(), given)
    for grad, expected in zip(ours, torch.autograd.grad(((wanted_xy + wanted_yx) * weight).sum(), exact), strict=True):
        assert (grad - expected).norm() < 3 * bound * expected.norm()


def test_one_direction_and_other_options():
    given = pair(k=6, c=9)
    layer = FunctionalMapSolver(30.0, 0.7, row_chunk=4)
    fmap, nothing = layer(*given)
    assert nothing is None
    torch.testing.assert_close(fmap, regularized_fmap_net(*given, lmbda=30.0, gamma=0.7))
    kept = {}
    for row_chunk in (None, 4):
        sizes = kept[row_chunk] = []
        feat_x = given[0].clone().requires_grad_()
        with torch.autograd.graph.saved_tensors_hooks(lambda t, s=sizes: s.append(t.shape) or t, lambda t: t):
            FunctionalMapSolver(row_chunk=row_chunk)(feat_x, *given[1:])
    kernel = kernel_for(feat_x.device, feat_x.dtype)
    shape = kernel.factor_shape(3, 6, 6) if kernel else (6, 3, 6, 6)
    assert kept[None].count(shape) == 1
    assert kept[4].count(shape) == 0
    coeffs = [trans @ feat for feat, trans in zip(given[:2], given[4:], strict=True)]
    for kind in ("squared", "normalized"):
        options = {"commutativity": kind, "ridge": 0.1}
        expected = regularized_fmap(*coeffs, *given[2:4], 2.0, **options)
        torch.testing.assert_close(FunctionalMapSolver(2.0, **options)(*given)[0], expected)
    assert repr(layer) == "FunctionalMapSolver(lmbda=30.0, commutativity='resolvent', bidirectional=False)"


def test_semi_quotient():
    given = pair(k=5, kx=8, c=12)
    fmap_xy, fmap_yx = FunctionalMapSolver(bidirectional=True)(*given)
    assert (fmap_xy.shape, fmap_yx.shape) == ((3, 5, 8), (3, 8, 5))
    torch.testing.assert_close(fmap_xy, regularized_fmap_net(*given))


def test_a_learned_weight():
    given = pair(k=4, c=6)
    layer = FunctionalMapSolver(20.0, learn_lmbda=True)
    assert [name for name, _ in layer.named_parameters()] == ["log_lmbda"]
    torch.testing.assert_close(layer(*given)[0], FunctionalMapSolver(20.0)(*given)[0], atol=1e-6, rtol=1e-6)
    layer(*given)[0].square().sum().backward()
    near = [FunctionalMapSolver(20.0 * (1 + h))(*given)[0].square().sum() for h in (-1e-4, 1e-4)]
    torch.testing.assert_close(layer.log_lmbda.grad.double(), (near[1] - near[0]) / 2e-4, atol=0, rtol=1e-4)
    assert layer.double()(*given)[0].dtype == torch.float64
    assert list(FunctionalMapSolver().parameters()) == []
    with pytest.raises(ValueError, match="lmbda: 0 given, expected a positive number"):
        FunctionalMapSolver(0, learn_lmbda=True)


def test_further_descriptors_and_weights():
    """Further descriptors are more features with a weight of their own."""
    given, more = pair(k=5, c=7), pair(k=5, c=3, seed=4)[:2]
    weights = torch.linspace(0.5, 2, 21).double().view(3, 7)
    joined = [torch.cat(parts, -1) for parts in zip(given[:2], more, strict=True)]
    layer, options = FunctionalMapSolver(extra_weight=4.0), {"extra_x": more[0], "extra_y": more[1]}
    for own in (None, weights[0], weights):
        whole = torch.cat([weights.new_ones(3, 7) if own is None else own.expand(3, 7), weights.new_full((3, 3), 4)], 1)
        expected = FunctionalMapSolver()(*joined, *given[2:], weights=whole)[0]
        torch.testing.assert_close(layer(*given, weights=own, **options)[0], expected)
    trust = torch.tensor([0.1, 1.0, 10.0]).double()
    for i in range(3):
        one = [tensor[i : i + 1] for tensor in given]
        torch.testing.assert_close(
            layer(*given, sample_weights=trust)[0][i : i + 1], FunctionalMapSolver(100 / float(trust[i]))(*one)[0]
        )
    with pytest.raises(ValueError, match="extra_x, extra_y: give both or none"):
        layer(*given, extra_x=more[0])


def halves(tensor, dim):
    even, odd = ([0, 2, 3, 5], [1, 4])
    return tensor.index_select(dim, torch.tensor(even)), tensor.index_select(dim, torch.tensor(odd))


def test_even_and_odd_blocks():
    """With even features and odd further ones: the blocks of the full map, both ways, and nothing beside them."""
    _, _, x, y, trans_x, trans_y = pair(k=6)
    generator = torch.Generator().manual_seed(2)
    feats, extras = [], []
    for trans in (trans_x, trans_y):
        even, odd = halves(trans, 1)
        feats.append(even.mT @ torch.randn(3, 4, 8, generator=generator, dtype=torch.float64))
        extras.append(odd.mT @ torch.randn(3, 2, 5, generator=generator, dtype=torch.float64))
    layer = FunctionalMapSolver(bidirectional=True, extra_weight=2.0)
    extra = {"extra_x": extras[0], "extra_y": extras[1]}
    full = layer(*feats, x, y, trans_x, trans_y, **extra)
    parts = {name: halves(tensor, 1) for name, tensor in (("x", x), ("y", y), ("tx", trans_x), ("ty", trans_y))}
    odd = {
        "evals_odd_x": parts["x"][1],
        "evals_odd_y": parts["y"][1],
        "evecs_trans_odd_x": parts["tx"][1],
        "evecs_trans_odd_y": parts["ty"][1],
    }
    blocks = layer(*feats, *(parts[name][0] for name in ("x", "y", "tx", "ty")), **odd, **extra)
    for whole, (even_block, odd_block) in zip(full, blocks, strict=True):
        rows = halves(whole, 1)
        torch.testing.assert_close(even_block, halves(rows[0], 2)[0])
        torch.testing.assert_close(odd_block, halves(rows[1], 2)[1])
        assert halves(rows[0], 2)[1].abs().max() < 1e-12
    del odd["evals_odd_y"]
    with pytest.raises(ValueError, match=r"evals_odd_x, .* give all four or none"):
        layer(*feats, *(parts[name][0] for name in ("x", "y", "tx", "ty")), **odd)


def test_a_padded_batch():
    """Vertices and functions are padded with zeros, features there may be anything finite."""
    small, large = pair(b=1, k=4, kx=5, c=9, v=30), pair(b=1, k=6, kx=7, c=9, v=40, seed=1)
    batch = []
    for i, (one, other) in enumerate(zip(small, large, strict=True)):
        padded = torch.full_like(other, 5.0 if i < 2 else 0.0)
        padded[tuple(slice(n) for n in one.shape)] = one
        batch.append(torch.cat([padded, other]))
    masks = {"evals_mask_x": batch[2] > 0, "evals_mask_y": batch[3] > 0}
    layer = FunctionalMapSolver(bidirectional=True)
    for found, alone, whole in zip(layer(*batch, **masks), layer(*small), layer(*large), strict=True):
        rows, columns = alone.shape[1:]
        torch.testing.assert_close(found[:1, :rows, :columns], alone)
        torch.testing.assert_close(found[1:], whole)
        assert found[0, rows:].abs().max() == 0
        assert found[0, :, columns:].abs().max() == 0


def test_inputs_that_do_not_fit():
    feat_x, feat_y, x, y, trans_x, trans_y = pair(k=4, c=6)
    layer = FunctionalMapSolver()
    with pytest.raises(ValueError, match="feat_x: 1200 of 3600 entries are NaN"):
        layer(torch.where(torch.arange(6) < 2, torch.nan, feat_x), feat_y, x, y, trans_x, trans_y)
    with pytest.raises(ValueError, match=r"row\(s\) \[0, 1, 2, 3\] of sample 0"):
        FunctionalMapSolver(0.0)(feat_x[..., :2], feat_y[..., :2], x, y, trans_x, trans_y)


def test_an_odd_block_of_rounding_is_no_map():
    """Features that are even leave 1e-16 in the odd basis: without a ridge an error, with it zero."""
    generator = torch.Generator().manual_seed(0)
    basis = torch.linalg.qr(torch.randn(30, 9, generator=generator, dtype=torch.float64)).Q.T
    even, odd = basis[:5], basis[5:]
    feat = even.T @ torch.randn(5, 12, generator=generator, dtype=torch.float64)
    evals = torch.arange(5.0).double()
    given = {"evals_odd_x": evals[1:], "evals_odd_y": evals[1:], "evecs_trans_odd_x": odd, "evecs_trans_odd_y": odd}
    with pytest.raises(ValueError, match="undetermined"):
        FunctionalMapSolver()(feat, feat, evals, evals, even, even, **given)
    (found, nothing), _ = FunctionalMapSolver(ridge=1e-6)(feat, feat, evals, evals, even, even, **given)
    torch.testing.assert_close(found, torch.eye(5, dtype=torch.float64), atol=1e-5, rtol=0)
    assert float(nothing.abs().max()) < 1e-9


def test_every_argument_has_its_own_name():
    feat, evals, trans = torch.ones(2, 6, 3), torch.arange(4.0).expand(2, 4), torch.ones(2, 4, 6)
    usual = (feat, feat, evals, evals, trans, trans)
    odd = {"evals_odd_x": evals, "evals_odd_y": evals, "evecs_trans_odd_x": trans, "evecs_trans_odd_y": trans}
    layer = partial(unchecked(FunctionalMapSolver.forward), FunctionalMapSolver())
    for wrong, message in (
        ({"extra_x": feat * torch.nan, "extra_y": feat}, "extra_x: 36 of 36 entries are NaN"),
        ({"extra_x": feat[:, 1:], "extra_y": feat}, r"extra_x: shape \(2, 5, 3\) given, .* Vx = 6 as in feat_x"),
        ({"extra_x": feat, "extra_y": feat[..., 1:]}, r"extra_y: shape \(2, 6, 2\) given, .* E = 3 as in extra_x"),
        ({"evals_mask_x": torch.ones(2, 3, dtype=torch.bool)}, r"evals_mask_x: shape \(2, 3\) given"),
        (odd | {"evals_odd_x": evals * torch.nan}, "evals_odd_x: 8 of 8 entries are NaN"),
        (odd | {"evecs_trans_odd_y": trans[:, :, 1:]}, r"evecs_trans_odd_y: shape \(2, 4, 5\)"),
        (
            odd | {"evals_odd_mask_x": torch.ones(2, 4)},
            r"evals_odd_mask_x: dtype torch\.float32 given, expected torch\.bool",
        ),
        (odd | {"evals_mask_x": torch.zeros(2, 4, dtype=torch.bool)}, "evals_mask_x: no true element"),
    ):
        with pytest.raises(ValueError, match=message):
            layer(*usual, **wrong)
    with pytest.raises(ValueError, match=r"feat_y: dtype torch\.float64 given, expected torch\.float32 as in feat_x"):
        layer(feat, feat.double(), *usual[2:])
