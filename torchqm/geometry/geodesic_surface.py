"""The part of a mesh that geodesic solvers see, and what they need of it."""

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
        self._oriented: np.ndarray | None = None
        self._why_not: str | None = None
        self._known = False

    @property
    def compact(self) -> Mesh:
        """The same part as a mesh of its own."""
        return Mesh(torch.from_numpy(self.verts), torch.from_numpy(self.faces), self._name, self._path)

    @property
    def why_not_marching(self) -> str | None:
        """Why fast marching cannot run here, or None."""
        if not self._known:
            self._known = True
            report = inspect_mesh(self.compact) if self.n else None
            if report is not None and not report.manifold:
                self._why_not = (
                    f"fast marching needs a manifold ({report.n_nonmanifold_edges} non-manifold edges, "
                    f"{report.n_nonmanifold_verts} non-manifold vertices)"
                )
            elif report is not None and report.oriented:
                self._oriented = self.faces
            else:
                oriented = orient_faces(self.compact)
                self._oriented = None if oriented is None else oriented.numpy()
                if oriented is None:
                    self._why_not = "fast marching needs an orientable surface"
        return self._why_not

    def marching_solver(self) -> tuple[Any, int]:
        """A potpourri3d solver, and how many of its vertices are real (the first ones)."""
        import potpourri3d

        if self.why_not_marching is not None or self._oriented is None:
            raise ValueError(f"{self.label}: {self.why_not_marching}")
        # potpourri3d 1.4 never walks along a boundary edge against its only half-edge, which makes distances near a
        # boundary too long. A flap on every boundary edge, the parallelogram point of its triangle, gives it the other
        # half-edge; a path over the flap is longer than the edge itself, so no distance gets shorter.
        faces = self._oriented
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
