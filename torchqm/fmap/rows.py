"""Many symmetric systems that differ in their diagonals only: one batched Cholesky for both passes.

Each row of a functional map solves ``(gram + diag(d_i)) c_i = r_i``. The solve is an operator of its own
(:mod:`torchqm.fmap.row_operators`), so that :func:`torch.compile`, :func:`torch.export` and :func:`torch.func.vmap`
take it as one piece, and the check for undetermined rows runs inside them, too.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.forward_ad import unpack_dual

from torchqm.checks import Sizes, enabled, wanted
from torchqm.fmap.row_operators import UndeterminedRowsError, is_packed, solved_rows

__all__ = ["UndeterminedRowsError", "solve_rows"]


def solve_rows(
    gram: Float[Tensor, "*B Kx Kx"],
    diagonal: Float[Tensor, "*B Ky Kx"],
    rhs: Float[Tensor, "*B Ky Kx"],
    row_chunk: int | None = None,
) -> Float[Tensor, "*B Ky Kx"]:
    """Row i of the result solves ``(gram + diag(diagonal_i)) c_i = rhs_i``.

    The Cholesky factor of all rows, ``(..., Ky, Kx, Kx)`` in size (half of that by the compiled kernel), is the only
    tensor of that size, and it is made only if there will be a backward pass. That one solves with the same factor: for
    ``u_i = S_i^-1 grad_i`` the gradients are ``u_i`` for ``rhs_i``, ``-u_i * c_i`` for ``diagonal_i`` and
    ``-1/2 sum_i (u_i c_i^T + c_i u_i^T)`` for ``gram``. It is made of differentiable operations: derivatives of any
    order are right.

    Args:
        gram: ``(..., Kx, Kx)`` symmetric; the lower triangle is not used.
        diagonal: ``(..., Ky, Kx)`` added to the diagonal of ``gram``, for each row.
        rhs: ``(..., Ky, Kx)`` right-hand sides.
        row_chunk: keep no factor, and let at most so many rows of all samples be in memory at once: ``(..., row_chunk,
            Kx, Kx)`` numbers (the compiled kernel: rounded up to 4 or 8 rows of one sample). The backward pass then
            factors again, chunk by chunk. None: keep the factor.

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
        return solved_rows(gram, diagonal, rhs, row_chunk or 0, False, True, is_packed(gram))[0]
    return _solver().apply(gram, diagonal, rhs, row_chunk or 0, keep, wanted())[0]


def _plain(*tensors: Tensor) -> bool:
    """Whether nobody compiles or traces, and none has a tangent."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing():
        return False
    return all(type(tensor) is Tensor and not _has_tangent(tensor) for tensor in tensors)


def _has_tangent(tensor: Tensor) -> bool:
    return unpack_dual(tensor).tangent is not None


def _solver() -> type["_Solve"]:
    """With derivatives in forward mode, unless ``torch.compile`` is at work, which takes no function that has these."""
    return _Solve if torch.compiler.is_compiling() else _SolveForward


def _solver_again() -> type["_SolveAgain"]:
    return _SolveAgain if torch.compiler.is_compiling() else _SolveAgainForward


class _Solve(torch.autograd.Function):
    """Derivatives of the operator; it has none of its own, since ``torch.func.grad`` does not go through those."""

    generate_vmap_rule = True

    @staticmethod
    def forward(
        gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool, check: bool
    ) -> tuple[Tensor, Tensor]:
        return torch.ops.torchqm.solve_rows(gram, diagonal, rhs, row_chunk, keep, check, is_packed(gram))

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
            u = _solver_again().apply(gram, diagonal, grad, factor)
        else:
            u = _solver().apply(gram, diagonal, grad, ctx.row_chunk, False, False)[0]
        return *_gradients(rows, u, ctx.needs_input_grad), None, None, None


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
        ctx.save_for_forward(gram, diagonal, output, factor)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        gram, diagonal, rows, factor = ctx.saved_tensors
        u = _solver_again().apply(gram, diagonal, grad, factor)
        return *_gradients(rows, u, ctx.needs_input_grad), None


class _SolveForward(_Solve):
    """Also with derivatives in forward mode."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> tuple[Tensor, None]:
        gram, diagonal, rows, _ = ctx.saved_tensors
        moved = _moved(rows, *tangents[:3])
        return _SolveForward.apply(gram, diagonal, moved, ctx.row_chunk, False, False)[0], None


class _SolveAgainForward(_SolveAgain):
    """Also with derivatives in forward mode: of a backward pass, as in a Hessian by forward over reverse."""

    @staticmethod
    def jvp(ctx: Any, *tangents: Tensor | None) -> Tensor:
        gram, diagonal, rows, factor = ctx.saved_tensors
        return _SolveAgainForward.apply(gram, diagonal, _moved(rows, *tangents[:3]), factor)


def _moved(rows: Tensor, gram: Tensor | None, diagonal: Tensor | None, rhs: Tensor | None) -> Tensor:
    """Right-hand sides of the rows' tangents: ``S_i dc_i = drhs_i - (dgram + diag(ddiagonal_i)) c_i``."""
    from torch._C._functorch import TransformType
    from torch._functorch.pyfunctorch import retrieve_all_functorch_interpreters

    if sum(level.key() == TransformType.Jvp for level in retrieve_all_functorch_interpreters()) > 1:
        # What torch gives for the second derivatives of any autograd.Function in this mode is zero, or wrong.
        raise NotImplementedError("solve_rows has no derivatives forward over forward; take them forward over reverse")
    moved = torch.zeros_like(rows) if rhs is None else rhs
    if gram is not None:
        moved = moved - rows @ (gram + gram.mT) / 2
    return moved if diagonal is None else moved - diagonal * rows


def _gradients(rows: Tensor, u: Tensor, needed: Sequence[bool]) -> tuple[Tensor | None, Tensor | None, Tensor]:
    """For ``gram``, ``diagonal`` and ``rhs``; None for the first two where nobody asks."""
    gram = None
    if needed[0]:
        product = u.mT @ rows
        gram = (product + product.mT).mul(-0.5)
    return gram, -u * rows if needed[1] else None, u
