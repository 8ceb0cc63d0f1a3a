"""What a map says about itself, without any ground truth: commutativity, distances and orientation."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import nearest_used, p2p_to_fmap
from torchqm.geometry.curvature import vertex_normals
from torchqm.geometry.mesh import Mesh
from torchqm.matching.shape import PreparedShape
from torchqm.spectral.basis import SpectralBasis

__all__ = [
    "commutativity_score",
    "commutator_norm",
    "displacement",
    "distance_change",
    "map_label",
    "orientation_agreement",
    "orientation_label",
    "torn_length",
]


def commutativity_score(
    p2p_xy: Int[Tensor, " Vx"], basis_x: SpectralBasis, basis_y: SpectralBasis, k: int = 50
) -> float:
    """``|| C Delta - Delta C || / (|| C Delta || + || Delta C ||)`` of the pull-back along a point map; 0: an isometry.

    Args:
        p2p_xy: for each vertex of x a vertex of y; its pull-back takes functions on y to functions on x.
        basis_x: full basis of x.
        basis_y: full basis of y.
        k: functions of each to use, at most.
    """
    k = min(k, basis_x.k, basis_y.k)
    small_x, small_y = basis_x.truncate(k), basis_y.truncate(k)
    return commutator_norm(p2p_to_fmap(p2p_xy, small_y, small_x), small_y.evals, small_x.evals)


def commutator_norm(
    fmap_xy: Float[Tensor, "Ky Kx"], evals_x: Float[Tensor, " Kx"], evals_y: Float[Tensor, " Ky"]
) -> float:
    """``|| C Delta_x - Delta_y C || / (|| C Delta_x || + || Delta_y C ||)`` of a functional map; 0: an isometry."""
    right, left = fmap_xy * evals_x, evals_y[:, None] * fmap_xy
    return float((right - left).norm() / (right.norm() + left.norm()).clamp_min(1e-300))


def distance_change(
    fmap_xy: Float[Tensor, "Ky Kx"], x: PreparedShape, y: PreparedShape, n: int = 1000, k: int = 100
) -> float:
    """Mean change of the biharmonic distance between two samples under a map, relative to the mean distance.

    Args:
        fmap_xy: in the first functions of the two shapes.
        x: source.
        y: target; partners are looked for among its anchors.
        n: samples; each is compared with two others, far apart in their (random) order.
        k: functions in the distances.
    """
    k_y, k_x = fmap_xy.shape
    samples = x.samples[:n]
    among = y.basis.truncate(k_y).restricted(y.anchors)
    partners = y.anchors[nearest_used(x.basis.evecs[samples, :k_x] @ fmap_xy.T, among, exact=False)]
    before, after = (b.restricted(i).biharmonic(k) for b, i in ((x.basis, samples), (y.basis, partners)))
    gaps = []
    for step in (len(samples) // 3, len(samples) // 2 + 1):
        gaps.append(((before - before.roll(step, 0)).norm(dim=1), (after - after.roll(step, 0)).norm(dim=1)))
    change = sum(float((b - a).abs().mean()) for b, a in gaps)
    return change / max(sum(float(b.mean()) for b, _ in gaps), 1e-300)


def displacement(fmap: Float[Tensor, "K K"], evals: Float[Tensor, " N"]) -> float:
    """How far a self-map moves the points of a shape: 0 for the identity, about 1 if it were none of its own doing.

    Root mean square of the biharmonic distances between points and their images, over that between any two points:
    ``|| L^-1 (C - I) || / (sqrt(2) || L^-1 ||)`` with the eigenvalues ``L``, the constant left out.

    Args:
        fmap: orthonormal.
        evals: ``(N,)`` ascending, N at least K; the first is that of the constant.

    Example:
        >>> evals = torch.tensor([0.0, 1.0, 2.0])
        >>> displacement(torch.eye(3), evals), round(displacement(torch.diag(torch.tensor([1.0, -1.0, 1.0])), evals), 4)
        (0.0, 1.2649)
    """
    k = fmap.shape[0]
    weights = 1 / evals[1:k].clamp_min(torch.finfo(evals.dtype).tiny)
    moved = weights[:, None] * (fmap - torch.eye(k, dtype=fmap.dtype, device=fmap.device))[1:, 1:]
    return float(moved.norm() / (2**0.5 * weights.norm()))


def orientation_agreement(mesh_x: Mesh, mesh_y: Mesh, p2p_xy: Int[Tensor, " Vx"]) -> float:
    """Area-weighted mean over triangles of +1 where a point map keeps orientation and -1 where it turns it over.

    A triangle of x is compared with the normal of y at the image of its first corner; triangles whose image has no area
    say nothing. Both meshes must be consistently oriented, with normals outward.
    """
    corners = p2p_xy[mesh_x.faces]
    a, b, c = mesh_y.verts[corners].unbind(1)
    image = torch.linalg.cross(b - a, c - a)
    normals = vertex_normals(mesh_y)
    sign = torch.sign((image * normals[corners[:, 0]]).sum(1))
    weight = mesh_x.face_areas * (sign != 0)
    return float((sign * weight).sum() / weight.sum().clamp_min(1e-300))


def map_label(agreement: float, cosine: float) -> str:
    """Name of a map: by its triangles if they say it clearly, else by how it carries smooth functions.

    Triangles smaller than the errors of a map are turned over here and there even if the map is right everywhere.

    Args:
        agreement: :func:`orientation_agreement`.
        cosine: :func:`torchqm.symmetry.orientation.orientation_cosine`.
    """
    label = orientation_label(agreement)
    if label == "unknown" and abs(cosine) > 0.5 and agreement * cosine > 0:
        return "direct" if cosine > 0 else "mirrored"
    return label


def orientation_label(agreement: float) -> str:
    """Name of a map by its orientation agreement; a map that is right on three quarters of the area has 0.5."""
    return "direct" if agreement > 0.3 else "mirrored" if agreement < -0.3 else "unknown"


def torn_length(mesh: Mesh, p2p: Int[Tensor, " V"]) -> float:
    """Length of the edges that a point map tears: their images are over three times as long, plus 0.02 sqrt(area).

    The same tear has the same length in a coarse and in a fine mesh.

    Args:
        mesh: the shape that is mapped, of area 1.
        p2p: for each of its vertices a vertex of the same shape.
    """
    verts = mesh.verts
    a, b = mesh.edges.T
    images = (verts[p2p[a]] - verts[p2p[b]]).norm(dim=1)
    return float(mesh.edge_lengths[images > 3 * mesh.edge_lengths + 0.02].sum())
