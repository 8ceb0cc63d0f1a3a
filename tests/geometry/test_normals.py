"""torchqm.geometry.normals: as for one mesh, in a batch with padding."""

import torch
from references.shapes import blob, grid, icosphere

from torchqm.data import collate
from torchqm.geometry import Mesh, vertex_normals
from torchqm.geometry.normals import centred_unit_area, normals_at_vertices
from torchqm.testing import gradcheck64


def test_as_for_one_mesh_in_a_padded_batch():
    meshes = [blob(1).mesh, grid(5, 3, 2.0, 1.0)]
    batch = collate([{"verts": m.verts, "faces": m.faces, "mass": m.vertex_areas} for m in meshes])
    normals = normals_at_vertices(batch["verts"], batch["faces"])
    places = centred_unit_area(batch["verts"], batch["mass"])
    for i, mesh in enumerate(meshes):
        torch.testing.assert_close(normals[i, : mesh.n_verts], vertex_normals(mesh))
        torch.testing.assert_close(places[i, : mesh.n_verts], mesh.normalized().verts)
    assert not normals[1, 24:].any()


def test_without_a_face_or_an_area():
    mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2], [2, 1, 0]])
    verts = mesh.verts.clone().requires_grad_()
    normals = normals_at_vertices(verts, mesh.faces)
    assert not normals.any()
    normals.sum().backward()
    assert torch.equal(verts.grad, torch.zeros(4, 3, dtype=torch.float64))
    verts.grad = None
    places = centred_unit_area(verts, torch.zeros(4, dtype=torch.float64))
    assert not places.any()
    places.sum().backward()
    assert torch.equal(verts.grad, torch.zeros(4, 3, dtype=torch.float64))


def test_gradients():
    mesh = icosphere(0)
    gradcheck64(lambda v: normals_at_vertices(v, mesh.faces), mesh.verts)
    gradcheck64(centred_unit_area, mesh.verts, mesh.vertex_areas)
