"""torchqm.geometry.geodesic_solver: one set-up for many questions, the same answers, and nothing kept for too long."""

import gc
import weakref
from threading import Event, Thread
from time import sleep

import pytest
import torch
import trimesh

import torchqm.geometry.geodesic_solver as module
import torchqm.geometry.geodesic_surface as surface_module
from torchqm.geometry import GeodesicSolver, Mesh, distances

METHODS = list(module.METHODS)


def sphere(level=2):
    ball = trimesh.creation.icosphere(subdivisions=level)
    return Mesh.from_arrays(ball.vertices, ball.faces, name="ball")


def fin():
    """Three triangles at one edge: no manifold."""
    return Mesh.from_arrays(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]], [[0, 1, 2], [0, 1, 3], [0, 1, 4]], "fin"
    )


@pytest.fixture
def set_ups(monkeypatch):
    """The label of the mesh and the method of every set-up."""
    seen = []
    module._KEPT.clear()

    def counting(name, build):
        return lambda surface: seen.append((surface.label, name)) or build(surface)

    monkeypatch.setattr(module, "_SET_UP", {name: counting(name, build) for name, build in module._SET_UP.items()})
    yield seen
    module._KEPT.clear()


@pytest.mark.parametrize("method", METHODS)
def test_a_solver_that_was_used_before_gives_the_numbers_of_a_new_one(method):
    mesh = sphere()
    solver = GeodesicSolver(mesh, method)
    for sources in ([3], [77, 3, 161], [5]):
        assert torch.equal(solver.distances(sources), GeodesicSolver(mesh, method).distances(sources))
    few = torch.tensor([9, 2])
    assert torch.equal(solver.distances([5, 6], few), solver.distances([5, 6])[:, few])


@pytest.mark.parametrize("method", METHODS)
def test_calls_on_one_mesh_share_one_set_up(method, set_ups):
    mesh = sphere()
    first = distances(mesh, [0, 1], method)
    assert torch.equal(distances(mesh, [1, 0], method), first.flip(0))
    assert set_ups == [("ball", method)]
    distances(sphere(), [0], method)  # equal, but another mesh
    assert len(set_ups) == 2


def test_another_method_is_another_solver(set_ups):
    mesh = sphere()
    rows = [distances(mesh, [0], method) for method in ("dijkstra", "heat", "dijkstra")]
    assert [name for _, name in set_ups] == ["dijkstra", "heat", "dijkstra"]  # one a mesh is kept
    assert torch.equal(rows[0], rows[2])
    assert not torch.equal(rows[0], rows[1])


def test_the_mesh_asked_for_longest_ago_is_forgotten(set_ups):
    meshes = [sphere(1) for _ in range(module.KEEP + 1)]
    for mesh in meshes[:-1]:
        distances(mesh, [0], "dijkstra")
    distances(meshes[0], [0], "dijkstra")  # is now the last that was asked for
    distances(meshes[-1], [0], "dijkstra")
    assert list(module._KEPT) == [*meshes[2:-1], meshes[0], meshes[-1]]
    assert len(set_ups) == module.KEEP + 1


def test_a_kept_solver_does_not_keep_its_mesh():
    module._KEPT.clear()
    mesh = sphere(1)
    distances(mesh, [0], "heat")
    assert len(module._KEPT) == 1
    gone = weakref.ref(mesh)
    del mesh
    gc.collect()
    assert gone() is None
    assert len(module._KEPT) == 0


def test_what_runs_is_named():
    solver = GeodesicSolver(fin())
    assert solver.used == "heat"
    assert solver.note.startswith("fin: fast marching needs a manifold (1 non-manifold edges")
    assert torch.equal(solver.distances([0]), GeodesicSolver(fin(), "heat").distances([0]))
    assert (GeodesicSolver(sphere(1)).used, GeodesicSolver(sphere(1)).note) == ("fast_marching", "")


def test_every_call_on_a_mesh_that_cannot_be_marched_on_warns():
    mesh = fin()
    for _ in range(2):
        with pytest.warns(UserWarning, match="the heat method is used instead"):
            distances(mesh, [0])


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method is 'euclid'; allowed are 'fast_marching', 'heat'"):
        GeodesicSolver(sphere(1), "euclid")


def test_a_mesh_that_was_written_into_gets_a_new_solver():
    mesh = Mesh.from_arrays([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 1, 0]], [[0, 1, 2], [1, 3, 2]])
    before = distances(mesh, [0])
    mesh.verts.mul_(3)
    torch.testing.assert_close(distances(mesh, [0]), 3 * before)


def test_threads_that_come_while_the_triangles_are_oriented_wait(monkeypatch):
    entered, inner = Event(), surface_module.inspect_mesh

    def slow(mesh):
        entered.set()
        sleep(0.1)
        return inner(mesh)

    monkeypatch.setattr(surface_module, "inspect_mesh", slow)
    verts, faces = trimesh.creation.icosphere(1).vertices, trimesh.creation.icosphere(1).faces
    surface = surface_module.Surface(Mesh.from_arrays(verts, faces[:, ::-1]))
    first = Thread(target=lambda: surface.why_not_marching)
    first.start()
    assert entered.wait(10)
    _, n = surface.marching_solver()  # raised, while another thread was at it
    first.join()
    assert n == len(verts)
