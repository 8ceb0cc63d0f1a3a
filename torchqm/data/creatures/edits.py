"""Edits of a surface patch that change its triangles: split, collapse and flip, each as one array operation."""

from dataclasses import dataclass, replace

import numpy as np
import scipy

__all__ = ["OPPOSITE", "Patch", "collapse", "edge_lengths", "edge_table", "face_vectors", "flip", "split"]

OPPOSITE = -0.2  # an edge whose normals have a smaller cosine cuts off a limb's end


@dataclass
class Patch:
    """A triangle mesh whose boundary lies on mirror planes.

    Args:
        verts: ``(V, 3)`` positions.
        faces: ``(F, 3)`` int64.
        mask: ``(V,)`` int64, bit ``i``: the vertex lies on plane ``i`` (0 in the interior).
        target: ``(V,)`` wanted edge length around each vertex.
        normal: ``(V, 3)`` unit normals of the smooth surface.
    """

    verts: np.ndarray
    faces: np.ndarray
    mask: np.ndarray
    target: np.ndarray
    normal: np.ndarray

    @classmethod
    def bare(cls, verts: np.ndarray, faces: np.ndarray, mask: np.ndarray) -> "Patch":
        """A patch for which no edge length is wanted yet."""
        return cls(verts, faces, mask, np.zeros(len(verts)), np.zeros_like(verts))

    def edge_targets(self, edges: np.ndarray) -> np.ndarray:
        """Wanted length of each edge."""
        return self.target[edges].mean(1)

    def compact(self) -> "Patch":
        """Without the vertices that no face uses."""
        used = np.zeros(len(self.verts), dtype=bool)
        used[self.faces] = True
        new_id = np.cumsum(used) - 1
        return Patch(self.verts[used], new_id[self.faces], self.mask[used], self.target[used], self.normal[used])


