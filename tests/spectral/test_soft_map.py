import pytest
import torch

from torchqm.spectral import SoftMap, soft_fmap
from torchqm.testing import gradcheck64


def random_map(generator, *batch, rows=7, k=3, columns=9):
    indices = torch.stack([torch.randperm(columns, generator=generator)[:k] for _ in range(rows)])
    weights = torch.rand(*batch, rows, k, generator=generator, dtype=torch.float64)
    return SoftMap(indices.expand(*batch, rows, k), weights / weights.sum(-1, keepdim=True), columns)


def test_as_the_dense_matrix():
    generator = torch.Generator().manual_seed(0)
    soft = random_map(generator, 2)
    values = torch.rand(2, 9, 4, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(soft.apply(values), soft.to_dense() @ values)
    left = torch.rand(2, 5, 7, generator=generator, dtype=torch.float64)
    expected = left @ soft.to_dense() @ values
    torch.testing.assert_close(soft_fmap(soft, values, left), expected)
    torch.testing.assert_close(soft_fmap(soft.to_dense(), values, left), expected)


def test_a_target_named_twice_gets_both_weights():
    soft = SoftMap(torch.tensor([[1, 1]]), torch.tensor([[0.25, 0.75]]), 2)
    assert soft.to_dense().tolist() == [[0.0, 1.0]]
    assert soft.apply(torch.tensor([[1.0], [2.0]])).item() == 2.0


def test_point_maps_there_and_back():
    p2p = torch.tensor([[2, 0, 1], [1, 1, 0]])
    assert torch.equal(SoftMap.from_p2p(p2p, 3).to_p2p(), p2p)


def test_gradients():
    generator = torch.Generator().manual_seed(1)
    soft = random_map(generator)
    values = torch.rand(9, 2, generator=generator, dtype=torch.float64)
    gradcheck64(lambda w, f: SoftMap(soft.indices, w, 9).apply(f).square().sum(), soft.weights, values)


def test_values_of_another_shape():
    with pytest.raises(ValueError, match="values: 8 rows given, but the map goes to 9 vertices"):
        random_map(torch.Generator()).apply(torch.zeros(8, 2, dtype=torch.float64))


def test_mapped_over_samples():
    """A sparse map goes in and comes out of vmap, and is a tree of two tensors."""
    generator = torch.Generator().manual_seed(2)
    soft = random_map(generator, 3)
    values = torch.rand(3, 9, 4, generator=generator, dtype=torch.float64)
    found = torch.func.vmap(lambda one, f: one.apply(f))(soft, values)
    torch.testing.assert_close(found, soft.apply(values))
    halved = torch.func.vmap(lambda one: SoftMap(one.indices, one.weights / 2, one.n_targets))(soft)
    assert halved.n_targets == 9
    assert torch.equal(halved.to_dense(), soft.to_dense() / 2)
    one = torch.func.vmap(lambda f, only: only.apply(f), in_dims=(0, None))(values, random_map(generator))
    assert one.shape == (3, soft.indices.shape[1], 4)
    leaves, spec = torch.utils._pytree.tree_flatten(soft)
    assert all(a is b for a, b in zip(leaves, (soft.indices, soft.weights), strict=True))
    assert torch.utils._pytree.tree_unflatten(leaves, spec).n_targets == 9
    assert torch.utils._pytree.treespec_loads(torch.utils._pytree.treespec_dumps(spec)) == spec
