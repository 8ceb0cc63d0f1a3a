"""Mean curvature at the vertices of a mesh."""

import scipy
import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.geometry.laplacian import cotan_matrix
from torchqm.geometry.mesh import Mesh

__all__ = ["mean_curvature", "vertex_normals"]


def vertex_normals(mesh: Mesh) -> Float[Tensor, "V 3"]:
    """Unit normals at the vertices: those of the faces around each, weighted by their areas; 0 without a face."""
    sums = torch.zeros_like(mesh.verts)
    for corner in range(3):
        sums.index_add_(0, mesh.faces[:, corner], mesh.face_vectors)
    return torch.nn.functional.normalize(sums, dim=1, eps=1e-300)


def mean_curvature(mesh: Mesh, stiffness: "scipy.sparse.csr_array | None" = None) -> Float[Tensor, " V"]:
    """``H = n . (Delta x) / 2`` with the cotangent Laplacian (positive semidefinite); unit 1 / length.

    Positive where the surface is convex, if its normals point outward; a sphere of radius r has 1 / r. At single
    vertices of an irregular mesh it is noisy; its smooth part is not. 0 at vertices without area, and where triangles
    are so degenerate that the number is not finite.

    Args:
        mesh: consistently oriented, or the sign means nothing.
        stiffness: cotangent matrix of the mesh, if it is there already.

    References:
        Meyer et al. 2003, section 3.
    """
    areas = mesh.vertex_areas
    if stiffness is None:
        stiffness = cotan_matrix(mesh.verts, mesh.faces)
    laplacian = torch.from_numpy(stiffness @ mesh.verts.numpy()) / areas.clamp_min(1e-300)[:, None]
    values = (laplacian * vertex_normals(mesh)).sum(1) / 2
    return torch.where((areas > 0) & torch.isfinite(values), values, 0.0)
