"""Many symmetric systems that differ in their diagonals only: one batched Cholesky for both passes.

Each row of a functional map solves ``(gram + diag(d_i)) c_i = r_i``. The solve is an operator of its own
(``torch.ops.torchqm.solve_rows``), so that :func:`torch.compile`, :func:`torch.export` and :func:`torch.func.vmap` take
it as one piece, and the check for undetermined rows runs inside them, too.
"""

from collections.abc import Sequence
from math import prod
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.checks import Sizes

__all__ = ["UndeterminedRowsError", "solve_rows"]

# Columns that LAPACK factors at once on the CPU, the rest is matrix products; below _SMALL it does a whole system.
# Measured at 100 x 100: 2.2 times as fast as LAPACK alone.
_PANEL, _SMALL = 16, 32
# Numbers in the systems that are factored together: on the CPU what its caches hold, on a GPU what keeps it busy.
_AT_ONCE = {"cpu": 2**20, "gpu": 2**26}


class UndeterminedRowsError(ValueError):
    """Rows of a map that neither descriptors nor regulariser determine.

    Args:
        undetermined: ``(..., Ky)`` true where a row has no unique solution.
    """

    def __init__(self, undetermined: Bool[Tensor, "*B Ky"]) -> None:
        self.undetermined = undetermined.cpu()
        super().__init__(
            f"the descriptors and the regulariser leave {self._rows()} of the map undetermined; "
            "give a positive lmbda, a ridge or more independent descriptors"
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
        gram: ``(..., Kx, Kx)`` symmetric; the upper triangle is not read.
        diagonal: ``(..., Ky, Kx)`` added to the diagonal of ``gram``, for each row.
        rhs: ``(..., Ky, Kx)`` right-hand sides.
        row_chunk: keep no factor, and let at most so many rows of all samples be in memory at once: ``(..., row_chunk,
            Kx, Kx)`` numbers. The backward pass then factors again, chunk by chunk. None: keep the factor.

    Returns:
        ``(..., Ky, Kx)``.

    Raises:
        ValueError: shapes that do not fit, ``row_chunk < 1``, or entries that are not finite;
            :class:`UndeterminedRowsError` (a ``ValueError``) where a system is singular to the precision of its dtype
            (about ``8 sqrt(Kx) eps``, with its diagonal scaled to ones).

    Example:
        >>> gram, diagonal = torch.eye(2), torch.tensor([[0.0, 1.0], [1.0, 3.0]])
        >>> solve_rows(gram, diagonal, torch.ones(2, 2)).tolist()
        [[1.0, 0.5], [0.5, 0.25]]
    """
    sizes = Sizes()
    sizes.bind("gram", gram, "... Kx Kx")
    sizes.bind("diagonal", diagonal, "... Ky Kx")
    sizes.bind("rhs", rhs, "... Ky Kx")
    if row_chunk is not None and row_chunk < 1:
        raise ValueError(f"row_chunk is {row_chunk}; allowed are None and whole numbers from 1")
    tracked = gram.requires_grad or diagonal.requires_grad or rhs.requires_grad
    keep = row_chunk is None and tracked and torch.is_grad_enabled()
    return _Solve.apply(gram, diagonal, rhs, row_chunk or 0, keep)[0]


@torch.library.custom_op("torchqm::solve_rows", mutates_args=())
def _solve_rows(gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool) -> tuple[Tensor, Tensor]:
    """The rows, and the factor ``(Ky, samples, Kx, Kx)``, empty unless kept; rows first: chunks lie together."""
    ky, kx = rhs.shape[-2:]
    n = prod(rhs.shape[:-2])
    systems = gram.reshape(n, kx, kx)
    entries, right = (side.reshape(n, ky, kx).transpose(0, 1) for side in (diagonal, rhs))
    limit = _AT_ONCE["cpu" if gram.device.type == "cpu" else "gpu"]
    step = max(1, min(row_chunk or ky, limit // max(1, n * kx * kx)))
    factor = gram.new_empty((ky, n, kx, kx) if keep else 0)
    workspace = gram.new_empty((0 if keep else min(step, ky), n, kx, kx))
    rows = gram.new_empty(ky, n, kx)
    probes, noise = _probes(gram), 8 * max(kx, 1) ** 0.5 * torch.finfo(gram.dtype).eps
    singular = torch.zeros(ky, n, dtype=torch.bool, device=gram.device)
    for start in range(0, ky, step):
        part = slice(start, start + step)
        lower = factor[part] if keep else workspace[: len(rows[part])]
        failed = _factorize(systems, entries[part], lower)
        # With a diagonal of ones, a system applied backwards to vectors of signs makes them as long as 1 / its smallest
        # eigenvalue. If that is what rounding leaves of zero, the solution is noise. Pivots alone do not show it: they
        # can be 1e6 times as large.
        unit = (systems.diagonal(dim1=-2, dim2=-1) + entries[part]).clamp_min(0).sqrt()[..., None]
        solved = _solve_factored(lower, torch.cat([right[part, ..., None], unit * probes], -1))
        longest = (unit * solved[..., 1:]).square().sum(-2).amax(-1).sqrt()
        singular[part] = failed | ~(longest * noise < 1)
        rows[part] = solved[..., 0]
    if bool(singular.any()):
        for name, values in (("descriptors", gram), ("lmbda and eigenvalues", diagonal)):
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"the system made of the {name} has entries that are NaN or infinite")
        raise UndeterminedRowsError(singular.T.reshape(rhs.shape[:-1]))
    return rows.transpose(0, 1).reshape(rhs.shape).contiguous(), factor


@torch.library.custom_op("torchqm::solve_rows_again", mutates_args=())
def _solve_rows_again(rhs: Tensor, factor: Tensor) -> Tensor:
    """The same systems with other right-hand sides."""
    ky, kx = rhs.shape[-2:]
    right = rhs.reshape(prod(rhs.shape[:-2]), ky, kx).transpose(0, 1)[..., None]
    return _solve_factored(factor, right)[..., 0].transpose(0, 1).reshape(rhs.shape).contiguous()


def _factorize(gram: Tensor, diagonal: Tensor, out: Tensor) -> Tensor:
    """Cholesky factors of ``gram + diag(diagonal)`` into the lower triangles of ``out``; which of them there are not.

    Args:
        gram: ``(n, K, K)``.
        diagonal: ``(R, n, K)``.
        out: ``(R, n, K, K)``, contiguous; its upper triangles are not written.
    """
    r, n, k = diagonal.shape
    panel = k if k <= _SMALL or gram.device.type != "cpu" else _PANEL
    lower, failed = out.view(r * n, k, k), torch.zeros(r * n, dtype=torch.bool, device=gram.device)
    for j in range(0, k, panel):
        end = min(j + panel, k)
        # The columns j to end from the diagonal downwards, less what the columns before explain of them.
        columns = gram[:, j:, j:end].expand(r, n, k - j, end - j).clone(memory_format=torch.contiguous_format)
        columns = columns.view(r * n, k - j, end - j)
        top = columns[:, : end - j]
        top.diagonal(dim1=1, dim2=2).add_(diagonal[..., j:end].reshape(r * n, end - j))
        if j:
            columns.baddbmm_(lower[:, j:, :j], lower[:, j:end, :j].mT, alpha=-1)
        corner, info = torch.linalg.cholesky_ex(top)
        failed |= info > 0
        lower[:, j:end, j:end] = corner
        if end < k:
            below = torch.linalg.solve_triangular(corner.mT, columns[:, end - j :], upper=True, left=False)
            lower[:, end:, j:end] = below
    return failed.view(r, n)


def _solve_factored(lower: Tensor, columns: Tensor) -> Tensor:
    half = torch.linalg.solve_triangular(lower, columns, upper=False)
    return torch.linalg.solve_triangular(lower.mT, half, upper=True)


def _probes(like: Tensor) -> Tensor:
    """``(K, 3)`` signs without a pattern, the same in every call."""
    place = torch.arange(like.shape[-1], device=like.device, dtype=like.dtype)[:, None] + 0.5
    phases = place.square() * torch.arange(1, 4, device=like.device, dtype=like.dtype)
    return torch.where(phases.cos() > 0, 1.0, -1.0).to(like.dtype)


@_solve_rows.register_fake
def _(gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool) -> tuple[Tensor, Tensor]:
    ky, kx = rhs.shape[-2:]
    return rhs.new_empty(rhs.shape), rhs.new_empty((ky, prod(rhs.shape[:-2]), kx, kx) if keep else 0)


@_solve_rows_again.register_fake
def _(rhs: Tensor, factor: Tensor) -> Tensor:
    return rhs.new_empty(rhs.shape)


class _Solve(torch.autograd.Function):
    """Derivatives of the operator; it has none of its own, since ``torch.func.grad`` does not go through those."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool) -> tuple[Tensor, Tensor]:
        return torch.ops.torchqm.solve_rows(gram, diagonal, rhs, row_chunk, keep)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        gram, diagonal, _, ctx.row_chunk, ctx.keep = inputs
        ctx.mark_non_differentiable(output[1])
        ctx.set_materialize_grads(False)  # else autograd makes zeros as large as the factor
        ctx.save_for_backward(gram, diagonal, *output)

    @staticmethod
    def backward(ctx: Any, grad: Tensor | None, _: Any) -> tuple[Tensor | None, ...]:
        if grad is None:
            return None, None, None, None, None
        gram, diagonal, rows, factor = ctx.saved_tensors
        if ctx.keep:
            u = _SolveAgain.apply(gram, diagonal, grad, factor)
        else:
            u = _Solve.apply(gram, diagonal, grad, ctx.row_chunk, False)[0]
        return *_gradients(rows, u), None, None


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


def _gradients(rows: Tensor, u: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    product = u.mT @ rows
    return -0.5 * (product + product.mT), -u * rows, u


def _to_front(size: int, tensors: Sequence[Tensor], in_dims: Sequence[int | None]) -> list[Tensor]:
    return [
        t.expand(size, *t.shape) if dim is None else t.movedim(dim, 0) for t, dim in zip(tensors, in_dims, strict=True)
    ]


@_solve_rows.register_vmap
def _(
    info: Any, in_dims: Any, gram: Tensor, diagonal: Tensor, rhs: Tensor, row_chunk: int, keep: bool
) -> tuple[tuple[Tensor, Tensor], tuple[int, int | None]]:
    front = _to_front(info.batch_size, (gram, diagonal, rhs), in_dims[:3])
    rows, factor = torch.ops.torchqm.solve_rows(*front, row_chunk, keep)
    if not keep:
        return (rows, factor), (0, None)
    return (rows, factor.unflatten(1, (info.batch_size, -1))), (0, 1)


@_solve_rows_again.register_vmap
def _(info: Any, in_dims: Any, rhs: Tensor, factor: Tensor) -> tuple[Tensor, int]:
    (rhs,) = _to_front(info.batch_size, (rhs,), in_dims[:1])
    # The samples of all elements of the batch in one dimension, in the order of the right-hand sides.
    dim = in_dims[1]
    factor = factor.unsqueeze(1).expand(-1, info.batch_size, -1, -1, -1) if dim is None else factor.movedim(dim, 1)
    return torch.ops.torchqm.solve_rows_again(rhs, factor.flatten(1, 2)), 0
