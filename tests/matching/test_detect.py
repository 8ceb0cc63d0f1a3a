"""torchqm.matching.detect: exact groups are found without help, none is made up, poses have the group of the body."""

from functools import lru_cache

import pytest
import torch
from references.pairs import FAST, with_loose_vertices
from references.shapes import icosphere, prism

from torchqm.data.synthetic import creature, exact_maps
from torchqm.geometry import Mesh
from torchqm.matching import MatchParameters, detect_group, prepare

FULL, SMALL = MatchParameters(k_max=100), FAST.changed(k_max=40)
GROUPS = {"biped": (2, "C2"), "quadruped": (2, "C2"), "ellipsoid": (8, "C2 x C2 x C2"), "octopus": (16, "D8")}
POSES = {"biped": (1000, 2), "quadruped": (1500, 2), "ellipsoid": (1000, 2), "octopus": (1000, 1)}
"""Vertices and pose."""


@lru_cache
def detected(kind):
    """A pose in its own triangulation, what is found on it, and where the elements of its group truly send it."""
    n_verts, pose = POSES[kind]
    body = creature(kind, n_verts, 0, pose, retriangulate=1)
    shape = prepare(body.mesh, 100)
    truth = exact_maps(body, body).points(shape.mesh)
    return body, shape, detect_group(shape, FULL), truth


def errors(mesh, maps, truth):
    """``(G, G)`` mean distance between each found map and each true one."""
    return torch.stack([(mesh.verts[found] - truth).norm(dim=2).mean(1) for found in maps])


@pytest.fixture(scope="module")
def blob_found(exact):
    return detect_group(exact.x, SMALL)


def test_the_exact_reflection_of_a_blob(exact, blob_found):
    found = blob_found
    assert found.verdict == "symmetric"
    assert found.name == "C2"
    assert found.warnings == []
    assert found.group.order == 2
    assert float((found.group.maps == exact.group_x.maps).double().mean()) > 0.99
    assert found.parts["score"] < 1e-3
    assert found.parts["involution"] < 1e-3
    assert found.parts["orientation"] < -0.95
    assert found.orientation.tolist() == [1, -1]
    assert found.scores[0] == 0
    side = exact.side_x
    assert float((found.sign * side)[side != 0].mean().abs()) > 0.95


def test_an_exact_group_to_the_vertex():
    """All symmetries of a square prism, whose eigenvalues come in pairs."""
    mesh, group = prism()
    found = detect_group(prepare(mesh, 60), MatchParameters(k_max=60))
    assert (found.verdict, found.name, found.warnings) == ("symmetric", "D4 x C2", [])
    assert {tuple(m) for m in found.group.maps.tolist()} == {tuple(m) for m in group.maps.tolist()}
    residuals = found.group.residuals(mesh.verts)
    assert residuals.closure == 0
    assert torch.equal(residuals.products, found.products)


@pytest.mark.parametrize("kind", GROUPS)
def test_poses_with_their_own_triangulation(kind):
    body, shape, found, truth = detected(kind)
    order, name = GROUPS[kind]
    assert found.verdict == "symmetric"
    assert (found.group.order, found.name) == (order, name)
    assert found.warnings == []
    gaps = errors(shape.mesh, found.group.maps, truth)
    near, number = gaps.min(1)
    assert float(near.max()) < 0.025  # the vertex spacing
    assert sorted(number.tolist()) == list(range(order))  # each element once
    assert number[0] == 0
    assert found.orientation.tolist() == body.orientation[number].tolist()
    assert found.parts["moved"] > 0.9
    assert found.scores[0] == 0
    assert float(found.scores.max()) < 0.12


@pytest.mark.parametrize("kind", GROUPS)
def test_what_is_said_of_the_elements(kind):
    """Functional maps that make a group as well as the vertex maps do; left and right of a single reflection only."""
    _, shape, found, _ = detected(kind)
    order, k = found.group.order, found.fmaps.shape[1]
    assert found.fmaps.shape == (order, 100, 100)
    assert torch.equal(found.fmaps[0], torch.eye(k).double())
    torch.testing.assert_close(
        found.fmaps @ found.fmaps.transpose(1, 2), torch.eye(k).double().expand(order, k, k), atol=1e-8, rtol=0
    )
    assert found.scores.shape == found.orientation.shape == (order,)
    residuals = found.group.residuals(shape.mesh.verts)
    assert torch.equal(residuals.products, found.products)
    assert residuals.name == found.name
    assert residuals.closure < 0.03
    if order == 2:
        reflection, sign = found.group.maps[1], found.sign
        assert set(sign.tolist()) <= {-1.0, 0.0, 1.0}
        assert float((sign[reflection] == -sign).double().mean()) > 0.9
    else:
        assert not found.sign.any()


