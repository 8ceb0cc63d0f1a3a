"""Closest points on a triangle mesh, as face and barycentric coordinates."""

from collections.abc import Callable

import numpy as np
import scipy

__all__ = ["closest_points", "normal_points"]

_CHUNK = 20000


def _closest_on_triangles(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Barycentric coordinates ``(N, 3)`` of the point of each triangle that is nearest to its query."""
    u, v, w = b - a, c - a, p - a
    uu, uv, vv = (u * u).sum(1), (u * v).sum(1), (v * v).sum(1)
    wu, wv = (w * u).sum(1), (w * v).sum(1)
    det = np.maximum(uu * vv - uv * uv, 1e-300)
    s, t = (vv * wu - uv * wv) / det, (uu * wv - uv * wu) / det
    inner = np.stack([1 - s - t, s, t], 1)
    outside = np.flatnonzero(inner.min(1) < 0)
    if len(outside):
        corner = np.stack([a[outside], b[outside], c[outside]], 1)
        q = p[outside]
        best = np.full(len(outside), np.inf)
        for k in range(3):
            x, e = corner[:, k], corner[:, (k + 1) % 3] - corner[:, k]
            r = np.clip(((q - x) * e).sum(1) / np.maximum((e * e).sum(1), 1e-300), 0, 1)
            d = ((q - x - r[:, None] * e) ** 2).sum(1)
            win = d < best
            best[win] = d[win]
            rows = outside[win]
            inner[rows] = 0.0
            inner[rows, k], inner[rows, (k + 1) % 3] = 1 - r[win], r[win]
    return inner


def _candidates(verts: np.ndarray, faces: np.ndarray) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """A function from points to (row, face) pairs: all faces around the four vertices nearest to each point."""
    order = np.argsort(faces.reshape(-1), kind="stable")
    ring = order // 3
    start = np.concatenate([[0], np.cumsum(np.bincount(faces.reshape(-1), minlength=len(verts)))])
    tree = scipy.spatial.cKDTree(verts)

    def pairs(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        near = tree.query(q, k=4)[1].reshape(-1)
        number = start[near + 1] - start[near]
        owner = np.repeat(np.arange(len(near)) // 4, number)
        inside = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        key = np.unique(owner * len(faces) + ring[np.repeat(start[near], number) + inside])
        return key // len(faces), key % len(faces)

    return pairs


def closest_points(verts: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest point of a mesh to each query.

    The triangles around the four nearest vertices are tried, which is exact for meshes of even edge length and queries
    closer to the surface than an edge.

    Args:
        verts: ``(V, 3)``.
        faces: ``(F, 3)``.
        points: ``(N, 3)`` queries.

    Returns:
        Faces ``(N,)`` int64 and barycentric coordinates ``(N, 3)``, not negative, with sum 1.
    """
    pairs = _candidates(verts, faces)
    out_face = np.empty(len(points), dtype=np.int64)
    out_bary = np.empty((len(points), 3))
    for begin in range(0, len(points), _CHUNK):
        q = points[begin : begin + _CHUNK]
        owner, face = pairs(q)
        corner = verts[faces[face]]
        bary = _closest_on_triangles(q[owner], corner[:, 0], corner[:, 1], corner[:, 2])
        gap = ((q[owner] - np.einsum("nk,nki->ni", bary, corner)) ** 2).sum(1)
        best = _first_of_each(owner, gap)
        out_face[begin : begin + _CHUNK] = face[best]
        out_bary[begin : begin + _CHUNK] = bary[best]
    return out_face, out_bary


def _first_of_each(owner: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """For each owner (0 .. N - 1) the row of least cost."""
    order = np.lexsort((cost, owner))
    return order[np.r_[True, np.diff(owner[order]) > 0]]


def normal_points(
    verts: np.ndarray, faces: np.ndarray, normals: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The point of a mesh from which the interpolated normal leads to each query.

    Solves ``x = p(b) + t n(b)`` with vertex positions and normals interpolated linearly in each triangle. Unlike the
    nearest point this does not gather the queries on convex edges, so that a mesh stays a mesh when its vertices are
    moved there. Where there is no solution the nearest point is taken.

    Args:
        verts: ``(V, 3)``.
        faces: ``(F, 3)``.
        normals: ``(V, 3)`` unit normals of the smooth surface at the vertices.
        points: ``(N, 3)`` queries near the surface.

    Returns:
        Faces ``(N,)`` int64 and barycentric coordinates ``(N, 3)``, not negative, with sum 1.

    References:
        Panozzo et al.: Weighted Averages on Surfaces, SIGGRAPH 2013, section 4 (Phong projection).
    """
    pairs = _candidates(verts, faces)
    out_face, out_bary = closest_points(verts, faces, points)
    for begin in range(0, len(points), _CHUNK):
        q = points[begin : begin + _CHUNK]
        owner, face = pairs(q)
        p, n, x = verts[faces[face]], normals[faces[face]], q[owner]
        unknown = np.tile([1 / 3, 1 / 3, 0.0], (len(face), 1))
        for _ in range(6):
            bary = np.concatenate([1 - unknown[:, :2].sum(1, keepdims=True), unknown[:, :2]], 1)
            t = unknown[:, 2:]
            base, normal = np.einsum("nk,nki->ni", bary, p), np.einsum("nk,nki->ni", bary, n)
            columns = [p[:, k] - p[:, 0] + t * (n[:, k] - n[:, 0]) for k in (1, 2)] + [normal]
            matrix = np.stack(columns, 2)
            matrix += 1e-12 * np.abs(matrix).max((1, 2))[:, None, None] * np.eye(3)
            step = np.linalg.solve(matrix, (x - base - t * normal)[:, :, None])[:, :, 0]
            unknown += np.clip(step, -1, 1)
        bary = np.concatenate([1 - unknown[:, :2].sum(1, keepdims=True), unknown[:, :2]], 1)
        size = np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
        found = (bary.min(1) > -1e-6) & (np.abs(step).max(1) < 1e-6) & (np.abs(unknown[:, 2]) < size)
        rows = np.flatnonzero(found)
        if len(rows) == 0:
            continue
        numbers, compact = np.unique(owner[rows], return_inverse=True)
        best = rows[_first_of_each(compact, np.abs(unknown[rows, 2]))]
        bary = np.maximum(bary[best], 0)
        out_face[begin + numbers] = face[best]
        out_bary[begin + numbers] = bary / bary.sum(1, keepdims=True)
    return out_face, out_bary
