import numpy as np
import pytest

from torchqm.data.creatures.edits import Patch, collapse, edge_table, flip, split


def grid(n: int) -> Patch:
    """A flat square of n x n vertices, its rim free of mirror planes but kept by the boundary rule."""
    x, y = np.meshgrid(np.arange(n, dtype=float), np.arange(n, dtype=float), indexing="ij")
    verts = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    ids = np.arange(n * n).reshape(n, n)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)])
    mask = ((x == 0) * 1 | (y == 0) * 2 | (x == n - 1) * 4 | (y == n - 1) * 8).reshape(-1).astype(np.int64)
    normal = np.tile([0.0, 0, 1], (n * n, 1))
    return Patch(verts, faces, mask, np.full(n * n, 1.0), normal)


def areas(patch: Patch) -> np.ndarray:
    a, b, c = patch.verts[patch.faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)[:, 2] / 2


@pytest.mark.parametrize("seed", range(4))
def test_split_keeps_area_orientation_and_boundary(seed):
    patch = grid(5)
    edges, sides, count = edge_table(patch.faces, len(patch.verts))
    marked = np.random.default_rng(seed).random(len(edges)) < 0.5
    out = split(patch, marked, edges, sides, count)
    assert len(out.verts) == len(patch.verts) + marked.sum()
    assert areas(out).min() > 0
    assert areas(out).sum() == pytest.approx(16)
    _, _, new_count = edge_table(out.faces, len(out.verts))
    assert new_count.max() == 2
    assert (new_count == 1).sum() == 16 + (marked & (count == 1)).sum()
    rim = out.mask > 0
    assert rim.sum() == 16 + (marked & (count == 1)).sum()


def test_collapse_keeps_area_corners_and_topology():
    patch = grid(9)
    patch.target[:] = 2.5
    for salt in range(10):
        patch, _ = collapse(patch, 0.5, salt)
        edges, _, count = edge_table(patch.faces, len(patch.verts))
        assert len(patch.verts) - len(edges) + len(patch.faces) == 1
        assert count.max() == 2
        assert areas(patch).min() > 0
        assert areas(patch).sum() == pytest.approx(64)
        chords = (count == 2) & (patch.mask[edges[:, 0]] & patch.mask[edges[:, 1]] > 0)
        assert not chords.any()
    assert len(patch.verts) < 50
    assert (np.bitwise_count(patch.mask) == 2).sum() == 4


def test_flip_makes_the_mesh_delaunay():
    patch = grid(6)
    inner = patch.mask == 0
    patch.verts[inner, :2] += np.random.default_rng(0).uniform(-0.3, 0.3, (inner.sum(), 2))
    assert areas(patch).min() > 0
    for _ in range(20):
        patch, done = flip(patch)
        if done == 0:
            break
    assert done == 0
    assert areas(patch).min() > 0
    assert areas(patch).sum() == pytest.approx(25)
    for face in patch.faces:  # empty circumscribed circles, but for vertices hidden behind the rim
        a, b, c = patch.verts[face, :2]
        centre = np.linalg.solve(2 * np.array([b - a, c - a]), [b @ b - a @ a, c @ c - a @ a])
        r = np.linalg.norm(a - centre)
        others = np.setdiff1d(np.arange(len(patch.verts)), face)
        if (patch.mask[face] == 0).all():
            assert np.linalg.norm(patch.verts[others, :2] - centre, axis=1).min() > r - 1e-9
