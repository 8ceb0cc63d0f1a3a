"""Geodesic error of a point-to-point map, from the distances of the true points only (never a V x V matrix).

The error at source point x is ``d_N(T(x), T*(x)) / sqrt(area(N))``: geodesic distance on the target N between the
predicted vertex and the true one. Only the rows of the true points are computed. They are kept in
:class:`TruthDistances`, built once for a target and shared by all maps, pairs and protocols that use the same true
points, and optionally on disk.

References:
    Kim, Lipman, Funkhouser 2011, section 7 (the error and its scale); Ovsjanikov et al. 2013, section 7.
"""

import hashlib
import warnings
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.files import write_whole
from torchqm.geometry.mesh import Mesh

__all__ = ["SurfacePoints", "TruthDistances", "geodesic_errors", "group_truth", "spread_points"]

_CACHE_VERSION = 1
_CHUNK_BYTES = 2**28  # of the solver's float64 rows at a time (it sets up anew for each chunk); kept are float32


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
    A reflection and 100 points on 53k vertices are 42 MB.

    Args:
        mesh: the target.
        sources: ``(U,)`` ascending vertex ids.
        rows: ``(U, V)`` distance of every vertex from each source, in the unit of ``mesh.verts``; infinite between
            components.
        sqrt_area: square root of the target's total area.
        method: the solver, see :func:`torchqm.geometry.geodesic.distances`; name it beside every number.
    """

    mesh: Mesh
    sources: Int[Tensor, " U"]
    rows: Float[Tensor, "U V"]
    sqrt_area: float
    method: str

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
            cache_dir: folder for ``.npz`` files keyed by the content of mesh, sources and method. Entries are written
                beside and renamed, so many processes may share it; a damaged entry is computed anew with a warning.

        Raises:
            ValueError: if a vertex id is out of range, there is no true point, or the mesh has no area.
        """
        sources = _vertex_ids(truth).unique()
        _check_ids("truth", sources, mesh)
        if not (mesh.area > 0 and np.isfinite(mesh.area)):
            raise ValueError(f"mesh: {mesh.label} has area {mesh.area}; the error is undefined")
        path = None if cache_dir is None else Path(cache_dir) / f"{_cache_key(mesh, sources, method)}.npz"
        rows = None if path is None else _read_rows(path, sources, mesh.n_verts)
        if rows is None:
            rows = _compute_rows(mesh, sources, method)
            if path is not None:
                _write_rows(path, sources, rows)
        return cls(mesh, sources, rows, mesh.area**0.5, method)

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
        _check_ids("predicted", predicted, self.mesh)
        shape = truth.corners.shape[:-1] if isinstance(truth, SurfacePoints) else truth.shape
        if len(shape) == 0 or shape[-1] != len(predicted):
            raise ValueError(
                f"truth: expected a true point for each of the {len(predicted)} predictions, got shape {tuple(shape)}"
            )
        if isinstance(truth, SurfacePoints):
            to_corners = self._lookup(truth.corners, predicted[:, None])
            corners, bary = self.mesh.verts[truth.corners], truth.bary.to(torch.float64)
            points = (bary[..., None] * corners).sum(-2)
            detour = (to_corners + (corners - points[..., None, :]).norm(dim=-1)).min(-1).values
            # a corner of weight 0 must not make 0 * inf
            interpolated = torch.where(bary > 0, bary * to_corners, torch.zeros_like(bary)).sum(-1)
            out = torch.minimum(interpolated, detour)
        else:
            out = self._lookup(truth, predicted)
        return out / self.sqrt_area

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

    Args:
        target_mesh: the target.
        p2p: ``(Vs,)`` target vertex of each source vertex (source to target).
        truth: ``(S,)`` true target vertices of the points ``at``, or ``(G, S)`` their images under the target's group
            (:func:`group_truth`), or :class:`SurfacePoints` where the truth lies inside faces.
        at: ``(S,)`` source vertices at which to measure; all of them if left out.
        method: geodesic solver; ignored if ``distances`` is given.
        distances: rows built before for this target; they must contain all true points.
        cache_dir: see :meth:`TruthDistances.build`.

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
        distances = TruthDistances.build(target_mesh, truth, method, cache_dir)
    elif distances.mesh is not target_mesh and not _same_mesh(distances.mesh, target_mesh):
        raise ValueError(f"distances: built for {distances.mesh.label}, not for {target_mesh.label}")
    return distances.errors(p2p[at], truth)


def group_truth(truth: Int[Tensor, " S"], maps: Int[Tensor, "G V"]) -> Int[Tensor, "G S"]:
    """Images of the true points under the target's symmetry group: all answers that are equally right.

    Args:
        truth: ``(S,)`` true target vertices.
        maps: ``(G, V)`` vertex maps of the target, row 0 the identity (``SymmetryGroup.maps``). On TOSCA they come
            from the undeformed pose of the class, whose vertex ids all poses share.

    Example:
        >>> group_truth(torch.tensor([0, 2]), torch.tensor([[0, 1, 2], [2, 1, 0]])).tolist()
        [[0, 2], [2, 0]]
    """
    n_verts = maps.shape[1]
    if len(truth) and not 0 <= int(truth.min()) <= int(truth.max()) < n_verts:
        raise ValueError(f"truth: vertices must lie in 0..{n_verts - 1}, got {int(truth.min())}..{int(truth.max())}")
    if not torch.equal(maps[0], torch.arange(n_verts)):
        raise ValueError("maps: row 0 must be the identity")
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


def _compute_rows(mesh: Mesh, sources: Int[Tensor, " U"], method: str) -> Float[Tensor, "U V"]:
    from torchqm.geometry.geodesic import distances  # on first use: it loads the solvers

    rows = torch.empty(len(sources), mesh.n_verts, dtype=torch.float32)
    step = max(1, _CHUNK_BYTES // (8 * mesh.n_verts))
    for first in range(0, len(sources), step):
        rows[first : first + step] = distances(mesh, sources[first : first + step], method=method).to(torch.float32)
    return rows


def _cache_key(mesh: Mesh, sources: Int[Tensor, " U"], method: str) -> str:
    digest = hashlib.sha256(f"torchqm truth distances {_CACHE_VERSION} {method} {mesh.n_verts} {mesh.n_faces}".encode())
    for array in (*mesh.numpy(), sources.numpy()):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:40]


def _read_rows(path: Path, sources: Int[Tensor, " U"], n_verts: int) -> Float[Tensor, "U V"] | None:
    """The cached rows, or None if there are none or they are not what was asked for."""
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as entry:
            rows, ids = entry["rows"], entry["sources"]
        if rows.shape == (len(sources), n_verts) and rows.dtype == np.float32 and np.array_equal(ids, sources.numpy()):
            return torch.from_numpy(rows)
        reason = f"it holds {rows.dtype} {rows.shape}"
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zipfile.LargeZipFile) as error:
        reason = str(error)
    warnings.warn(f"{path}: damaged or foreign cache entry, computed anew ({reason})", stacklevel=3)
    return None


def _write_rows(path: Path, sources: Int[Tensor, " U"], rows: Float[Tensor, "U V"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: np.savez(file, rows=rows.numpy(), sources=sources.numpy()))
