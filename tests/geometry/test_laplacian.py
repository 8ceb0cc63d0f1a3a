"""torchqm.geometry.laplacian: exact small matrices, the properties of a Laplacian, and the choice of its kind."""

import numpy as np
import pytest
import robust_laplacian
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from torchqm.geometry import Mesh, cotan_matrix, cotan_stiffness, laplacian, lumped_mass, robust_stiffness, to_scipy

GRID = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
TWO = [[0, 1, 2], [1, 3, 2]]


def sphere(level=2):
    ball = trimesh.creation.icosphere(subdivisions=level)
    return Mesh.from_arrays(ball.vertices, ball.faces, name="ball")


def planar(n=7, seed=0):
    """A square grid with its inner points moved at random, and its Delaunay triangles; which vertices are inside."""
    grid = np.stack(np.meshgrid(np.arange(n), np.arange(n), indexing="ij"), -1).reshape(-1, 2) / (n - 1)
    inside = ((grid > 0) & (grid < 1)).all(1)
    grid[inside] += np.random.default_rng(seed).uniform(-0.25, 0.25, (inside.sum(), 2)) / (n - 1)
    mesh = Mesh.from_arrays(np.column_stack([grid, np.zeros(len(grid))]), Delaunay(grid).simplices)
    return mesh, torch.from_numpy(inside)


def test_right_triangle_by_hand():
    stiffness = cotan_stiffness(torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), torch.tensor([[0, 1, 2]]))
    expected = torch.tensor([[1, -0.5, -0.5], [-0.5, 0.5, 0], [-0.5, 0, 0.5]])
    torch.testing.assert_close(stiffness.to_dense(), expected)


def test_square_is_the_five_point_stencil():
    stiffness = cotan_stiffness(torch.tensor(GRID, dtype=torch.float64), torch.tensor(TWO)).to_dense()
    expected = torch.tensor([[2, -1, -1, 0], [-1, 2, 0, -1], [-1, 0, 2, -1], [0, -1, -1, 2]], dtype=torch.float64) / 2
    torch.testing.assert_close(stiffness, expected)


def test_equilateral_triangle():
    verts = torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, 3**0.5 / 2, 0]], dtype=torch.float64)
    off_diagonal = cotan_stiffness(verts, torch.tensor([[0, 1, 2]])).to_dense()[0, 1]
    assert off_diagonal.item() == pytest.approx(-(1 / 3**0.5) / 2)


@pytest.mark.parametrize("kind", ["cotan", "robust"])
def test_symmetric_semidefinite_with_constants_as_kernel(kind):
    mesh, _ = planar()
    operator = laplacian(mesh, kind)
    assert operator.stiffness.is_coalesced()
    dense = operator.stiffness.to_dense()
    torch.testing.assert_close(dense, dense.T, rtol=0, atol=1e-12)
    assert dense.sum(1).abs().max() < 1e-9
    assert (dense.diagonal() > 0).all()
    values = torch.linalg.eigvalsh(dense)
    assert values[0] > -1e-9
    assert values[1] > 1e-6  # one component, one constant
    assert operator.mass.sum().item() == pytest.approx(mesh.area, rel=1e-4)


@pytest.mark.parametrize("kind", ["cotan", "robust"])
def test_linear_functions_are_harmonic_inside_a_planar_mesh(kind):
    mesh, inside = planar()
    residual = laplacian(mesh, kind).stiffness @ mesh.verts
    assert residual[inside].abs().max() < (1e-11 if kind == "cotan" else 1e-4)  # robust: edges are mollified


def test_dirichlet_energy_of_a_linear_function_is_its_gradient_squared_times_the_area():
    mesh, _ = planar()
    f = mesh.verts @ torch.tensor([3.0, -2.0, 0.0], dtype=torch.float64)
    assert (f @ (cotan_stiffness(mesh.verts, mesh.faces) @ f)).item() == pytest.approx(13 * mesh.area)


