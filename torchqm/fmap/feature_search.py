"""Which vertices of y are most similar to each vertex of x, found in blocks of rows."""

import torch
from torch import Tensor

from torchqm.fmap.pair_products import PairProducts, at_neighbours, by_blocks, rows_at_once

__all__ = ["KINDS", "best_neighbours", "with_bias"]

KINDS = ("dot", "distance")


def best_neighbours(
    feat_x: Tensor,
    feat_y: Tensor,
    bias: Tensor | None,
    mask_y: Tensor | None,
    k: int,
    include: Tensor | None,
    chunk: int | None,
) -> Tensor:
    """The k most similar vertices of y, ``include`` first of all, in the order of similarity; without gradients."""
    limits = torch.finfo(feat_y.dtype)
    columns = feat_y.transpose(-1, -2)

    def block(at: slice) -> Tensor:
        scores = feat_x[..., at, :] @ columns
        if bias is not None:
            scores = scores + bias.detach()[..., None, :]
        if mask_y is not None:
            scores = scores.masked_fill(~mask_y[..., None, :], limits.min)
        if include is not None:
            wanted = include[..., at, :]
            raised = torch.full_like(wanted, limits.min, dtype=scores.dtype).masked_fill(wanted >= 0, limits.max)
            scores = scores.scatter_reduce(-1, wanted.clamp_min(0), raised, "amax")
        return scores.topk(k, -1).indices

    best = by_blocks(block, feat_x.shape[-2], rows_at_once(feat_x, feat_y.shape[-2], chunk))
    if include is None:
        return best
    # Those that were to be kept came first; the order is by similarity again.
    logits = PairProducts.apply(feat_x, feat_y, best, chunk)
    if bias is not None:
        logits = logits + at_neighbours(bias.detach(), best)
    if mask_y is not None:
        logits = logits.masked_fill(~at_neighbours(mask_y, best), limits.min)
    return torch.gather(best, -1, logits.argsort(-1, descending=True))


def with_bias(
    feat_x: Tensor, feat_y: Tensor, mask_y: Tensor | None, kind: str, normalize: bool
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Features and a bias of each y with which the similarity is ``<f_x, f_y> + bias_y``, half the squared distance."""
    if normalize:
        feat_x, feat_y = _unit(feat_x), _unit(feat_y)
    if kind == "dot":
        return feat_x, feat_y, None
    # Distances do not change when all features move: around their mean the squares below lose no digits.
    weight = torch.ones_like(feat_y[..., :1]) if mask_y is None else mask_y[..., None].to(feat_y.dtype)
    centre = ((weight * feat_y).sum(-2, keepdim=True) / weight.sum(-2, keepdim=True).clamp_min(1)).detach()
    feat_x, feat_y = feat_x - centre, feat_y - centre
    return feat_x, feat_y, -feat_y.square().sum(-1) / 2


def _unit(values: Tensor) -> Tensor:
    squares = values.square().sum(-1, keepdim=True)
    empty = squares == 0
    return values * torch.where(empty, 0.0, torch.where(empty, 1.0, squares).rsqrt())
