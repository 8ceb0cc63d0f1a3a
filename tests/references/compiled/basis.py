"""Run by tests/nn/test_compiled.py in a process without run-time type checks."""

import torch

from torchqm.nn.basis import SymmetrizedBasis

torch.manual_seed(0)
b, n, k = 2, 12, 6
group = torch.stack([torch.arange(n), torch.arange(n).roll(6)]).repeat(b, 1, 1)
evecs = torch.randn(b, n, k, dtype=torch.float64)
evecs[:, 6:] = evecs[:, :6] * torch.tensor([1.0, 1, 1, 1, -1, -1])
evecs = torch.linalg.qr(evecs).Q
evals, mass = torch.tensor([0.0, 1, 1, 3, 3, 4]).double().repeat(b, 1), torch.ones(b, n).double()
soft = (8 * torch.nn.functional.one_hot(group[:, 1], n)).double().softmax(-1)
masks = {"verts_mask": torch.ones(b, n).bool(), "evals_mask": torch.arange(k).repeat(b, 1) < torch.tensor([[6], [5]])}
layer = SymmetrizedBasis(k_even=4, k_odd=2)


def loss(evals, evecs, mass, soft, **masks):
    split = layer(evals, evecs, mass, soft_map=soft, **masks)
    even = (split.evecs_trans_even * torch.arange(n)).square().sum()
    return even + split.evals_odd.exp().sum() + split.evecs_odd.square().sum(-1).square().sum()


inputs = [value.requires_grad_() for value in (evals, evecs, mass, soft)]


def gradients(function):
    return torch.autograd.grad(function(*inputs, **masks), inputs)


def close(found, expected):
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-9, rtol=0)


eager = gradients(loss)
close(gradients(torch.compile(loss, fullgraph=True, backend="aot_eager")), eager)
given = {"group": group, "group_mask": torch.ones(b, 2).bool(), **masks}
want = layer(*inputs[:3], **given)
exported = torch.export.export(layer, tuple(inputs[:3]), given).module()(*inputs[:3], **given)
close(vars(exported).values(), vars(want).values())
plain = [value.detach() for value in inputs]
each = torch.func.vmap(torch.func.grad(lambda *x: loss(*x[:4], verts_mask=x[4], evals_mask=x[5]), argnums=(0, 1, 2, 3)))
close(each(*plain, *masks.values()), eager)
print("done")
