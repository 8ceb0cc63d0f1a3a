"""A triangle mesh as two tensors and the quantities that follow from them."""

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["Mesh"]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; vertex ids are kept exactly as they were given, also of unreferenced vertices.

    Args:
        verts: ``(V, 3)`` float64 positions.
        faces: ``(F, 3)`` int64 vertex ids, 0-based.
        name: what messages call the shape (usually the file's stem).
        path: the file it came from, if any; error messages name it.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
        >>> mesh.area
        0.5
    """

    verts: Float[Tensor, "V 3"]
    faces: Int[Tensor, "F 3"]
    name: str = "mesh"
    path: Path | None = None

    @classmethod
    def from_arrays(cls, verts: object, faces: object, name: str = "mesh", path: Path | None = None) -> "Mesh":
        """Build a mesh from anything ``numpy.asarray`` or torch understands (positions become float64, ids int64)."""
        return cls(
            torch.as_tensor(np.ascontiguousarray(np.asarray(verts), dtype=np.float64)),
            torch.as_tensor(np.ascontiguousarray(np.asarray(faces), dtype=np.int64)).reshape(-1, 3),
            name,
            path,
        )

    @property
    def label(self) -> str:
        """What an error message calls this mesh: its file if it has one, else its name."""
        return str(self.path) if self.path is not None else self.name

    @property
    def n_verts(self) -> int:
        """Number of vertices V, unreferenced ones included."""
        return int(self.verts.shape[0])

    @property
    def n_faces(self) -> int:
        """Number of triangles F."""
        return int(self.faces.shape[0])

    def numpy(self) -> tuple[np.ndarray, np.ndarray]:
        """The two arrays ``verts (V, 3) float64`` and ``faces (F, 3) int64``, sharing memory with the tensors."""
        return self.verts.numpy(), self.faces.numpy()

    @cached_property
    def face_vectors(self) -> Float[Tensor, "F 3"]:
        """Cross products of two edges of each face: twice the area times the unit normal."""
        a, b, c = self.verts[self.faces].unbind(1)
        return torch.linalg.cross(b - a, c - a)

    @cached_property
    def face_areas(self) -> Float[Tensor, " F"]:
        """Area of each triangle, in squared units of ``verts``."""
        return self.face_vectors.norm(dim=1) / 2

    @cached_property
    def area(self) -> float:
        """Total surface area."""
        return float(self.face_areas.sum())

    @cached_property
    def vertex_areas(self) -> Float[Tensor, " V"]:
        """Lumped (barycentric) vertex areas: a third of the area of the triangles around each vertex."""
        out = torch.zeros(self.n_verts, dtype=self.verts.dtype)
        return out.index_add_(0, self.faces.reshape(-1), (self.face_areas / 3).repeat_interleave(3))

    @cached_property
    def face_normals(self) -> Float[Tensor, "F 3"]:
        """Unit normal of each face (zero where the triangle is degenerate)."""
        return torch.nn.functional.normalize(self.face_vectors, dim=1, eps=1e-300)

    @cached_property
    def edges(self) -> Int[Tensor, "E 2"]:
        """Undirected edges, each once, smaller id first, sorted; an edge from a vertex to itself is left out."""
        directed = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        low, high = directed.min(1).values, directed.max(1).values
        keys = torch.unique(low[low != high] * self.n_verts + high[low != high])
        return torch.stack([keys // self.n_verts, keys % self.n_verts], dim=1)

    @cached_property
    def edge_lengths(self) -> Float[Tensor, " E"]:
        """Euclidean length of each row of :attr:`edges`."""
        return (self.verts[self.edges[:, 0]] - self.verts[self.edges[:, 1]]).norm(dim=1)

    @cached_property
    def referenced(self) -> torch.Tensor:
        """``(V,)`` bool: which vertices some face uses."""
        out = torch.zeros(self.n_verts, dtype=torch.bool)
        out[self.faces.reshape(-1)] = True
        return out

    def normalized(self) -> "Mesh":
        """The same mesh moved to its area-weighted centroid and scaled to total area 1."""
        scale = float((self.verts - self.verts[0]).abs().max())
        small = replace(self, verts=(self.verts - self.verts[0]) / scale)  # 1e+-200 must not overflow when squared
        corners = small.verts[small.faces].mean(1)
        centre = (corners * small.face_areas[:, None]).sum(0) / small.area
        return replace(self, verts=(small.verts - centre) / small.area**0.5)

    def moved(self, verts: Float[Tensor, "V 3"]) -> "Mesh":
        """The same triangles at other positions."""
        return replace(self, verts=verts)

    def __repr__(self) -> str:
        return f"Mesh({self.label}: {self.n_verts} vertices, {self.n_faces} faces)"
