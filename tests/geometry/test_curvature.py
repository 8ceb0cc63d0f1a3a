"""torchqm.geometry.curvature: spheres, cylinders and planes have the curvature that they are known to have."""

import math

import pytest
import torch
from references.shapes import icosphere

from torchqm.geometry import Mesh
from torchqm.geometry.curvature import mean_curvature, vertex_normals


@pytest.mark.parametrize("radius", [0.3, 1.0, 5.0])
def test_a_sphere_has_one_over_its_radius(radius):
    sphere = icosphere(3)
    scaled = sphere.moved(radius * sphere.verts)
    found = radius * mean_curvature(scaled)
    assert float(scaled.vertex_areas @ found / scaled.area) == pytest.approx(1, rel=2e-5)
    # Its twelve vertices of degree five have a barycentric area that is a seventh too small; all others are exact.
    deviation = (found - 1).abs().sort().values
    assert float(deviation[-13]) < 0.02
    assert 0.13 < float(deviation[-12]) < 0.15
    torch.testing.assert_close(vertex_normals(scaled), sphere.verts, atol=0.02, rtol=0)


def test_a_surface_inside_out_has_the_opposite_sign():
    sphere = icosphere(2)
    turned = Mesh(sphere.verts, sphere.faces.flip(1))
    torch.testing.assert_close(mean_curvature(turned), -mean_curvature(sphere))


def test_a_cylinder_has_half_one_over_its_radius_and_a_plane_none():
    n, rows, radius = 60, 12, 2.0
    angle = 2 * math.pi * torch.arange(n, dtype=torch.float64) / n
    height = 2 * math.pi * radius / n * torch.arange(rows, dtype=torch.float64)
    around, up = angle.repeat(rows), height.repeat_interleave(n)
    verts = torch.stack([radius * around.cos(), radius * around.sin(), up], 1)
    flat = torch.stack([radius * around, torch.zeros_like(up), up], 1)
    i, j = torch.meshgrid(torch.arange(rows - 1), torch.arange(n), indexing="ij")
    a, b, c, d = i * n + j, i * n + (j + 1) % n, (i + 1) * n + (j + 1) % n, (i + 1) * n + j
    faces = torch.cat([torch.stack([a, b, c], -1).reshape(-1, 3), torch.stack([a, c, d], -1).reshape(-1, 3)])
    inner = slice(n, (rows - 1) * n)
    curvature = mean_curvature(Mesh(verts, faces))[inner]
    torch.testing.assert_close(curvature, torch.full_like(curvature, 0.5 / radius), rtol=0.01, atol=0)
    open_faces = faces[(verts[faces][..., :2].amax(1) - verts[faces][..., :2].amin(1)).norm(dim=1) < radius]
    keep = open_faces[(flat[open_faces][..., 0].amax(1) - flat[open_faces][..., 0].amin(1)) < radius]
    plane = mean_curvature(Mesh(flat, keep)).reshape(rows, n)[1:-1, 1:-1]
    torch.testing.assert_close(plane, torch.zeros_like(plane), atol=1e-9, rtol=0)


def test_loose_vertices_and_flat_triangles_have_none():
    sphere = icosphere(1)
    verts = torch.cat([sphere.verts, torch.full((2, 3), 9.0, dtype=torch.float64)])
    faces = torch.cat([sphere.faces, torch.tensor([[0, 0, 1]])])
    found = mean_curvature(Mesh(verts, faces))
    assert torch.isfinite(found).all()
    assert found[-2:].tolist() == [0.0, 0.0]
