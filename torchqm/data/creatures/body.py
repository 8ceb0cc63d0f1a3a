"""From a skeleton to a closed mesh with an exact permutation group (or to one that knows nothing of the symmetry)."""

from dataclasses import dataclass, replace

import numpy as np

from torchqm.data.creatures.edits import Patch, edge_table, flip, split
from torchqm.data.creatures.remesh import remesh, smooth
from torchqm.data.creatures.skeleton import Skeleton, reflection_group
from torchqm.data.creatures.surface import field, project, thickness

__all__ = ["Body", "is_sound", "mesh_asymmetrically", "mesh_symmetrically"]

_DIRECT = 6000  # meshes of more vertices (in the fundamental domain) are made by subdivision

_ATTEMPTS = 6  # grids that are tried
_TRIANGLE = 0.87  # area that one vertex of an even mesh stands for, in squared edge lengths


@dataclass(frozen=True, eq=False)
class Body:
    """A closed mesh with its symmetry group.

    Args:
        verts: ``(V, 3)``.
        faces: ``(F, 3)`` int64, outward.
        group: ``(G, V)`` int64 permutations, row 0 the identity.
        orientation: ``(G,)`` +1 for rotations, -1 for reflections.
    """

    verts: np.ndarray
    faces: np.ndarray
    group: np.ndarray
    orientation: np.ndarray


def _marching_cubes(skeleton: Skeleton, turn: np.ndarray, shift: np.ndarray, planes: np.ndarray, step: float) -> Patch:
    """Marching cubes on a turned grid that covers the body (or its part with ``planes @ x >= 0``, with a margin)."""
    from skimage.measure import marching_cubes

    low, high = skeleton.box
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3) @ turn
    lower, upper = corners.min(0) - 2 * step + shift * step, corners.max(0) + 3 * step
    if len(planes) and np.allclose(turn, np.eye(3)):
        for n in planes[np.abs(planes).max(1) == 1]:
            lower[np.argmax(n)] = -(2 + shift[np.argmax(n)]) * step
        if len(planes) == 2:  # a wedge in the quadrant x, z >= 0
            lower[0] = -(2 + shift[0]) * step
    blocks = np.ceil((upper - lower) / (4 * step)).astype(int)

    def points(index: np.ndarray) -> np.ndarray:
        return (lower + index * step) @ turn.T

    corner = np.stack(np.meshgrid(*(4 * np.arange(b) for b in blocks), indexing="ij"), -1).reshape(-1, 3)
    centre = points(corner + 1.5)
    inside = (centre @ planes.T > -6 * step).all(1)
    coarse = np.full(len(corner), 1.0)
    coarse[inside] = field(skeleton, centre[inside])[0]
    active = np.abs(coarse) < 5 * step  # a block's half diagonal and its neighbour: the gradient is about one
    fine = corner[active][:, None] + np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(1, 64, 3)
    fine = fine.reshape(-1, 3)
    values = np.sign(coarse).reshape(blocks).repeat(4, 0).repeat(4, 1).repeat(4, 2)
    values[tuple(fine.T)] = field(skeleton, points(fine))[0]
    verts, faces, _, _ = marching_cubes(np.clip(values, -1, 1), 0.0)
    verts = (lower + verts.astype(float) * step) @ turn.T
    faces = faces.astype(np.int64)
    a, b, c = verts[faces].transpose(1, 0, 2)
    if np.einsum("ni,ni->", np.cross(a, b), c) < 0:
        faces = faces[:, ::-1].copy()
    return Patch.bare(verts, faces, np.zeros(len(verts), dtype=np.int64))


def _cut(patch: Patch, planes: np.ndarray) -> Patch:
    """The part with ``planes @ x >= 0``; crossing triangles are cut exactly at the planes."""
    for bit, plane in enumerate(planes):
        side = patch.verts @ plane
        side[np.abs(side) < 1e-12] = 1e-12
        edges, sides, count = edge_table(patch.faces, len(patch.verts))
        s = side[edges]
        marked = s[:, 0] * s[:, 1] < 0
        ratio = (s[marked, 0] / (s[marked, 0] - s[marked, 1]))[:, None]
        old = len(patch.verts)
        boundary_mask = patch.mask
        patch = split(patch, marked, edges, sides, count)
        ends = patch.verts[edges[marked]]
        patch.verts[old:] = ends[:, 0] * (1 - ratio) + ends[:, 1] * ratio
        on_rim = (count[marked] == 1) * (boundary_mask[edges[marked, 0]] & boundary_mask[edges[marked, 1]])
        patch.mask[old:] = on_rim | (1 << bit)
        side = np.concatenate([side, np.zeros(len(patch.verts) - old)])
        keep = (side[patch.faces] >= 0).all(1)
        patch = replace(patch, faces=patch.faces[keep]).compact()
    return patch