def test_gradcheck():
    mesh, _ = planar(n=3)
    verts = mesh.verts + 0.1 * torch.randn(mesh.verts.shape, generator=torch.Generator().manual_seed(0)).double()

    def dense(v):
        return cotan_stiffness(v, mesh.faces).to_dense()

    def mass(v):
        return lumped_mass(v, mesh.faces)

    assert torch.autograd.gradcheck(dense, (verts.requires_grad_(),))
    assert torch.autograd.gradcheck(mass, (verts,))


def test_a_flat_triangle_adds_nothing_and_has_a_finite_gradient():
    verts = torch.tensor([*GRID, [2, 0, 0]], dtype=torch.float64, requires_grad=True)
    faces = torch.tensor([*TWO, [0, 1, 4], [0, 0, 1]])
    stiffness = cotan_stiffness(verts, faces).to_dense()
    torch.testing.assert_close(stiffness, cotan_stiffness(verts, torch.tensor(TWO)).to_dense())
    stiffness.square().sum().backward()
    assert torch.isfinite(verts.grad).all()


def test_robust_without_mollification_is_the_cotangent_laplacian_on_delaunay_meshes():
    # The icosphere is intrinsically Delaunay; a planar Delaunay triangulation is so too.
    for mesh in (sphere(), planar()[0]):
        stiffness, mass = robust_stiffness(mesh, mollify=0.0)
        torch.testing.assert_close(stiffness.to_dense(), cotan_stiffness(mesh.verts, mesh.faces).to_dense())
        torch.testing.assert_close(mass, mesh.vertex_areas)


def test_robust_is_the_library_itself_in_the_units_of_the_mesh():
    mesh, _ = planar()
    mesh = mesh.moved(mesh.verts * 37.0 + 5.0)
    stiffness, mass = robust_stiffness(mesh)
    raw, raw_mass = robust_laplacian.mesh_laplacian(*mesh.numpy())
    np.testing.assert_allclose(to_scipy(stiffness).toarray(), raw.toarray(), atol=1e-9)
    np.testing.assert_allclose(mass.numpy(), raw_mass.diagonal())


