"""Batches of shapes with different numbers of vertices: padded tensors, and masks that say what is real.

===========================  =====================  ========================================================
key                          in a batch             where a shape has less than the largest of the batch
===========================  =====================  ========================================================
``name``                     list of B
``verts, mass``              ``(B, V, 3), (B, V)``  0 (``verts_mask (B, V)``)
``faces``                    ``(B, F, 3)``          ``0 0 0``, a triangle without area (``faces_mask (B, F)``)
``evals, evecs``             ``(B, K), (B, V, K)``  0 (``evals_mask (B, K)``); ``evecs_trans`` is ``(B, K, V)``
``evals_even`` and so on     the same               0 (``evals_even_mask``, ``evals_odd_mask``)
``dist``                     ``(B, V, V)``          0
``corr``                     ``(B, S)``             0 (``corr_mask (B, S)``)
``group``                    ``(B, G, V)``          identity: a vertex goes to itself (``group_mask (B, G)``)
``L, gradX, gradY``          sparse, see below      empty rows and columns
``truth``                    list of B
===========================  =====================  ========================================================

Padding is chosen so that sums and products come out as for each shape alone: padded vertices have no mass, padded
functions are zero, padded triangles have no area. Means, softmax and nearest neighbours need the masks.
"""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor

__all__ = ["collate", "collate_with"]

SPARSE_FORMS = ("stacked", "block", "list")

_DENSE = ("verts", "mass", "faces", "evals", "evecs", "evecs_trans", "dist", "corr")
_SYMMETRIC = ("evals_even", "evecs_even", "evals_odd", "evecs_odd")
_MASKS = {
    "verts": "verts_mask",
    "faces": "faces_mask",
    "evals": "evals_mask",
    "evals_even": "evals_even_mask",
    "evals_odd": "evals_odd_mask",
    "corr": "corr_mask",
    "group": "group_mask",
}


def collate(items: Sequence[dict[str, Any]], sparse: str = "stacked") -> dict[str, Any]:
    """Put items, or pairs of items, into one batch; see :mod:`torchqm.data.collate` for every key.

    Args:
        items: dictionaries with the same keys, from :class:`torchqm.data.dataset.ShapeDataset` or
            :class:`~torchqm.data.dataset.PairDataset`. Pairs give ``{"first": batch, "second": batch, ...}``. Keys that
            are not ours become one tensor where all values are tensors of one shape, else a list.
        sparse: what becomes of ``L``, ``gradX`` and ``gradY``: ``stacked``, one sparse ``(B, V, V)`` tensor for
            ``torch.bmm`` (what diffusion-net reads); ``block``, one block-diagonal sparse ``(B V, B V)`` matrix for
            values of shape ``(B V, C)``; ``list``, the B matrices without padding.

    Returns:
        The batch.

    Raises:
        ValueError: no item, items with different keys, or an unknown ``sparse``.

    Example:
        >>> a = {"name": "a", "verts": torch.zeros(3, 3), "mass": torch.ones(3)}
        >>> b = {"name": "b", "verts": torch.zeros(2, 3), "mass": torch.ones(2)}
        >>> batch = collate([a, b])
        >>> batch["verts"].shape, batch["verts_mask"].tolist()
        (torch.Size([2, 3, 3]), [[True, True, True], [True, True, False]])
    """
    if sparse not in SPARSE_FORMS:
        raise ValueError(f"sparse is {sparse!r}; allowed are {', '.join(SPARSE_FORMS)}")
    if not items:
        raise ValueError("items: none given; a batch has at least one")
    keys = list(items[0])
    for number, item in enumerate(items):
        if set(item) != set(keys):
            different = ", ".join(sorted(set(item) ^ set(keys)))
            raise ValueError(f"items: number 0 and number {number} have different keys ({different})")
    batch: dict[str, Any] = {}
    for key in keys:
        values = [item[key] for item in items]
        batch[key] = _collate_key(key, values, items, sparse)
        if key in _MASKS:
            batch[_MASKS[key]] = _mask([len(value) for value in values])
    return batch


def collate_with(sparse: str) -> Callable[[Sequence[dict[str, Any]]], dict[str, Any]]:
    """:func:`collate` with another form of sparse matrices, for ``DataLoader(collate_fn=...)``."""
    from functools import partial

    return partial(collate, sparse=sparse)


def _collate_key(key: str, values: list[Any], items: Sequence[dict[str, Any]], sparse: str) -> Any:
    if key in ("first", "second"):
        return collate(values, sparse)
    if key == "group":
        return _pad_groups(values)
    if key in _DENSE or key in _SYMMETRIC:
        return _pad(values)
    tensors = all(isinstance(value, Tensor) for value in values)
    if tensors and values[0].layout != torch.strided:
        n = max(len(value) for value in values)
        return values if sparse == "list" else _join_sparse(values, n, sparse)
    if tensors and len({value.shape for value in values}) == 1:
        return torch.stack(values)
    return values


def _mask(lengths: list[int]) -> Tensor:
    return torch.arange(max(lengths))[None] < torch.tensor(lengths)[:, None]


def _pad(values: list[Tensor]) -> Tensor:
    """One tensor of the largest size in each dimension, zero where a value has less."""
    shape = [max(sizes) for sizes in zip(*(value.shape for value in values), strict=True)]
    out = values[0].new_zeros(len(values), *shape)
    for row, value in zip(out, values, strict=True):
        row[tuple(slice(size) for size in value.shape)] = value
    return out


def _pad_groups(values: list[Int[Tensor, "_G _V"]]) -> Int[Tensor, "B G V"]:
    order, n = (max(value.shape[dim] for value in values) for dim in (0, 1))
    out = torch.arange(n).repeat(len(values), order, 1)
    for row, value in zip(out, values, strict=True):
        row[: value.shape[0], : value.shape[1]] = value
    return out


def _join_sparse(values: list[Tensor], n: int, sparse: str) -> Tensor:
    """``(B, n, n)`` with the matrices in its slices, or ``(B n, B n)`` with them on its diagonal."""
    b = len(values)
    parts = [value.to_sparse_coo().coalesce() for value in values]
    number = torch.arange(b).repeat_interleave(torch.tensor([part.values().shape[0] for part in parts]))
    indices, entries = torch.cat([part.indices() for part in parts], 1), torch.cat([part.values() for part in parts])
    if sparse == "stacked":
        indices, shape = torch.cat([number[None], indices]), torch.Size((b, n, n))
    else:
        indices, shape = indices + n * number, torch.Size((b * n, b * n))
    # Sorted already: slice by slice, each in the order of its own matrix.
    return torch.sparse_coo_tensor(indices, entries, shape, check_invariants=False, is_coalesced=True)
