"""torchqm.geometry.sampling: determinism, spread, and the share of area."""

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse.csgraph import dijkstra

import torchqm.geometry.sampling as module
from torchqm.geometry import Mesh, area_samples, edge_graph, farthest_points


def sphere(level=2):
    ball = trimesh.creation.icosphere(subdivisions=level)
    return Mesh.from_arrays(ball.vertices, ball.faces, name="ball")


def uneven():
    """A strip: 40 columns of width 0.01, then 40 of width 1, and one stray vertex."""
    x = np.concatenate([np.arange(40) * 0.01, 0.4 + np.arange(41)])
    verts = np.concatenate([np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x, 0 * x + 1, 0 * x]), [[9, 9, 9]]])
    i = np.arange(80)
    faces = np.concatenate([np.column_stack([i, i + 1, i + 81]), np.column_stack([i + 1, i + 82, i + 81])])
    return Mesh.from_arrays(verts, faces, name="strip")


def test_area_samples_follow_area_and_are_all_different():
    mesh = uneven()
    ids = area_samples(mesh, 20, generator=5)
    assert len(set(ids.tolist())) == 20
    assert mesh.verts[ids, 0].gt(0.4).sum() >= 18  # 99% of the area
    everything = area_samples(mesh, 162, generator=5)
    assert sorted(everything.tolist()) == list(range(162))  # never the stray one


def test_first_draws_have_the_shares_of_the_areas():
    mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [4, 4, 0]], [[0, 1, 2], [1, 3, 2]])
    generator = torch.Generator().manual_seed(0)
    first = torch.cat([area_samples(mesh, 1, generator) for _ in range(1500)])
    share = torch.bincount(first, minlength=4) / 1500
    torch.testing.assert_close(share.double(), mesh.vertex_areas / mesh.area, rtol=0, atol=0.05)


def test_area_samples_repeat_with_the_seed_and_advance_the_generator():
    mesh = sphere()
    assert torch.equal(area_samples(mesh, 30, 1), area_samples(mesh, 30, 1))
    assert not torch.equal(area_samples(mesh, 30, 1), area_samples(mesh, 30, 2))
    generator = torch.Generator().manual_seed(1)
    first, second = area_samples(mesh, 30, generator), area_samples(mesh, 30, generator)
    assert torch.equal(first, area_samples(mesh, 30, 1))
    assert not torch.equal(first, second)
    state = torch.get_rng_state()
    area_samples(mesh, 30, 1)
    assert torch.equal(state, torch.get_rng_state())


@pytest.mark.parametrize("exponent", [-480, -40, 40, 480])
def test_samples_do_not_depend_on_the_scale(exponent):
    mesh = uneven()
    other = mesh.moved(mesh.verts * 2.0**exponent)  # a power of two, so that not even rounding differs
    assert torch.equal(area_samples(mesh, 20, 3), area_samples(other, 20, 3))
    for method in ("dijkstra", "euclidean"):
        assert torch.equal(farthest_points(mesh, 50, method=method), farthest_points(other, 50, method=method))


@pytest.mark.parametrize("method", ["dijkstra", "euclidean"])
def test_farthest_points_are_the_greedy_choice(method):
    mesh = sphere()
    ids = farthest_points(mesh, 40, start=3, method=method).numpy()
    assert ids[0] == 3
    if method == "dijkstra":
        distance = dijkstra(edge_graph(mesh), indices=ids)
    else:
        distance = torch.cdist(mesh.verts[ids], mesh.verts).numpy()
    for k in range(1, 40):
        nearest = distance[:k].min(0)
        assert nearest[ids[k]] == pytest.approx(nearest.max(), rel=1e-9)


def by_whole_rows(mesh, n, start):
    """The twin: all distances from every point, and their least."""
    rows = dijkstra(edge_graph(mesh))
    nearest, out = np.where(mesh.referenced.numpy(), np.inf, -1.0), []
    for _ in range(n):
        out.append(start)
        nearest = np.minimum(nearest, rows[start])
        nearest[out] = -1.0
        start = int(nearest.argmax())
    return out


def islands():
    """Two strips of different triangles far apart."""
    strip = uneven()
    return Mesh(torch.cat([strip.verts, strip.verts + 50]), torch.cat([strip.faces, strip.faces + strip.n_verts]))


def rough(seed):
    """A ball with noise, so that edges differ and no two paths are equally long, and triangles left out."""
    noise = torch.Generator().manual_seed(seed)
    ball = sphere()
    verts = ball.verts * (0.3 + torch.rand(ball.n_verts, 1, generator=noise, dtype=torch.float64))
    return Mesh(verts, ball.faces[torch.rand(ball.n_faces, generator=noise) > 0.2])


