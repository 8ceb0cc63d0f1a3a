"""Slow twins of the differentiable layers of floor 4, written from their descriptions with loops and inverses."""

import torch
from torch import Tensor


def resolvent_mask(evals_x: Tensor, evals_y: Tensor, gamma: float) -> Tensor:
    """Real and imaginary parts of the resolvents' difference, one entry at a time as the formula says."""
    top = max(float(evals_x.detach().max()), float(evals_y.detach().max()))
    top = next(e for evals in (evals_x, evals_y) for e in evals if float(e.detach()) == top)
    q, p = (evals_x / top) ** gamma, (evals_y / top) ** gamma
    real = (p / (p**2 + 1))[:, None] - (q / (q**2 + 1))[None]
    imaginary = (1 / (p**2 + 1))[:, None] - (1 / (q**2 + 1))[None]
    return real**2 + imaginary**2


def fmap_by_inverses(a: Tensor, b: Tensor, masks: Tensor, lmbda: float) -> Tensor:
    """``c_i = b_i A^T (A A^T + lmbda diag(D_i))^-1`` for a batch, one row and one inverse after the other."""
    gram, right = torch.bmm(a, a.mT), torch.bmm(b, a.mT)
    rows = []
    for i in range(b.shape[1]):
        diagonals = torch.stack([torch.diag(mask[i]) for mask in masks])
        inverse = torch.inverse(gram + lmbda * diagonals)
        rows.append(torch.bmm(right[:, i : i + 1], inverse))
    return torch.cat(rows, 1)


def regularized_fmap_net(
    feat_x: Tensor,
    feat_y: Tensor,
    evals_x: Tensor,
    evals_y: Tensor,
    evecs_trans_x: Tensor,
    evecs_trans_y: Tensor,
    lmbda: float = 100.0,
    gamma: float = 0.5,
) -> Tensor:
    """What ULRSSM's ``RegularizedFMNet`` is described to return for the direction x to y."""
    masks = torch.stack([resolvent_mask(x, y, gamma) for x, y in zip(evals_x, evals_y, strict=True)])
    return fmap_by_inverses(torch.bmm(evecs_trans_x, feat_x), torch.bmm(evecs_trans_y, feat_y), masks, lmbda)


def energy(fmap: Tensor, a: Tensor, b: Tensor, masks: Tensor, lmbda: float, ridge: float = 0.0) -> Tensor:
    """``|| C A - B ||^2 + lmbda sum D C^2 + ridge || C ||^2`` of one map, for whoever wants its minimum."""
    fit = sum(((fmap @ a[:, c] - b[:, c]) ** 2).sum() for c in range(a.shape[1]))
    return fit + lmbda * (masks * fmap**2).sum() + ridge * (fmap**2).sum()
