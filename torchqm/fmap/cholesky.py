"""Batched Cholesky factors of systems that differ in their diagonals, in place and in pieces that fit a cache."""

import torch
from torch import Tensor

from torchqm.fmap.lapack import has_lapack, potrf

__all__ = ["factorize", "noise", "rows_at_once", "solve_checked", "solve_factored", "surely_regular"]

# Numbers in the systems that are factored together: on the CPU what its caches hold, on a GPU what keeps it busy.
_AT_ONCE = {"cpu": 2**20, "gpu": 2**26}


def rows_at_once(like: Tensor, n: int, row_chunk: int) -> int:
    """Rows of ``n`` samples, at most ``row_chunk``, to factor together; K is the last size of ``like``."""
    limit = _AT_ONCE["cpu" if like.device.type == "cpu" else "gpu"]
    return max(1, min(row_chunk, limit // max(1, n * like.shape[-1] ** 2)))


def factorize(gram: Tensor, diagonal: Tensor, out: Tensor) -> Tensor:
    """Factors U, ``U^T U = gram + diag(diagonal)``, into the upper triangles of ``out``; which of them there are not.

    Args:
        gram: ``(n, K, K)``; what is below its diagonal is not used.
        diagonal: ``(R, n, K)``.
        out: ``(R, n, K, K)``, contiguous; what it holds below its diagonals afterwards means nothing.
    """
    out.copy_(gram)
    out.diagonal(dim1=-2, dim2=-1).add_(diagonal)
    if has_lapack(out):
        failed = potrf(out.flatten(0, 1)).view(diagonal.shape[:2]) != 0
        pivots = out.diagonal(dim1=-2, dim2=-1)  # LAPACK goes on with what is not a number
        return failed | ~(torch.isfinite(pivots) & (pivots > 0)).all(-1)
    upper, info = torch.linalg.cholesky_ex(out, upper=True)
    out.copy_(upper)
    return info != 0


def solve_factored(upper: Tensor, rows: Tensor) -> Tensor:
    """Solutions of ``U^T U x = b`` for each row b: ``(..., K, K)`` and ``(..., m, K)`` to ``(..., m, K)``."""
    half = torch.linalg.solve_triangular(upper.mT, rows.mT, upper=False)
    return torch.linalg.solve_triangular(upper, half, upper=True).mT


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
    # The same triangle that is factored.
    values = torch.linalg.eigvalsh(root[..., :, None] * least * root[..., None, :], UPLO="U")
    return bool((values[..., 0] > 4 * noise(gram)).all())


def noise(systems: Tensor) -> float:
    """The least eigenvalue, as a share of the largest, that systems of unit diagonal and this type can show."""
    return 8 * systems.shape[-1] ** 0.5 * torch.finfo(systems.dtype).eps


def solve_checked(upper: Tensor, rhs: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
    """The rows, and which systems are singular to working precision.

    Scaled to a diagonal of ones (``unit`` is the root of the old one), a system applied backwards twice to any vector
    shows its smallest eigenvalue. If that is what rounding leaves of zero, the solution is noise. Pivots alone do not
    show it: they can be a million times as large.
    """
    place = torch.arange(rhs.shape[-1], device=rhs.device, dtype=torch.float64) + 0.5
    signs = torch.where(place.square().cos() > 0, unit, -unit)  # without a pattern: a part along every eigenvector
    solved = solve_factored(upper, torch.stack([rhs, signs], -2))
    once = unit * solved[..., 1, :]
    once = once / once.abs().amax(-1, keepdim=True)  # its square could overflow
    twice = unit * solve_factored(upper, (unit * once)[..., None, :])[..., 0, :]
    return solved[..., 0, :], ~(noise(upper) * twice.norm(dim=-1) < once.norm(dim=-1))
