"""Run by tests/nn/test_compiled.py in a process without run-time type checks."""

import torch

from torchqm.nn import (
    HeatKernelSignature,
    OrientationDescriptors,
    QuotientICP,
    SoftPointMap,
    SpectralUpsampling,
    WaveKernelSignature,
)

generator = torch.Generator().manual_seed(0)
basis_x, basis_y = (torch.randn(2, n, 6, generator=generator).double() for n in (14, 17))
mass = torch.rand(2, 14, generator=generator).double()
evals = torch.rand(2, 6, generator=generator).double().cumsum(1)
faces = torch.randint(0, 14, (2, 20, 3), generator=generator)
fmap = torch.eye(4).double().repeat(2, 1, 1)
cases = [
    (WaveKernelSignature(n=5, k=6).double(), (evals, basis_x, mass)),
    (HeatKernelSignature(n=5, k=6).double(), (evals, basis_x, mass)),
    (OrientationDescriptors(6, 4), (basis_x, faces, mass)),
    (QuotientICP(2, 0.3).double(), (fmap, basis_x[..., :4].contiguous(), basis_y[..., :4].contiguous(), mass)),
    (SpectralUpsampling((5, 6), 1, 0.3).double(), (fmap, basis_x, basis_y, mass)),
    (SoftPointMap(0.3), (basis_x, basis_y)),
]
for layer, given in cases:

    def step(call, given=given):
        inputs = [value.clone().requires_grad_() if value.is_floating_point() else value for value in given]
        found = call(*inputs)
        wanted = [value for value in inputs if value.requires_grad]
        return [found.detach(), *torch.autograd.grad(found.square().sum(), wanted, allow_unused=True)]

    want = step(layer)
    for a, b in zip(step(torch.compile(layer, fullgraph=True, backend="eager")), want, strict=True):
        torch.testing.assert_close(a, b)
    exported = torch.export.export(layer, given).module()(*given)
    torch.testing.assert_close(exported.detach(), want[0])
    dims = tuple(0 for _ in given)
    alone = torch.func.vmap(layer, dims)(*given)
    torch.testing.assert_close(alone.detach(), want[0])

sparse = SoftPointMap(0.3, k=3)
want = sparse(basis_x, basis_y)
exported = torch.export.export(sparse, (basis_x, basis_y)).module()(basis_x, basis_y)
torch.testing.assert_close(exported.to_dense(), want.to_dense())
