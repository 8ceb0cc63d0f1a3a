"""Positions and normals of a batch of meshes, as tensors that may be padded."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["centred_unit_area", "normals_at_vertices"]


def centred_unit_area(verts: Float[Tensor, "*B V 3"], mass: Float[Tensor, "*B V"]) -> Float[Tensor, "*B V 3"]:
    """``(x - sum_i m_i x_i / A) / sqrt(A)`` with ``A = sum_i m_i``: positions from the centroid, at total area 1.

    Args:
        verts: ``(..., V, 3)``.
        mass: ``(..., V)`` vertex areas; 0 for padding, whose result has no meaning.

    Returns:
        ``(..., V, 3)``; a shape without area gives zeros.

    Example:
        >>> centred_unit_area(torch.tensor([[1.0, 0, 0], [5.0, 0, 0]]), torch.tensor([2.0, 2.0]))
        tensor([[-1.,  0.,  0.],
                [ 1.,  0.,  0.]])
    """
    area = mass.sum(-1)[..., None, None]
    some = area > 0
    area = torch.where(some, area, 1.0)
    centre = (mass[..., None] * verts).sum(-2, keepdim=True) / area
    return torch.where(some, (verts - centre) / area.sqrt(), 0.0)


def normals_at_vertices(verts: Float[Tensor, "*B V 3"], faces: Int[Tensor, "*B F 3"]) -> Float[Tensor, "*B V 3"]:
    """Unit normals, of the faces around each vertex weighted by area: :func:`torchqm.geometry.vertex_normals`.

    Differentiable in the positions, also where there is no normal (0 and a gradient of 0).

    Args:
        verts: ``(..., V, 3)``, best at a size about 1.
        faces: ``(..., F, 3)`` consistently oriented; ``0 0 0``, as in padding, counts nothing.

    Returns:
        ``(..., V, 3)``; 0 at a vertex without a face, or whose faces cancel.

    Example:
        >>> normals_at_vertices(torch.eye(3), torch.tensor([[0, 1, 2]]))[0].mul(3**0.5).round().tolist()
        [1.0, 1.0, 1.0]
    """
    ids = faces.flatten(-2)[..., None].expand(*faces.shape[:-2], -1, 3)
    corners = torch.gather(verts, -2, ids).unflatten(-2, (-1, 3))
    first = corners[..., 0, :]
    cross = torch.linalg.cross(corners[..., 1, :] - first, corners[..., 2, :] - first)
    total = torch.zeros_like(verts).scatter_add(-2, ids, cross.repeat_interleave(3, -2))
    square = total.square().sum(-1, keepdim=True)
    some = square > torch.finfo(verts.dtype).tiny
    return torch.where(some, total / torch.where(some, square, 1.0).sqrt(), 0.0)
