"""The projections pi+ and pi- onto symmetric functions and their complement (paper, section 3, equation 1)."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.spectral.basis import SpectralBasis
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["even_part", "odd_part", "projection_matrix"]

_ROWS = 2048  # of a block of vertices: the mean over orbits never exists at all of them


def even_part(values: Float[Tensor, "V C"], group: SymmetryGroup) -> Float[Tensor, "V C"]:
    """The Reynolds operator ``pi+(f) = 1/|G| sum_S f o S``: the mean of a function over each orbit.

    Args:
        values: ``(V, C)`` vertex values of C functions.
        group: symmetry group of the shape.

    Example:
        >>> import torch
        >>> swap = SymmetryGroup(torch.tensor([[0, 1], [1, 0]]))
        >>> even_part(torch.tensor([[1.0], [3.0]]), swap).T
        tensor([[2., 2.]])

    References:
        Paper, section 3, equation 1.
    """
    _check(values, group)
    total = values.clone()
    for element in group.maps[1:]:
        total = total + values[element]
    return total / group.order


def odd_part(values: Float[Tensor, "V C"], group: SymmetryGroup) -> Float[Tensor, "V C"]:
    """``pi-(f) = f - pi+(f)``, the part of a function that its mean over orbits leaves out (paper, equation 1)."""
    return values - even_part(values, group)


def projection_matrix(basis: SpectralBasis, group: SymmetryGroup) -> Float[Tensor, "K K"]:
    """``P = mean_g Phi^T A Phi[g]``: pi+ written in a truncated basis.

    Exactly a projector only if the group preserves mass and the basis cuts no eigenspace; on real shapes its
    eigenvalues crowd near 0 and 1, and :func:`torchqm.symmetry.basis.split_by_projector` cuts between them.
    """
    _check(basis.evecs, group)
    total = basis.evecs.new_zeros(basis.k, basis.k)
    for start in range(0, basis.n_verts, _ROWS):
        rows = slice(start, start + _ROWS)
        orbits = torch.stack([basis.evecs[element[rows]] for element in group.maps]).sum(0)
        total = total + (basis.evecs[rows] * basis.mass[rows, None]).T @ orbits
    return total / group.order


def _check(values: Tensor, group: SymmetryGroup) -> None:
    if values.shape[0] != group.n_verts:
        raise ValueError(f"values: {values.shape[0]} rows, but the group acts on {group.n_verts} vertices")
