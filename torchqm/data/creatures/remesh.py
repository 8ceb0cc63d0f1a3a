"""Isotropic remeshing of a surface patch to a wanted edge length."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from torchqm.data.creatures.edits import OPPOSITE, Patch, collapse, edge_lengths, edge_table, face_vectors, flip, split

__all__ = ["remesh", "smooth"]

Projector = Callable[[np.ndarray, np.ndarray, float, int], tuple[np.ndarray, np.ndarray]]


def smooth(patch: Patch, normal: np.ndarray, project: Projector, limit: float, strength: float = 0.7) -> np.ndarray:
    """Move vertices tangentially to the centroids of their surroundings and back onto the surface; no face turns over.

    Returns:
        ``(V, 3)`` unit normals at the new places (``patch.verts`` is changed).
    """
    n = len(patch.verts)
    v, F = patch.verts, patch.faces
    area = np.linalg.norm(face_vectors(v, F), axis=1)
    centre = v[F].mean(1) * area[:, None]
    total = np.bincount(F.reshape(-1), np.repeat(area, 3), n)
    goal = np.stack([np.bincount(F.reshape(-1), np.repeat(centre[:, i], 3), n) for i in range(3)], 1)
    goal = np.divide(goal, np.maximum(total, 1e-300)[:, None])
    edges, _, count = edge_table(F, n)
    rim = edges[count == 1]
    if len(rim):
        ends = np.bincount(rim.reshape(-1), minlength=n)
        mean = np.stack(
            [np.bincount(np.r_[rim[:, 0], rim[:, 1]], np.r_[v[rim[:, 1], i], v[rim[:, 0], i]], n) for i in range(3)], 1
        )
        on = ends > 0
        goal[on] = mean[on] / ends[on, None]
    move = goal - v
    move -= normal * (move * normal).sum(1, keepdims=True)
    move *= strength
    new, new_normal = project(v + move, patch.mask, limit, 1)
    for _ in range(4):
        vectors = face_vectors(new, F)
        mean_normal = new_normal[F].sum(1)
        bad = (vectors * mean_normal).sum(1) < 0.3 * np.linalg.norm(vectors, axis=1) * np.linalg.norm(
            mean_normal, axis=1
        )
        if not bad.any():
            break
        back = np.unique(F[bad])
        new[back], new_normal[back] = v[back], normal[back]
    patch.verts = new
    return new_normal


def _split_long(patch: Patch, project: Projector, limit: float) -> tuple[Patch, int]:
    """Split the edges above 4/3 of their wanted length, and those that join two rim vertices across the inside."""
    edges, sides, count = edge_table(patch.faces, len(patch.verts))
    length = edge_lengths(patch.verts, edges)
    chord = (count == 2) & (patch.mask[edges[:, 0]] & patch.mask[edges[:, 1]] > 0)
    wanted = patch.edge_targets(edges)
    cosine = (patch.normal[edges[:, 0]] * patch.normal[edges[:, 1]]).sum(1)
    ids = np.flatnonzero((length > 4 / 3 * wanted) | chord | ((cosine < OPPOSITE) & (length > 0.5 * wanted)))
    ends = patch.verts[edges[ids]]
    on = np.where(count[ids] == 1, np.bitwise_and.reduce(patch.mask[edges[ids]], 1), 0)
    middle, outward = project(ends.mean(1), on, limit, 2)
    # In a mesh too coarse for the body the middle can land on another vertex or on the other side: the edge stays
    gap = np.linalg.norm(middle[:, None] - ends, axis=2)
    place = np.full(len(edges), -1)
    place[ids] = np.arange(len(ids))
    apex, at = np.roll(patch.faces, 1, axis=1).reshape(-1), place[sides].reshape(-1)
    apex, at = apex[at >= 0], at[at >= 0]
    free = np.full(len(ids), np.inf)
    np.minimum.at(free, at, np.linalg.norm(patch.verts[apex] - middle[at], axis=1))
    vectors = np.repeat(face_vectors(patch.verts, patch.faces), 3, axis=0)
    around = np.stack([np.bincount(sides.reshape(-1), vectors[:, i], len(edges)) for i in range(3)], 1)[ids]
    fine = (gap.min(1) > 0.3 * length[ids]) & (gap.max(1) < length[ids])
    fine &= free > 0.25 * length[ids]
    fine &= (around * outward).sum(1) > 0.5 * np.linalg.norm(around, axis=1)
    middle, outward, ids = middle[fine], outward[fine], ids[fine]
    if len(ids) == 0:
        return patch, 0
    marked = np.zeros(len(edges), dtype=bool)
    marked[ids] = True
    old = len(patch.verts)
    patch = split(patch, marked, edges, sides, count)
    patch.verts[old:], patch.normal[old:] = middle, outward
    return patch, len(ids)


def remesh(
    patch: Patch, target: Callable[[np.ndarray], np.ndarray], project: Projector, rounds: int = 3, passes: int = 3
) -> Patch:
    """Bring all edges near their wanted length.

    Args:
        patch: the mesh; its boundary stays on its mirror planes.
        target: ``(N, 3) -> (N,)`` wanted edge length at surface points.
        project: ``(points, mask, step limit, steps) -> points, normals`` onto the surface.
        rounds: how often split, collapse, flip and smooth are repeated.
        passes: flips and smoothing steps in the last round (two in the others).

    Returns:
        The new mesh.

    References:
        Botsch, Kobbelt: A Remeshing Approach to Multiresolution Modeling, SGP 2004, section 4.
    """
    for number in range(rounds):
        _, normal = project(patch.verts, patch.mask, 0.0, 1)
        patch = replace(patch, target=target(patch.verts), normal=normal)
        limit = float(patch.target.max())
        for _ in range(8):
            patch, done = _split_long(patch, project, limit)
            if done == 0:
                break
            for _ in range(2):
                patch, _ = flip(patch)
        for salt in range(30):
            patch, done = collapse(patch, 0.5, salt + 100 * number)
            if done <= 0.002 * len(patch.verts):
                break
            if salt % 3 == 2:
                patch, _ = flip(patch)
        _, normal = project(patch.verts, patch.mask, limit, 1)
        for _ in range(passes if number == rounds - 1 else 2):
            for _ in range(6):
                patch, done = flip(patch)
                if done <= 0.001 * len(patch.faces):
                    break
            normal = smooth(patch, normal, project, limit)
    return patch
