import inspect
from functools import lru_cache

import numpy as np
import pytest
import torch
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra

from torchqm.data import synthetic
from torchqm.data.creatures.skeleton import reflection_group
from torchqm.data.synthetic import CREATURES, Creature, creature, exact_maps, symmetry_truth

ORDER = {"biped": 2, "quadruped": 2, "octopus": 16, "ellipsoid": 8, "asymmetric": 1}
SIZE = 1000


def build(kind: str, **options: int) -> Creature:
    return creature(kind, SIZE, **options)


def min_angles(verts: np.ndarray, faces: np.ndarray) -> np.ndarray:
    out = []
    for k in range(3):
        a, b, c = (verts[faces[:, (k + i) % 3]] for i in range(3))
        u, w = b - a, c - a
        out.append(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), (u * w).sum(1))))
    return np.min(out, axis=0)


def directed_edges(faces: np.ndarray, n: int) -> np.ndarray:
    return np.sort(faces.reshape(-1) * n + faces[:, [1, 2, 0]].reshape(-1))


def oriented_faces(faces: np.ndarray) -> np.ndarray:
    turn = (faces.argmin(1)[:, None] + np.arange(3)) % 3
    return np.unique(np.take_along_axis(faces, turn, 1), axis=0)


@pytest.mark.parametrize("retriangulate", [0, 1])
@pytest.mark.parametrize("kind", CREATURES)
def test_is_a_closed_oriented_sphere_of_the_wanted_size(kind, retriangulate):
    c = build(kind, retriangulate=retriangulate)
    verts, faces = c.mesh.numpy()
    n = len(verts)
    assert abs(n / SIZE - 1) < 0.05
    forward = directed_edges(faces, n)
    assert (np.diff(forward) > 0).all()  # no directed edge twice: manifold edges, consistent orientation
    assert np.array_equal(forward, directed_edges(faces[:, ::-1], n))  # each edge has its partner: closed
    assert n - len(forward) // 2 + len(faces) == 2
    graph = csr_matrix((np.ones(faces.size), (faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1))), shape=(n, n))
    assert connected_components(graph, directed=False)[0] == 1
    a, b, d = verts[faces].transpose(1, 0, 2)
    assert np.einsum("ni,ni->", np.cross(a, b), d) > 0  # positive volume: normals point outwards
    # the faces around each vertex form one ring: as many faces as neighbours, and no face twice
    assert len(np.unique(np.sort(faces, 1), axis=0)) == len(faces)
    assert (np.bincount(faces.reshape(-1), minlength=n) >= 3).all()


@pytest.mark.parametrize("retriangulate", [0, 1])
@pytest.mark.parametrize("kind", CREATURES)
def test_triangles_are_well_shaped(kind, retriangulate):
    angles = min_angles(*build(kind, retriangulate=retriangulate).mesh.numpy())
    assert angles.min() > 10
    assert np.median(angles) > 45


@pytest.mark.parametrize("kind", CREATURES)
def test_the_permutations_are_a_group_of_mesh_automorphisms(kind):
    c = build(kind)
    group, faces, n = c.base_group.numpy(), c.base.faces.numpy(), c.base.n_verts
    assert group.shape == (ORDER[kind], n)
    assert np.array_equal(group[0], np.arange(n))
    rows = {row.tobytes(): i for i, row in enumerate(group)}
    assert len(rows) == ORDER[kind]
    face_set = np.unique(np.sort(faces, 1), axis=0)
    oriented = oriented_faces(faces)
    for g, row in enumerate(group):
        assert np.array_equal(np.sort(row), np.arange(n))
        assert np.argsort(row).tobytes() in rows
        for other in group:
            assert row[other].tobytes() in rows
        image = row[faces]
        assert np.array_equal(np.unique(np.sort(image, 1), axis=0), face_set)
        kept = np.array_equal(oriented_faces(image), oriented)
        assert kept or np.array_equal(oriented_faces(image[:, ::-1]), oriented)
        assert c.orientation[g] == (1 if kept else -1)
    assert c.orientation.sum() == (1 if kind == "asymmetric" else 0)


