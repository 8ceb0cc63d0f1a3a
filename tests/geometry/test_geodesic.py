"""torchqm.geometry.geodesic: against closed forms on the plane and the sphere, and exact polyhedral distances."""

import math
import sys

import numpy as np
import pytest
import torch
import trimesh

from torchqm.geometry import EdgePoints, Mesh, distance_to_curve, distances, edge_graph, nodal_crossings

METHODS = ["fast_marching", "heat", "dijkstra", "exact"]
TOLERANCE = {"fast_marching": 0.02, "heat": 0.03, "dijkstra": 0.09, "exact": 1e-12}  # mean relative error


def sphere(level=3):
    ball = trimesh.creation.icosphere(subdivisions=level)
    return Mesh.from_arrays(ball.vertices, ball.faces, name="ball")


def square(n=31):
    """The unit square; diagonals alternate, so no direction is favoured."""
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 2)
    low = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    a, b, c, d = low, low + n, low + n + 1, low + 1
    even = (grid[low].sum(1) % 2 == 0)[:, None]
    first = np.where(even, np.column_stack([a, b, c]), np.column_stack([a, b, d]))
    second = np.where(even, np.column_stack([a, c, d]), np.column_stack([b, c, d]))
    verts = np.column_stack([grid / (n - 1), np.zeros(len(grid))])
    return Mesh.from_arrays(verts, np.concatenate([first, second]), name="square")


def relative(found, true):
    far = true > 0
    return ((found - true).abs()[far] / true[far]).mean().item()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("source", [0, 30, 480, 15, 930])  # corners, the middle, the middles of two sides
def test_flat_square(method, source):
    mesh = square()
    found = distances(mesh, [source], method)[0]
    true = (mesh.verts - mesh.verts[source]).norm(dim=1)
    tolerance = {**TOLERANCE, "fast_marching": 0.03, "heat": 0.04}[method]
    assert found[source] == 0
    assert relative(found, true) < tolerance
    if method == "dijkstra":
        assert (found - true).min() > -1e-12  # never too short


@pytest.mark.parametrize("method", ["fast_marching", "dijkstra", "exact"])
def test_along_a_straight_boundary_distances_are_exact(method):
    mesh = square()
    side = torch.arange(31) * 31  # vertices with y = 0, edges of the boundary
    for source in (0, 15 * 31, 30 * 31):
        found = distances(mesh, [source], method, targets=side)[0]
        torch.testing.assert_close(found, (mesh.verts[side, 0] - mesh.verts[source, 0]).abs())


@pytest.mark.parametrize("method", METHODS)
def test_sphere(method):
    mesh = sphere()
    found = distances(mesh, torch.tensor([0, 7, 100]), method)
    unit = mesh.verts / mesh.verts.norm(dim=1, keepdim=True)
    true = torch.arccos((unit[[0, 7, 100]] @ unit.T).clamp(-1, 1))
    true[torch.arange(3), [0, 7, 100]] = 0
    assert relative(found, true) < max(TOLERANCE[method], 0.005)  # the polyhedron itself is 0.3% smaller


@pytest.mark.parametrize("method", ["fast_marching", "heat", "dijkstra"])
def test_against_exact_distances_on_a_bumpy_surface(method):
    ball = sphere()
    bumpy = ball.moved(ball.verts * (1 + 0.3 * torch.sin(4 * ball.verts[:, :1]) * torch.cos(3 * ball.verts[:, 1:2])))
    sources = [0, 50, 333]
    assert relative(distances(bumpy, sources, method), distances(bumpy, sources, "exact")) < 1.5 * TOLERANCE[method]


@pytest.mark.parametrize("method", METHODS)
def test_shape_targets_and_input_kinds(method):
    mesh = sphere(2)
    everything = distances(mesh, torch.arange(5), method)
    assert everything.shape == (5, mesh.n_verts)
    assert everything.dtype == torch.float64
    targets = torch.tensor([8, 3, 3])
    torch.testing.assert_close(distances(mesh, [0, 1, 2, 3, 4], method, targets=targets), everything[:, targets])
    assert distances(mesh, [], method).shape == (0, mesh.n_verts)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-150, 1e-12, 1e12, 1e150])
