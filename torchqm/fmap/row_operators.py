"""Operators of torch that solve the rows of functional maps, and how ``torch.compile`` and ``vmap`` take them.

A kernel of our own where there is one (:mod:`torchqm.fmap.compiled`), else LAPACK or torch
(:mod:`torchqm.fmap.cholesky`). Their factors have different shapes: ``(n, groups, numbers)`` and ``(Ky, n, Kx, Kx)``.
"""

from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from torchqm.fmap.cholesky import factorize, noise, rows_at_once, solve_checked, solve_factored, surely_regular
from torchqm.fmap.compiled import Kernel, kernel_for
from torchqm.fmap.operator import operator
from torchqm.fmap.threads import in_shares

__all__ = ["UndeterminedRowsError", "is_packed", "solved_rows"]

# Numbers in all systems of a call from which on several threads gain more than they cost. Measured.
_WORTH_THREADS = 2**20


class UndeterminedRowsError(ValueError):
    """Rows of a map that neither descriptors nor regulariser determine.

    Args:
        undetermined: ``(..., Ky)`` true where a row has no unique solution.
        dtype: in which that was found.
    """

    def __init__(self, undetermined: Bool[Tensor, "*B Ky"], dtype: torch.dtype) -> None:
        self.undetermined = undetermined.cpu()
        single = dtype != torch.float64
        super().__init__(
            f"the descriptors and the regulariser leave {self._rows()} of the map undetermined, to the precision of "
            f"{dtype}; give a positive lmbda, a ridge ({'1e-3' if single else '1e-9'}), more independent descriptors"
            + (", smaller ones (of shapes of area 1) or float64" if single else "")
        )

    def _rows(self) -> str:
        if self.undetermined.ndim == 1:
            return f"row(s) {self.undetermined.nonzero().flatten().tolist()[:5]}"
        samples = self.undetermined.any(-1).nonzero().tolist()
        parts = [
            f"row(s) {self.undetermined[tuple(at)].nonzero().flatten().tolist()[:5]} of sample "
            f"{at[0] if len(at) == 1 else tuple(at)}"
            for at in samples[:3]
        ]
        return ", ".join(parts) + (f" and rows of {len(samples) - 3} more samples" if len(samples) > 3 else "")


def solved_rows(
    gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool, packed: bool
) -> tuple[Tensor, Tensor]:
    """The rows, and what a backward pass needs of their systems, empty unless ``keep``.

    Args:
        gram: this and the next two as in :func:`torchqm.fmap.rows.solve_rows`.
        diagonal: added to the diagonal of ``gram``.
        rhs: right-hand sides.
        row_chunk: at most so many rows of all samples at once; 0: no limit.
        keep: the factors.
        check: find systems that are singular to working precision; else only those are found that have no factor.
        packed: by our kernel; see :func:`is_packed`.
    """
    ky, kx = rhs.shape[-2:]
    n = prod(rhs.shape[:-2])
    if rhs.numel() == 0:
        return rhs.clone(), gram.new_empty(_factor_shape(gram, n, ky, kx, packed) if keep else 0)
    sides = gram.reshape(n, kx, kx), diagonal.reshape(n, ky, kx), rhs.reshape(n, ky, kx)
    if packed:
        kernel = _kernel(gram)
        threads = max(1, row_chunk * n // kernel.lanes) if row_chunk else None  # each has a group of rows in memory
        rows, undetermined, factor = kernel.solve(*sides, noise(gram) if check else 0.0, keep, threads)
    else:
        rows, undetermined, factor = _solved_by_library(*sides, row_chunk, keep, check)
    if bool(undetermined.any()):
        for name, values in (("descriptors", gram), ("lmbda and eigenvalues", diagonal)):
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"the system made of the {name} has entries that are NaN or infinite")
        raise UndeterminedRowsError(undetermined.reshape(rhs.shape[:-1]), gram.dtype)
    return rows.reshape(rhs.shape), factor


def is_packed(like: Tensor) -> bool:
    """Whether our kernel solves for tensors like this one.

    An argument of the operators: what ``torch.compile`` keeps on the disk must not be taken where it is otherwise,
    since the factors differ in shape.
    """
    return kernel_for(like.device, like.dtype) is not None


def _kernel(like: Tensor) -> Kernel:
    kernel = kernel_for(like.device, like.dtype)
    if kernel is None:
        raise ValueError(f"rows of {like.dtype} on {like.device}: asked of a kernel that is not here")
    return kernel


def _factor_shape(like: Tensor, n: int, ky: int, kx: int, packed: bool) -> tuple[int, ...]:
    return _kernel(like).factor_shape(n, ky, kx) if packed else (ky, n, kx, kx)


