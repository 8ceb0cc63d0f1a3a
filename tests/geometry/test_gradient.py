import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references import shapes

from torchqm.geometry import Mesh, cotan_stiffness, lumped_mass
from torchqm.geometry.gradient import tangent_frames, vertex_gradient


def harmonics(mesh):
    """Spherical harmonics of degree 1 and 2 (not normalised) with their eigenvalues."""
    x, y, z = mesh.verts.T
    return torch.stack([x, y, z, x * y, y * z, x * z, 3 * z * z - 1, x * x - y * y], 1), [2.0] * 3 + [6.0] * 5


def weak_laplacian(mesh, values):
    """``-div grad`` from the operators, integrated over vertex areas."""
    g = vertex_gradient(mesh)
    mass = lumped_mass(mesh.verts, mesh.faces)[:, None]
    return g.grad_x.T @ (mass * (g.grad_x @ values)) + g.grad_y.T @ (mass * (g.grad_y @ values))


@given(st.tuples(*[st.floats(-10, 10)] * 3), st.integers(0, 50), st.floats(-8, 8))
def test_linear_functions_on_a_plane_have_their_exact_gradient_at_every_vertex(slope, seed, decade):
    """Also at the boundary and its corners, in any position, at any scale."""
    flat, turn, size = shapes.grid(5, 4, 1.5, 1.0), shapes.rotation(seed), 10**decade
    rng = np.random.default_rng(seed)
    jitter = torch.from_numpy(rng.uniform(-0.08, 0.08, (flat.n_verts, 3)) * [1, 1, 0])
    mesh = flat.moved(size * ((flat.verts + jitter) @ turn.T))
    gradient = torch.tensor(slope, dtype=torch.float64)
    normal = turn[:, 2]
    tangential = gradient - (gradient @ normal) * normal
    found = vertex_gradient(mesh).vectors((mesh.verts @ gradient)[:, None])[:, 0]
    assert torch.allclose(found, tangential.expand_as(found), atol=1e-9)


def test_divergence_and_gradient_fit_together_on_the_sphere():
    """``h . (-div grad f)`` is ``l (l + 1) <h, f>`` for harmonics, to second order, as the cotangent Laplacian says."""
    worst = []
    for level in (2, 3):
        mesh = shapes.icosphere(level)
        f, evals = harmonics(mesh)
        mass = lumped_mass(mesh.verts, mesh.faces)[:, None]
        inner = f.T @ (mass * f)
        norm = inner.diagonal().sqrt()
        error = (f.T @ weak_laplacian(mesh, f) - inner * torch.tensor(evals)) / (norm[:, None] * norm)
        cotan = f.T @ (cotan_stiffness(mesh.verts, mesh.faces) @ f)
        against = (f.T @ weak_laplacian(mesh, f) - cotan) / (norm[:, None] * norm)
        worst.append([float(error.abs().max()), float(against.abs().max())])
    assert worst[1][0] < 0.15  # of eigenvalues 2 and 6
    assert worst[1][1] < 0.12
    assert all(coarse / fine > 3.5 for coarse, fine in zip(*worst, strict=True))  # 4 in the limit: second order


def test_gradient_of_height_on_the_sphere_points_up_along_the_surface():
    up, worst = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64), []
    for level in (2, 3):
        mesh = shapes.icosphere(level)
        found = vertex_gradient(mesh).vectors(mesh.verts[:, 2:])[:, 0]
        exact = up - mesh.verts[:, 2:] * mesh.verts  # of length sqrt(1 - z^2)
        worst.append(float((found - exact).norm(dim=1).max()))
    assert worst[1] < 0.03
    assert worst[0] / worst[1] > 1.6


def test_frames_are_right_handed_and_tangent(mirror_blob):
    mesh = mirror_blob.mesh
    frames = tangent_frames(mesh)
    assert torch.allclose(frames @ frames.mT, torch.eye(3, dtype=torch.float64).expand_as(frames), atol=1e-12)
    assert torch.allclose(torch.linalg.det(frames), torch.ones(mesh.n_verts, dtype=torch.float64))
    sphere = shapes.icosphere(3)
    assert float((tangent_frames(sphere)[:, 2] * sphere.verts).sum(1).min()) > 0.999  # outward


def test_given_frames_turn_the_components_and_not_the_vectors(mirror_blob):
    mesh = mirror_blob.mesh
    frames = tangent_frames(mesh)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = torch.stack([c * frames[:, 0] + s * frames[:, 1], c * frames[:, 1] - s * frames[:, 0], frames[:, 2]], 1)
    a, b = vertex_gradient(mesh), vertex_gradient(mesh, turned)
    f = mesh.verts.sin()
    assert torch.allclose(a.vectors(f), b.vectors(f), atol=1e-9)
    assert torch.allclose(b.grad_x @ f, c * (a.grad_x @ f) + s * (a.grad_y @ f), atol=1e-9)


@given(st.integers(0, 50), st.floats(-6, 6))
def test_constants_have_none_and_size_and_position_do_not_matter(seed, decade):
    mesh = shapes.blob(1, 2).mesh
    size = 10**decade
    moved = mesh.moved(size * (mesh.verts @ shapes.rotation(seed).T) + size)
    f = torch.from_numpy(np.random.default_rng(seed).standard_normal((mesh.n_verts, 2)))
    a, b = (vertex_gradient(m) for m in (mesh, moved))
    lengths = [g.vectors(f).norm(dim=2) for g in (a, b)]
    assert torch.allclose(lengths[0], size * lengths[1], rtol=1e-6)
    ones = torch.ones(mesh.n_verts, 1, dtype=torch.float64)
    assert float((b.grad_x @ ones).abs().max()) < 1e-9 / size


def test_stored_entries_are_the_edges_and_the_diagonal(mirror_blob):
    mesh = mirror_blob.mesh
    g = vertex_gradient(mesh)
    assert g.grad_x.is_coalesced()
    assert g.grad_x._nnz() == 2 * len(mesh.edges) + mesh.n_verts
    assert torch.equal(g.grad_x.indices(), g.grad_y.indices())


def test_loose_vertices_have_empty_rows_and_degenerate_ones_stay_finite():
    """Vertex 3 belongs to nothing; 4, 5, 6 make a triangle without area along a line."""
    mesh = Mesh.from_arrays(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9], [2, 0, 0], [3, 0, 0], [5, 0, 0]], [[0, 1, 2], [4, 5, 6]]
    )
    g = vertex_gradient(mesh)
    f = 2 * mesh.verts[:, :1] + 7 * mesh.verts[:, 1:2]
    found = g.vectors(f)[:, 0]
    assert torch.equal(found[3], torch.zeros(3, dtype=torch.float64))
    assert torch.allclose(found[:3, :2], torch.tensor([2.0, 7.0], dtype=torch.float64))
    assert torch.allclose(found[4:], torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64))


def test_frames_of_another_mesh_are_refused(sphere):
    with pytest.raises(ValueError, match=r"frames: shape \(3, 3, 3\) given; sphere3 needs \(642, 3, 3\)"):
        vertex_gradient(sphere, torch.zeros(3, 3, 3, dtype=torch.float64))
