"""Many symmetric systems that differ in their diagonals only: one batched Cholesky for both passes.

Each row of a functional map solves ``(gram + diag(d_i)) c_i = r_i``. The solve is an operator of its own
(``torch.ops.torchqm.solve_rows``), so that :func:`torch.compile`, :func:`torch.export` and :func:`torch.func.vmap` take
it as one piece, and the check for undetermined rows runs inside them, too.
"""

from collections.abc import Callable, Sequence
from math import prod
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from torchqm.checks import Sizes, enabled, wanted
from torchqm.fmap.cholesky import factorize, rows_at_once, solve_checked, solve_factored, surely_regular
from torchqm.fmap.operator import operator
from torchqm.fmap.threads import in_shares

__all__ = ["UndeterminedRowsError", "solve_rows"]

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


def solve_rows(
    gram: Float[Tensor, "*B Kx Kx"],
    diagonal: Float[Tensor, "*B Ky Kx"],
    rhs: Float[Tensor, "*B Ky Kx"],
    row_chunk: int | None = None,
) -> Float[Tensor, "*B Ky Kx"]:
    """Row i of the result solves ``(gram + diag(diagonal_i)) c_i = rhs_i``.

    The Cholesky factor of all rows, ``(..., Ky, Kx, Kx)`` in size, is the only tensor of that size, and it is made only
    if there will be a backward pass. That one solves with the same factor: for ``u_i = S_i^-1 grad_i`` the gradients
    are ``u_i`` for ``rhs_i``, ``-u_i * c_i`` for ``diagonal_i`` and ``-1/2 sum_i (u_i c_i^T + c_i u_i^T)`` for
    ``gram``. It is made of differentiable operations: derivatives of any order are right.

    Args:
        gram: ``(..., Kx, Kx)`` symmetric; the lower triangle is not used.
        diagonal: ``(..., Ky, Kx)`` added to the diagonal of ``gram``, for each row.
        rhs: ``(..., Ky, Kx)`` right-hand sides.
        row_chunk: keep no factor, and let at most so many rows of all samples be in memory at once: ``(..., row_chunk,
            Kx, Kx)`` numbers. The backward pass then factors again, chunk by chunk. None: keep the factor.

    Returns:
        ``(..., Ky, Kx)``.

    Raises:
        ValueError: shapes that do not fit, ``row_chunk < 1``, or entries that are not finite;
            :class:`UndeterminedRowsError` (a ``ValueError``) where a system is singular to the precision of its dtype
            (about ``8 sqrt(Kx) eps``, with its diagonal scaled to ones); inside
            :func:`torchqm.checks.disabled` only where its factor does not exist.

    Example:
        >>> gram, diagonal = torch.eye(2), torch.tensor([[0.0, 3.0], [3.0, 15.0]])
        >>> solve_rows(gram, diagonal, torch.ones(2, 2)).tolist()
        [[1.0, 0.25], [0.25, 0.0625]]
    """
    sizes = Sizes()
    sizes.bind("gram", gram, "... Kx Kx")
    sizes.bind("diagonal", diagonal, "... Ky Kx")
    sizes.bind("rhs", rhs, "... Ky Kx")
    if row_chunk is not None and row_chunk < 1:
        raise ValueError(f"row_chunk is {row_chunk}; allowed are None and whole numbers from 1")
    tracked = gram.requires_grad or diagonal.requires_grad or rhs.requires_grad
    keep = row_chunk is None and tracked and torch.is_grad_enabled()
    if enabled() and not tracked and _plain(gram, diagonal, rhs):
        # Nobody differentiates either. Called as an operator for the first time, it would load the
        # compiler, which takes longer than the match of a pair.
        return _rows_and_factor(gram, diagonal, rhs, row_chunk or 0, False, True)[0]
    moving = not torch.compiler.is_compiling() and any(map(_has_tangent, (gram, diagonal, rhs)))
    solve = _SolveForward if moving else _Solve
    return solve.apply(gram, diagonal, rhs, row_chunk or 0, keep, wanted())[0]