def _largest_component(patch: Patch) -> Patch:
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    n = len(patch.verts)
    f = patch.faces
    graph = coo_matrix((np.ones(2 * len(f)), (np.r_[f[:, 0], f[:, 1]], np.r_[f[:, 1], f[:, 2]])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    keep = label[f[:, 0]] == np.bincount(label).argmax()
    return replace(patch, faces=f[keep]).compact()


def _stabilisers(planes: np.ndarray, matrices: np.ndarray) -> np.ndarray:
    """``(2**P, G)``: for each mask and element the first element of its coset modulo the mask's reflections."""
    g = len(matrices)
    products = np.einsum("gij,hjk->ghik", matrices, matrices).reshape(g * g, 1, 9)
    table = np.abs(products - matrices.reshape(1, g, 9)).max(2).argmin(1).reshape(g, g)
    out = np.empty((1 << len(planes), g), dtype=np.int64)
    for mask in range(1 << len(planes)):
        inside = reflection_group(planes[[i for i in range(len(planes)) if mask >> i & 1]])
        ids = [int(np.abs(matrices - m).max((1, 2)).argmin()) for m in inside]
        out[mask] = table[:, ids].min(1)
    return out


def _close(patch: Patch, planes: np.ndarray) -> Body:
    """All images of the patch, joined along the planes by their ids (not by distance)."""
    matrices = reflection_group(planes)
    g, n = len(matrices), len(patch.verts)
    canon = _stabilisers(planes, matrices)[patch.mask].T  # (G, n)
    key = canon * n + np.arange(n)
    unique, inverse = np.unique(key.reshape(-1), return_inverse=True)
    vertex = inverse.reshape(g, n)
    verts = np.einsum("nij,nj->ni", matrices[unique // n], patch.verts[unique % n])
    flipped = np.linalg.det(matrices) < 0
    faces = np.concatenate([vertex[i][patch.faces[:, ::-1] if flipped[i] else patch.faces] for i in range(g)])
    products = np.einsum("gij,hjk->ghik", matrices, matrices).reshape(g * g, 1, 9)
    table = np.abs(products - matrices.reshape(1, g, 9)).max(2).argmin(1).reshape(g, g)
    group = vertex[table[:, unique // n], unique % n]
    return Body(verts, faces, group, np.where(flipped, -1, 1).astype(np.int64))


def _size(patch: Patch, planes: np.ndarray) -> int:
    """Vertices of the closed mesh."""
    matrices = reflection_group(planes)
    orbit = np.array([len(np.unique(row)) for row in _stabilisers(planes, matrices)])
    return int(orbit[patch.mask].sum())


def _edge_length(skeleton: Skeleton, patch: Patch, n_verts: float, copies: int) -> tuple[float, float]:
    """Wanted edge length and the most that it may be in parts of the local radius, to get so many vertices."""
    corner = patch.verts[patch.faces]
    areas = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2 * copies
    radius = thickness(skeleton, corner.mean(1))
    for ratio in (1.1, 1.2, 1.35, 1.5, 1.7, 2.0):
        low, high = 1e-4, 4 * float(radius.max())
        for _ in range(40):
            edge = (low * high) ** 0.5
            expected = (areas / (_TRIANGLE * np.minimum(edge, ratio * radius) ** 2)).sum()
            low, high = (edge, high) if expected > n_verts else (low, edge)
        if high < 3.9 * radius.max():
            break
    return edge, ratio


def _fit(skeleton: Skeleton, patch: Patch, planes: np.ndarray, n_verts: int) -> Patch:
    """Remesh until the closed mesh has the wanted number of vertices within three percent."""

    def onto(x: np.ndarray, mask: np.ndarray, limit: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
        return project(skeleton, x, mask, limit, steps)

    def target(x: np.ndarray) -> np.ndarray:
        return np.minimum(edge, ratio * scale * thickness(skeleton, x))

    copies = len(reflection_group(planes))
    levels = 0
    while n_verts / copies / 4**levels > _DIRECT:
        levels += 1
    wanted = n_verts / 4**levels
    edge, ratio = _edge_length(skeleton, patch, wanted, copies)
    scale = 1.0
    patch = remesh(patch, target, onto, rounds=3)
    best, best_error = patch, np.inf
    for attempt in range(6):
        size = _size(patch, planes)
        error = abs(size / wanted - 1)
        if error < best_error:
            best, best_error = patch, error
        if error < 0.03:
            break
        # Edges between the two thresholds of the remesher stay as they are: push harder each time
        change = float(np.clip((size / wanted) ** (0.5 + 0.3 * attempt), 0.8, 1.25))
        edge, scale = edge * change, scale * change
        patch = remesh(replace(patch, verts=patch.verts.copy()), target, onto, rounds=2)
    patch = best
    for _ in range(levels):
        edges, sides, count = edge_table(patch.faces, len(patch.verts))
        patch = split(patch, np.ones(len(edges), dtype=bool), edges, sides, count)
        patch.verts, normal = onto(patch.verts, patch.mask, edge, 2)
        for _ in range(2):
            patch, _ = flip(patch)
            normal = smooth(patch, normal, onto, edge)
    patch.verts, _ = onto(patch.verts, patch.mask, edge, 3)
    return patch


def _grid_step(skeleton: Skeleton, n_verts: int) -> float:
    """Fine enough for the thinnest limb; coarser where the mesh is to be coarse anyway."""
    thin = min(float(c.point_radii.min() / np.linalg.svd(c.metric, compute_uv=False).max()) for c in skeleton.chains)
    return float(np.clip(1.8 * thin, np.clip(1.6 / np.sqrt(n_verts), 0.018, 0.034), 0.034))


def is_sound(verts: np.ndarray, faces: np.ndarray) -> bool:
    """Closed, manifold edges, genus 0 and no triangle with an angle below about 3 degrees."""
    edges, _, count = edge_table(faces, len(verts))
    a, b, c = verts[faces].transpose(1, 0, 2)
    longest = np.max([((b - a) ** 2).sum(1), ((c - b) ** 2).sum(1), ((a - c) ** 2).sum(1)], axis=0)
    sliver = np.linalg.norm(np.cross(b - a, c - a), axis=1) < 0.05 * longest
    return bool((count == 2).all()) and len(verts) - len(edges) + len(faces) == 2 and not sliver.any()


def mesh_symmetrically(skeleton: Skeleton, n_verts: int) -> Body:
    """Mesh the fundamental domain and copy it by the group.

    Args:
        skeleton: the body.
        n_verts: wanted number of vertices.

    Returns:
        The closed mesh with its group.

    Raises:
        RuntimeError: if no grid gives a sound mesh (so coarse that a limb is lost).
    """
    planes = skeleton.planes
    for attempt in range(_ATTEMPTS):
        shift = np.array([0.37, 0.41, 0.29]) * (1 - 0.17 * attempt)
        patch = _marching_cubes(skeleton, np.eye(3), shift, planes, _grid_step(skeleton, n_verts))
        patch = _largest_component(_cut(patch, planes))
        body = _close(_fit(skeleton, patch, planes, n_verts), planes)
        if is_sound(body.verts, body.faces):
            return body
    raise RuntimeError(f"the {skeleton.kind} could not be meshed with {n_verts} vertices")


def mesh_asymmetrically(skeleton: Skeleton, n_verts: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mesh the whole surface on a turned and shifted grid, without regard to its symmetry.

    Args:
        skeleton: the body.
        n_verts: wanted number of vertices.
        seed: draws the grid.

    Returns:
        Vertices ``(V, 3)`` and faces ``(F, 3)``.

    Raises:
        RuntimeError: if no grid gives a sound mesh (so coarse that a limb is lost).
    """
    rng = np.random.default_rng(seed)
    none = np.zeros((0, 3))
    for _ in range(_ATTEMPTS):
        turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        turn[:, 0] *= np.sign(np.linalg.det(turn))
        patch = _marching_cubes(skeleton, turn, rng.random(3), none, 0.95 * _grid_step(skeleton, n_verts))
        patch = _fit(skeleton, _largest_component(patch), none, n_verts)
        if is_sound(patch.verts, patch.faces):
            return patch.verts, patch.faces
    raise RuntimeError(f"the {skeleton.kind} could not be meshed with {n_verts} vertices")
