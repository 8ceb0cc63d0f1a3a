"""Geodesic error of a point-to-point map, from the distances of the true points only (never a V x V matrix).

The error at source point x is ``d_N(T(x), T*(x)) / sqrt(area(N))``: geodesic distance on the target N between the
predicted vertex and the true one. Only the rows of the true points are computed. Those of chosen points are kept in
:class:`TruthDistances`, built once for a target and shared by all maps, pairs and protocols that use the same true
points, and optionally on disk. Where the truth is all vertices of a large shape, :func:`geodesic_errors` keeps no rows.

References:
    Kim, Lipman, Funkhouser 2011, section 7 (the error and its scale); Ovsjanikov et al. 2013, section 7.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.evaluate.distances import distance_rows, pair_distances
from torchqm.geometry.mesh import Mesh

__all__ = ["SurfacePoints", "TruthDistances", "geodesic_errors", "group_truth", "spread_points"]

MAX_ROWS_BYTES = 2**29
"""Rows that :class:`TruthDistances` keeps at most: 2,550 of 52,565 vertices, or all of 11,500."""


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """Points on a mesh as barycentric combinations of three vertices each; the truth between different triangulations.

    Args:
        corners: ``(*, 3)`` vertex ids of the corners of each point's face (``mesh.faces[face_ids]``).
        bary: ``(*, 3)`` weights >= 0 that sum to one.

    Raises:
        ValueError: if the shapes differ or the weights are no barycentric coordinates.

    Example:
        >>> SurfacePoints(torch.tensor([[0, 1, 2]]), torch.tensor([[0.5, 0.5, 0.0]])).corners.shape
        torch.Size([1, 3])
    """

    corners: Int[Tensor, "*shape 3"]
    bary: Float[Tensor, "*shape 3"]

    def __post_init__(self) -> None:
        if self.corners.shape != self.bary.shape:
            raise ValueError(f"corners, bary: shapes differ, {tuple(self.corners.shape)} and {tuple(self.bary.shape)}")
        low = float(self.bary.min()) if self.bary.numel() else 0.0
        off = float((self.bary.sum(-1) - 1).abs().max()) if self.bary.numel() else 0.0
        if not (low >= -1e-6 and off <= 1e-5):
            raise ValueError(
                f"bary: expected weights >= 0 that sum to 1, got a least weight of {low:.3g} and a sum off by {off:.3g}"
            )

    @classmethod
    def from_faces(
        cls, mesh: Mesh, face_ids: Int[Tensor, "*shape"], bary: Float[Tensor, "*shape 3"]
    ) -> "SurfacePoints":
        """Points given by face ids of a mesh and barycentric weights in the order of the face's corners."""
        if face_ids.numel() and not 0 <= int(face_ids.min()) <= int(face_ids.max()) < mesh.n_faces:
            raise ValueError(
                f"face_ids: must lie in 0..{mesh.n_faces - 1}, got {int(face_ids.min())}..{int(face_ids.max())}"
            )
        return cls(mesh.faces[face_ids], bary)


