"""torchqm.fmap.soft: equal to the loops, in bounded memory, with right gradients, padding without effect."""

import pytest
import torch
from references import loss_layers as twin
from references.unchecked import unchecked
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from torchqm.fmap.soft import feature_neighbours, soft_assignment, soft_map
from torchqm.spectral import SoftMap
from torchqm.testing import gradcheck64


def noise(*shape, seed=0, dtype=torch.float64):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def dense(soft):
    return soft.to_dense() if isinstance(soft, SoftMap) else soft


@pytest.mark.parametrize("kind", ["dot", "distance"])
@pytest.mark.parametrize("k", [None, 1, 3, 8])
def test_as_the_loop(kind, k):
    x, y = noise(2, 6, 4), noise(2, 8, 4, seed=1)
    expected = torch.stack([twin.soft_map(a, b, 0.7, k, kind) for a, b in zip(x, y, strict=True)])
    torch.testing.assert_close(dense(soft_map(x, y, 0.7, k, kind=kind)), expected, rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(dense(soft_map(x[0], y[0], torch.tensor(0.7), k, kind=kind)), expected[0])
    if k is not None:
        for chunk in (1, 4, 100):  # 6 rows: the last block is a short one
            torch.testing.assert_close(dense(soft_map(x, y, 0.7, k, kind=kind, chunk=chunk)), expected)


def test_normalized_features():
    x, y = noise(6, 4), noise(8, 4, seed=1)
    unit = [v / v.norm(dim=1, keepdim=True) for v in (x, y)]
    for k in (None, 3):
        got = dense(soft_map(x, y, 0.2, k, normalize=True))
        torch.testing.assert_close(got, twin.soft_map(*unit, 0.2, k))
    y[2] = 0
    y.requires_grad_()
    got = soft_map(x, y, 0.2, normalize=True)
    got.square().sum().backward()
    assert bool(torch.isfinite(y.grad).all())
    assert not y.grad[2].any()


def test_neighbours_best_first():
    x, y = noise(5, 3), noise(9, 3, seed=1)
    found = feature_neighbours(x, y, 4, kind="distance", chunk=2)
    assert torch.equal(found, torch.cdist(x, y).argsort(1)[:, :4])
    assert torch.equal(soft_map(x, y, 0.3, 4, kind="distance").indices, found)


@pytest.mark.parametrize("kind", ["dot", "distance"])
@pytest.mark.parametrize("k", [None, 4])
def test_padding_has_no_effect(kind, k):
    x, y = noise(2, 6, 3), noise(2, 7, 3, seed=1)
    mask_x, mask_y = torch.arange(6) < torch.tensor([[6], [4]]), torch.arange(7) < torch.tensor([[7], [5]])
    for filler in (0.0, 50.0):  # padding that would win
        padded_x = torch.where(mask_x[..., None], x, filler).requires_grad_()
        padded_y = torch.where(mask_y[..., None], y, filler).requires_grad_()
        soft = soft_map(padded_x, padded_y, 0.5, k, mask_x, mask_y, kind)
        both = dense(soft)
        for b, (n, m) in enumerate(((6, 7), (4, 5))):
            alone = dense(soft_map(x[b, :n], y[b, :m], 0.5, k, kind=kind))
            torch.testing.assert_close(both[b, :n, :m], alone)
            assert not both[b, n:].any()
            assert not both[b, :, m:].any()
        both.square().sum().backward()
        assert not padded_x.grad[1, 4:].any()
        assert not padded_y.grad[1, 5:].any()


def test_fewer_real_vertices_than_neighbours():
    mask = torch.tensor([True, False, True, False])
    soft = soft_map(noise(5, 3), noise(4, 3, seed=1), 0.5, 3, mask_y=mask)
    assert bool(mask[soft.indices].all())
    torch.testing.assert_close(soft.to_dense()[:, mask], soft_map(noise(5, 3), noise(4, 3, seed=1)[mask], 0.5))
    assert not soft.weights[:, 2].any()


def test_included_vertices_are_kept_and_the_rest_are_the_best():
    x, y = noise(5, 3), noise(9, 3, seed=1)
    worst = (x @ y.T).argsort(1)[:, :2]
    include = torch.cat([worst[:, :1], worst[:, 1:]], 1)
    include[0] = -1
    include[1, 1] = -1
    soft = soft_map(x, y, 0.3, 4, include=include, chunk=2)
    ranking = (x @ y.T).argsort(1, descending=True)
    for row, (kept, order) in enumerate(zip(include.tolist(), ranking.tolist(), strict=True)):
        wanted = {i for i in kept if i >= 0}
        others = [y for y in order if y not in wanted][: 4 - len(wanted)]
        assert set(soft.indices[row].tolist()) == wanted | set(others)
    logits = torch.gather(x @ y.T, 1, soft.indices) / 0.3
    torch.testing.assert_close(soft.weights, torch.softmax(logits, 1))
    assert bool((logits.diff(dim=1) <= 0).all())


def test_distances_far_from_the_origin():
    x, y = (noise(6, 4, seed=s).add(1e4).float() for s in (0, 1))
    for k in (None, 3):
        expected = twin.soft_map(x.double(), y.double(), 0.5, k, "distance").float()
        torch.testing.assert_close(dense(soft_map(x, y, 0.5, k, kind="distance")), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("kind", ["dot", "distance"])
@pytest.mark.parametrize("k", [None, 3])
def test_gradients(kind, k):
    x, y, tau, weights = noise(2, 4, 3), noise(2, 5, 3, seed=1), torch.tensor(0.8), noise(2, 4, 5, seed=2)
    mask = torch.arange(5) < torch.tensor([[5], [4]])

    def loss(x, y, tau):
        return (
            dense(soft_map(x, y, tau, k, mask_y=mask, kind=kind, normalize=kind == "dot", chunk=3 if k else None))
        ) * weights

    gradcheck64(loss, x, y, tau)


def test_second_derivatives_of_a_sparse_map():
    x, y = noise(3, 2).requires_grad_(), noise(5, 2, seed=1).requires_grad_()
    assert torch.autograd.gradgradcheck(lambda x, y: soft_map(x, y, 0.8, 2, chunk=2).weights, (x, y))


class Largest(TorchDispatchMode):
    """The largest storage that an operation returned, in bytes."""

    nbytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        sizes = [leaf.untyped_storage().nbytes() for leaf in tree_leaves(out) if isinstance(leaf, torch.Tensor)]
        self.nbytes = max(self.nbytes, *sizes, 0)
        return out


@pytest.mark.parametrize("kind", ["dot", "distance"])
def test_no_tensor_is_larger_than_the_features(kind):
    n, c, k = 1500, 32, 8
    x, y = noise(n, c).requires_grad_(), noise(n, c, seed=1).requires_grad_()
    with Largest() as seen:
        soft_map(x, y, 0.5, k, kind=kind, normalize=True, chunk=20).weights.square().sum().backward()
    assert seen.nbytes == n * c * 8  # and n k is 12,000, n k C 384,000, n n 2,250,000 numbers
    with Largest() as seen:
        soft_map(x, y, 0.5, kind=kind)
    assert seen.nbytes == n * n * 8  # so it does see them


def test_blocks_are_bounded_by_default():
    x = noise(3000, 2, dtype=torch.float32)
    with Largest() as seen:
        soft_map(x, x, 0.5, 2)
    assert seen.nbytes <= 4 * 2**22


def test_hard_assignment_is_straight_through():
    log_alpha = noise(2, 3, 4).requires_grad_()
    weights = noise(2, 3, 4, seed=1)
    hard = soft_assignment(log_alpha, 0.5, dim=1, hard=True)
    assert torch.equal(hard, torch.nn.functional.one_hot(log_alpha.argmax(1), 3).transpose(1, 2).double())
    (got,) = torch.autograd.grad((hard * weights).sum(), log_alpha)
    (expected,) = torch.autograd.grad((torch.softmax(log_alpha / 0.5, 1) * weights).sum(), log_alpha)
    torch.testing.assert_close(got, expected)
    assert soft_assignment(torch.tensor([1.0, 2.0]), 1e-44).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"feat_y": torch.zeros(8, 5)}, r"feat_y: shape \(8, 5\) given, expected \(Y, C\) with C = 4 as in feat_x"),
        ({"feat_x": torch.full((6, 4), torch.nan)}, "feat_x: 24 of 24 entries are NaN"),
        ({"tau": 0.0}, "tau: 0 given, expected a positive number"),
        ({"tau": torch.tensor(-1.0)}, "tau: -1 given"),
        ({"tau": torch.ones(2)}, r"tau: shape \(2,\) given, expected a number or a tensor of one element"),
        ({"tau": 1e-40}, "tau: 1e-40 is too small for features as large as 1"),
        ({"kind": "cosine"}, "kind: 'cosine' given, allowed are dot, distance"),
        ({"k": 9}, r"k: 9 given, but feat_y has 8 vertices, so 1\.\.8 is allowed"),
        ({"chunk": 5}, "chunk: only of use together with k"),
        ({"k": 2, "chunk": 0}, "chunk: 0 given, expected 1 or more rows"),
        ({"k": 2, "include": torch.full((6, 1), 8)}, r"include: ids from 8 to 8 given, allowed are 0\.\.7 and -1"),
        ({"k": 1, "include": torch.zeros(6, 2, dtype=torch.int64)}, "include: 2 vertices a row given, but only k = 1"),
        ({"mask_y": torch.zeros(8, dtype=torch.bool)}, r"mask_y: no true element in row\(s\) \[0\]"),
        ({"mask_x": torch.ones(5, dtype=torch.bool)}, r"mask_x: shape \(5,\) given, expected \(X,\) with X = 6"),
    ],
)
def test_bad_input(change, message):
    given = {"feat_x": torch.ones(6, 4), "feat_y": torch.ones(8, 4), "tau": 0.5} | change
    with pytest.raises(ValueError, match=message):
        unchecked(soft_map)(**given)