def _plain(*tensors: Tensor) -> bool:
    """Whether nobody compiles or traces, and none has a tangent."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing():
        return False
    return all(type(tensor) is Tensor and not _has_tangent(tensor) for tensor in tensors)


def _has_tangent(tensor: Tensor) -> bool:
    return unpack_dual(tensor).tangent is not None


def _rows_and_factor(
    gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool
) -> tuple[Tensor, Tensor]:
    """The rows, and the factor ``(Ky, samples, Kx, Kx)``, empty unless kept; rows first: chunks lie together."""
    ky, kx = rhs.shape[-2:]
    n = prod(rhs.shape[:-2])
    if rhs.numel() == 0:
        return rhs.clone(), gram.new_empty((ky, n, kx, kx) if keep else 0)
    systems = gram.reshape(n, kx, kx)
    entries, right = (side.reshape(n, ky, kx).transpose(0, 1) for side in (diagonal, rhs))
    factor = gram.new_empty((ky, n, kx, kx) if keep else 0)
    rows = gram.new_empty(ky, n, kx)
    check = check and not surely_regular(systems, entries.amin(0))
    # Without a check only those are found whose factor does not exist.
    undetermined = torch.zeros(ky, n, dtype=torch.bool, device=gram.device)

    def solve(parts: Sequence[slice]) -> None:
        workspace = gram.new_empty((0 if keep else parts[0].stop - parts[0].start, n, kx, kx))
        for part in parts:
            upper = factor[part] if keep else workspace[: len(rows[part])]
            failed = factorize(systems, entries[part], upper)
            if check:
                unit = (systems.diagonal(dim1=-2, dim2=-1) + entries[part]).clamp_min(0).sqrt()
                rows[part], singular = solve_checked(upper, right[part], unit)
                undetermined[part] = failed | singular
            else:
                rows[part] = solve_factored(upper, right[part, :, None])[:, :, 0]
                undetermined[part] = failed

    _in_parts(solve, gram, n, ky, row_chunk or ky)
    if bool(undetermined.any()):
        for name, values in (("descriptors", gram), ("lmbda and eigenvalues", diagonal)):
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"the system made of the {name} has entries that are NaN or infinite")
        raise UndeterminedRowsError(undetermined.T.reshape(rhs.shape[:-1]), gram.dtype)
    return rows.transpose(0, 1).reshape(rhs.shape).contiguous(), factor


def _in_parts(solve: Callable[[Sequence[slice]], None], like: Tensor, n: int, ky: int, row_chunk: int) -> None:
    """Solve all rows of ``n`` samples, at most ``row_chunk`` at a time; the first part is one of the longest.

    On the CPU several parts run at a time: LAPACK takes one matrix after the other.
    """
    several = like.device.type == "cpu" and n * ky * like.shape[-1] ** 2 >= _WORTH_THREADS
    threads = min(torch.get_num_threads(), row_chunk) if several else 1
    step = rows_at_once(like, n, row_chunk // threads)
    in_shares(solve, [slice(start, min(start + step, ky)) for start in range(0, ky, step)], threads)


_solve_rows = operator("solve_rows")(_rows_and_factor)


@operator("solve_rows_again")
def _solve_rows_again(rhs: Tensor, factor: Tensor) -> Tensor:
    """The same systems with other right-hand sides."""
    ky, kx = rhs.shape[-2:]
    n = factor.shape[1]
    if rhs.numel() == 0:
        return rhs.clone()
    right = rhs.reshape(n, ky, kx).transpose(0, 1)[:, :, None]
    rows = rhs.new_empty(ky, n, kx)

    def solve(parts: Sequence[slice]) -> None:  # what the first sweep of a part has read, the second finds in the cache
        for part in parts:
            rows[part] = solve_factored(factor[part], right[part])[:, :, 0]

    _in_parts(solve, rhs, n, ky, ky)
    return rows.transpose(0, 1).reshape(rhs.shape).contiguous()


@torch.library.register_fake("torchqm::solve_rows")
def _(gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool) -> tuple[Tensor, Tensor]:
    ky, kx = rhs.shape[-2:]
    return rhs.new_empty(rhs.shape), rhs.new_empty((ky, prod(rhs.shape[:-2]), kx, kx) if keep else 0)


@torch.library.register_fake("torchqm::solve_rows_again")
def _(rhs: Tensor, factor: Tensor) -> Tensor:
    return rhs.new_empty(rhs.shape)


class _Solve(torch.autograd.Function):
    """Derivatives of the operator; it has none of its own, since ``torch.func.grad`` does not go through those."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool
    ) -> tuple[Tensor, Tensor]:
        return torch.ops.torchqm.solve_rows(gram, diagonal, rhs, row_chunk, keep, check)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        gram, diagonal, _, ctx.row_chunk, ctx.keep, _ = inputs
        ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)  # else autograd makes zeros as large as the factor
        ctx.save_for_backward(gram, diagonal, *output)
        ctx.save_for_forward(gram, diagonal, *output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
        if grad is None:
            return (None,) * 6
        gram, diagonal, rows, factor = ctx.saved_tensors
        if ctx.keep:
            u = _SolveAgain.apply(gram, diagonal, grad, factor)
        else:
            u = _Solve.apply(gram, diagonal, grad, ctx.row_chunk, False, False)[0]
        return *_gradients(rows, u), None, None, None


class _SolveAgain(torch.autograd.Function):
    """The same for other right-hand sides, with the factor at hand."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gram: Tensor, diagonal: Tensor, rhs: Tensor, factor: Tensor) -> Tensor:
        return torch.ops.torchqm.solve_rows_again(rhs, factor)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        gram, diagonal, _, factor = inputs
        ctx.save_for_backward(gram, diagonal, output, factor)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        gram, diagonal, rows, factor = ctx.saved_tensors
        return *_gradients(rows, _SolveAgain.apply(gram, diagonal, grad, factor)), None


class _SolveForward(_Solve):
    """Also with derivatives in forward mode; ``torch.compile`` takes no function that has these."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None]:
        # S_i dc_i = drhs_i - (dgram + diag(ddiagonal_i)) c_i
        gram, diagonal, rows, _ = ctx.saved_tensors
        gram_t, diagonal_t, rhs_t = tangents[:3]
        moved = torch.zeros_like(rows) if rhs_t is None else rhs_t
        if gram_t is not None:
            moved = moved - rows @ (gram_t + gram_t.mT) / 2
        if diagonal_t is not None:
            moved = moved - diagonal_t * rows
        return _SolveForward.apply(gram, diagonal, moved, ctx.row_chunk, False, False)[0], None


def _gradients(rows: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    product = u.mT @ rows
    return -0.5 * (product + product.mT), -u * rows, u


def _to_front(size: int, tensors: Sequence[Tensor], in_dims: Sequence[int | None]) -> list[Tensor]:
    return [
        t.expand(size, *t.shape) if dim is None else t.movedim(dim, 0) for t, dim in zip(tensors, in_dims, strict=True)
    ]


@torch.library.register_vmap("torchqm::solve_rows")
def _(
    info: Any, in_dims: Any, gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool
) -> tuple[tuple[Tensor, Tensor], tuple[int, int | None]]:
    front = _to_front(info.batch_size, (gram, diagonal, rhs), in_dims[:3])
    rows, factor = torch.ops.torchqm.solve_rows(*front, row_chunk, keep, check)
    if not keep:
        return (rows, factor), (0, None)
    return (rows, factor.unflatten(1, (info.batch_size, -1))), (0, 1)


@torch.library.register_vmap("torchqm::solve_rows_again")
def _(info: Any, in_dims: Any, rhs: Tensor, factor: Tensor) -> tuple[Tensor, int]:
    (rhs,) = _to_front(info.batch_size, (rhs,), in_dims[:1])
    # The samples of all elements of the batch in one dimension, in the order of the right-hand sides.
    dim = in_dims[1]
    factor = factor.unsqueeze(1).expand(-1, info.batch_size, -1, -1, -1) if dim is None else factor.movedim(dim, 1)
    return torch.ops.torchqm.solve_rows_again(rhs, factor.flatten(1, 2)), 0
