import numpy as np
import pytest

from torchqm.data.creatures.locate import closest_points, normal_points
from torchqm.data.synthetic import creature


@pytest.fixture(scope="module")
def body():
    mesh = creature("ellipsoid", 500).mesh
    verts, faces = mesh.numpy()
    return verts, faces, mesh.face_normals.numpy()


def test_closest_points_agree_with_all_triangles(body):
    verts, faces, normals = body
    rng = np.random.default_rng(0)
    face, bary = rng.integers(0, len(faces), 50), rng.dirichlet(np.ones(3), 50)
    points = np.einsum("nk,nki->ni", bary, verts[faces[face]]) + 0.02 * normals[face]
    found_face, found_bary = closest_points(verts, faces, points)
    gap = np.linalg.norm(np.einsum("nk,nki->ni", found_bary, verts[faces[found_face]]) - points, axis=1)
    dense = rng.dirichlet(np.ones(3), 400)
    every = np.einsum("sk,fki->fsi", dense, verts[faces]).reshape(-1, 3)
    best = np.array([np.linalg.norm(every - p, axis=1).min() for p in points])
    assert (gap <= best + 1e-12).all()
    assert gap.max() < 0.02 + 1e-12


def test_points_on_the_mesh_are_found_where_they_are(body):
    verts, faces, _ = body
    rng = np.random.default_rng(1)
    face, bary = rng.integers(0, len(faces), 100), rng.dirichlet(np.full(3, 5.0), 100)
    points = np.einsum("nk,nki->ni", bary, verts[faces[face]])
    found_face, found_bary = closest_points(verts, faces, points)
    assert np.array_equal(found_face, face)
    assert np.abs(found_bary - bary).max() < 1e-9


def test_normal_points_invert_the_offset_along_interpolated_normals(body):
    verts, faces, face_normals = body
    normals = np.zeros_like(verts)
    np.add.at(normals, faces.reshape(-1), np.repeat(face_normals, 3, axis=0))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rng = np.random.default_rng(2)
    face, bary = rng.integers(0, len(faces), 100), rng.dirichlet(np.full(3, 5.0), 100)
    points = np.einsum("nk,nki->ni", bary, verts[faces[face]] + 0.004 * normals[faces[face]])
    found_face, found_bary = normal_points(verts, faces, normals, points)
    assert np.array_equal(found_face, face)
    assert np.abs(found_bary - bary).max() < 1e-6
