"""The part of a mesh that geodesic solvers see, and what they need of it."""

from threading import Lock
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from torchqm.geometry.check import clean_faces, inspect_mesh, orient_faces
from torchqm.geometry.mesh import Mesh

__all__ = ["Surface", "symmetric_graph", "vertex_ids"]


class Surface:
    """The referenced part of a mesh at size one, as the solvers want it."""

    def __init__(self, mesh: Mesh) -> None:
        # Not the mesh itself, which what is kept for a mesh must not hold.
        self.label, self._name, self._path = mesh.label, mesh.name, mesh.path
        faces = clean_faces(mesh).numpy()
        self.ids, local = np.unique(faces, return_inverse=True)
        self.faces = np.ascontiguousarray(local.reshape(faces.shape))
        self.local = np.full(mesh.n_verts, -1, dtype=np.int64)
        self.local[self.ids] = np.arange(len(self.ids))
        verts = mesh.numpy()[0][self.ids]
        verts = verts - verts[:1]
        self.scale = float(np.abs(verts).max(initial=0.0)) or 1.0
        self.verts = np.ascontiguousarray(verts / self.scale)
        self.n = len(self.ids)
        self._found: tuple[np.ndarray | None, str | None] | None = None
        self._lock = Lock()  # several threads may share what is kept for a mesh

    @property
    def compact(self) -> Mesh:
        """The same part as a mesh of its own."""
        return Mesh(torch.from_numpy(self.verts), torch.from_numpy(self.faces), self._name, self._path)

    @property
    def why_not_marching(self) -> str | None:
        """Why fast marching cannot run here, or None."""
        return self._marching[1]

    @property
    def _marching(self) -> tuple[np.ndarray | None, str | None]:
        """Oriented triangles, or why there are none."""
        with self._lock:
            if self._found is None:
                self._found = self._orient()
            return self._found

    def _orient(self) -> tuple[np.ndarray | None, str | None]:
        report = inspect_mesh(self.compact) if self.n else None
        if report is None:
            return None, None
        if not report.manifold:
            return None, (
                f"fast marching needs a manifold ({report.n_nonmanifold_edges} non-manifold edges, "
                f"{report.n_nonmanifold_verts} non-manifold vertices)"
            )
        if report.oriented:
            return self.faces, None
        oriented = orient_faces(self.compact)
        return (None, "fast marching needs an orientable surface") if oriented is None else (oriented.numpy(), None)

    def marching_solver(self) -> tuple[Any, int]:
        """A potpourri3d solver, and how many of its vertices are real (the first ones)."""
        import potpourri3d

        faces, why_not = self._marching
        if faces is None:
            raise ValueError(f"{self.label}: {why_not or 'it has no triangles'}")
        # potpourri3d 1.4 never walks along a boundary edge against its only half-edge, which makes distances near a
        # boundary too long. A flap on every boundary edge, the parallelogram point of its triangle, gives it the other
        # half-edge; a path over the flap is longer than the edge itself, so no distance gets shorter.
        keys = faces * self.n + faces[:, [1, 2, 0]]
        twins = faces[:, [1, 2, 0]] * self.n + faces
        face, corner = np.nonzero(~np.isin(keys, twins))
        a, b, c = faces[face, corner], faces[face, (corner + 1) % 3], faces[face, (corner + 2) % 3]
        apex = self.n + np.arange(len(a))
        verts = np.concatenate([self.verts, self.verts[a] + self.verts[b] - self.verts[c]])
        flaps = np.stack([b, a, apex], axis=1)
        return potpourri3d.MeshFastMarchingDistanceSolver(verts, np.concatenate([faces, flaps])), self.n

    def graph(self) -> "scipy.sparse.csr_array":
        """``(n, n)`` lengths of its edges."""
        compact = self.compact
        return symmetric_graph(self.n, compact.edges.numpy(), compact.edge_lengths.numpy())


def vertex_ids(label: str, n_verts: int, name: str, ids: Tensor | np.ndarray | list[int]) -> np.ndarray:
    """One row of ids as an array; ValueError, naming the argument, where it has no such vertices."""
    array = np.atleast_1d(np.asarray(ids))
    if array.ndim != 1 or not (np.issubdtype(array.dtype, np.integer) or array.size == 0):
        raise ValueError(f"{name} must be one row of integer vertex ids, not {array.dtype} of shape {array.shape}")
    array = array.astype(np.int64)
    bad = (array < 0) | (array >= n_verts)
    if bad.any():
        raise ValueError(f"{name} holds {array[bad][0]}; {label} has vertices 0 to {n_verts - 1}")
    return array


def symmetric_graph(n: int, edges: np.ndarray, lengths: np.ndarray) -> "scipy.sparse.csr_array":
    """``(n, n)`` lengths in both directions; those of length 0 are stored entries."""
    row, col = np.concatenate([edges[:, 0], edges[:, 1]]), np.concatenate([edges[:, 1], edges[:, 0]])
    return scipy.sparse.coo_array((np.concatenate([lengths, lengths]), (row, col)), shape=(n, n)).tocsr()