def test_any_scale(method, scale):
    mesh = sphere(2)
    plain, scaled = distances(mesh, [5], method), distances(mesh.moved(mesh.verts * scale), [5], method)
    torch.testing.assert_close(scaled / scale, plain, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("method", METHODS)
def test_unreferenced_vertices_are_infinitely_far(method):
    ball = sphere(1)
    stray = torch.full((1, 3), 3.0, dtype=torch.float64)
    mesh = Mesh(torch.cat([stray, ball.verts, stray]), ball.faces + 1)
    found = distances(mesh, [0, 1], method)
    assert found[0, 0] == 0
    assert found[0, 1:].isinf().all()
    assert found[1, [0, -1]].isinf().all()
    torch.testing.assert_close(found[1, 1:-1], distances(ball, [0], method)[0])


@pytest.mark.parametrize("method", METHODS)
def test_other_components_are_infinitely_far(method):
    ball = sphere(1)
    mesh = Mesh(torch.cat([ball.verts, ball.verts + 5]), torch.cat([ball.faces, ball.faces + ball.n_verts]))
    found = distances(mesh, [0], method)[0]
    torch.testing.assert_close(found[: ball.n_verts], distances(ball, [0], method)[0], rtol=0.05, atol=0.01)
    assert found[ball.n_verts :].isinf().all()


def test_turned_and_repeated_triangles_do_not_matter():
    mesh = square(9)
    faces = mesh.faces.clone()
    faces[::3] = faces[::3][:, [1, 0, 2]]
    faces = torch.cat([faces, faces[:4], torch.tensor([[0, 0, 1]])])
    torch.testing.assert_close(distances(Mesh(mesh.verts, faces), [0, 40]), distances(mesh, [0, 40]))


def nonmanifold():
    mesh = square(9)
    return Mesh(
        torch.cat([mesh.verts, torch.tensor([[0.5, 0.5, 1.0]], dtype=torch.float64)]),
        torch.cat([mesh.faces, torch.tensor([[40, 41, 81]])]),
        "fin",
    )


def test_fast_marching_falls_back_with_a_warning_on_a_nonmanifold_mesh():
    with pytest.warns(UserWarning, match=r"fin: fast marching needs a manifold \(1 non-manifold edges.*heat method"):
        found = distances(nonmanifold(), [0])
    torch.testing.assert_close(found, distances(nonmanifold(), [0], "heat"))
    with pytest.raises(ValueError, match="fin: method='exact' needs a manifold"):
        distances(nonmanifold(), [0], "exact")


def test_the_exact_method_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygeodesic.geodesic", None)
    with pytest.raises(ImportError, match="method='exact' needs the package pygeodesic \\(pip install pygeodesic\\)"):
        distances(sphere(1), [0], "exact")


@pytest.mark.parametrize(
    ("arguments", "fault"),
    [
        (([0], "euclid"), "method is 'euclid'; allowed are 'fast_marching', 'heat', 'dijkstra', 'exact'"),
        (([42],), "sources holds 42; ball has vertices 0 to 41"),
        (([-1],), "sources holds -1"),
        (([0], "heat", torch.tensor([99])), "targets holds 99"),
    ],
)
def test_bad_arguments(arguments, fault):
    with pytest.raises(ValueError, match=fault):
        distances(sphere(1), *arguments)


def test_edge_graph_is_symmetric_and_stores_edges_without_length():
    mesh = Mesh.from_arrays([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 0, 0]], [[0, 1, 2], [1, 3, 2]])
    graph = edge_graph(mesh)
    assert graph.nnz == 10
    assert (graph - graph.T).nnz == 0
    assert distances(mesh, [1], "dijkstra")[0, 3] == 0


def test_crossings_lie_where_the_function_is_zero():
    mesh = sphere(2)
    f = mesh.verts @ torch.tensor([0.3, 1.0, -0.2], dtype=torch.float64) - 0.1
    points = nodal_crossings(mesh, f)
    a, b = points.edges.unbind(1)
    assert ((1 - points.t) * f[a] + points.t * f[b]).abs().max() < 1e-15
    assert ((f[a] < 0) != (f[b] < 0)).all()
    sides = (f < 0)[mesh.faces].sum(1)
    assert len(points.t) == ((sides == 1) | (sides == 2)).sum()  # a closed curve: 2 points a face, 2 faces a point


def test_crossings_with_zeros_at_vertices():
    mesh = square(5)
    points = nodal_crossings(mesh, mesh.verts[:, 0] - 0.5)  # zero exactly on a column of vertices
    x = (1 - points.t) * mesh.verts[points.edges[:, 0], 0] + points.t * mesh.verts[points.edges[:, 1], 0]
    assert (x == 0.5).all()
    assert torch.equal(distance_to_curve(mesh, points), (mesh.verts[:, 0] - 0.5).abs())
    assert len(nodal_crossings(mesh, torch.zeros(25, dtype=torch.float64)).t) == 0
    assert len(nodal_crossings(mesh, torch.ones(25, dtype=torch.float64)).t) == 0


