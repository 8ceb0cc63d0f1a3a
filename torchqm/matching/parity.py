"""Which eigenfunctions a reflection leaves and which it turns over, and where on the shape it turns them over."""

from dataclasses import dataclass
from itertools import pairwise, product

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis

__all__ = ["ParityPatterns", "odd_halves", "parity_patterns"]


@dataclass(frozen=True, eq=False)
class ParityPatterns:
    """Guesses at a reflection of a shape, on its first functions.

    Args:
        fmaps: ``(N, M, M)`` involutions on the first M functions, best first; all leave the constant.
        signs: ``(N, M-1)`` the parity that each gives to the (rotated) functions after the constant.
        costs: ``(N,)`` what speaks against each: share of descriptor energy in odd functions plus share of the squared
            triple products of odd parity; both vanish for the reflection of an exactly symmetric shape.
    """

    fmaps: Float[Tensor, "N M M"]
    signs: Float[Tensor, "N M-1"]
    costs: Float[Tensor, " N"]


def parity_patterns(
    basis: SpectralBasis, coefficients: Float[Tensor, "K C"], n_functions: int = 8, n: int = 48, rtol: float = 0.05
) -> ParityPatterns:
    """The parity patterns on the first functions that descriptors and triple products speak against least.

    Odd functions are orthogonal to every intrinsic descriptor, and ``int phi_a phi_b phi_c`` vanishes if an odd number
    of the three is odd. All the ``2^n_functions - 1`` patterns but the identity are weighed. Functions of nearly equal
    eigenvalues are no functions but a space: there they are turned so that the descriptors see as much as possible of
    some and as little as possible of the others.

    Args:
        basis: eigenfunctions, the first one constant.
        coefficients: ``(K, C)`` of descriptors in the basis.
        n_functions: functions after the constant that get a sign; at most 12.
        n: how many patterns come back.
        rtol: eigenvalues closer than this belong to one space.

    Raises:
        ValueError: ``n_functions`` is not in 1..12 or the basis is too small.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.spectral import mesh_basis
        >>> basis = mesh_basis(creature("biped", 1000).mesh.normalized(), 9)
        >>> found = parity_patterns(basis, basis.coefficients(basis.evecs[:, 1:].square()))
        >>> found.fmaps.shape[1:], bool(found.costs[0] < 1e-3)
        (torch.Size([9, 9]), True)
    """
    if not 1 <= n_functions <= 12 or basis.k <= n_functions:
        raise ValueError(f"n_functions={n_functions}: must be in 1..12 and below the {basis.k} functions of the basis")
    evals = basis.evals[1 : n_functions + 1]
    seen = coefficients[1 : n_functions + 1]
    gram = seen @ seen.T
    turn = torch.eye(n_functions, dtype=gram.dtype)
    starts = [0, *((evals.diff() >= rtol * evals[1:]).nonzero().flatten() + 1).tolist(), n_functions]
    for start, stop in pairwise(starts):
        turn[start:stop, start:stop] = torch.linalg.eigh(gram[start:stop, start:stop])[1]
    functions = basis.evecs[:, 1 : n_functions + 1] @ turn
    energy = (turn.T @ gram @ turn).diagonal()
    triples = torch.einsum("va,vb,vc->abc", functions * basis.mass[:, None], functions, functions).square()
    signs = torch.tensor(list(product([1.0, -1.0], repeat=n_functions))[1:], dtype=gram.dtype)
    parity = signs[:, :, None, None] * signs[:, None, :, None] * signs[:, None, None, :]
    costs = (energy * (signs < 0)).sum(1) / energy.sum().clamp_min(1e-300)
    costs = costs + (triples * (parity < 0)).sum((1, 2, 3)) / triples.sum().clamp_min(1e-300)
    order = costs.argsort(stable=True)[:n]
    fmaps = torch.eye(n_functions + 1, dtype=gram.dtype).repeat(len(order), 1, 1)
    fmaps[:, 1:, 1:] = turn @ (signs[order, :, None] * turn.T)
    return ParityPatterns(fmaps, signs[order], costs[order])


def odd_halves(mesh: Mesh, basis: SpectralBasis, fmap: Float[Tensor, "K K"], k: int = 60) -> Float[Tensor, " V"]:
    """Left and right of a reflection that is known as a functional map: an odd function that is +-1 but on the axis.

    Among the odd functions the one with the least ``int d^2 |grad s|^2`` at given norm is taken, where d is how far the
    reflection moves a point (in the biharmonic embedding): it costs nothing to change sign on the axis, and much
    anywhere else. This holds a rough map together: where it moves one pair of limbs only, the function still tells left
    from right on the others, by continuity.

    Args:
        mesh: the shape.
        basis: its eigenfunctions.
        fmap: an involution in its first K functions (:func:`torchqm.matching.nearest_involution`).
        k: functions used, at most.

    Returns:
        ``(V,)`` signs; all 0 if the map has no odd functions.
    """
    k = min(k, fmap.shape[0])
    weights, vectors = torch.linalg.eigh((fmap[:k, :k] + fmap[:k, :k].T) / 2)
    odd = vectors[:, weights < -0.5]
    if not odd.shape[1]:
        return torch.zeros(mesh.n_verts, dtype=fmap.dtype)
    values = basis.evecs[:, :k] @ odd
    # z(S x) - z(x) = -2 (odd part of z), z = phi / lambda
    scale = 1 / basis.evals[:k].clamp_min(1e-12 * float(basis.evals[k - 1]))
    scale[0] = 0.0
    displacement = (values @ (odd.T * scale)).square().sum(1)
    faces = mesh.faces
    corners = mesh.verts[faces]
    edges = [corners[:, 2] - corners[:, 1], corners[:, 0] - corners[:, 2], corners[:, 1] - corners[:, 0]]
    weight = displacement[faces].mean(1) / (4 * mesh.face_areas.clamp_min(1e-300))
    # int_T w grad f . grad g = w sum_ij f_i g_j e_i . e_j / (4 area): only the three corners' products are needed
    energy = values.new_zeros(odd.shape[1], odd.shape[1])
    for i in range(3):
        for j in range(i, 3):
            part = values[faces[:, i]].T @ ((weight * (edges[i] * edges[j]).sum(1))[:, None] * values[faces[:, j]])
            energy += part if i == j else part + part.T
    vectors = torch.linalg.eigh((energy + energy.T) / 2)[1]
    found = values @ vectors[:, 0]
    return torch.where(found.abs() > 1e-6 * found.abs().max(), torch.sign(found), 0.0)