def test_runner_up_is_no_element():
    """Of a quadruped nothing else comes near; the pool of the octopus holds no more than its group."""
    parts = detected("quadruped")[2].parts
    assert parts["runner_up"] > 2 * parts["score"]
    assert parts["margin"] == pytest.approx(parts["runner_up"] / parts["score"])
    assert detected("octopus")[2].parts["runner_up"] > 0.1


def test_three_different_axes_without_tips():
    """A smooth ellipsoid: the signs of its first functions step in for the landmarks that it lacks."""
    ball = icosphere(2)
    mesh = Mesh(ball.verts * torch.tensor([1.0, 1.3, 1.7]).double(), ball.faces, "egg")
    found = detect_group(prepare(mesh, 40), MatchParameters(k_max=40))
    assert (found.verdict, found.name, found.warnings) == ("symmetric", "C2 x C2 x C2", [])
    signs = {
        tuple(float(torch.sign((mesh.verts[m] * mesh.verts)[:, a].sum())) for a in range(3)) for m in found.group.maps
    }
    assert len(signs) == 8
    assert (
        float(errors(mesh, found.group.maps, mesh.verts * torch.tensor(sorted(signs)).double()[:, None]).amin(1).max())
        < 1e-9
    )


def test_nothing_is_made_up():
    shape = prepare(creature("asymmetric", 600, 0, 1).mesh, 100)
    found = detect_group(shape, FULL)
    assert found.verdict == "asymmetric"
    assert found.name == "trivial"
    assert found.group.order == 1
    assert torch.equal(found.sign, torch.zeros(shape.n_verts, dtype=torch.float64))
    (text,) = found.warnings
    assert f"score {found.parts['score']:.2f}" in text
    assert f"commutativity {found.parts['commutativity']:.3f}" in text
    assert f"orientation {found.parts['orientation']:+.2f}" in text


def test_a_sphere_is_not_given_a_finite_group_without_a_warning():
    """What comes out depends on the triangles and the number of functions: D5 on 162 vertices, C2 to D8 on 642."""
    found = detect_group(prepare(icosphere(2), 60), MatchParameters(k_max=60))
    assert found.verdict in ("ambiguous", "asymmetric")
    assert found.group.order == 1 or "infinitely many symmetries" in found.warnings[-1]


def test_same_shape_same_answer(exact, blob_found):
    again = detect_group(exact.x, SMALL)
    assert torch.equal(blob_found.fmaps, again.fmaps)
    assert torch.equal(blob_found.group.maps, again.group.maps)
    assert blob_found.parts == again.parts
    assert blob_found.warnings == again.warnings


def test_inside_out_and_loose_vertices_do_not_matter(exact, blob_found):
    """The mesh as a file may hold it: all faces turned over, vertices of no triangle among the others."""
    turned = Mesh(exact.x.mesh.verts, exact.x.mesh.faces.flip(1), "turned")
    mesh, ids = with_loose_vertices(turned, [0, 5, 100])
    found = detect_group(prepare(mesh, 60), SMALL)
    assert (found.verdict, found.name) == ("symmetric", "C2")
    wanted = ids[blob_found.group.maps[1]]
    assert float((found.group.maps[1][ids] == wanted).double().mean()) > 0.99
    assert found.orientation.tolist() == [1, -1]


def test_few_functions_are_enough(exact):
    """Fewer than landmarks are compared in."""
    found = detect_group(exact.x, MatchParameters(k=20, k_max=20))
    assert found.verdict == "symmetric"
    assert found.fmaps.shape == (2, 20, 20)
    gap = exact.x.mesh.verts[found.group.maps[1]] - exact.x.mesh.verts[exact.group_x.maps[1]]
    assert float(gap.norm(dim=1).mean()) < 0.01


def test_small_triangles_do_not_hide_a_group():
    """At 45 functions a right map turns many of these triangles over; smooth functions say what it does."""
    shape = prepare(creature("octopus", 1000, pose=4, retriangulate=1).mesh, 45)
    found = detect_group(shape, MatchParameters(k_max=45))
    assert abs(found.parts["orientation"]) < 0.3
    assert (found.verdict, found.group.order) == ("symmetric", 16)
