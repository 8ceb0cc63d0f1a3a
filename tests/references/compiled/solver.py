"""Run by tests/nn/test_compiled.py in a process without run-time type checks."""

import torch

from torchqm.nn.solver import FunctionalMapSolver

generator = torch.Generator().manual_seed(0)
given = [torch.randn(2, 30, 9, generator=generator) for _ in range(2)]
given += [torch.rand(2, 5, generator=generator).cumsum(1) for _ in range(2)]
given += [torch.randn(2, 5, 30, generator=generator) for _ in range(2)]


def step(layer, call):
    feats = [feat.clone().requires_grad_() for feat in given[:2]]
    maps = call(*feats, *given[2:])
    return [*maps, *torch.autograd.grad(sum(c.square().sum() for c in maps), [*feats, *layer.parameters()])]


layer = FunctionalMapSolver(bidirectional=True, learn_lmbda=True)
compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
for ours, wanted in zip(step(layer, compiled), step(layer, layer), strict=True):
    torch.testing.assert_close(ours, wanted)
program = torch.export.export(FunctionalMapSolver(bidirectional=True, row_chunk=2), tuple(given))
for ours, wanted in zip(program.module()(*given), layer(*given), strict=True):
    torch.testing.assert_close(ours, wanted)
for call in (compiled, program.module()):
    try:
        call(*(0 * feat for feat in given[:2]), given[2], given[2], *given[4:])
    except ValueError as error:
        assert "of sample 1 of the map undetermined" in str(error), error
    else:
        raise SystemExit("no error")
for position, message in ((2, "evals_x: shape (2, 4) given"), (5, "evecs_trans_y: shape (2, 5, 29) given")):
    cut = [tensor[..., 1:] if i == position else tensor for i, tensor in enumerate(given)]
    try:
        layer(*cut)
    except ValueError as error:
        assert str(error).startswith(message), error
    else:
        raise SystemExit("no error")
print("done")
