"""Eigenvectors and projectors with gauge-invariant gradients: finite at repeated eigenvalues, batched.

Eigenvectors are determined up to sign, and up to rotation inside a cluster of equal eigenvalues (the gauge). The
derivative along the gauge is ``0 / 0`` in the textbook backward pass; here it is left out. What that means for a loss:

* A function of projectors onto whole clusters (``V_c V_c^T``: distances, Gram matrices, low-pass filters that are
  constant on a cluster) and of symmetric functions of a cluster's eigenvalues (mean, trace of ``f(H)``) does not depend
  on the gauge. Its gradient is exact, at exactly repeated eigenvalues too.
* A spectral filter ``V f(Lambda) V^T`` does not depend on the gauge either, but its derivative inside a cluster is
  ``f'(lambda)`` times the derivative of the matrix, and the eigenvectors' part of it is ``0 / 0`` at equal eigenvalues:
  of that block only the diagonal survives. It is exact again as soon as the eigenvalues differ by more than ``rtol``.
* A loss on single vectors of a cluster has no derivative; it gets that of its gauge-invariant part.

All take the symmetric part of what they are given, work under ``torch.func``, ``torch.compile`` and ``torch.export``,
and raise on a second derivative.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.options import require_number

__all__ = ["column_signs", "gap_tolerance", "invariant_eigh", "spectral_projector", "split_eigh"]


def gap_tolerance(dtype: torch.dtype) -> float:
    """Gaps up to this share of the largest eigenvalue count as zero: 1e-10 in float64, 1e-5 in float32.

    For an invariant loss ``V^T grad V`` is symmetric inside a cluster, up to rounding of about ``eps |G|``, which the
    gap makes ``eps |G| / (rtol scale)`` at worst; an ordinary pair of a K-dimensional problem counts about
    ``K |G| / scale``. With these numbers rounding stays at 1e-7 (float64) and 1e-4 (float32) of it or below for
    K = 100. The solver's own error of eigenvalues, about ``K eps scale``, still counts as a gap of zero. Larger
    numbers would only take away more of the derivative of spectral filters.
    """
    return 1e-10 if dtype == torch.float64 else 1e-5


def invariant_eigh(
    matrix: Float[Tensor, "*B K K"], rtol: float | None = None, scale: Float[Tensor, "*B"] | None = None
) -> tuple[Float[Tensor, "*B K"], Float[Tensor, "*B K K"]]:
    """``(H + H^T) / 2 = V diag(l) V^T``, whose gradient leaves pairs with ``|l_i - l_j| <= rtol scale`` out.

    ``grad H = V (diag(grad l) + sym(F o V^T grad V)) V^T`` with ``F_ij = 1 / (l_j - l_i)``, or 0 for such a pair.

    Args:
        matrix: ``(..., K, K)`` matrices H.
        rtol: gaps that count as zero, as a share of ``scale``; by default :func:`gap_tolerance`.
        scale: ``(...)`` by default the largest eigenvalue's magnitude.

    Returns:
        Eigenvalues ``(..., K)``, ascending, and eigenvectors ``(..., K, K)`` as columns.

    Example:
        >>> matrix = torch.eye(2, dtype=torch.float64).requires_grad_()
        >>> values, vectors = invariant_eigh(matrix)
        >>> (values.sum() + vectors[0, 0] ** 2).backward()
        >>> matrix.grad.tolist()
        [[1.0, 0.0], [0.0, 1.0]]

    References:
        Magnus 1985 for the derivatives; :mod:`torchqm.symmetry.invariant` for the losses they are exact for.
    """
    return _eigh(matrix, rtol, scale, None)


def split_eigh(
    matrix: Float[Tensor, "*B K K"],
    threshold: float = 0.5,
    rtol: float | None = None,
    scale: Float[Tensor, "*B"] | None = None,
) -> tuple[Float[Tensor, "*B K"], Float[Tensor, "*B K K"]]:
    """Eigenvectors as bases of two subspaces, above and below a threshold: the gradient knows nothing inside either.

    ``grad S = Q (diag(grad w) + sym(F o Q^T grad Q)) Q^T`` with ``F_ij = 1 / (w_j - w_i)`` where one of the two is
    above ``threshold`` and the other is not, else 0. So it is right for losses that depend on the two subspaces only,
    however often an eigenvalue is repeated in either.

    Args:
        matrix: ``(..., K, K)`` matrices S.
        threshold: eigenvalues above it belong to the upper subspace.
        rtol: pairs across the threshold with a gap of at most ``rtol scale`` are left out: there the subspaces are not
            determined. By default :func:`gap_tolerance`.
        scale: ``(...)`` by default the largest eigenvalue's magnitude.

    Returns:
        Eigenvalues ``(..., K)``, ascending, and eigenvectors ``(..., K, K)`` as columns.

    Example:
        >>> values, vectors = split_eigh(torch.diag(torch.tensor([0.0, 1.0, 1.0])))
        >>> int((values > 0.5).sum())
        2
    """
    return _eigh(matrix, rtol, scale, threshold)


def spectral_projector(
    matrix: Float[Tensor, "*B K K"], threshold: float = 0.5, rtol: float | None = None
) -> Float[Tensor, "*B K K"]:
    """``U+ U+^T``: the orthogonal projector onto the eigenspace of ``(S + S^T) / 2`` above a threshold.

    Basis-free: there is no gauge, and the Frechet derivative is exact at any multiplicity inside the two halves. With
    divided differences of the step it is ``grad S = U (D o U^T grad U) U^T``, ``D_ij = 1 / |w_i - w_j|`` across
    the threshold and 0 on one side of it.

    Args:
        matrix: ``(..., K, K)`` matrices S.
        threshold: where the spectrum is cut; best in a gap.
        rtol: as in :func:`split_eigh`.

    Returns:
        ``(..., K, K)`` projectors; zero where no eigenvalue is above the threshold.

    Example:
        >>> swap = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
        >>> spectral_projector((torch.eye(2) + swap) / 2).mul(4).round().div(4).tolist()
        [[0.5, 0.5], [0.5, 0.5]]
    """
    values, vectors = split_eigh(matrix, threshold, rtol)
    return (vectors * (values > threshold)[..., None, :].to(vectors.dtype)) @ vectors.mT


def column_signs(vectors: Float[Tensor, "*B V K"]) -> Float[Tensor, "*B 1 K"]:
    """1 or -1 for each column, by the rule of :func:`torchqm.spectral.eigen.fix_signs`; batched and without gradient.

    Example:
        >>> column_signs(torch.tensor([[1.0, 0.0], [-2.0, 0.0]])).tolist()
        [[-1.0, 1.0]]
    """
    vectors = vectors.detach()
    size = vectors.abs()
    peak = (size >= (1 - 1e-4) * size.amax(-2, keepdim=True)).to(torch.uint8).argmax(-2, keepdim=True)
    return torch.where(torch.gather(vectors, -2, peak) < 0, -1.0, 1.0).to(vectors.dtype)


def _eigh(matrix: Tensor, rtol: float | None, scale: Tensor | None, threshold: float | None) -> tuple[Tensor, Tensor]:
    if rtol is None:
        rtol = gap_tolerance(matrix.dtype)
    else:  # below zero an eigenvalue would be apart from itself
        require_number("rtol", rtol, least=0)
    found: tuple[Tensor, Tensor] = _Eigh.apply((matrix + matrix.mT) / 2, scale, rtol, threshold)
    return found


class _Eigh(torch.autograd.Function):
    """``eigh`` of symmetric matrices; the backward pass keeps the pairs that the threshold and the tolerance leave."""

    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor, scale: Tensor | None, rtol: float, threshold: float | None) -> tuple[Tensor, Tensor]:
        values, vectors = torch.linalg.eigh(matrix)
        return values, vectors  # a plain tuple: vmap cannot pair eigh's named one with its own

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        _, scale, ctx.rtol, ctx.threshold = inputs
        ctx.save_for_backward(*output, scale)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        values, vectors, scale = ctx.saved_tensors
        return _EighBackward.apply(values, vectors, scale, *grads, ctx.rtol, ctx.threshold), None, None, None


class _EighBackward(torch.autograd.Function):
    """A function of its own, so that a second derivative finds it on its way, and raises.

    ``once_differentiable`` does not do that for ``torch.autograd.grad``: it cuts the graph, and what is asked for comes
    back without this part.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(
        values: Tensor,
        vectors: Tensor,
        scale: Tensor | None,
        grad_values: Tensor,
        grad_vectors: Tensor,
        rtol: float,
        threshold: float | None,
    ) -> Tensor:
        gaps = values[..., None, :] - values[..., :, None]
        largest = values.abs().amax(-1) if scale is None else scale
        kept = gaps.abs() > rtol * largest[..., None, None]
        if threshold is not None:
            above = values > threshold
            kept = kept & (above[..., None, :] != above[..., :, None])
        inner = (vectors.mT @ grad_vectors) * torch.where(kept, 1 / torch.where(kept, gaps, 1.0), 0.0)
        inner = (inner + inner.mT) / 2 + torch.diag_embed(grad_values)
        return vectors @ inner @ vectors.mT

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> None:
        raise RuntimeError("eigenvectors with gauge-invariant gradients can be differentiated once, not twice")