def edge_table(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges ``(E, 2)``, the edge of each face's side k from corner k to k + 1 ``(F, 3)``, faces per edge ``(E,)``."""
    a, b = faces, np.roll(faces, -1, axis=1)
    key = np.minimum(a, b) * n + np.maximum(a, b)
    unique, inverse, count = np.unique(key.reshape(-1), return_inverse=True, return_counts=True)
    return np.stack([unique // n, unique % n], axis=1), inverse.reshape(faces.shape), count


def edge_lengths(verts: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Length of each edge."""
    return np.linalg.norm(verts[edges[:, 0]] - verts[edges[:, 1]], axis=1)


def face_vectors(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Cross products of two sides of each face, ``(F, 3)``."""
    a, b, c = verts[faces[:, 0]], verts[faces[:, 1]], verts[faces[:, 2]]
    return np.cross(b - a, c - a)


def split(patch: Patch, marked: np.ndarray, edges: np.ndarray, sides: np.ndarray, count: np.ndarray) -> Patch:
    """Split the marked edges at their midpoints; a face with 1, 2 or 3 of them becomes 2, 3 or 4 faces."""
    n = len(patch.verts)
    ends = edges[marked]
    middle = patch.verts[ends].mean(1)
    on = np.where(count[marked] == 1, patch.mask[ends[:, 0]] & patch.mask[ends[:, 1]], 0)
    new_id = np.full(len(edges), -1)
    new_id[marked] = n + np.arange(len(ends))
    verts = np.concatenate([patch.verts, middle])
    f, m = patch.faces, new_id[sides]
    hit = m >= 0
    number = hit.sum(1)
    first = np.where(number == 1, np.argmax(hit, 1), np.where(number == 2, (np.argmin(hit, 1) + 1) % 3, 0))
    turn = (first[:, None] + np.arange(3)) % 3
    f, m = np.take_along_axis(f, turn, 1), np.take_along_axis(m, turn, 1)
    out = [f[number == 0]]
    (a, b, c), (p, _, _) = f[number == 1].T, m[number == 1].T
    out += [np.stack([a, p, c], 1), np.stack([p, b, c], 1)]
    (a, b, c), (p, q, _) = f[number == 2].T, m[number == 2].T
    short = np.linalg.norm(verts[a] - verts[q], axis=1) <= np.linalg.norm(verts[p] - verts[c], axis=1)
    out += [np.stack([p, b, q], 1)]
    out += [np.stack([a, p, q], 1)[short], np.stack([a, q, c], 1)[short]]
    out += [np.stack([a, p, c], 1)[~short], np.stack([p, q, c], 1)[~short]]
    (a, b, c), (p, q, r) = f[number == 3].T, m[number == 3].T
    out += [np.stack(t, 1) for t in ((a, p, r), (p, b, q), (r, q, c), (p, q, r))]
    target = np.concatenate([patch.target, patch.edge_targets(ends)])
    normal = np.concatenate([patch.normal, patch.normal[ends].mean(1)])
    return Patch(verts, np.concatenate(out), np.concatenate([patch.mask, on]), target, normal)


def chords(mask: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Inner edges ``(C, 2)`` that join two vertices of one mirror plane: the closed mesh would have them twice."""
    rim = faces[(mask[faces] > 0).sum(1) >= 2]
    edges, _, count = edge_table(rim, len(mask))
    return edges[(count == 2) & (mask[edges[:, 0]] & mask[edges[:, 1]] > 0)]


def collapse(patch: Patch, cosine: float, salt: int) -> tuple[Patch, int]:
    """Collapse short edges that are far from each other, where this keeps topology, planes and orientation."""
    n = len(patch.verts)
    edges, _, count = edge_table(patch.faces, n)
    length = edge_lengths(patch.verts, edges)
    short = 0.8 * patch.edge_targets(edges)
    a, b = edges.T
    ma, mb = patch.mask[a], patch.mask[b]
    keep_a, keep_b = (ma & mb) == mb, (ma & mb) == ma  # the planes of the kept end must contain the other's
    boundary = count == 1
    lean = _is_lean(patch, edges)
    keep_a, keep_b = (
        keep_a & (lean[b] | ~lean[a]),
        keep_b & (lean[a] | ~lean[b]),
    )  # a vertex of three faces is the one to go
    allowed = (keep_a | keep_b) & (boundary | (ma == 0) | (mb == 0)) & ((length < short) | (lean[a] ^ lean[b]))
    ids = np.flatnonzero(allowed)
    if len(ids) == 0:
        return patch, 0
    rank = np.full(len(edges), np.iinfo(np.int64).max)
    rank[ids] = np.random.default_rng(salt).permutation(len(ids))
    best = np.full(n, np.iinfo(np.int64).max)
    np.minimum.at(best, edges[ids].reshape(-1), np.repeat(rank[ids], 2))
    near = best.copy()
    np.minimum.at(near, a, best[b])
    np.minimum.at(near, b, best[a])
    ids = ids[(near[a[ids]] == rank[ids]) & (near[b[ids]] == rank[ids])]
    adjacency = scipy.sparse.csr_matrix(
        (np.ones(2 * len(edges), dtype=np.int32), (np.r_[a, b], np.r_[b, a])), shape=(n, n)
    )
    common = adjacency[a[ids]].multiply(adjacency[b[ids]]).tocsr()
    ids = ids[(common @ np.ones(n) == np.where(boundary[ids], 1, 2)) & (common @ lean == 0)]
    both = keep_a[ids] & keep_b[ids]
    kept = np.where(keep_a[ids], a[ids], b[ids])
    gone = np.where(keep_a[ids], b[ids], a[ids])
    target = np.where(both[:, None], (patch.verts[a[ids]] + patch.verts[b[ids]]) / 2, patch.verts[kept])
    verts = patch.verts.copy()
    verts[kept] = target
    verts[gone] = target
    normal = patch.normal.copy()
    normal[gone] = normal[kept]
    owner = np.full(n, -1)
    owner[kept] = owner[gone] = np.arange(len(ids))
    touch = owner[patch.faces]
    face_owner = touch.max(1)
    rows = np.flatnonzero(face_owner >= 0)
    rows = rows[(touch[rows] >= 0).sum(1) == 1]  # the faces that stay and change
    before, after = face_vectors(patch.verts, patch.faces[rows]), face_vectors(verts, patch.faces[rows])
    nb, na = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    corners = verts[patch.faces[rows]]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    size = patch.target[patch.faces[rows]].mean(1)
    bad = ((before * after).sum(1) < cosine * na * nb) & (nb > 1e-3 * size**2)
    bad |= (na < 0.1 * longest**2) & (na < nb)  # a sliver may stay one only if it grows
    bad |= longest > 4 / 3 * size
    bad |= _opening(normal, patch.faces[rows]) < np.minimum(OPPOSITE, _opening(patch.normal, patch.faces[rows]))
    reject = np.zeros(len(ids), dtype=bool)
    reject[face_owner[rows[bad]]] = True
    reject[(length[ids] < 0.2 * short[ids]) | lean[gone]] = False  # moves next to nothing: only topology counts
    new_id = np.arange(n)
    new_id[gone[~reject]] = kept[~reject]
    if patch.mask.any():
        chord = chords(patch.mask, _without_degenerate(new_id[patch.faces]))
        hit = owner[chord].reshape(-1)
        reject[hit[hit >= 0]] = True
    kept, gone, target = kept[~reject], gone[~reject], target[~reject]
    verts = patch.verts.copy()
    verts[kept] = target
    new_id = np.arange(n)
    new_id[gone] = kept
    faces = _without_degenerate(new_id[patch.faces])
    return replace(patch, verts=verts, faces=faces).compact(), len(kept)


def _is_lean(patch: Patch, edges: np.ndarray) -> np.ndarray:
    """Which inner vertices have only three neighbours (one fewer would fold two faces onto each other)."""
    return (np.bincount(edges.reshape(-1), minlength=len(patch.verts)) <= 3) & (patch.mask == 0)


def _opening(normal: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Least cosine between the surface normals at two corners of each face."""
    corner = normal[faces]
    return (corner * np.roll(corner, 1, axis=1)).sum(2).min(1)


def _without_degenerate(faces: np.ndarray) -> np.ndarray:
    return faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]


def flip(patch: Patch, cosine: float = 0.5) -> tuple[Patch, int]:
    """Flip edges that are not Delaunay (opposite angles above a half turn together), no two in one face."""
    n = len(patch.verts)
    edges, sides, count = edge_table(patch.faces, n)
    order = np.argsort(sides.reshape(-1), kind="stable")
    start = np.concatenate([[0], np.cumsum(count)])[:-1]
    inner = np.flatnonzero(count == 2)
    h0, h1 = order[start[inner]], order[start[inner] + 1]
    f0, k0, f1, k1 = h0 // 3, h0 % 3, h1 // 3, h1 % 3
    F, v = patch.faces, patch.verts
    a, b, c = F[f0, k0], F[f0, (k0 + 1) % 3], F[f0, (k0 + 2) % 3]
    d = F[f1, (k1 + 2) % 3]
    angle = _angle(v[c], v[a], v[b]) + _angle(v[d], v[a], v[b])
    n0, n1 = face_vectors(v, F[f0]), face_vectors(v, F[f1])
    m0 = np.cross(v[d] - v[a], v[c] - v[a])  # the new faces a d c and d b c
    m1 = np.cross(v[b] - v[d], v[c] - v[d])
    s0, s1, t0, t1 = (np.linalg.norm(q, axis=1) for q in (n0, n1, m0, m1))
    mean = n0 + n1
    scale = np.linalg.norm(mean, axis=1)
    good = (angle > np.pi * (1 + 1e-6)) & ((m0 * mean).sum(1) > cosine * t0 * scale)
    good &= ((m1 * mean).sum(1) > cosine * t1 * scale) & (np.minimum(t0, t1) > 1e-3 * np.maximum(s0, s1))
    keys = edges[:, 0] * n + edges[:, 1]
    new = np.minimum(c, d) * n + np.maximum(c, d)
    at = np.minimum(np.searchsorted(keys, new), len(keys) - 1)
    good &= (keys[at] != new) & (c != d) & (patch.mask[c] & patch.mask[d] == 0)
    lean = _is_lean(patch, edges)
    ids = np.flatnonzero(good & ~lean[a] & ~lean[b])
    if len(ids) == 0:
        return patch, 0
    rank = np.argsort(np.argsort(-angle[ids], kind="stable"), kind="stable")
    best = np.full(len(F), len(ids))
    np.minimum.at(best, f0[ids], rank)
    np.minimum.at(best, f1[ids], rank)
    win = (best[f0[ids]] == rank) & (best[f1[ids]] == rank)
    ids = ids[win]
    _, first = np.unique(new[ids], return_index=True)  # two flips must not make the same edge
    ids = ids[np.sort(first)]
    faces = F.copy()
    faces[f0[ids]] = np.stack([a[ids], d[ids], c[ids]], 1)
    faces[f1[ids]] = np.stack([d[ids], b[ids], c[ids]], 1)
    return replace(patch, faces=faces), len(ids)


def _angle(apex: np.ndarray, p: np.ndarray, q: np.ndarray) -> np.ndarray:
    u, w = p - apex, q - apex
    return np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), (u * w).sum(1))
