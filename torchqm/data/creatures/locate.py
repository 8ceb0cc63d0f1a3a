"""Closest points on a triangle mesh, as face and barycentric coordinates."""

import numpy as np
from scipy.spatial import cKDTree

__all__ = ["closest_points"]

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
    order = np.argsort(faces.reshape(-1), kind="stable")
    ring = order // 3
    start = np.concatenate([[0], np.cumsum(np.bincount(faces.reshape(-1), minlength=len(verts)))])
    tree = cKDTree(verts)
    out_face = np.empty(len(points), dtype=np.int64)
    out_bary = np.empty((len(points), 3))
    for begin in range(0, len(points), _CHUNK):
        q = points[begin : begin + _CHUNK]
        near = tree.query(q, k=min(4, len(verts)))[1].reshape(-1)
        number = start[near + 1] - start[near]
        owner = np.repeat(np.arange(len(near)) // min(4, len(verts)), number)
        inside = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number)
        pairs = np.unique(owner * len(faces) + ring[np.repeat(start[near], number) + inside])
        owner, face = pairs // len(faces), pairs % len(faces)
        corner = verts[faces[face]]
        bary = _closest_on_triangles(q[owner], corner[:, 0], corner[:, 1], corner[:, 2])
        gap = ((q[owner] - np.einsum("nk,nki->ni", bary, corner)) ** 2).sum(1)
        first = np.lexsort((gap, owner))
        first = first[np.r_[True, np.diff(owner[first]) > 0]]
        out_face[begin : begin + _CHUNK] = face[first]
        out_bary[begin : begin + _CHUNK] = bary[first]
    return out_face, out_bary