@dataclass(frozen=True, eq=False)
class TruthDistances:
    """Rows of geodesic distances on a target from its true points, and the scale of the error.

    Memory: ``4 U V`` bytes for U different true vertices (float32; a relative error of 6e-8 is far below the solver's).
    A reflection and 1,024 points on 53k vertices are 430 MB. Where a matrix of all distances is at hand, as in the data
    sets of the learned methods, ``TruthDistances(mesh, torch.arange(mesh.n_verts), dist, mesh.area**0.5, "given")``
    takes it as it is.

    Args:
        mesh: the target.
        sources: ``(U,)`` ascending vertex ids.
        rows: ``(U, V)`` distance of every vertex from each source, in the unit of ``mesh.verts``; infinite between
            components.
        sqrt_area: square root of the target's total area.
        method: the solver that computed them (``heat`` where fast marching was asked for and cannot run); name it
            beside every number.
    """

    mesh: Mesh
    sources: Int[Tensor, " U"]
    rows: Float[Tensor, "U V"]
    sqrt_area: float
    method: str

    @staticmethod
    def fits(mesh: Mesh, truth: Int[Tensor, "..."] | SurfacePoints) -> bool:
        """Whether the rows of these true points take at most :data:`MAX_ROWS_BYTES`."""
        return 4 * len(_vertex_ids(truth).unique()) * mesh.n_verts <= MAX_ROWS_BYTES

    @classmethod
    def build(
        cls,
        mesh: Mesh,
        truth: Int[Tensor, "..."] | SurfacePoints,
        method: str = "fast_marching",
        cache_dir: str | Path | None = None,
    ) -> "TruthDistances":
        """Compute (or read back) the rows of all vertices that occur in ``truth``.

        Args:
            mesh: the target.
            truth: vertex ids of any shape, e.g. ``(S,)`` or ``(G, S)``, or points inside faces.
            method: geodesic solver.
            cache_dir: folder for the rows, see :func:`torchqm.evaluate.distances.distance_rows`.

        Raises:
            ValueError: if a vertex id is out of range, there is no true point, the mesh has no area, or the rows would
                take more than :data:`MAX_ROWS_BYTES`.
        """
        sources, sqrt_area = _true_sources(mesh, truth)
        if not cls.fits(mesh, sources):
            raise ValueError(
                f"truth: rows of {len(sources)} true vertices of {mesh.label} take "
                f"{4 * len(sources) * mesh.n_verts / 2**30:.1f} GiB, allowed are {MAX_ROWS_BYTES / 2**30:.1f}; measure "
                "at spread_points(mesh), or call geodesic_errors, which keeps no rows"
            )
        rows, solver = distance_rows(mesh, sources, method, cache_dir)
        return cls(mesh, sources, rows, sqrt_area, solver)

    def errors(self, predicted: Int[Tensor, " S"], truth: Int[Tensor, "..."] | SurfacePoints) -> Float[Tensor, "..."]:
        """Geodesic distance / sqrt(area) between predicted vertices and true points.

        For a true point q inside a face with corners c_i and weights b_i the distance to vertex p is the smaller of the
        interpolation ``sum_i b_i d(c_i, p)`` and the detour ``min_i d(c_i, p) + |q - c_i|``. Far from q both are
        first-order exact; where p is a corner of the face of q this is the Euclidean distance ``|q - p|``, exactly.

        Args:
            predicted: ``(S,)`` predicted target vertices.
            truth: ``(S,)`` true vertices, or ``(G, S)`` for the images under a group, or :class:`SurfacePoints` of
                such shape.

        Returns:
            ``(S,)`` or ``(G, S)`` float64.

        Raises:
            ValueError: if an id is out of range, lengths differ or a true vertex has no row here.
        """
        return _errors(self.mesh, predicted, truth, self._lookup) / self.sqrt_area

    def _lookup(self, truth: Int[Tensor, "..."], predicted: Int[Tensor, "..."]) -> Float[Tensor, "..."]:
        position = torch.searchsorted(self.sources, truth.contiguous()).clamp_max(len(self.sources) - 1)
        absent = truth[self.sources[position] != truth].unique()
        if len(absent):
            raise ValueError(
                f"truth: {len(absent)} true vertices of {self.mesh.label} have no row here, first {int(absent[0])}; "
                "build TruthDistances from all true points, images under the group included"
            )
        return self.rows[position, predicted.expand(truth.shape)].to(torch.float64)


def geodesic_errors(
    target_mesh: Mesh,
    p2p: Int[Tensor, " Vs"],
    truth: Int[Tensor, "..."] | SurfacePoints,
    at: Int[Tensor, " S"] | None = None,
    method: str = "fast_marching",
    distances: TruthDistances | None = None,
    cache_dir: str | Path | None = None,
) -> Float[Tensor, "..."]:
    """Geodesic errors of a point-to-point map at some source points, divided by sqrt(area of the target).

    Rows of distances are kept while they are computed if they take at most :data:`MAX_ROWS_BYTES`. Beyond that, as with
    a truth at all vertices of a large shape, a chunk of rows is computed, read and forgotten: 52k vertices stay below
    2 GiB (``benchmarks/evaluate_memory.py``). That takes a solve for every true vertex: on 53k vertices and a slow core
    ten minutes with ``dijkstra``, twenty with ``heat``, ninety with ``fast_marching``.

    Args:
        target_mesh: the target.
        p2p: ``(Vs,)`` target vertex of each source vertex (source to target).
        truth: ``(S,)`` true target vertices of the points ``at``, or ``(G, S)`` their images under the target's group
            (:func:`group_truth`), or :class:`SurfacePoints` where the truth lies inside faces.
        at: ``(S,)`` source vertices at which to measure; all of them if left out.
        method: geodesic solver; ignored if ``distances`` is given.
        distances: rows built before for this target; they must contain all true points.
        cache_dir: folder for rows, or where none are kept for the distances that were read from them.

    Returns:
        ``(S,)`` or ``(G, S)`` float64 errors, ready for :func:`torchqm.evaluate.protocol.evaluate_errors`.

    Raises:
        ValueError: naming the argument, if ids are out of range, lengths differ or ``distances`` belong to another
            mesh.

    References:
        Kim, Lipman, Funkhouser 2011, section 7.
    """
    if at is None:
        at = torch.arange(len(p2p))
    if len(at) and not 0 <= int(at.min()) <= int(at.max()) < len(p2p):
        raise ValueError(f"at: source vertices must lie in 0..{len(p2p) - 1}, got {int(at.min())}..{int(at.max())}")
    if distances is None:
        sources, sqrt_area = _true_sources(target_mesh, truth)
        if not TruthDistances.fits(target_mesh, sources):
            return _errors(target_mesh, p2p[at], truth, _streamed(target_mesh, method, cache_dir)) / sqrt_area
        distances = TruthDistances.build(target_mesh, truth, method, cache_dir)
    elif distances.mesh is not target_mesh and not _same_mesh(distances.mesh, target_mesh):
        raise ValueError(f"distances: built for {distances.mesh.label}, not for {target_mesh.label}")
    return distances.errors(p2p[at], truth)


