"""Which triangles, edges and vertices hang together: the array work behind the mesh check."""

from dataclasses import dataclass

import numpy as np
import scipy

__all__ = [
    "EdgeTable",
    "component_areas",
    "components",
    "count_nonmanifold_verts",
    "edge_table",
    "equal_positions",
    "face_masks",
    "orient",
    "triangle_shapes",
]


@dataclass(frozen=True)
class EdgeTable:
    """Half-edges sorted by the edge they belong to.

    Args:
        edges: ``(E, 2)`` vertex ids, smaller one first, sorted.
        start: ``(E,)`` where the half-edges of each edge begin in the arrays below.
        count: ``(E,)`` how many there are: triangles of the edge.
        face: ``(3F,)`` triangle of each half-edge.
        corner: ``(3F,)`` which corner of the triangle it leaves from.
        forward: ``(3F,)`` whether it runs from the smaller id to the larger.
    """

    edges: np.ndarray
    start: np.ndarray
    count: np.ndarray
    face: np.ndarray
    corner: np.ndarray
    forward: np.ndarray

    @property
    def pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """The two half-edges of each edge that has exactly two."""
        first = self.start[self.count == 2]
        return first, first + 1

    @property
    def oriented(self) -> bool:
        """Whether the two triangles of such an edge always run along it in opposite directions."""
        a, b = self.pairs
        return bool((self.forward[a] != self.forward[b]).all())


def edge_table(faces: np.ndarray, n_verts: int) -> EdgeTable:
    """Sort the half-edges of ``(F, 3)`` faces (three different corners each) by edge."""
    tail, head = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    keys = low * n_verts + high
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    start = np.flatnonzero(_run_starts(keys))
    count = np.diff(np.append(start, len(keys)))
    edges = np.stack([low[order[start]], high[order[start]]], axis=1)
    return EdgeTable(edges, start, count, order // 3, order % 3, (tail < head)[order])


def face_masks(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of ``(F, 3)`` faces have three different corners, and which are the first with their set of corners."""
    low, high = faces.min(1), faces.max(1)
    mid = faces.sum(1) - low - high
    distinct = (low != mid) & (mid != high)
    first = np.ones(len(faces), dtype=bool)
    order = np.lexsort((high, mid, low))
    first[order] = _run_starts(low[order], mid[order], high[order])  # lexsort is stable: the earliest leads its run
    return distinct, first


def triangle_shapes(verts: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Area, height over the longest edge as a share of that edge, and smallest angle (radians) of each triangle."""
    a, b, c = verts[faces[:, 0]], verts[faces[:, 1]], verts[faces[:, 2]]
    sides = (b - c, c - a, a - b)
    squares = np.stack([np.einsum("fi,fi->f", side, side) for side in sides])
    double_area = np.linalg.norm(np.cross(sides[0], sides[1]), axis=1)
    short, long = squares.min(0), squares.max(0)
    # The smallest angle lies opposite the shortest side; 2 <u, v> = |u|^2 + |v|^2 - |u - v|^2 gives its cosine.
    angle = np.arctan2(double_area, (squares.sum(0) - 2 * short) / 2)
    height = np.divide(double_area, long, out=np.zeros_like(long), where=long > 0)
    return double_area / 2, height, np.where(long > 0, angle, 0.0)


def components(n: int, rows: np.ndarray, cols: np.ndarray) -> tuple[int, np.ndarray]:
    """Number of connected pieces of an undirected graph on ``n`` nodes, and the piece of each node."""
    graph = scipy.sparse.coo_array((np.ones(len(rows), dtype=np.int8), (rows, cols)), shape=(n, n)).tocsr()
    count, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return int(count), label


def component_areas(n_verts: int, edges: np.ndarray, faces: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Area of each connected piece that has a face, largest first."""
    if len(faces) == 0:
        return np.zeros(0)
    count, label = components(n_verts, edges[:, 0], edges[:, 1])
    of_face = label[faces[:, 0]]
    total = np.bincount(of_face, weights=areas, minlength=count)
    return np.sort(total[np.unique(of_face)])[::-1]


def count_nonmanifold_verts(faces: np.ndarray, table: EdgeTable, n_verts: int) -> int:
    """Vertices whose triangles form more than one fan, that is whose corners do not all hang together through edges."""
    if len(faces) == 0:
        return 0
    inside = np.ones(len(table.face), dtype=bool)
    inside[table.start] = False
    later = np.flatnonzero(inside)  # each half-edge that follows another one of the same edge ...
    earlier = later - 1  # ... is linked with it, at both ends of the edge
    here, there = 3 * table.face + table.corner, 3 * table.face + (table.corner + 1) % 3
    low, high = np.where(table.forward, here, there), np.where(table.forward, there, here)
    rows, cols = np.concatenate([low[earlier], high[earlier]]), np.concatenate([low[later], high[later]])
    count, fan = components(3 * len(faces), rows, cols)
    owner = np.zeros(count, dtype=np.int64)
    owner[fan] = faces.reshape(-1)  # all corners of a fan belong to the same vertex
    return int((np.bincount(owner, minlength=n_verts) > 1).sum())


def orient(faces: np.ndarray, n_verts: int) -> np.ndarray | None:
    """Turn over some faces so that neighbours agree, as few as possible in each piece; None where that cannot be."""
    table, count = edge_table(faces, n_verts), len(faces)
    if count == 0 or table.oriented:
        return faces
    # Two copies of each triangle, one turned over; neighbours that agree join like copies, others join unlike ones.
    # The surface is orientable if and only if no triangle is then connected with its own turned copy.
    a, b = table.pairs
    agree = table.forward[a] != table.forward[b]
    rows = np.concatenate([table.face[a], table.face[a] + count])
    cols = np.concatenate([table.face[b] + count * ~agree, table.face[b] + count * agree])
    n_labels, label = components(2 * count, rows, cols)
    plain, turned = label[:count], label[count:]
    if (plain == turned).any():
        return None
    # A piece comes out twice, with the copies swapped: keep the one with more unturned triangles.
    votes = np.bincount(plain, minlength=n_labels)
    turn = (votes[plain] < votes[turned]) | ((votes[plain] == votes[turned]) & (plain > turned))
    return np.where(turn[:, None], faces[:, [0, 2, 1]], faces)


def equal_positions(verts: np.ndarray) -> np.ndarray:
    """For each vertex the smallest id that has exactly its position (0.0 and -0.0 are the same)."""
    order = np.lexsort(verts.T)
    new = _run_starts(*verts[order].T)
    out = np.empty(len(verts), dtype=np.int64)
    out[order] = order[np.flatnonzero(new)][np.cumsum(new) - 1]  # lexsort is stable: the smallest id leads its run
    return out


def _run_starts(*columns: np.ndarray) -> np.ndarray:
    """Where a sorted table differs from the row before."""
    new = np.ones(len(columns[0]), dtype=bool)
    new[1:] = np.logical_or.reduce([c[1:] != c[:-1] for c in columns])
    return new
