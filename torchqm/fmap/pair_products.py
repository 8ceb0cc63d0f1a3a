"""Scalar products of the features of chosen pairs of vertices, in blocks of rows, so that memory is bounded."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

__all__ = ["PairProducts", "at_neighbours", "by_blocks", "rows_at_once"]

BLOCK = 2**22
"""Entries of the largest tensor made for some rows of a sparse map: 16 MiB in float32."""


class PairProducts(torch.autograd.Function):
    """``<f_x, f_y>`` for the given pairs, some rows at a time; the backward pass can be differentiated again."""

    generate_vmap_rule = True

    @staticmethod
    def forward(feat_x: Tensor, feat_y: Tensor, indices: Tensor, chunk: int | None) -> Tensor:
        """``(..., X, k)`` products of each x with its k neighbours."""
        rows = rows_at_once(indices, indices.shape[-1] * feat_x.shape[-1], chunk)

        def block(at: slice) -> Tensor:
            return (_taken(feat_y, indices[..., at, :]) @ feat_x[..., at, :, None])[..., 0]

        return by_blocks(block, feat_x.shape[-2], rows)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor, int | None], output: Tensor) -> None:
        """What the backward pass needs: the inputs."""
        feat_x, feat_y, indices, chunk = inputs
        ctx.save_for_backward(feat_x, feat_y, indices)
        ctx.chunk = chunk

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        """Features of the neighbours are gathered again."""
        feat_x, feat_y, indices = ctx.saved_tensors
        rows, n = rows_at_once(indices, indices.shape[-1] * feat_x.shape[-1], ctx.chunk), feat_x.shape[-2]
        grad, grad_x, grad_y = grads[0], None, None

        def block(at: slice) -> Tensor:
            return (grad[..., at, None, :] @ _taken(feat_y, indices[..., at, :]))[..., 0, :]

        if ctx.needs_input_grad[0]:
            grad_x = by_blocks(block, n, rows)
        if ctx.needs_input_grad[1]:
            grad_y = torch.zeros_like(feat_y)
            for start in range(0, n, rows):
                at = slice(start, start + rows)
                outer = (grad[..., at, :, None] * feat_x[..., at, None, :]).flatten(-3, -2)
                ids = indices[..., at, :].flatten(-2)[..., None]
                grad_y = grad_y.scatter_add(-2, ids.expand(*ids.shape[:-1], feat_y.shape[-1]), outer)
        return grad_x, grad_y, None, None


def by_blocks(block: Callable[[slice], Tensor], n: int, rows: int) -> Tensor:
    """``block`` of some rows at a time, all results in one tensor made in time.

    Small results that live on between large blocks that come and go would split the memory these leave: allocators
    then take new memory for each block, as much as the matrix that is not to be made.
    """
    first = block(slice(0, rows))
    if rows >= n:
        return first
    out = first[..., :1, :].expand(*first.shape[:-2], n, first.shape[-1]).clone()  # a batch under vmap, as first is
    out[..., :rows, :] = first
    for start in range(rows, n, rows):
        out[..., start : start + rows, :] = block(slice(start, start + rows))
    return out


def _taken(feat_y: Tensor, ids: Tensor) -> Tensor:
    """``(..., R, k, C)``: the features of the neighbours of R rows."""
    flat = ids.flatten(-2)[..., None].expand(*ids.shape[:-2], -1, feat_y.shape[-1])
    return torch.gather(feat_y, -2, flat).unflatten(-2, ids.shape[-2:])


def at_neighbours(values: Tensor, indices: Tensor) -> Tensor:
    """``values (..., Y)`` at ``indices (..., X, k)``."""
    return torch.gather(values, -1, indices.flatten(-2)).unflatten(-1, indices.shape[-2:])


def rows_at_once(tensor: Tensor, entries: int, chunk: int | None) -> int:
    """How many rows are taken at once if one row of one shape in the batch makes this many entries."""
    if chunk is not None:
        return chunk
    return max(1, BLOCK // max(1, tensor.shape[:-2].numel() * entries))
