"""Bases of symmetric functions and of their complement, with their own Laplacian eigenvalues (paper, Lemma 3.1)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.eigen import fix_signs
from torchqm.symmetry.group import SymmetryGroup
from torchqm.symmetry.projection import projection_matrix

__all__ = ["EvenOddBasis", "split_by_projector", "symmetrized_basis"]


@dataclass(frozen=True, eq=False)
class EvenOddBasis:
    """The two halves of a truncated eigenbasis: L2+ (even) and its orthogonal complement L2- (odd).

    Both are orthonormal in the mass of the full basis, ordered by their own eigenvalues, and together span it.

    Args:
        full: the basis that was split, K functions.
        even_coeffs: ``(K, K+)`` orthonormal columns, the even functions written in the full basis.
        odd_coeffs: ``(K, K-)`` the same for the odd ones; ``K+ + K- = K``.
        even_evals: ``(K+,)`` eigenvalues of the Laplacian restricted to L2+.
        odd_evals: ``(K-,)`` likewise on L2-.
        spectrum: ``(K,)`` eigenvalues of the projector, ascending; how far they are from 0 and 1 tells how exact the
            symmetry is in this basis.
    """

    full: SpectralBasis
    even_coeffs: Float[Tensor, "K Ke"]
    odd_coeffs: Float[Tensor, "K Ko"]
    even_evals: Float[Tensor, " Ke"]
    odd_evals: Float[Tensor, " Ko"]
    spectrum: Float[Tensor, " K"]

    @property
    def even(self) -> SpectralBasis:
        """Basis of the symmetric functions L2+; made when it is first asked for."""
        return self._functions("_even", self.even_evals, self.even_coeffs)

    @property
    def odd(self) -> SpectralBasis:
        """Basis of the complement L2- (antisymmetric functions, where the group is one reflection), likewise."""
        return self._functions("_odd", self.odd_evals, self.odd_coeffs)

    def _functions(self, name: str, evals: Tensor, coeffs: Tensor) -> SpectralBasis:
        kept = self.__dict__.get(name)  # not a cached_property: before Python 3.12 it lets one thread in at a time
        if kept is None:
            kept = self.__dict__[name] = SpectralBasis(evals, self.full.evecs @ coeffs, self.full.mass)
        return kept


def split_by_projector(basis: SpectralBasis, projector: Float[Tensor, "K K"]) -> EvenOddBasis:
    """Split a basis by an approximate projector onto its symmetric part.

    The even half is the eigenspace of ``(P + P^T) / 2`` above one half, the odd half is the rest; inside each the
    Laplacian ``diag(evals)`` is diagonalised again, so the new functions are (nearly) Laplacian eigenfunctions.

    Args:
        basis: K functions.
        projector: ``(K, K)``, from vertex maps (:func:`projection_matrix`) or ``(I + C) / 2`` from the functional map
            C of a reflection.

    Raises:
        ValueError: the projector is not ``(K, K)``, or no function is symmetric (then it is no projector of a group:
            the constant function always is).

    References:
        Paper, Lemma 3.1 and the first step of Algorithm 1.
    """
    if projector.shape != (basis.k, basis.k):
        raise ValueError(f"projector: expected shape ({basis.k}, {basis.k}), got {tuple(projector.shape)}")
    weights, vectors = torch.linalg.eigh((projector + projector.T) / 2)
    even = weights > 0.5
    if not bool(even.any()):
        raise ValueError(
            f"projector: largest eigenvalue is {float(weights[-1]):.3g}, so no function counts as symmetric"
        )
    even_evals, even_coeffs = _diagonalize(basis.evals, vectors[:, even])
    odd_evals, odd_coeffs = _diagonalize(basis.evals, vectors[:, ~even])
    return EvenOddBasis(basis, even_coeffs, odd_coeffs, even_evals, odd_evals, weights)


def symmetrized_basis(basis: SpectralBasis, group: SymmetryGroup) -> EvenOddBasis:
    """The bases of L2+ and L2- of a shape with a known symmetry group; see :func:`split_by_projector`.

    Raises:
        ValueError: the group acts on another number of vertices.
    """
    if group.n_verts != basis.n_verts:
        raise ValueError(f"basis: has {basis.n_verts} vertices, but the group acts on {group.n_verts} vertices")
    if group.order == 1:
        identity = torch.eye(basis.k, dtype=basis.evecs.dtype)
        return EvenOddBasis(
            basis, identity, identity[:, :0], basis.evals, basis.evals[:0], torch.ones_like(basis.evals)
        )
    return split_by_projector(basis, projection_matrix(basis, group))


def _diagonalize(evals: Tensor, columns: Tensor) -> tuple[Tensor, Tensor]:
    own, rotation = torch.linalg.eigh(columns.T @ (evals[:, None] * columns))
    return own, fix_signs(columns @ rotation) if columns.shape[1] else columns