def group_truth(
    truth: Int[Tensor, " S"] | SurfacePoints, maps: Int[Tensor, "G V"]
) -> Int[Tensor, "G S"] | SurfacePoints:
    """Images of the true points under the target's symmetry group: all answers that are equally right.

    Args:
        truth: ``(S,)`` true target vertices, or S points inside faces, which go where their corners go (exact where the
            image of a face is a face again).
        maps: ``(G, V)`` vertex maps of the target, row 0 the identity (``SymmetryGroup.maps``). On TOSCA they come
            from the undeformed pose of the class, whose vertex ids all poses share.

    Returns:
        ``(G, S)`` vertices or points, row 0 the truth itself.

    Raises:
        ValueError: if a vertex is out of range or row 0 is not the identity.

    Example:
        >>> group_truth(torch.tensor([0, 2]), torch.tensor([[0, 1, 2], [2, 1, 0]])).tolist()
        [[0, 2], [2, 0]]
    """
    ids, n_verts = _vertex_ids(truth), maps.shape[1]
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < n_verts:
        raise ValueError(f"truth: vertices must lie in 0..{n_verts - 1}, got {int(ids.min())}..{int(ids.max())}")
    if len(maps) == 0 or not torch.equal(maps[0], torch.arange(n_verts)):
        raise ValueError("maps: row 0 must be the identity")
    if isinstance(truth, SurfacePoints):
        corners = maps[:, truth.corners]
        return SurfacePoints(corners, truth.bary.expand(corners.shape))
    return maps[:, truth]


def spread_points(mesh: Mesh, n: int = 100, start: int | None = None) -> Int[Tensor, " n"]:
    """Evaluation points spread over a shape by geodesic farthest-point sampling.

    Choose them once, on the undeformed pose of a class, and use the same ids on all its poses. BIM's published errors
    are at 1024 points that were spread in the same way, and are lost.
    """
    from torchqm.geometry.sampling import farthest_points

    return farthest_points(mesh, n, start)


def _vertex_ids(truth: Int[Tensor, "..."] | SurfacePoints) -> Int[Tensor, " N"]:
    return (truth.corners if isinstance(truth, SurfacePoints) else truth).reshape(-1)


def _check_ids(name: str, ids: Int[Tensor, " N"], mesh: Mesh) -> None:
    if len(ids) == 0:
        raise ValueError(f"{name}: expected at least one point on {mesh.label}")
    if not 0 <= int(ids.min()) <= int(ids.max()) < mesh.n_verts:
        given = f"{int(ids.min())}..{int(ids.max())}"
        raise ValueError(f"{name}: vertices of {mesh.label} must lie in 0..{mesh.n_verts - 1}, got {given}")


def _same_mesh(a: Mesh, b: Mesh) -> bool:
    return torch.equal(a.verts, b.verts) and torch.equal(a.faces, b.faces)


def _true_sources(mesh: Mesh, truth: Int[Tensor, "..."] | SurfacePoints) -> tuple[Int[Tensor, " U"], float]:
    """The different true vertices in ascending order, and the scale of the error; ValueError where there is none."""
    sources = _vertex_ids(truth).unique()
    _check_ids("truth", sources, mesh)
    if not (mesh.area > 0 and isfinite(mesh.area)):
        raise ValueError(f"mesh: {mesh.label} has area {mesh.area}; the error is undefined")
    return sources, mesh.area**0.5


_Lookup = Callable[[Tensor, Tensor], Tensor]  # true vertices (...), predicted vertices (broadcast) -> distances (...)


def _streamed(mesh: Mesh, method: str, cache_dir: str | Path | None) -> _Lookup:
    def lookup(truth: Tensor, predicted: Tensor) -> Tensor:
        pairs = truth.reshape(-1), predicted.expand(truth.shape).reshape(-1)
        return pair_distances(mesh, *pairs, method, cache_dir).reshape(truth.shape)

    return lookup


def _errors(
    mesh: Mesh, predicted: Int[Tensor, " S"], truth: Int[Tensor, "..."] | SurfacePoints, lookup: _Lookup
) -> Float[Tensor, "..."]:
    """Distances from true points to predicted vertices, in the unit of the mesh."""
    _check_ids("predicted", predicted, mesh)
    shape = truth.corners.shape[:-1] if isinstance(truth, SurfacePoints) else truth.shape
    if len(shape) == 0 or shape[-1] != len(predicted):
        raise ValueError(
            f"truth: expected a true point for each of the {len(predicted)} predictions, got shape {tuple(shape)}"
        )
    if not isinstance(truth, SurfacePoints):
        return lookup(truth, predicted)
    to_corners = lookup(truth.corners, predicted[:, None])
    corners, bary = mesh.verts[truth.corners], truth.bary.to(torch.float64)
    points = (bary[..., None] * corners).sum(-2)
    detour = (to_corners + (corners - points[..., None, :]).norm(dim=-1)).min(-1).values
    # a corner of weight 0 must not make 0 * inf
    interpolated = torch.where(bary > 0, bary * to_corners, torch.zeros_like(bary)).sum(-1)
    return torch.minimum(interpolated, detour)
