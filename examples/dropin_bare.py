"""A plain MLP on wave kernel signatures, trained for a few steps up to symmetry, without any framework.

python examples/dropin_bare.py
"""

import torch

from torchqm.data import ItemOptions, PairDataset, collate, open_shapes
from torchqm.nn import FunctionalMapSolver, PointToOrbitLoss, SymmetrizedBasis, WaveKernelSignature

torch.manual_seed(0)
shapes = open_shapes("synthetic:kinds=quadruped;poses=3;verts=800;triangulation=shared")
pairs = PairDataset(shapes, "within-class", options=ItemOptions(keys=("mass", "basis", "symmetry"), k=40))
batch = collate([pairs[0], pairs[1]])
x, y = batch["first"], batch["second"]

network = torch.nn.Sequential(
    WaveKernelSignature(n=64, k=40), torch.nn.Linear(64, 64), torch.nn.ReLU(), torch.nn.Linear(64, 32)
).double()
split, solver, loss = SymmetrizedBasis(), FunctionalMapSolver(lmbda=1.0), PointToOrbitLoss("spectral")
optimizer = torch.optim.Adam(network.parameters(), 3e-3)
masks = ("group_mask", "evals_mask", "verts_mask")  # what is real in a padded batch
halves = [
    split(s["evals"], s["evecs"], s["mass"], group=s["group"], **{mask: s[mask] for mask in masks}) for s in (x, y)
]
truth = torch.arange(x["verts"].shape[1]).expand(2, -1)  # the two share their triangulation

for step in range(10):
    feat = [network[1:](network[0](s["evals"], s["evecs"], s["mass"], s["evals_mask"])) for s in (x, y)]
    evals, evecs_trans = [h.evals_even for h in halves], [h.evecs_trans_even for h in halves]
    real = {f"evals_mask_{side}": h.evals_even_mask for side, h in zip("xy", halves, strict=True)}
    fmap, _ = solver(*feat, *evals, *evecs_trans, **real)
    value = loss(truth, x["mass"], fmap_even=fmap, evecs_even_x=halves[0].evecs_even, evecs_even_y=halves[1].evecs_even)
    optimizer.zero_grad()
    value.backward()
    optimizer.step()
    print(f"step {step}: loss {value.item():.3f}")
