"""The basis of a shape split by the irreducible representations of its symmetry group (paper, Lemma 3.1, refined)."""

from dataclasses import dataclass
from functools import cached_property

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.spectral.basis import SpectralBasis
from torchqm.spectral.eigen import fix_signs
from torchqm.symmetry.algebra import central_idempotents, real_degrees
from torchqm.symmetry.basis import split_by_projector
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["IsotypicComponent", "isotypic_components"]


@dataclass(frozen=True, eq=False)
class IsotypicComponent:
    """The functions of a truncated basis that transform by one real irreducible representation of the group.

    Args:
        full: the basis that was split, K functions.
        coeffs: ``(K, K_i)`` orthonormal columns, the functions of the component written in the full basis; none where
            the representation does not occur.
        evals: ``(K_i,)`` eigenvalues of the Laplacian restricted to the component, ascending.
        idempotent: ``(G,)`` the central idempotent e of the representation: ``sum_g e(g) f o g`` projects onto the
            component.
        degree: dimension of the representation over the reals (1 for the trivial one and for parities).
        purity: mean of ``<f, P f>`` over the functions of the component, P its projector written in the basis: 1 where
            the symmetry is exact in this basis (and for an empty component).
    """

    full: SpectralBasis
    coeffs: Float[Tensor, "K Ki"]
    evals: Float[Tensor, " Ki"]
    idempotent: Float[Tensor, " G"]
    degree: int
    purity: float

    @property
    def k(self) -> int:
        """Number of functions K_i."""
        return int(self.evals.shape[0])

    @property
    def multiplicity(self) -> float:
        """How often the representation occurs, ``K_i / degree``; no whole number if the basis cuts an eigenspace."""
        return self.k / self.degree

    @cached_property
    def basis(self) -> SpectralBasis:
        """The functions of the component on the shape."""
        return SpectralBasis(self.evals, self.full.evecs @ self.coeffs, self.full.mass)


def isotypic_components(
    basis: SpectralBasis, group: SymmetryGroup, products: Int[Tensor, "G G"]
) -> list[IsotypicComponent]:
    """Split a truncated basis into the isotypic components of a symmetry group.

    ``P_i = sum_g e_i(g) Phi^T A Phi[g]`` with the central idempotents e_i. The P_i sum to the identity, but on a real
    shape each is only nearly a projector, so the splitting is sequential, which makes it orthonormal and complete:

    1. The trivial component is the eigenspace of ``sym(P_0)`` above one half: the even functions of
       :func:`torchqm.symmetry.symmetrized_basis`, a basis of the quotient.
    2. The others follow in their order; each takes the eigenspace above one half of ``sym(P_i)`` restricted to what
       is left. A function with ``<f, P_i f> > 1/2`` has less than one half for all others together.
    3. Functions that no projector claims (they mix components: the symmetry is poor there, or an eigenspace is cut)
       go one by one to the non-trivial component with the largest eigenvalue on what is still left.

    In each component the Laplacian is diagonalised again.

    Args:
        basis: K functions; the spectrum should not be cut through a cluster of equal eigenvalues.
        group: G symmetries of the shape.
        products: ``(G, G)`` index of ``g o h``, as measured by :meth:`SymmetryGroup.residuals`.

    Returns:
        One component for each row of :func:`torchqm.symmetry.central_idempotents`, in the same order (the trivial one
        first); empty where a representation does not occur.

    Raises:
        ValueError: the table is no group or of another order, the group acts on another number of vertices, or no
            function is symmetric.

    Example:
        >>> basis = SpectralBasis(torch.tensor([0.0, 2.0]), torch.tensor([[1.0, 1.0], [1.0, -1.0]]), torch.ones(2) / 2)
        >>> swap = SymmetryGroup(torch.tensor([[0, 1], [1, 0]]))
        >>> [c.evals.tolist() for c in isotypic_components(basis, swap, torch.tensor([[0, 1], [1, 0]]))]
        [[0.0], [2.0]]

    References:
        Paper, Lemma 3.1; J.-P. Serre, "Linear Representations of Finite Groups", section 2.6.
    """
    if group.n_verts != basis.n_verts:
        raise ValueError(f"basis: has {basis.n_verts} vertices, but the group acts on {group.n_verts} vertices")
    if products.shape[0] != group.order:
        raise ValueError(f"products: a table of {products.shape[0]} elements, but the group has {group.order}")
    weights = central_idempotents(products)
    degrees = real_degrees(products, weights).tolist()
    if group.order == 1:
        identity = torch.eye(basis.k, dtype=basis.evecs.dtype)
        return [IsotypicComponent(basis, identity, basis.evals, weights[0], 1, 1.0)]
    projectors = _projectors(basis, group, weights.to(basis.evecs.dtype))
    split = split_by_projector(basis, projectors[0])
    columns, rest = [split.even_coeffs], split.odd_coeffs
    for projector in projectors[1:]:
        strength, vectors = torch.linalg.eigh(rest.T @ projector @ rest)
        columns.append(rest @ vectors[:, strength > 0.5])
        rest = rest @ vectors[:, strength <= 0.5]
    while rest.shape[1]:
        strength, vectors = torch.linalg.eigh(rest.T @ projectors[1:] @ rest)
        i = int(strength[:, -1].argmax())
        columns[i + 1] = torch.cat([columns[i + 1], rest @ vectors[i][:, -1:]], 1)
        rest = rest @ vectors[i][:, :-1]
    return [_component(basis, *parts) for parts in zip(columns, projectors, weights, degrees, strict=True)]


def _projectors(basis: SpectralBasis, group: SymmetryGroup, weights: Tensor) -> Tensor:
    """Symmetric parts ``(N, K, K)`` of the projectors onto all components."""
    found = torch.zeros(weights.shape[0], basis.k, basis.k, dtype=basis.evecs.dtype)
    for element, share in zip(group.maps, weights.T, strict=True):
        action = basis.coefficients(basis.evecs[element])
        found += share[:, None, None] * ((action + action.T) / 2)
    return found


def _component(
    basis: SpectralBasis, columns: Tensor, projector: Tensor, idempotent: Tensor, degree: int
) -> IsotypicComponent:
    evals, rotation = torch.linalg.eigh(columns.T @ (basis.evals[:, None] * columns))
    coeffs = columns @ rotation
    if coeffs.shape[1]:
        coeffs = fix_signs(coeffs)
    purity = float((coeffs * (projector @ coeffs)).sum(0).mean()) if coeffs.shape[1] else 1.0
    return IsotypicComponent(basis, coeffs, evals, idempotent, degree, purity)
