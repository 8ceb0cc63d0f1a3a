"""A truncated orthonormal basis of functions on a shape, ordered by frequency."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["SpectralBasis", "cluster_end"]


@dataclass(frozen=True, eq=False)
class SpectralBasis:
    """Eigenpairs of the Laplacian, or of its restriction to a subspace, with the mass they are orthonormal in.

    ``evecs.T @ diag(mass) @ evecs = I``; the Laplacian acts as ``diag(evals)``.

    Args:
        evals: ``(K,)`` eigenvalues in ascending order (1 / area).
        evecs: ``(V, K)`` eigenfunctions as columns.
        mass: ``(V,)`` lumped vertex areas; zero where a vertex belongs to no face.

    Example:
        >>> basis = SpectralBasis(torch.zeros(1), torch.ones(4, 1), torch.full((4,), 0.25))
        >>> basis.coefficients(torch.arange(4.0)[:, None]).item()
        1.5
    """

    evals: Float[Tensor, " K"]
    evecs: Float[Tensor, "V K"]
    mass: Float[Tensor, " V"]

    @property
    def k(self) -> int:
        """Number of basis functions K."""
        return int(self.evals.shape[0])

    @property
    def n_verts(self) -> int:
        """Number of vertices V."""
        return int(self.evecs.shape[0])

    @cached_property
    def evecs_trans(self) -> Float[Tensor, "K V"]:
        """``evecs.T @ diag(mass)``: the map from vertex values to coefficients."""
        return (self.evecs * self.mass[:, None]).T.contiguous()

    def coefficients(self, values: Float[Tensor, "V C"]) -> Float[Tensor, "K C"]:
        """Coefficients of functions given by their vertex values (the orthogonal projection)."""
        # The narrower factor is multiplied by the mass; no transposed copy is made.
        if values.ndim == 2 and values.shape[1] < self.k:
            return self.evecs.T @ (self.mass[:, None] * values)
        return (self.evecs * self.mass[:, None]).T @ values

    def truncate(self, k: int) -> "SpectralBasis":
        """The first ``k`` functions.

        Raises:
            ValueError: ``k`` is not in ``1..K``.
        """
        if not 1 <= k <= self.k:
            raise ValueError(f"k={k}: this basis can be cut at 1..{self.k} functions")
        return self if k == self.k else SpectralBasis(self.evals[:k], self.evecs[:, :k], self.mass)

    def scaled(self, factor: float) -> "SpectralBasis":
        """The basis of the same shape with all lengths multiplied by ``factor`` (the Laplacian has the unit 1 / area).

        Example:
            >>> basis = SpectralBasis(torch.ones(1), torch.ones(4, 1), torch.full((4,), 0.25)).scaled(2.0)
            >>> basis.evals.item(), basis.evecs[0].item(), basis.mass.sum().item()
            (0.25, 0.5, 4.0)
        """
        return SpectralBasis(self.evals / factor**2, self.evecs / factor, self.mass * factor**2)

    def restricted(self, ids: Int[Tensor, " S"]) -> "SpectralBasis":
        """The same functions at some of the vertices only, for searches among these; no longer orthonormal."""
        return SpectralBasis(self.evals, self.evecs[ids], self.mass[ids])

    def biharmonic(self, k: int | None = None) -> Float[Tensor, "V _D"]:
        """``phi_i / lambda_i`` without the constant: distances of rows are biharmonic distances (Lipman et al. 2010).

        Args:
            k: functions used, at most; all by default.
        """
        small = self if k is None else self.truncate(min(k, self.k))
        return small.evecs[:, 1:] / small.evals[1:].clamp_min(torch.finfo(small.evals.dtype).tiny)

    def low_pass(self, values: Float[Tensor, "V C"], time: float = 0.0) -> Float[Tensor, "V C"]:
        """Project onto the basis and let heat flow for ``time`` (area): ``Phi exp(-time Lambda) Phi^T A f``."""
        return self.evecs @ (torch.exp(-time * self.evals)[:, None] * self.coefficients(values))


def cluster_end(evals: Float[Tensor, " K"], k: int, rtol: float = 1e-3) -> int:
    """The largest ``k' <= k`` at which the spectrum can be cut without splitting a cluster of equal eigenvalues.

    Two neighbours belong to one cluster if they differ by less than ``rtol`` of the larger. Where everything below
    ``k`` is one cluster, ``k`` itself comes back: there is no better cut.

    Example:
        >>> cluster_end(torch.tensor([0.0, 2.0, 2.0, 2.0, 6.0]), 3)
        1
    """
    if not 1 <= k <= evals.shape[0]:
        raise ValueError(f"k={k}: the spectrum has {evals.shape[0]} eigenvalues, so 1..{evals.shape[0]} is allowed")
    for cut in range(k, 0, -1):
        if cut == evals.shape[0] or evals[cut] - evals[cut - 1] > rtol * evals[cut].abs():
            return cut
    return k