@pytest.mark.parametrize("kind", ["dot", "distance"])
def test_a_sparse_map_of_each_sample(kind):
    """Under vmap, alone and inside a gradient, as called with the whole batch."""
    x, y = noise(3, 5, 4), noise(3, 6, 4, seed=1)
    mask = torch.arange(6) < torch.tensor([[6], [4], [5]])

    def one(x, y, mask):
        return soft_map(x, y, 0.5, 3, mask_y=mask, kind=kind)

    found, whole = torch.func.vmap(one)(x, y, mask), soft_map(x, y, 0.5, 3, mask_y=mask, kind=kind)
    assert torch.equal(found.indices, whole.indices)
    torch.testing.assert_close(found.weights, whole.weights)
    weight = noise(5, 6, seed=2)
    grad = torch.func.vmap(torch.func.grad(lambda *given: (one(*given).to_dense() * weight).sum(), (0, 1)))(x, y, mask)
    tracked = x.clone().requires_grad_(), y.clone().requires_grad_()
    expected = torch.autograd.grad(
        (soft_map(*tracked, 0.5, 3, mask_y=mask, kind=kind).to_dense() * weight).sum(), tracked
    )
    for ours, wanted in zip(grad, expected, strict=True):
        torch.testing.assert_close(ours, wanted)