@pytest.mark.parametrize("kind", ["cotan", "robust"])
@pytest.mark.parametrize("scale", [1e-150, 1e-12, 1e12, 1e150])
def test_any_scale(kind, scale):
    mesh = sphere(1)
    plain, scaled = laplacian(mesh, kind), laplacian(mesh.moved(mesh.verts * scale), kind)
    torch.testing.assert_close(scaled.stiffness.to_dense(), plain.stiffness.to_dense(), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(scaled.mass / scale**2, plain.mass)
    assert laplacian(mesh.moved(mesh.verts * scale)).reason == laplacian(mesh).reason


@pytest.mark.parametrize("kind", ["cotan", "robust"])
def test_unreferenced_vertices_have_empty_rows_and_no_mass(kind):
    ball = sphere(1)
    verts = torch.cat(
        [torch.full((1, 3), 7.0, dtype=torch.float64), ball.verts, torch.zeros(1, 3, dtype=torch.float64)]
    )
    operator = laplacian(Mesh(verts, ball.faces + 1), kind)
    rows = operator.stiffness.indices()[0]
    assert set(rows.tolist()) == set(range(1, ball.n_verts + 1))
    assert (operator.mass == 0).nonzero().flatten().tolist() == [0, ball.n_verts + 1]
    alone = laplacian(ball, kind)
    torch.testing.assert_close(operator.stiffness.to_dense()[1:-1, 1:-1], alone.stiffness.to_dense())


@pytest.mark.parametrize("kind", ["cotan", "robust"])
def test_repeated_triangles_count_once(kind):
    ball = sphere(1)
    twice = Mesh(
        ball.verts, torch.cat([ball.faces, ball.faces[:5], ball.faces[3:4].flip(1), ball.faces[:1, [0, 0, 1]]])
    )
    torch.testing.assert_close(laplacian(twice, kind).stiffness.to_dense(), laplacian(ball, kind).stiffness.to_dense())
    torch.testing.assert_close(laplacian(twice, kind).mass, laplacian(ball, kind).mass)


@pytest.mark.parametrize(
    ("verts", "faces", "kind", "reason"),
    [
        (GRID, TWO, "cotan", "manifold, no flat triangle"),
        ([*GRID, [0.5, 0.5, 1]], [*TWO, [1, 2, 4]], "robust", "1 non-manifold edges"),
        ([*GRID, [-1, 0, 0], [0, -1, 0]], [*TWO, [0, 4, 5]], "robust", "1 such vertices"),
        ([*GRID, [0.5, 0, 0]], [*TWO, [0, 4, 1]], "robust", "1 flat triangles"),
        ([*GRID, [0.5, -2e-3, 0]], [*TWO, [0, 4, 1]], "robust", "0.1% of the area"),
        ([*GRID, [0.5, -1e-4, 0]], [*TWO, [0, 4, 1]], "cotan", "0.005% of the area"),
    ],
)
def test_the_rule(verts, faces, kind, reason):
    operator = laplacian(Mesh.from_arrays(verts, faces))
    assert operator.kind == kind
    assert reason in operator.reason
    assert torch.isfinite(operator.stiffness.values()).all()
    assert (operator.mass > 0).all()


def test_unknown_kind():
    with pytest.raises(ValueError, match="kind is 'fem'; allowed are 'auto', 'cotan' and 'robust'"):
        laplacian(sphere(1), "fem")


def test_to_scipy_round_trip():
    dense = torch.tensor([[0.0, 2, 0], [1, 0, 3]], dtype=torch.float64)
    for sparse in (dense.to_sparse_coo(), dense.T.to_sparse_coo().T):
        assert (to_scipy(sparse).toarray() == dense.numpy()).all()
    assert to_scipy(sparse).format == "csr"


@settings(max_examples=15, deadline=None)
@given(st.randoms(use_true_random=False), st.sampled_from(["cotan", "robust"]))
def test_renumbering_the_vertices_permutes_the_matrix(random, kind):
    mesh = sphere(1)
    order = list(range(mesh.n_verts))
    random.shuffle(order)
    new_id = torch.empty(mesh.n_verts, dtype=torch.int64)
    new_id[order] = torch.arange(mesh.n_verts)
    plain, renumbered = laplacian(mesh, kind), laplacian(Mesh(mesh.verts[order], new_id[mesh.faces]), kind)
    expected = plain.stiffness.to_dense()[order][:, order]
    torch.testing.assert_close(renumbered.stiffness.to_dense(), expected, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(renumbered.mass, plain.mass[order])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10**6))
def test_energy_never_grows_negative_on_bad_triangles(seed):
    generator = torch.Generator().manual_seed(seed)
    verts = torch.randn(12, 3, generator=generator, dtype=torch.float64)
    verts[:, 2] *= 1e-3
    faces = torch.stack([torch.randperm(12, generator=generator)[:3] for _ in range(20)])
    values = torch.linalg.eigvalsh(cotan_stiffness(verts, faces).to_dense())
    assert values[0] > -1e-9 * values[-1]


@pytest.mark.parametrize("faces", [TWO, [*TWO, [0, 0, 3], [0, 1, 2]], [[0, 1, 2]]])
def test_the_matrix_for_scipy_is_the_same(faces):
    """Also with a corner twice, a triangle twice, and a vertex without triangles."""
    verts, faces = torch.tensor(GRID, dtype=torch.float64) + 0.3 * planar(2)[0].verts, torch.tensor(faces)
    found = torch.from_numpy(cotan_matrix(verts, faces).toarray())
    torch.testing.assert_close(found, cotan_stiffness(verts, faces).to_dense(), atol=1e-14, rtol=0)


def test_the_matrix_for_scipy_is_the_same_to_the_last_bit():
    """Its last digits have decided which of two maps of equal quality was returned."""
    ball = sphere(5)  # torch adds in no certain order where there are few entries
    verts = ball.verts + 0.1 * torch.randn(ball.verts.shape, generator=torch.Generator().manual_seed(0)).double()
    found, slow = cotan_matrix(verts, ball.faces), to_scipy(cotan_stiffness(verts, ball.faces))
    assert (found != slow).nnz == 0
