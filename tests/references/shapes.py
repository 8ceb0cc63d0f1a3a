"""Shapes whose spectrum or symmetry group is known exactly."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from torchqm.geometry import Mesh
from torchqm.spectral import SpectralBasis, mesh_basis
from torchqm.symmetry import SymmetryGroup


class Shape(NamedTuple):
    mesh: Mesh
    group: SymmetryGroup


@lru_cache
def icosphere(level: int = 3) -> Mesh:
    """Unit sphere; eigenvalues of the smooth one are l (l + 1), each 2 l + 1 times."""
    sphere = trimesh.creation.icosphere(subdivisions=level)
    return Mesh.from_arrays(sphere.vertices, sphere.faces, f"sphere{level}")


def permutation_of(verts: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """The vertex permutation of an orthogonal map that sends the vertex set to itself."""
    distance, permutation = cKDTree(verts).query(verts @ linear.T)
    assert distance.max() < 1e-10
    assert np.unique(permutation).size == len(verts)
    return permutation


def group_of(verts: np.ndarray, linears: Sequence[np.ndarray]) -> SymmetryGroup:
    return SymmetryGroup(torch.from_numpy(np.stack([permutation_of(verts, m) for m in linears])))


@lru_cache
def blob(order: int = 2, level: int = 3) -> Shape:
    """A bumpy ellipsoid with ``order`` exact symmetries: mirrors in x (2), x and y (4), x, y and z (8); or none (1)."""
    ball = icosphere(level)
    x, y, z = ball.verts.T.numpy()
    n_planes = {1: 0, 2: 1, 4: 2, 8: 3}[order]
    odd = [1.0] * 3
    odd[:n_planes] = [0.0] * n_planes
    radius = 1 + 0.2 * np.sin(2 * x * x + 3 * y * y) + 0.15 * np.cos(3 * z * z - 2 * x * x)
    radius = radius + odd[0] * (0.25 * x + 0.2 * x**3 - 0.3 * x * y)
    radius = radius + odd[1] * (0.2 * y + 0.1 * y**3) + odd[2] * (0.25 * z + odd[1] * 0.2 * y * z + 0.15 * z**3)
    verts = np.stack([x, 0.75 * y, 1.35 * z], 1) * radius[:, None]
    # The undeformed ball's exact permutations: the deformation is even, so it keeps them.
    signs = [s + (1,) * (3 - n_planes) for s in product((1, -1), repeat=n_planes)]
    group = group_of(ball.verts.numpy(), [np.diag(s) for s in signs])
    return Shape(Mesh.from_arrays(verts, ball.faces, f"blob{order}"), group)


@lru_cache
def box(cells: tuple[int, int, int] = (7, 5, 4), size: tuple[float, float, float] = (1.4, 1.0, 0.8)) -> Shape:
    """A cuboid; each cell is cut into four triangles around its middle, so that every symmetry of the cuboid is exact.

    With two equal sides (cells and lengths) the group has 16 elements and two-dimensional eigenspaces, else 8.
    """
    ids: dict[tuple[int, ...], int] = {}
    faces = []

    def vertex(place: tuple[int, ...]) -> int:
        return ids.setdefault(place, len(ids))  # in half cells

    for axis, side in product(range(3), (0, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for i, j in product(range(cells[u]), range(cells[v])):
            corners = []
            for du, dv in ((0, 0), (2, 0), (2, 2), (0, 2), (1, 1)):
                place = [0, 0, 0]
                place[axis], place[u], place[v] = 2 * cells[axis] * side, 2 * i + du, 2 * j + dv
                corners.append(vertex(tuple(place)))
            ring = corners[:4] if side else corners[3::-1]
            faces += [[ring[k], ring[(k + 1) % 4], corners[4]] for k in range(4)]
    centred = (np.array(list(ids), dtype=float) / (2 * np.array(cells)) - 0.5) * size
    linears = [np.diag(s).astype(float) for s in product((1, -1), repeat=3)]
    if cells[0] == cells[1] and size[0] == size[1]:
        swap = np.eye(3)[[1, 0, 2]]
        linears += [m @ swap for m in linears]
    return Shape(Mesh.from_arrays(centred, faces, "box"), group_of(centred, linears))


def prism() -> Shape:
    """A square prism: 16 symmetries, pairs of equal eigenvalues."""
    return box((5, 5, 6), (1.0, 1.0, 1.3))


@lru_cache
def grid(n: int, m: int, a: float = 1.0, b: float = 1.0) -> Mesh:
    """A flat rectangle ``[0, a] x [0, b]`` of ``n x m`` cells with parallel diagonals."""
    x, y = np.meshgrid(np.linspace(0, a, n + 1), np.linspace(0, b, m + 1), indexing="ij")
    at = np.arange((n + 1) * (m + 1)).reshape(n + 1, m + 1)
    p, q, r, s = at[:-1, :-1].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel(), at[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([p, q, r], 1), np.stack([p, r, s], 1)])
    return Mesh.from_arrays(np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1), faces, "grid")


def neumann_spectrum(k: int, a: float, b: float) -> np.ndarray:
    """The ``k`` lowest ``pi^2 (m^2 / a^2 + n^2 / b^2)``."""
    m, n = np.meshgrid(np.arange(k), np.arange(k))
    return np.sort((np.pi**2 * (m**2 / a**2 + n**2 / b**2)).ravel())[:k]


@lru_cache
def basis_of(mesh: Mesh, k: int) -> SpectralBasis:
    return mesh_basis(mesh, k)


class Copy(NamedTuple):
    """A renumbered copy ``y`` of a shape and the exact isometry between the two, as vertex maps both ways."""

    shape: Shape
    basis: SpectralBasis
    p2p_yx: torch.Tensor
    p2p_xy: torch.Tensor


def renumbered(shape: Shape, k: int, seed: int = 0) -> Copy:
    """The shape with its vertices in another order, its own eigenbasis computed afresh."""
    mesh, group = shape
    p2p_yx = torch.randperm(mesh.n_verts, generator=torch.Generator().manual_seed(seed))
    p2p_xy = torch.argsort(p2p_yx)
    copy = Mesh(mesh.verts[p2p_yx], p2p_xy[mesh.faces], "copy")
    return Copy(Shape(copy, SymmetryGroup(p2p_xy[group.maps[:, p2p_yx]])), mesh_basis(copy, k), p2p_yx, p2p_xy)


def rotation(seed: int) -> torch.Tensor:
    """A random proper rotation."""
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return torch.from_numpy(q * np.linalg.det(q))
