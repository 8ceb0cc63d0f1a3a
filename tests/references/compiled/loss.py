"""Run by tests/nn/test_compiled.py in a process without run-time type checks."""

import torch
from references import loss_layers as twin
from torch import nn

from torchqm.nn.loss import FunctionalMapLoss, OrbitConsistencyLoss, PointToOrbitLoss
from torchqm.nn.soft_map import Similarity, SoftPointMap


class All(nn.Module):
    def __init__(self):
        super().__init__()
        self.dense = SoftPointMap(0.3, learn_tau=True, normalize=True)
        self.sparse = SoftPointMap(0.3, k=3, kind="distance")
        self.spectral, self.nll = PointToOrbitLoss("spectral", "none"), PointToOrbitLoss("assignment", "none")
        self.distance = PointToOrbitLoss("distance", "none")
        self.map, self.fmap = PointToOrbitLoss("map", "none", temperature=0.3), FunctionalMapLoss()
        self.points, self.consistent = OrbitConsistencyLoss("points", "none"), OrbitConsistencyLoss("fmap", "none")

    def forward(self, x, y, c, mass, truth, table, dist, evals, mask):
        dense, sparse = self.dense(x, y, mask, mask), self.sparse(x, y, mask, mask)
        total = self.spectral(truth, mass, fmap_even=c, evecs_even_x=x, evecs_even_y=y)
        total = total + self.nll(truth, mass, soft_xy=dense, group_y=table)
        total = total + self.distance(truth, mass, soft_xy=sparse, group_y=table, dist_y=dist)
        total = total + self.map(truth, mass, soft_xy=sparse, group_y=table)
        total = total + self.points(sparse, table, table, values_y=y, mass_x=mass)
        total = total + self.consistent(c, torch.stack([c, c], -3), torch.stack([c, c.mT], -3))
        losses = self.fmap(c, c.mT, evals, evals, evals > -1, evals > -1)
        return total + sum(losses.values()) + Similarity()(c).square().sum((-2, -1))


make = torch.Generator().manual_seed(0)


def noise(*shape):
    return torch.randn(*shape, generator=make, dtype=torch.float64)


table = torch.stack([twin.cyclic(2, s) for s in (0, 1)])
b, v, k = 2, table.shape[-1], 4
x, y, c, mass, evals, dist = noise(b, v, k), noise(b, v, k), noise(b, k, k), noise(b, v), noise(b, k), noise(b, v, v)
truth = torch.randint(-1, v, (b, v), generator=make)
rest = (mass.abs(), truth, table, dist.abs(), evals.abs(), torch.ones(b, v, dtype=torch.bool))
layer = All()


def gradients(fn):
    leaves = [t.clone().requires_grad_() for t in (x, y, c)]
    loss = fn(*leaves, *rest)
    return loss.detach(), *torch.autograd.grad(loss.sum(), leaves)


expected = gradients(layer)
torch.testing.assert_close(gradients(torch.compile(layer, fullgraph=True, backend="eager")), expected)
exported = torch.export.export(layer, (x, y, c, *rest))
torch.testing.assert_close(exported.module()(x, y, c, *rest), expected[0])
alone = [layer(*(t[i] for t in (x, y, c, *rest))) for i in range(b)]
torch.testing.assert_close(torch.func.vmap(layer)(x, y, c, *rest), torch.stack(alone))
by_vmap = torch.func.vmap(torch.func.grad(layer, argnums=(0, 1, 2)))(x, y, c, *rest)
for i in range(b):
    leaves = [t[i].clone().requires_grad_() for t in (x, y, c)]
    grads = torch.autograd.grad(layer(*leaves, *(t[i] for t in rest)), leaves)
    torch.testing.assert_close(tuple(g[i] for g in by_vmap), grads)
print("equal")
