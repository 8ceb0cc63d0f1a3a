"""The products of Gram-Schmidt, a few rows against many: our own on a CPU where they are built, or torch's."""

import ctypes
from functools import cache

import torch
from torch import Tensor

from torchqm.native import library

__all__ = ["for_products", "project", "subtract_"]


def project(vectors: Tensor, rows: Tensor) -> Tensor:
    """``vectors rows^T``: ``(m, n)`` and ``(b, n)`` to ``(m, b)``; ours are the same on any number of threads.

    Example:
        >>> project(torch.eye(3), torch.tensor([[1.0, 2.0, 3.0]])).tolist()
        [[1.0], [2.0], [3.0]]
    """
    ours = _ours(vectors, rows)
    if ours is None:
        return vectors @ rows.T
    (m, n), b, few = vectors.shape, rows.shape[0], ours.few()
    space = torch.empty(ours.parts(n) * m * few, dtype=torch.float64)
    threads = min(torch.get_num_threads(), ours.parts(n))
    products = torch.empty(m, b, dtype=torch.float64)
    for begin in range(0, b, few):
        some = rows[begin : begin + few]
        ours.project(m, n, vectors.data_ptr(), some.data_ptr(), threads, space.data_ptr())
        products[:, begin : begin + few] = space[: m * few].view(m, few)
    return products


def subtract_(rows: Tensor, vectors: Tensor, products: Tensor) -> Tensor:
    """``rows -= products^T vectors`` in place: ``(b, n)``, ``(m, n)`` and ``(m, b)``; returns the rows.

    Example:
        >>> subtract_(torch.ones(1, 2), torch.eye(2), torch.tensor([[1.0], [3.0]])).tolist()
        [[0.0, -2.0]]
    """
    if products.shape != (vectors.shape[0], rows.shape[0]):
        raise ValueError(f"products: {tuple(products.shape)} given, {(vectors.shape[0], rows.shape[0])} expected")
    ours = _ours(vectors, rows, products)
    if ours is None:
        return rows.addmm_(products.T, vectors, alpha=-1)
    (m, n), b, few = vectors.shape, rows.shape[0], ours.few()
    threads = min(torch.get_num_threads(), ours.parts(n))
    for begin in range(0, b, few):
        some, factors = rows[begin : begin + few], products[:, begin : begin + few].contiguous()
        ours.subtract(m, n, vectors.data_ptr(), some.data_ptr(), threads, factors.data_ptr())
    return rows


def for_products(vectors: Tensor) -> Tensor:
    """The same tensor, which nobody has written to yet: its memory is asked for in large pages."""
    built = _built() if vectors.device.type == "cpu" else None
    if built is not None:
        built.large_pages(vectors.data_ptr(), vectors.nbytes)
    return vectors


def _ours(vectors: Tensor, rows: Tensor, *more: Tensor) -> ctypes.CDLL | None:
    """The library, where it can be used for these."""
    built = _built()
    if built is None or rows.shape[0] % built.few() or vectors.shape[1] != rows.shape[1]:
        return None
    fits = all(
        t.device.type == "cpu" and t.dtype == torch.float64 and not t.is_neg() and not t.requires_grad
        for t in (vectors, rows, *more)
    )
    whole = vectors.is_contiguous() and rows.is_contiguous()
    return built if fits and whole and rows.numel() and vectors.numel() else None


@cache
def _built() -> ctypes.CDLL | None:
    built = library("spectral/_projections")
    if built is not None:
        at, size, integer = ctypes.c_void_p, ctypes.c_int64, ctypes.c_int
        built.parts.argtypes, built.parts.restype = [size], size
        for function in (built.project, built.subtract):
            function.argtypes, function.restype = [size, size, at, at, integer, at], None
    return built
