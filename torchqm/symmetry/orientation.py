"""Odd functions from pairs of even ones: what tells a direct map from a mirrored one on an oriented surface.

``omega(f, g) = n . (grad f x grad g)`` changes sign under a reflection, so for symmetric f and g it is antisymmetric.
Intrinsic descriptors say nothing about the odd half of a map; once the even half is known, these functions do.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis

__all__ = [
    "face_form",
    "function_pairs",
    "orientation_coefficients",
    "orientation_cosine",
    "orientation_descriptors",
    "orientation_form",
    "orientation_tensor",
]

_FACES = 1024  # of a block: what is computed for it stays in the cache of one core


def function_pairs(n: int) -> Int[Tensor, "2 P"]:
    """All pairs ``a < b`` of ``n`` functions, the constant one (index 0) left out: its gradient is zero.

    Example:
        >>> function_pairs(4).T.tolist()
        [[1, 2], [1, 3], [2, 3]]
    """
    return torch.triu_indices(n - 1, n - 1, 1) + 1


def orientation_form(mesh: Mesh, values: Float[Tensor, "V C"], pairs: Int[Tensor, "2 P"]) -> Float[Tensor, "F P"]:
    """``area * n . (grad f_a x grad f_b)`` on each triangle, for pairs of functions given by their vertex values.

    On a triangle with corners 0, 1, 2 this is ``((f1 - f0)(g2 - g0) - (f2 - f0)(g1 - g0)) / 2``: lengths and angles
    drop out, only the order of the corners (the orientation of the surface) is used.

    Args:
        mesh: consistently oriented triangles.
        values: ``(V, C)`` vertex values of C functions.
        pairs: ``(2, P)`` which functions to pair.

    Example:
        >>> triangle = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> orientation_form(triangle, triangle.verts[:, :2], torch.tensor([[0], [1]])).item()
        0.5
    """
    return face_form(values, mesh.faces, pairs)


def face_form(
    values: Float[Tensor, "*B V C"], faces: Int[Tensor, "*B F 3"], pairs: Int[Tensor, "2 P"]
) -> Float[Tensor, "*B F P"]:
    """:func:`orientation_form` of a batch; a triangle without area, as ``0 0 0`` in padding, gives zero.

    Args:
        values: ``(..., V, C)`` vertex values.
        faces: ``(..., F, 3)`` consistently oriented triangles.
        pairs: ``(2, P)`` which functions to pair, for all of the batch.
    """
    ids = faces.flatten(-2)[..., None].expand(*faces.shape[:-2], -1, values.shape[-1])
    corners = values[faces] if faces.ndim == 2 else torch.gather(values, -2, ids).unflatten(-2, (-1, 3))
    u = corners[..., 1, :] - corners[..., 0, :]
    v = corners[..., 2, :] - corners[..., 0, :]
    a, b = pairs
    return (u[..., a] * v[..., b] - v[..., a] * u[..., b]) / 2


def orientation_descriptors(
    values: Float[Tensor, "*B V C"],
    faces: Int[Tensor, "*B F 3"],
    mass: Float[Tensor, "*B V"],
    pairs: Int[Tensor, "2 P"],
) -> Float[Tensor, "*B V P"]:
    """``omega(f_a, f_b) = n . (grad f_a x grad f_b)`` at each vertex: odd functions, where the f are even.

    The mean over the triangles around a vertex, weighted by a third of their area, so that its coefficients in a basis
    are the integrals of :func:`orientation_coefficients`. Bilinear in f, differentiable.

    Args:
        values: ``(..., V, C)`` vertex values of C functions.
        faces: ``(..., F, 3)`` consistently oriented triangles.
        mass: ``(..., V)`` lumped vertex areas (a third of the triangles around each); zero where there is none.
        pairs: ``(2, P)`` which functions to pair.

    Returns:
        ``(..., V, P)`` in (unit of f)^2 / area; zero where a vertex has no mass.
    """
    form = face_form(values, faces, pairs) / 3
    total = values.new_zeros(*values.shape[:-1], form.shape[-1])
    for corner in range(3):
        ids = faces[..., corner, None].expand_as(form)
        total = total.scatter_add(-2, ids, form)
    used = mass > 0
    return torch.where(used[..., None], total / torch.where(used, mass, 1.0)[..., None], 0.0)


def orientation_coefficients(
    mesh: Mesh,
    values: Float[Tensor, "V C"],
    pairs: Int[Tensor, "2 P"],
    evecs: Float[Tensor, "V K"],
) -> Float[Tensor, "K P"]:
    """``<phi_k, omega(f_a, f_b)>`` for each basis function and pair, integrated exactly over the triangles.

    Args:
        mesh: consistently oriented.
        values: functions to pair.
        pairs: which.
        evecs: functions to test against: the odd basis.
    """
    used, (a, b) = torch.unique(pairs, return_inverse=True)
    omega = _integrals(values[:, used], mesh.faces, evecs)
    return omega[:, a, b]


def _integrals(
    values: Float[Tensor, "V N"], faces: Int[Tensor, "F 3"], evecs: Float[Tensor, "V K"]
) -> Float[Tensor, "K N N"]:
    """``<phi_k, omega(f_a, f_b)>`` of all pairs, over some triangles.

    The form is ``(u_a v_b - v_a u_b) / 2`` with differences u, v along two edges, and the integral of a linear function
    is the mean of its corners. Only pairs ``a < b`` are computed, for a block of triangles at a time.
    """
    n = values.shape[1]
    a, b = torch.triu_indices(n, n, 1)
    total = evecs.new_zeros(evecs.shape[1], len(a))
    for block in faces.split(_FACES):
        first, second, third = block.T
        means = evecs[first].add_(evecs[second]).add_(evecs[third])
        base = values[first]
        u, v = ((values[corner] - base).T.contiguous() for corner in (second, third))  # a pair is two rows then
        total.addmm_(means.T, (u[a].mul_(v[b])).sub_(v[a].mul_(u[b])).T)
    omega = evecs.new_zeros(evecs.shape[1], n, n)
    omega[:, a, b] = total / 6
    return omega - omega.mT


def orientation_tensor(
    mesh: Mesh, basis: SpectralBasis, n: int = 24, k: int = 60, n_faces: int = 8000
) -> Float[Tensor, "K N N"]:
    """``<phi_k, omega(phi_a, phi_b)>`` for the first functions of a basis: with it, ``omega`` is mere linear algebra.

    Args:
        mesh: consistently oriented.
        basis: its eigenfunctions.
        n: functions that are paired, at most.
        k: functions in which ``omega`` is written, at most.
        n_faces: about how many triangles are used, evenly: what is compared is smooth.
    """
    n, k = min(n, basis.k), min(k, basis.k)
    few = mesh.faces[:: max(1, mesh.n_faces // n_faces)]
    omega = _integrals(basis.evecs[:, :n], few, basis.evecs[:, :k]) * (mesh.n_faces / max(len(few), 1))
    omega[:, 0] = omega[:, :, 0] = 0.0  # the constant function, whose gradient is zero up to rounding
    return omega


def orientation_cosine(
    fmap_xy: Float[Tensor, "Ky Kx"],
    omega_x: Float[Tensor, "K N N"],
    omega_y: Float[Tensor, "L M M"],
    n_functions: int = 8,
) -> float:
    """Cosine between ``C omega(f, g)`` and ``omega(C f, C g)``, f and g low functions; 1: direct, -1: mirrored.

    Args:
        fmap_xy: takes functions on x to functions on y.
        omega_x: :func:`orientation_tensor` of x.
        omega_y: that of y.
        n_functions: how many low functions of x are paired.
    """
    (k, n, _), (last, m, _) = omega_x.shape, omega_y.shape
    n, k = min(n, n_functions, fmap_xy.shape[1]), min(k, fmap_xy.shape[1])
    m, last = min(m, fmap_xy.shape[0]), min(last, fmap_xy.shape[0])
    images = fmap_xy[:m, :n]
    found = torch.einsum("kpq,pa,qb->kab", omega_y[:last, :m, :m], images, images)
    wanted = torch.einsum("jk,kab->jab", fmap_xy[:last, :k], omega_x[:k, :n, :n])
    return float((wanted * found).sum() / (wanted.norm() * found.norm()).clamp_min(1e-300))