def _solved_by_library(
    gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """As :meth:`torchqm.fmap.compiled.Kernel.solve`; rows first in the factor, so that chunks lie together."""
    n, ky, kx = rhs.shape
    entries, right = diagonal.transpose(0, 1), rhs.transpose(0, 1)
    factor = gram.new_empty((ky, n, kx, kx) if keep else 0)
    rows = gram.new_empty(ky, n, kx)
    check = check and not surely_regular(gram, entries.amin(0))
    undetermined = torch.zeros(ky, n, dtype=torch.bool, device=gram.device)

    def solve(parts: Sequence[slice]) -> None:
        workspace = gram.new_empty((0 if keep else parts[0].stop - parts[0].start, n, kx, kx))
        for part in parts:
            upper = factor[part] if keep else workspace[: len(rows[part])]
            failed = factorize(gram, entries[part], upper)
            if check:
                unit = (gram.diagonal(dim1=-2, dim2=-1) + entries[part]).clamp_min(0).sqrt()
                rows[part], singular = solve_checked(upper, right[part], unit)
                undetermined[part] = failed | singular
            else:
                rows[part] = solve_factored(upper, right[part, :, None])[:, :, 0]
                undetermined[part] = failed

    _in_parts(solve, gram, n, ky, row_chunk or ky)
    return rows.transpose(0, 1).contiguous(), undetermined.T, factor


def _in_parts(solve: Callable[[Sequence[slice]], None], like: Tensor, n: int, ky: int, row_chunk: int) -> None:
    """Solve all rows of ``n`` samples, at most ``row_chunk`` at a time; the first part is one of the longest.

    On the CPU several parts run at a time: LAPACK takes one matrix after the other.
    """
    several = like.device.type == "cpu" and n * ky * like.shape[-1] ** 2 >= _WORTH_THREADS
    threads = min(torch.get_num_threads(), row_chunk) if several else 1
    step = rows_at_once(like, n, row_chunk // threads)
    in_shares(solve, [slice(start, min(start + step, ky)) for start in range(0, ky, step)], threads)


_solve_rows = operator("solve_rows")(solved_rows)


@operator("solve_rows_again")
def _solve_rows_again(rhs: Tensor, factor: Tensor) -> Tensor:
    """The same systems with other right-hand sides."""
    ky, kx = rhs.shape[-2:]
    if rhs.numel() == 0:
        return rhs.clone()
    if _holds_packed(factor):
        return _kernel(factor).solve_again(factor, rhs.reshape(-1, ky, kx)).reshape(rhs.shape)
    n = factor.shape[1]
    right = rhs.to(factor.dtype).reshape(n, ky, kx).transpose(0, 1)[:, :, None]
    rows = factor.new_empty(ky, n, kx)

    def solve(parts: Sequence[slice]) -> None:  # what the first sweep of a part has read, the second finds in the cache
        for part in parts:
            rows[part] = solve_factored(factor[part], right[part])[:, :, 0]

    _in_parts(solve, rhs, n, ky, ky)
    return rows.transpose(0, 1).reshape(rhs.shape).contiguous()


def _holds_packed(factor: Tensor) -> bool:
    return factor.ndim == 3


@torch.library.register_fake("torchqm::solve_rows")
def _(
    gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool, packed: bool
) -> tuple[Tensor, Tensor]:
    (ky, kx), n = rhs.shape[-2:], prod(rhs.shape[:-2])
    return gram.new_empty(rhs.shape), gram.new_empty(_factor_shape(gram, n, ky, kx, packed) if keep else 0)


@torch.library.register_fake("torchqm::solve_rows_again")
def _(rhs: Tensor, factor: Tensor) -> Tensor:
    return factor.new_empty(rhs.shape)


def _to_front(size: int, tensors: Sequence[Tensor], in_dims: Sequence[int | None]) -> list[Tensor]:
    return [
        t.expand(size, *t.shape) if dim is None else t.movedim(dim, 0) for t, dim in zip(tensors, in_dims, strict=True)
    ]


@torch.library.register_vmap("torchqm::solve_rows")
def _(
    info: Any,
    in_dims: Any,
    gram: Tensor,
    diagonal: Tensor,
    rhs: Tensor,
    row_chunk: int,
    keep: bool,
    check: bool,
    packed: bool,
) -> tuple[tuple[Tensor, Tensor], tuple[int, int | None]]:
    front = _to_front(info.batch_size, (gram, diagonal, rhs), in_dims[:3])
    rows, factor = torch.ops.torchqm.solve_rows(*front, row_chunk, keep, check, packed)
    if not keep:
        return (rows, factor), (0, None)
    samples = 0 if _holds_packed(factor) else 1
    return (rows, factor.unflatten(samples, (info.batch_size, -1))), (0, samples)


@torch.library.register_vmap("torchqm::solve_rows_again")
def _(info: Any, in_dims: Any, rhs: Tensor, factor: Tensor) -> tuple[Tensor, int]:
    (rhs,) = _to_front(info.batch_size, (rhs,), in_dims[:1])
    # The samples of all elements of the batch in one dimension, in the order of the right-hand sides.
    dim = in_dims[1]
    samples = 0 if factor.ndim - (dim is not None) == 3 else 1
    if dim is None:
        factor = factor.unsqueeze(samples)
        factor = factor.expand(*[info.batch_size if at == samples else -1 for at in range(factor.ndim)])
    else:
        factor = factor.movedim(dim, samples)
    return torch.ops.torchqm.solve_rows_again(rhs, factor.flatten(samples, samples + 1)), 0
