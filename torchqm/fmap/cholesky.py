"""Batched Cholesky factors of systems that differ in their diagonals, in place and in pieces that fit a cache."""

import torch
from torch import Tensor

__all__ = ["factorize", "rows_at_once", "solve_checked", "solve_factored", "surely_regular"]

# Columns that LAPACK factors at once on the CPU, the rest is matrix products; below _SMALL it does a whole system.
# Measured at 100 x 100: 2.2 times as fast as LAPACK alone.
_PANEL, _SMALL = 16, 32
# Numbers in the systems that are factored together: on the CPU what its caches hold, on a GPU what keeps it busy.
_AT_ONCE = {"cpu": 2**20, "gpu": 2**26}


def rows_at_once(like: Tensor, n: int, row_chunk: int) -> int:
    """Rows of ``n`` samples, at most ``row_chunk``, to factor together; K is the last size of ``like``."""
    limit = _AT_ONCE["cpu" if like.device.type == "cpu" else "gpu"]
    return max(1, min(row_chunk, limit // max(1, n * like.shape[-1] ** 2)))


def factorize(gram: Tensor, diagonal: Tensor, out: Tensor) -> Tensor:
    """Cholesky factors of ``gram + diag(diagonal)`` into the lower triangles of ``out``; which of them there are not.

    Args:
        gram: ``(n, K, K)``.
        diagonal: ``(R, n, K)``.
        out: ``(R, n, K, K)``, contiguous; its upper triangles are not written.
    """
    r, n, k = diagonal.shape
    panel = max(k, 1) if k <= _SMALL or gram.device.type != "cpu" else _PANEL
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


def solve_factored(lower: Tensor, columns: Tensor) -> Tensor:
    """Solutions for several right-hand sides ``(..., K, m)``."""
    half = torch.linalg.solve_triangular(lower, columns, upper=False)
    return torch.linalg.solve_triangular(lower.mT, half, upper=True)


def surely_regular(gram: Tensor, floor: Tensor) -> bool:
    """Whether all systems are regular, by one eigenvalue problem a sample instead of one estimate a row.

    With ``floor`` the least diagonal of all rows and ``M = gram + diag(floor)``, each system is M plus a diagonal that
    is not negative; scaled to a diagonal of ones its least eigenvalue is at least that of M, scaled likewise, or 1.

    Args:
        gram: ``(n, K, K)``.
        floor: ``(n, K)`` the least entries of the diagonals that are added.
    """
    least = gram + torch.diag_embed(floor)
    unit = least.diagonal(dim1=-2, dim2=-1)
    if not bool(torch.isfinite(least).all() & (unit > 0).all()):
        return False
    root = unit.rsqrt()
    values = torch.linalg.eigvalsh(root[..., :, None] * least * root[..., None, :])
    return bool((values[..., 0] > 4 * _noise(gram)).all())


def _noise(systems: Tensor) -> float:
    return 8 * systems.shape[-1] ** 0.5 * torch.finfo(systems.dtype).eps


def solve_checked(lower: Tensor, rhs: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
    """The rows, and which systems are singular to working precision.

    Scaled to a diagonal of ones (``unit`` is the root of the old one), a system applied backwards twice to any vector
    shows its smallest eigenvalue. If that is what rounding leaves of zero, the solution is noise. Pivots alone do not
    show it: they can be a million times as large.
    """
    k = rhs.shape[-1]
    place = torch.arange(k, device=rhs.device, dtype=rhs.dtype) + 0.5
    signs = torch.where(place.square().cos() > 0, unit, -unit)
    solved = solve_factored(lower, torch.stack([rhs, signs], -1))
    once = unit * solved[..., 1]
    once = once / once.abs().amax(-1, keepdim=True)  # its square could overflow
    twice = unit * solve_factored(lower, (unit * once)[..., None])[..., 0]
    return solved[..., 0], ~(_noise(lower) * twice.norm(dim=-1) < once.norm(dim=-1))
