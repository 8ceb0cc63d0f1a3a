"""torchqm.geometry.mesh: the quantities that follow from vertices and faces."""

import math

import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from torchqm.geometry import Mesh

SQUARE = ([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 1, 0]], [[0, 1, 2], [1, 3, 2]])


def test_square():
    mesh = Mesh.from_arrays(*SQUARE)
    assert (mesh.n_verts, mesh.n_faces) == (4, 2)
    assert mesh.area == 2.0
    assert torch.equal(mesh.face_areas, torch.ones(2, dtype=torch.float64))
    torch.testing.assert_close(mesh.vertex_areas, torch.tensor([1, 2, 2, 1], dtype=torch.float64) / 3)
    torch.testing.assert_close(mesh.face_normals, torch.tensor([[0, 0, 1.0]] * 2, dtype=torch.float64))
    assert mesh.edges.tolist() == [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    torch.testing.assert_close(mesh.edge_lengths, torch.tensor([2, 1, 5**0.5, 1, 2], dtype=torch.float64))


def test_dtypes_are_double_and_long():
    mesh = Mesh.from_arrays(torch.eye(3, dtype=torch.float32), [[0, 1, 2]])
    assert mesh.verts.dtype == torch.float64
    assert mesh.faces.dtype == torch.int64


def test_sphere_area_approaches_four_pi():
    errors = []
    for level in (2, 3, 4):
        sphere = trimesh.creation.icosphere(subdivisions=level)
        errors.append(4 * math.pi - Mesh.from_arrays(sphere.vertices, sphere.faces).area)
    assert errors[0] > errors[1] > errors[2] > 0  # inscribed
    assert errors[1] / errors[2] == pytest.approx(4, rel=0.05)  # second order


def test_unreferenced_vertices_keep_their_place():
    mesh = Mesh.from_arrays([[9, 9, 9], *SQUARE[0]], [[1, 2, 3]])
    assert mesh.referenced.tolist() == [False, True, True, True, False]
    assert mesh.vertex_areas[0] == 0


def test_repeated_corners_make_no_edge():
    assert Mesh.from_arrays(SQUARE[0], [[0, 0, 1]]).edges.tolist() == [[0, 1]]


def test_normal_of_a_degenerate_face_is_zero():
    assert Mesh.from_arrays(SQUARE[0], [[0, 0, 1]]).face_normals.tolist() == [[0, 0, 0]]


@settings(max_examples=20, deadline=None)
@given(st.floats(-150, 150), st.floats(-1e3, 1e3))
def test_normalized_has_area_one_at_any_scale(exponent, shift):
    verts = (torch.tensor(SQUARE[0], dtype=torch.float64) + shift) * 10.0**exponent
    unit = Mesh.from_arrays(verts, SQUARE[1]).normalized()
    assert unit.area == pytest.approx(1, rel=1e-6)
    centre = (unit.verts * unit.vertex_areas[:, None]).sum(0)
    assert centre.abs().max() < 1e-6


def test_label_names_the_file(tmp_path):
    assert Mesh.from_arrays(*SQUARE, name="a").label == "a"
    assert "x.off" in repr(Mesh.from_arrays(*SQUARE, path=tmp_path / "x.off"))
