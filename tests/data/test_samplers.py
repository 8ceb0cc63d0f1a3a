import pytest
import torch

from torchqm.data.samplers import EpochSampler, OnceSampler


def test_epochs_have_orders_of_their_own_that_only_the_seed_changes():
    sampler = EpochSampler(20, seed=3)
    orders = []
    for epoch in (0, 1, 0):
        sampler.set_epoch(epoch)
        orders.append(list(sampler))
    assert orders[0] == orders[2] != orders[1]
    assert sorted(orders[1]) == list(range(20)) == sorted(EpochSampler(20, seed=4))
    assert list(EpochSampler(20, seed=4)) != orders[0]


@pytest.mark.parametrize(("size", "replicas"), [(7, 1), (7, 2), (6, 3), (3, 3), (2, 3), (1, 4)])
def test_where_means_are_taken_no_pair_counts_more_than_another(size, replicas):
    parts = [OnceSampler(size, replicas, rank) for rank in range(replicas)]
    counts = torch.bincount(torch.tensor([number for part in parts for number in part]), minlength=size)
    assert counts.tolist() == [1 if size >= replicas else replicas] * size
    assert all(len(list(part)) == len(part) > 0 for part in parts)
    assert all(list(part) == sorted(part) for part in parts)