def test_crossings_of_tiny_and_huge_values():
    mesh = square(5)
    for scale in (1e-320, 1e-300, 1e300):
        t = nodal_crossings(mesh, (mesh.verts[:, 0] - 0.4) * scale).t
        assert torch.isfinite(t).all()
        assert ((t >= 0) & (t <= 1)).all()


@pytest.mark.parametrize(("method", "tolerance"), [("fast_marching", 0.02), ("dijkstra", 0.05)])
@pytest.mark.parametrize("slope", [0.0, 0.3, 1.0])
def test_distance_to_a_line_in_the_plane(method, tolerance, slope):
    mesh = square()
    f = mesh.verts[:, 0] + slope * mesh.verts[:, 1] - 0.51
    found = distance_to_curve(mesh, nodal_crossings(mesh, f), method)
    foot = mesh.verts - f[:, None] / (1 + slope**2) * torch.tensor([1, slope, 0], dtype=torch.float64)
    inside = ((foot >= 0) & (foot <= 1)).all(1)  # the foot of the perpendicular lies on the square
    true = f.abs() / math.hypot(1, slope)
    assert (found - true)[inside].abs().max() < tolerance
    near = inside & (true < 0.4 / 30)  # a corner of a triangle that the line cuts: exact there
    assert near.any()
    assert (found - true)[near].abs().max() < 1e-12


def test_distance_to_the_equator_of_a_sphere():
    mesh = sphere()
    direction = torch.nn.functional.normalize(torch.tensor([0.2, 0.5, 1.0], dtype=torch.float64), dim=0)
    height = mesh.verts @ direction
    found = distance_to_curve(mesh, nodal_crossings(mesh, height))
    true = torch.arcsin(height).abs()
    assert relative(found, true) < 0.01
    assert (found - true).abs().max() < 0.05  # largest at the poles, where the fronts meet


def test_order_and_container_of_the_points_do_not_matter():
    mesh = sphere(2)
    points = nodal_crossings(mesh, mesh.verts[:, 0] - 0.1)
    order = torch.randperm(len(points.t), generator=torch.Generator().manual_seed(0))
    shuffled = (points.edges[order].flip(1), 1 - points.t[order])
    torch.testing.assert_close(distance_to_curve(mesh, shuffled), distance_to_curve(mesh, points))


def test_a_single_point_on_an_edge():
    mesh = square()
    edge = mesh.edges[mesh.n_verts // 2]
    point = EdgePoints(edge[None], torch.tensor([0.25], dtype=torch.float64))
    where = 0.75 * mesh.verts[edge[0]] + 0.25 * mesh.verts[edge[1]]
    found = distance_to_curve(mesh, point)
    assert relative(found, (mesh.verts - where).norm(dim=1)) < 0.04
    torch.testing.assert_close(found[edge], (mesh.verts[edge] - where).norm(dim=1))


def test_curves_and_odd_meshes():
    fin = nonmanifold()
    with pytest.warns(UserWarning, match="fin: fast marching needs a manifold .*distances run along edges"):
        found = distance_to_curve(fin, nodal_crossings(fin, fin.verts[:, 0] - 0.3))
    assert torch.isfinite(found).all()
    ball = sphere(1)
    stray = Mesh(torch.cat([ball.verts, ball.verts[:1]]), ball.faces)
    found = distance_to_curve(stray, nodal_crossings(stray, stray.verts[:, 2] - 0.1))
    assert found[:-1].isfinite().all()
    assert found[-1].isinf()


@pytest.mark.parametrize(
    ("edges", "t", "fault"),
    [
        (torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0), "curve has 0 edges and 0 parameters"),
        (torch.tensor([[0, 1]]), torch.zeros(2), "curve has 1 edges and 2 parameters"),
        (torch.tensor([[0, 1]]), torch.tensor([1.5]), "curve has parameters from 1.5 to 1.5; allowed are 0 to 1"),
        (torch.tensor([[0, 1]]), torch.tensor([math.nan]), "allowed are 0 to 1"),
        (torch.tensor([[0, 24]]), torch.tensor([0.5]), r"edge \(0, 24\), which square does not have"),
        (torch.tensor([[0, 25]]), torch.tensor([0.5]), "curve holds 25"),
    ],
)
def test_bad_curves(edges, t, fault):
    with pytest.raises(ValueError, match=fault):
        distance_to_curve(square(5), (edges, t))


def test_bad_function_and_method():
    mesh = square(5)
    with pytest.raises(ValueError, match=r"f has shape \(3,\); one value for each of the 25 vertices"):
        nodal_crossings(mesh, torch.zeros(3))
    with pytest.raises(ValueError, match="method is 'heat'; allowed are 'fast_marching' and 'dijkstra'"):
        distance_to_curve(mesh, nodal_crossings(mesh, mesh.verts[:, 0] - 0.3), "heat")