@pytest.mark.parametrize("kind", CREATURES)
def test_the_rest_pose_is_exactly_symmetric_in_space(kind):
    c = build(kind)
    verts = c.base.verts.numpy()
    assert torch.equal(c.base.verts, c.mesh.verts)
    for row, sign in zip(c.base_group.numpy(), c.orientation.numpy(), strict=True):
        matrix = np.linalg.lstsq(verts, verts[row], rcond=None)[0]
        assert np.abs(verts @ matrix - verts[row]).max() < 1e-12
        assert np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-12
        assert np.linalg.det(matrix) == pytest.approx(sign)


@pytest.mark.parametrize("kind", CREATURES)
def test_there_is_no_further_symmetry_in_space(kind):
    """Reflections in planes through the centroid, on a fine set of directions: only the group's own come close."""
    c = build(kind)
    mesh = c.base.normalized()
    verts = mesh.verts.numpy()
    i = np.arange(1500) + 0.5
    z, a = 1 - i / 1500, np.pi * (1 + 5**0.5) * i
    normals = np.stack([np.sqrt(1 - z**2) * np.cos(a), np.sqrt(1 - z**2) * np.sin(a), z], 1)
    own = [np.eye(3) - 2 * np.outer(n, n) for n in np.eye(3)] if kind == "ellipsoid" else []
    if kind in ("biped", "quadruped"):
        own = [np.diag([-1.0, 1, 1])]
    if kind == "octopus":
        s, k = np.sin(np.pi / 8), np.cos(np.pi / 8)
        own = [m for m in reflection_group([[0, 0, 1], [s, 0, -k]]) if np.linalg.det(m) < 0]
    from scipy.spatial import cKDTree

    tree, sample = cKDTree(verts), verts[::10]
    for n in normals:
        matrix = np.eye(3) - 2 * np.outer(n, n)
        if any(np.abs(matrix - m).max() < 0.4 for m in own):
            continue
        assert tree.query(sample @ matrix)[0].mean() > 0.02


