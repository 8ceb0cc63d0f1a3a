"""The initial functional map between two shapes, on whatever pair of bases it is wanted (paper, sections 4.3 and 5)."""

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.solve import solve_fmap
from torchqm.fmap.threads import in_parallel
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.shape import PreparedShape
from torchqm.spectral.basis import SpectralBasis, cluster_end
from torchqm.spectral.descriptors import (
    heat_kernel_signature,
    heat_times,
    split_descriptors,
    unit_columns,
    wave_energies,
    wave_kernel_signature,
)
from torchqm.symmetry.basis import EvenOddBasis, symmetrized_basis
from torchqm.symmetry.group import SymmetryGroup

__all__ = [
    "basis_size",
    "curvature_descriptors",
    "fmap_from_coefficients",
    "initial_fmap",
    "shared_descriptors",
    "split_bases",
]

SHARPEST = 30.0
"""Curvature above which it is not told how much more: 1/30 of sqrt(area) is the radius of a finger."""

N_CURVATURES = 20
"""Intervals of curvature."""


def basis_size(bases: Sequence[SpectralBasis], k: int) -> int:
    """The largest size up to ``k`` at which no shape's spectrum is cut inside a cluster of equal eigenvalues.

    A cluster cut in two is not a space that a symmetry keeps, so its functions could neither be split nor matched.
    """
    return min(cluster_end(b.evals, min(k, b.k), rtol=1e-4) for b in bases)


def split_bases(
    x: PreparedShape, y: PreparedShape, k: int, group_x: SymmetryGroup, group_y: SymmetryGroup
) -> tuple[EvenOddBasis, EvenOddBasis]:
    """The first ``k`` functions of two shapes split by their symmetries, with the functions themselves.

    Args:
        x: one shape.
        y: the other.
        k: functions of each.
        group_x: symmetry of x.
        group_y: symmetry of y.
    """

    def split(shape: PreparedShape, group: SymmetryGroup) -> EvenOddBasis:
        found = symmetrized_basis(shape.basis.truncate(k), group)
        in_parallel([lambda: found.even, lambda: found.odd])
        return found

    first, second = in_parallel([partial(split, x, group_x), partial(split, y, group_y)])
    return first, second


def shared_descriptors(bases: Sequence[SpectralBasis], parameters: MatchParameters) -> list[Float[Tensor, "_V C"]]:
    """The split descriptors of several shapes, at the same energies and on the same value ranges.

    Computed from ``k_max`` functions (or as many as the smallest basis holds), not from the first ``k``: the same local
    shape, told more sharply.
    """
    k = min(parameters.k_max, *(b.k for b in bases))
    bases = [b.truncate(k) for b in bases]
    if parameters.descriptor == "wks":
        energies = wave_energies(bases, parameters.n_descriptors)
        values = [wave_kernel_signature(b, energies) for b in bases]
    else:
        times = heat_times(bases, parameters.n_descriptors)
        values = [heat_kernel_signature(b, times) for b in bases]
    # Eigenfunctions are 0 at vertices without area; that is no value of the shape, and must not widen the ranges.
    values = [torch.where((b.mass > 0)[:, None], v, v[b.mass > 0].amin(0)) for b, v in zip(bases, values, strict=True)]
    return split_descriptors(values, parameters.splits)


def curvature_descriptors(x: PreparedShape, y: PreparedShape) -> list[Float[Tensor, "_V C"]]:
    """Smooth mean curvature and its splitting, less the mean: what tells front from back.

    Intrinsic signatures hardly know the face of a person from the back of the head, and least squares may turn the body
    round; curvature knows, and is the same left and right.
    """
    bends = [s.curvature if x.oriented and y.oriented else s.curvature.abs() for s in (x, y)]
    bends = [b.clamp(-SHARPEST, SHARPEST)[:, None] for b in bends]
    values = [torch.cat([b, s], 1) for b, s in zip(bends, split_descriptors(bends, N_CURVATURES), strict=True)]
    return [v - (s.basis.mass @ v) / s.basis.mass.sum() for v, s in zip(values, (x, y), strict=True)]


def initial_fmap(
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    values_x: Float[Tensor, "Vx C"],
    values_y: Float[Tensor, "Vy C"],
    commutativity: float,
    more: Sequence[Float[Tensor, "_V D"]] | None = None,
    weight: float = 0.5,
) -> Float[Tensor, "Ky Kx"]:
    """Least-squares map from descriptor preservation and commutativity, between any two bases of the two shapes.

    Args:
        basis_x: basis of the source: full (semi-quotient), or even (quotient).
        basis_y: basis of the target.
        values_x: ``(Vx, C)`` descriptors of the source.
        values_y: ``(Vy, C)`` the same of the target.
        commutativity: weight of the commutativity term per (descriptor / basis function).
        more: ``(Vx, D)`` and ``(Vy, D)`` descriptors of another kind.
        weight: of all of these together, where the others together have 1.
    """
    coeffs = basis_x.coefficients(values_x), basis_y.coefficients(values_y)
    rest = None if more is None else (basis_x.coefficients(more[0]), basis_y.coefficients(more[1]))
    return fmap_from_coefficients(coeffs, basis_x.evals, basis_y.evals, commutativity, rest, weight)


def fmap_from_coefficients(
    coeffs: tuple[Float[Tensor, "Kx C"], Float[Tensor, "Ky C"]],
    evals_x: Float[Tensor, " Kx"],
    evals_y: Float[Tensor, " Ky"],
    commutativity: float,
    more: tuple[Float[Tensor, "Kx D"], Float[Tensor, "Ky D"]] | None = None,
    weight: float = 0.5,
) -> Float[Tensor, "Ky Kx"]:
    """:func:`initial_fmap` where the coefficients of the descriptors are there already.

    Args:
        coeffs: of the descriptors of the source and of the target.
        evals_x: eigenvalues of the source's basis.
        evals_y: eigenvalues of the target's.
        commutativity: as there.
        more: coefficients of descriptors of another kind.
        weight: as there.
    """
    coeffs_x, coeffs_y = unit_columns_pair(*coeffs)
    total = float(coeffs_x.shape[1])
    if more is not None:
        more_x, more_y = unit_columns_pair(*more)
        scale = weight * (total / more_x.shape[1]) ** 0.5
        coeffs_x, coeffs_y = torch.cat([coeffs_x, scale * more_x], 1), torch.cat([coeffs_y, scale * more_y], 1)
        total *= 1 + weight**2
    # Exactly symmetric twins have odd functions without descriptors at equal frequencies: nothing is known of these.
    return solve_fmap(coeffs_x, coeffs_y, evals_x, evals_y, commutativity * total / len(evals_x), ridge=1e-9)


def unit_columns_pair(
    coeffs_x: Float[Tensor, "Kx C"], coeffs_y: Float[Tensor, "Ky C"]
) -> tuple[Float[Tensor, "Kx C"], Float[Tensor, "Ky C"]]:
    """:func:`torchqm.spectral.descriptors.unit_columns` for two shapes."""
    first, second = unit_columns([coeffs_x, coeffs_y])
    return first, second
