"""Soft point maps: for each point of one shape, weights over a few points of another. Differentiable, V x k in size."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils._pytree import GetAttrKey, register_pytree_node

__all__ = ["SoftMap", "soft_fmap"]


@dataclass(frozen=True, eq=False)
class SoftMap:
    """A sparse row-stochastic matrix: row x holds the weights of the points of y that x may go to.

    As an operator it pulls functions on y back to x: ``(Pi f)(x) = sum_j weights[x, j] f(indices[x, j])``. Functions
    that take or return one work under :func:`torch.func.vmap`.

    Args:
        indices: ``(..., X, k)`` vertices of y.
        weights: ``(..., X, k)`` not negative, each row sums to 1 (or to 0 where x is padding).
        n_targets: number of vertices of y.

    Example:
        >>> soft = SoftMap(torch.tensor([[0, 1]]), torch.tensor([[0.25, 0.75]]), 3)
        >>> soft.apply(torch.tensor([[1.0], [5.0], [9.0]])).item(), soft.to_dense().tolist()
        (4.0, [[0.25, 0.75, 0.0]])
    """

    indices: Int[Tensor, "*B X k"]
    weights: Float[Tensor, "*B X k"]
    n_targets: int

    @classmethod
    def from_p2p(cls, p2p_xy: Int[Tensor, "*B X"], n_targets: int, dtype: torch.dtype = torch.float64) -> "SoftMap":
        """The map that puts all weight on one vertex of y each."""
        return cls(p2p_xy[..., None], torch.ones(*p2p_xy.shape, 1, dtype=dtype, device=p2p_xy.device), n_targets)

    def apply(self, values: Float[Tensor, "*B Y C"]) -> Float[Tensor, "*B X C"]:
        """Pull functions on y back to x (from their values at its vertices), with gradients to both.

        One neighbour after the other, so that no ``(X, k, C)`` tensor is made.
        """
        if values.shape[-2] != self.n_targets:
            raise ValueError(f"values: {values.shape[-2]} rows given, but the map goes to {self.n_targets} vertices")
        c = values.shape[-1]
        total: Tensor | None = None
        for j in range(self.indices.shape[-1]):
            at = self.indices[..., j, None].expand(*self.indices.shape[:-1], c)
            part = self.weights[..., j, None] * torch.gather(values, -2, at)
            total = part if total is None else total + part
        if total is None:
            raise ValueError("indices: no neighbour at all; each row needs at least one")
        return total

    def to_dense(self) -> Float[Tensor, "*B X Y"]:
        """The full matrix, for small shapes and for tests."""
        empty = self.weights.new_zeros(*self.weights.shape[:-1], self.n_targets)
        return empty.scatter_add(-1, self.indices, self.weights)

    def to_p2p(self) -> Int[Tensor, "*B X"]:
        """The vertex of largest weight."""
        return torch.gather(self.indices, -1, self.weights.argmax(-1, keepdim=True))[..., 0]


def _tensors(soft: SoftMap) -> tuple[list[Any], int]:
    return [soft.indices, soft.weights], soft.n_targets


def _tensors_with_names(soft: SoftMap) -> tuple[list[tuple[Any, Any]], int]:
    return [(GetAttrKey("indices"), soft.indices), (GetAttrKey("weights"), soft.weights)], soft.n_targets


def _from_tensors(leaves: Iterable[Any], n_targets: int) -> SoftMap:
    soft = object.__new__(SoftMap)  # leaves may be numbers of dimensions instead of tensors, which no check must see
    for name, value in zip(("indices", "weights", "n_targets"), (*leaves, n_targets), strict=True):
        object.__setattr__(soft, name, value)
    return soft


# So that a layer that takes or returns one can be exported, and mapped by torch.func.vmap: the number of targets is the
# same for all samples and no leaf, which torch.export.register_dataclass would make of it.
register_pytree_node(
    SoftMap,
    _tensors,
    _from_tensors,
    serialized_type_name="torchqm.spectral.SoftMap",
    flatten_with_keys_fn=_tensors_with_names,
)


def soft_fmap(
    soft_yx: "SoftMap | Float[Tensor, '*B Y X']",
    evecs_x: Float[Tensor, "*B X Kx"],
    evecs_trans_y: Float[Tensor, "*B Ky Y"],
) -> Float[Tensor, "*B Ky Kx"]:
    """``C = Phi_y^T A_y Pi Phi_x``: the functional map of a soft point map, takes functions on x to functions on y.

    Args:
        soft_yx: for each vertex of y weights over the vertices of x: sparse, or a dense ``(..., Y, X)`` matrix.
        evecs_x: ``(..., X, Kx)`` basis of x.
        evecs_trans_y: ``(..., Ky, Y)`` transposed basis of y times its vertex areas.

    Example:
        >>> swap = SoftMap.from_p2p(torch.tensor([1, 0]), 2, torch.float32)
        >>> soft_fmap(swap, torch.eye(2), torch.eye(2)).tolist()
        [[0.0, 1.0], [1.0, 0.0]]
    """
    pulled = soft_yx.apply(evecs_x) if isinstance(soft_yx, SoftMap) else soft_yx @ evecs_x
    return evecs_trans_y @ pulled
