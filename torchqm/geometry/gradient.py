"""Gradients of functions at the vertices of a mesh: two sparse matrices, one for each direction of a tangent frame."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.geometry.check import clean_faces
from torchqm.geometry.mesh import Mesh

__all__ = ["VertexGradient", "tangent_frames", "vertex_gradient"]

_FLAT_FAN = 1e-8
"""Edges whose matrix has eigenvalues of a smaller ratio count as one line (an angle of about 0.01 degrees)."""


@dataclass(frozen=True, eq=False)
class VertexGradient:
    """The gradient of a function at each vertex, as its two components in that vertex's tangent frame.

    With ``M = diag(mass)``, ``-(grad_x^T M u + grad_y^T M w)`` is the (integrated) divergence of the field ``(u, w)``.

    Args:
        frames: ``(V, 3, 3)``, the rows X, Y and normal of a right-handed orthonormal frame at each vertex.
        grad_x: ``(V, V)`` sparse COO, coalesced: vertex values to the derivative along X, in 1 / unit of ``verts``.
        grad_y: ``(V, V)`` likewise along Y; the same entries are stored.
    """

    frames: Float[Tensor, "V 3 3"]
    grad_x: Tensor
    grad_y: Tensor

    def vectors(self, values: Float[Tensor, "V C"]) -> Float[Tensor, "V C 3"]:
        """The gradients of C functions as vectors in space."""
        x, y = self.grad_x @ values, self.grad_y @ values
        return x[..., None] * self.frames[:, None, 0] + y[..., None] * self.frames[:, None, 1]


def tangent_frames(mesh: Mesh) -> Float[Tensor, "V 3 3"]:
    """A right-handed orthonormal frame at each vertex, by a fixed rule.

    The normal is the area-weighted mean of the normals of the triangles around the vertex, X is the coordinate axis
    that is farthest from the normal, projected into the tangent plane, and Y = normal x X.

    Args:
        mesh: any mesh; a vertex without triangles, or whose normals cancel, gets the z axis for a normal.

    Returns:
        ``(V, 3, 3)``: the rows of each are X, Y, normal.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> tangent_frames(mesh)[0].tolist()
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    verts = _unit_size(mesh)[0]
    i, j, k = verts[mesh.faces].unbind(1)
    cross = torch.linalg.cross(j - i, k - i)
    total = torch.zeros_like(verts).index_add_(0, mesh.faces.reshape(-1), cross.repeat_interleave(3, 0))
    length = total.norm(dim=1, keepdim=True)
    none = length <= 1e-30
    normal = torch.where(none, total.new_tensor([0.0, 0.0, 1.0]), total / torch.where(none, 1.0, length))
    # argmin takes the first of equal values, so that a normal along z has X along x
    axis = torch.eye(3, dtype=verts.dtype)[normal.abs().argmin(1)]
    x = torch.nn.functional.normalize(axis - (axis * normal).sum(1, keepdim=True) * normal, dim=1)
    return torch.stack([x, torch.linalg.cross(normal, x), normal], dim=1)


def vertex_gradient(mesh: Mesh, frames: Float[Tensor, "V 3 3"] | None = None) -> VertexGradient:
    """Gradient operators by least squares over the edges at each vertex.

    At vertex i the gradient g minimises ``sum_j (<g, P (x_j - x_i)> - (f_j - f_i))^2`` over its neighbours j, where P
    projects into the tangent plane. So it is exact for linear functions on a plane, also at a boundary, and zero for
    constants. Where all edges lie in one line only the derivative along it is taken; a vertex without triangles has
    empty rows.

    Args:
        mesh: any mesh, any scale.
        frames: ``(V, 3, 3)`` rows X, Y, normal; those of :func:`tangent_frames` if not given.

    Returns:
        The frames and the two ``(V, V)`` matrices.

    Raises:
        ValueError: ``frames`` for another number of vertices.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [2, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> gradient = vertex_gradient(mesh)
        >>> f = 3 * mesh.verts[:, :1] - mesh.verts[:, 1:2]
        >>> [round(float((operator @ f)[0]), 6) for operator in (gradient.grad_x, gradient.grad_y)]
        [3.0, -1.0]

    References:
        N. Sharp, S. Attaiki, K. Crane, M. Ovsjanikov, "DiffusionNet: Discretization Agnostic Learning on Surfaces",
        2022, section "Spatial Gradient Features".
    """
    n = mesh.n_verts
    if frames is None:
        frames = tangent_frames(mesh)
    elif frames.shape != (n, 3, 3):
        raise ValueError(f"frames: shape {tuple(frames.shape)} given; {mesh.label} needs ({n}, 3, 3)")
    verts, scale = _unit_size(mesh)
    edges = Mesh(verts, clean_faces(mesh)).edges
    start, end = torch.cat([edges, edges.flip(1)]).unbind(1)
    steps = torch.einsum("eab,eb->ea", frames[start, :2].to(verts.dtype), verts[end] - verts[start])  # (E, 2)
    normal_matrix = verts.new_zeros(n, 2, 2).index_add_(0, start, steps[:, :, None] * steps[:, None, :])
    inverse = torch.linalg.pinv(normal_matrix, rtol=_FLAT_FAN, hermitian=True)
    weights = torch.einsum("eab,eb->ea", inverse[start], steps) / scale
    indices = torch.stack([torch.cat([start, start]), torch.cat([end, start])])
    grad_x, grad_y = (
        torch.sparse_coo_tensor(indices, torch.cat([w, -w]), (n, n), check_invariants=False).coalesce()
        for w in weights.unbind(1)
    )
    return VertexGradient(frames, grad_x, grad_y)


def _unit_size(mesh: Mesh) -> tuple[Tensor, float]:
    """The vertices at size one, where products of lengths stay in range, and the size they had."""
    scale = float((mesh.verts - mesh.verts[:1]).abs().max()) or 1.0
    return (mesh.verts - mesh.verts[:1]) / scale, scale
