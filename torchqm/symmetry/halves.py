"""Even and odd subspaces of a batch of truncated bases, from approximate projections of different sizes."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchqm.checks import Sizes, enabled, require_finite, require_mask
from torchqm.symmetry.invariant import split_eigh
from torchqm.symmetry.soft import pairs

__all__ = ["symmetrized_projector"]


def symmetrized_projector(
    projection: Float[Tensor, "*B K K"],
    *,
    evals_mask: Bool[Tensor, "*B K"] | None = None,
    rtol: float | None = None,
) -> Float[Tensor, "*B K K"]:
    """The orthogonal projector onto even functions, in the full basis: ``U+ U+^T = C+ C+^T``.

    It needs no eigenvalues of the Laplacian and has no gauge: applied to coefficients it gives their even part, and
    what is left is the odd part. Smooth at any multiplicity (:func:`torchqm.symmetry.invariant.spectral_projector`).

    Args:
        projection: ``(..., K, K)`` from :func:`~torchqm.symmetry.soft.projection_matrices`.
        evals_mask: ``(..., K)`` which functions are real; rows and columns of the others are 0.
        rtol: as in :func:`~torchqm.symmetry.invariant.split_eigh`.

    Raises:
        ValueError: as in :func:`split_bases`.

    Example:
        >>> symmetrized_projector(torch.diag(torch.tensor([0.9, 0.1]))).tolist()
        [[1.0, 0.0], [0.0, 0.0]]
    """
    sizes = Sizes()
    sizes.bind("projection", projection, "... K K")
    if evals_mask is not None:
        sizes.bind("evals_mask", evals_mask, "... K")
        require_mask("evals_mask", evals_mask)
    require_finite("projection", projection)
    halves = find_halves(projection, evals_mask, rtol)
    return (halves.vectors * halves.even[..., None, :].to(projection.dtype)) @ halves.vectors.mT


class Halves(NamedTuple):
    """Eigenpairs of a projection, ascending, padding first: ``(..., K)``, and counts ``(..., 1)``."""

    weights: Tensor
    vectors: Tensor
    even: Tensor
    padding: Tensor
    n_even: Tensor
    n: Tensor

    @property
    def spectrum(self) -> Tensor:
        """The eigenvalues, real ones first, then zeros."""
        k = self.weights.shape[-1]
        place = torch.arange(k, device=self.weights.device)
        return torch.where(place < self.n, torch.gather(self.weights, -1, (place + k - self.n) % k), 0.0)


def find_halves(projection: Tensor, evals_mask: Tensor | None, rtol: float | None) -> Halves:
    """The eigenspaces of ``(P + P^T) / 2`` above one half (even) and below it (odd), and padding in neither."""
    k = projection.shape[-1]
    if not k:
        raise ValueError(f"projection: shape {tuple(projection.shape)} given, expected at least one function")
    place = torch.arange(k, device=projection.device)
    if evals_mask is None:
        n = torch.full((*projection.shape[:-2], 1), k, device=projection.device)
    else:
        n = evals_mask.sum(-1, keepdim=True)
        # Below all real eigenvalues (Gershgorin), as exact eigenvectors of their own: with the odd half they never mix.
        projection = torch.where(pairs(evals_mask), projection, 0.0)
        below = -1 - (projection + projection.mT).detach().abs().sum(-1).amax(-1, keepdim=True)
        projection = projection + torch.diag_embed(torch.where(evals_mask, 0.0, below))
    # A projection has no unit: gaps are compared with 1, whatever stands for padding.
    weights, vectors = split_eigh(projection, 0.5, rtol, torch.ones_like(projection[..., 0, 0]))
    even = weights > 0.5
    n_even = even.sum(-1, keepdim=True)
    if enabled() and not bool((n_even > 0).all()):
        sample = int((n_even == 0).flatten().nonzero()[0])
        largest = float(weights[..., -1].flatten()[sample])
        raise ValueError(
            f"projection: largest eigenvalue is {largest:.3g}, sample {sample}, so no function counts as symmetric; "
            "at least one above 0.5 is needed (the projection of a group keeps the constant function)"
        )
    if evals_mask is not None:  # exact zeros instead of rounding
        vectors = torch.where(evals_mask[..., None], vectors, 0.0)
    return Halves(weights, vectors, even, place < k - n, n_even, n)
