"""torchqm.symmetry.extrinsic: exact mirror planes are found wherever they lie, and none is made up."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from references.shapes import blob, icosphere, rotation
from scipy.spatial import cKDTree

from torchqm.data.synthetic import creature, exact_maps
from torchqm.geometry import Mesh
from torchqm.symmetry import SymmetryGroup, find_reflection, find_reflections
from torchqm.symmetry.extrinsic import _images, _Planes, _reflective_icp, extrinsic_group
from torchqm.testing import assert_orbit_equal


def lopsided() -> Mesh:
    """A ball with bumps of four sizes in no common plane."""
    ball = icosphere(3)
    radius = torch.ones(ball.n_verts, dtype=torch.float64)
    for place, height in (((1, 0, 0), 1.5), ((0, 1, 0.3), 1.1), ((-0.4, 0.2, 1), 0.8), ((-1, -1, -0.5), 0.5)):
        towards = torch.tensor(place, dtype=torch.float64)
        radius += height * torch.exp(-6 * (1 - ball.verts @ (towards / towards.norm())))
    return ball.moved(ball.verts * radius[:, None])


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_exact_plane_of_a_moved_blob(seed):
    mesh, group = blob(2)
    turn, shift = rotation(seed), torch.tensor([3.0, -2.0, 0.5], dtype=torch.float64) * seed
    found = find_reflection(mesh.moved(10.0**seed * (mesh.verts @ turn.T + shift)))
    assert torch.equal(found.map, group.maps[1])
    assert found.residual < 1e-9
    assert found.residual_max < 1e-9
    assert found.convincing
    assert abs(float(found.normal @ turn[:, 0])) == pytest.approx(1, abs=1e-9)
    assert float(found.normal.norm()) == pytest.approx(1)
    assert found.normal[found.normal.abs().argmax()] > 0
    side = found.side(10.0**seed * (mesh.verts @ turn.T + shift))
    torch.testing.assert_close(side.abs(), 10.0**seed * mesh.verts[:, 0].abs(), atol=1e-7, rtol=1e-7)
    torch.testing.assert_close(side[found.map], -side, atol=1e-7, rtol=1e-7)


def test_any_of_several_planes_will_do():
    mesh, group = blob(8)
    found = find_reflection(mesh.moved(mesh.verts @ rotation(5).T))
    assert found.residual < 1e-9
    planes = [g for g in (1, 2, 4) if torch.equal(found.map, group.maps[g])]
    assert len(planes) == 1


def test_different_triangulations_left_and_right():
    mesh, group = blob(2)
    moved = mesh.verts + torch.where(mesh.verts[:, :1] > 0.2, 0.004, 0.0)  # the right half's vertices sit elsewhere
    found = find_reflection(mesh.moved(moved), n_refine=2)
    assert found.convincing
    assert 1e-4 < found.residual < 0.01
    wrong = (found.map != group.maps[1]).double().mean()
    assert wrong < 0.1


def test_shape_without_a_plane_is_not_convincing():
    mesh = lopsided()
    found = find_reflection(mesh)
    assert not found.convincing
    assert found.residual_max >= found.residual
    assert not find_reflection(blob(1).mesh).convincing  # a gentle asymmetry, no larger than the vertex spacing


def test_reflective_icp_moves_the_plane_as_well():
    points = blob(2).mesh.verts.numpy() + np.array([0.05, 0.3, -0.2])
    start = np.array([1.0, 0.03, -0.02]) / np.linalg.norm([1.0, 0.03, -0.02])
    other = np.array([0.0, 0.0, 1.0])
    planes = _Planes(np.stack([start, other]), np.zeros(2))
    found = _reflective_icp(cKDTree(points), points, planes, steps=60)
    np.testing.assert_allclose(found.normals[0], [1, 0, 0], atol=1e-9)
    assert found.offsets[0] == pytest.approx(0.05, abs=1e-9)
    alone = _reflective_icp(cKDTree(points), points, planes.take([1]), steps=60)  # planes know nothing of one another
    np.testing.assert_allclose(found.normals[1], alone.normals[0], atol=1e-12)


def test_vertices_without_faces_are_no_images():
    mesh, group = blob(2)
    far = torch.tensor([[50.0, 0, 0]], dtype=torch.float64)
    found = find_reflection(Mesh(torch.cat([far, mesh.verts]), mesh.faces + 1))
    assert torch.equal(found.map[1:] - 1, group.maps[1])
    assert found.residual < 1e-9
    assert int(found.map.min()) >= 1  # the stray vertex's own image included


def test_same_seed_same_answer_and_group():
    mesh = lopsided()
    first, again = find_reflection(mesh, seed=3), find_reflection(mesh, seed=3)
    assert torch.equal(first.map, again.map)
    assert first.offset == again.offset
    exact = find_reflection(blob(4).mesh)
    group = SymmetryGroup.from_reflection(exact.map)
    assert group.residuals(blob(4).mesh.verts).inverse == 0
    assert_orbit_equal(exact.map, torch.arange(642), group.orbits)


def test_few_samples_are_enough_for_an_exact_plane():
    mesh, group = blob(2)
    found = find_reflection(mesh.moved(mesh.verts @ rotation(1).T), n_samples=50)
    assert torch.equal(found.map, group.maps[1])
    assert isinstance(found.offset, float)
    assert np.isfinite(found.spacing)


@pytest.mark.parametrize(("kind", "number"), [("biped", 1), ("ellipsoid", 3), ("octopus", 8)])
@pytest.mark.parametrize("retriangulate", [0, 1])
def test_all_the_planes_of_a_shape(kind, number, retriangulate):
    """Exactly as many as the creature has; each gives one of its reflections."""
    body = creature(kind, 1000, retriangulate=retriangulate)
    found = find_reflections(body.mesh)
    assert len(found) == number
    assert all(plane.convincing for plane in found)
    normals = torch.stack([plane.normal for plane in found])
    angles = torch.rad2deg(torch.arccos((normals @ normals.T).abs().clamp(max=1)))
    assert float((angles + 180 * torch.eye(number)).min()) > 20
    if not retriangulate:
        exact = {tuple(row) for row in exact_maps(body, body).nearest_vertices().tolist()}
        assert {tuple(plane.map.tolist()) for plane in found} <= exact


def test_mirror_images_of_two_planes_are_all_those_of_the_dihedral_group():
    angle = np.pi / 5
    normals = np.array([[1.0, 0.0, 0.0], [np.cos(angle), np.sin(angle), 0.0]])
    point = np.array([0.3, -0.2, 0.1])  # on all of them
    images = _images(_Planes(normals, normals @ point))
    every = np.concatenate([normals, images.normals])
    assert len(every) == 5
    turns = np.sort(np.degrees(np.arctan2(every[:, 1], every[:, 0])) % 180)
    np.testing.assert_allclose(np.diff(turns), 36, atol=1e-9)
    np.testing.assert_allclose(images.offsets, images.normals @ point, atol=1e-12)


def test_planes_generate_their_group(prism):
    planes = find_reflections(prism.mesh)
    assert torch.equal(find_reflection(prism.mesh).map, planes[0].map)  # the first is the one
    found = extrinsic_group(prism.mesh, planes)
    assert found.group.order == 16
    assert found.residual < 1e-9
    rows = {tuple(row) for row in prism.group.maps.tolist()}
    assert {tuple(row) for row in found.group.maps.tolist()} == rows
    assert int((found.orientation < 0).sum()) == 8
    assert found.group.residuals(prism.mesh.verts).name == "D4 x C2"
    alone = extrinsic_group(prism.mesh, planes[:1])
    assert alone.group.order == 2
    assert alone.orientation.tolist() == [1, -1]


def test_planes_of_no_finite_group_are_refused(prism):
    planes = find_reflections(prism.mesh)
    turned = torch.tensor([math.cos(1.0), math.sin(1.0), 0.0], dtype=torch.float64)  # an angle that is no part of pi
    upright = replace(planes[0], normal=torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), offset=0.0)
    with pytest.raises(ValueError, match="generate more than 12 elements"):
        extrinsic_group(prism.mesh, [upright, replace(upright, normal=turned)], most=12)