@pytest.mark.parametrize("kind", CREATURES)
def test_poses_are_near_isometric_and_break_the_symmetry_in_space(kind):
    rest = build(kind)
    edges, before = rest.mesh.edges.numpy(), rest.mesh.edge_lengths.numpy()
    n = rest.mesh.n_verts
    first = np.arange(0, n, n // 15)

    def graph_distances(lengths: np.ndarray) -> np.ndarray:
        return dijkstra(csr_matrix((lengths, edges.T), shape=(n, n)), directed=False, indices=first)

    d0 = graph_distances(before)
    for pose in (1, 2, 3, 4):
        c = build(kind, pose=pose)
        assert torch.equal(c.mesh.faces, rest.mesh.faces)
        change = np.abs(c.mesh.edge_lengths.numpy() / before - 1)
        assert np.median(change) < 0.05
        assert np.percentile(change, 95) < 0.35
        far = d0 > 0.2
        assert np.median(np.abs(graph_distances(c.mesh.edge_lengths.numpy())[far] / d0[far] - 1)) < 0.06
        assert abs(c.mesh.area / rest.mesh.area - 1) < 0.06
        verts = c.mesh.verts.numpy()
        centred = verts - verts.mean(0)
        for row in c.base_group.numpy()[1:]:
            u, _, vt = np.linalg.svd(centred.T @ centred[row])
            assert np.abs(centred @ (u @ vt) - centred[row]).max() > 0.02
        assert min_angles(*c.mesh.numpy()).min() > 1


@pytest.mark.parametrize("kind", CREATURES)
def test_retriangulated_creatures_lie_on_the_base(kind):
    c = build(kind, retriangulate=1)
    assert c.retriangulated
    assert c.mesh.n_verts != c.base.n_verts
    assert c.location_bary.min() >= 0
    assert torch.allclose(c.location_bary.sum(1), torch.ones(c.mesh.n_verts, dtype=torch.float64), atol=1e-12)
    assert torch.allclose(c.rest.verts, c.mesh.verts, atol=1e-14)
    posed = build(kind, retriangulate=1, pose=1)
    shared = build(kind, pose=1)
    corners = shared.mesh.verts[shared.mesh.faces[posed.location_faces]]
    there = (corners * posed.location_bary[:, :, None]).sum(1)
    gap = (there - posed.mesh.verts).norm(dim=1)
    edge = float(c.mesh.edge_lengths.mean())
    assert gap.mean() < 0.05 * edge  # skinning is not linear inside a face, but nearly
    assert gap.max() < 0.5 * edge


@pytest.mark.parametrize("kind", CREATURES)
def test_exact_maps_of_shared_triangulations_are_the_permutations(kind):
    a, b = build(kind), build(kind, pose=1)
    maps = exact_maps(a, b)
    assert torch.equal(maps.nearest_vertices(), a.base_group)
    assert torch.allclose(maps.points(b.mesh), b.mesh.verts[a.base_group], atol=1e-14)


@pytest.mark.parametrize("kind", CREATURES)
def test_exact_maps_reach_retriangulated_targets_with_tiny_error(kind):
    source, target = build(kind, pose=1), build(kind, retriangulate=1)
    maps = exact_maps(source, target)
    wanted = source.base.verts[source.base_group]  # at rest the target lies where the base lies
    edge = float(target.mesh.edge_lengths.mean())
    gap = (maps.points(target.mesh) - wanted).norm(dim=2)
    assert (
        gap.mean() < 0.15 * edge
    )  # the height of the arc over an edge, a part of (edge / radius): two polyhedra differ
    assert gap.max() < 0.8 * edge
    assert torch.allclose(maps.bary.sum(2), torch.ones(maps.bary.shape[:2], dtype=torch.float64), atol=1e-12)


@pytest.mark.parametrize("kind", CREATURES)
def test_symmetry_truth_of_a_retriangulated_creature(kind):
    c = build(kind, retriangulate=1)
    maps = symmetry_truth(c)
    assert maps.faces.shape == (ORDER[kind], c.mesh.n_verts)
    assert torch.equal(maps.nearest_vertices()[0], torch.arange(c.mesh.n_verts))
    assert torch.equal(maps.points(c.mesh)[0], c.mesh.verts)
    verts, points = c.mesh.verts.numpy(), maps.points(c.mesh).numpy()
    base = c.base.verts.numpy()
    edge = float(c.mesh.edge_lengths.mean())
    for row, image in zip(c.base_group.numpy(), points, strict=True):
        matrix = np.linalg.lstsq(base, base[row], rcond=None)[0]
        assert np.linalg.norm(image - verts @ matrix, axis=1).mean() < 0.1 * edge


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "dragon"}, "kind: unknown creature 'dragon'; allowed are biped"),
        ({"kind": "biped", "n_verts": 499}, "n_verts: given 499"),
        ({"kind": "biped", "n_verts": 400_001}, "n_verts: given 400001"),
        ({"kind": "biped", "seed": -1}, "seed: given -1"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        creature(**options)


def test_same_seed_same_mesh_and_other_seed_other_mesh(monkeypatch):
    a = build("quadruped", pose=2, retriangulate=1)
    for shared in ("_body", "_retriangulated"):  # made anew; what the tests share may come from another process
        monkeypatch.setattr(synthetic, shared, lru_cache(inspect.unwrap(getattr(synthetic, shared))))
    b = build("quadruped", pose=2, retriangulate=1)
    assert synthetic._body.cache_info().misses == synthetic._retriangulated.cache_info().misses == 1
    assert torch.equal(a.mesh.verts, b.mesh.verts)
    assert torch.equal(a.mesh.faces, b.mesh.faces)
    other = build("quadruped", seed=4)
    assert float((other.mesh.verts.max(0).values - a.base.verts.max(0).values).abs().max()) > 0.005
    with pytest.raises(ValueError, match="target: given quadruped of seed 4"):
        exact_maps(a, other)