@pytest.mark.parametrize("make", [sphere, uneven, islands, lambda: rough(0)])
def test_fronts_that_stop_give_the_points_of_all_distances(make, monkeypatch):
    mesh = make()
    mesh = mesh.moved((mesh.verts - mesh.verts[:1]) / (mesh.verts - mesh.verts[:1]).abs().max())  # as it is done inside
    n = min(80, int(mesh.referenced.sum()))
    for whole in (0, 3, module._WHOLE, n):
        monkeypatch.setattr(module, "_WHOLE", whole)
        assert farthest_points(mesh, n, start=7).tolist() == by_whole_rows(mesh, n, 7)


@given(st.integers(0, 10_000), st.integers(0, 3))
@settings(max_examples=15, deadline=None)
def test_a_front_leaves_the_least_distances(seed, taken):
    """Bit for bit, whatever was there before, and it goes no further than it has to."""
    mesh = rough(seed)
    graph = edge_graph(mesh)
    points = np.random.default_rng(seed).choice(mesh.n_verts, taken + 1, replace=False)
    rows = dijkstra(graph, indices=points)
    nearest = np.full(mesh.n_verts, np.inf)
    for point in points:
        module._lower(nearest, graph, int(point))
    wanted = rows.min(0)
    wanted[points] = -1.0
    assert np.array_equal(nearest, wanted)


def test_a_front_reads_no_more_than_its_own_part():
    """Edges of which one end is not nearer to the new point do not go on."""
    mesh = sphere(4)
    graph = edge_graph(mesh)
    nearest = np.full(mesh.n_verts, np.inf)
    points = farthest_points(mesh, 200).tolist()
    for point in points:
        module._lower(nearest, graph, point)
    before = nearest.copy()
    new = int(nearest.argmax())
    read = []

    class Counted(np.ndarray):
        def __getitem__(self, key):
            read.append(np.size(key))
            return np.asarray(self)[key]

    graph.data = graph.data.view(Counted)
    module._lower(nearest, graph, new)
    changed = int((nearest != before).sum())
    assert 0 < sum(read) < 30 * changed < graph.nnz / 4


@pytest.mark.parametrize("method", ["dijkstra", "euclidean"])
def test_smaller_samples_are_prefixes_and_all_vertices_can_be_taken(method):
    mesh = sphere(1)
    everything = farthest_points(mesh, mesh.n_verts, method=method)
    assert sorted(everything.tolist()) == list(range(mesh.n_verts))
    assert torch.equal(farthest_points(mesh, 7, method=method), everything[:7])
    assert farthest_points(mesh, 0, method=method).tolist() == []


def test_farthest_points_on_a_line_bisect_it():
    mesh = uneven()
    ids = farthest_points(mesh, 3)
    assert mesh.verts[ids[:2], 0].sort().values.tolist() == [0.0, pytest.approx(40.4)]
    assert mesh.verts[ids[2], 0].item() == pytest.approx(20.4, abs=1)


def test_each_component_gets_a_point_first():
    ball = sphere(1)
    mesh = Mesh(torch.cat([ball.verts, ball.verts + 5]), torch.cat([ball.faces, ball.faces + ball.n_verts]))
    first, second = (farthest_points(mesh, 2, start=0) >= ball.n_verts).tolist()
    assert (first, second) == (False, True)


def test_duplicate_positions_are_taken_once_each():
    mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]], [[0, 1, 2], [1, 3, 2]])
    for method in ("dijkstra", "euclidean"):
        assert sorted(farthest_points(mesh, 4, method=method).tolist()) == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("call", "fault"),
    [
        (lambda m: area_samples(m, 163), "n is 163; strip has 162 vertices with an area"),
        (lambda m: area_samples(m, -1), "n is -1"),
        (lambda m: farthest_points(m, 163), "n is 163; strip has 162 vertices of a triangle"),
        (lambda m: farthest_points(m, 2, start=162), "start is 162"),
        (lambda m: farthest_points(m, 2, start=-1), "start is -1"),
        (lambda m: farthest_points(m, 2, method="heat"), "method is 'heat'; allowed are 'dijkstra' and 'euclidean'"),
    ],
)
def test_bad_arguments(call, fault):
    with pytest.raises(ValueError, match=fault):
        call(uneven())


def test_a_first_part_is_the_smaller_sample():
    """Mirror planes draw once for samples of three sizes."""
    mesh = sphere()
    for n in (1, 7, 100):
        assert torch.equal(area_samples(mesh, 130, 5)[:n], area_samples(mesh, n, 5))
