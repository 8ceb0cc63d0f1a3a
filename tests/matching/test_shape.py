import pytest
import torch
from references.pairs import K, with_loose_vertices
from references.shapes import basis_of, blob, grid
from threadpoolctl import threadpool_limits

import torchqm.matching.shape as module
from torchqm.data.synthetic import creature
from torchqm.fmap import nearest_rows
from torchqm.geometry import Mesh, area_samples
from torchqm.matching import prepare
from torchqm.spectral import SpectralBasis, SpectrumError
from torchqm.testing import basis_allclose


@pytest.fixture(scope="module")
def mesh():
    return blob(2).mesh


@pytest.fixture(scope="module")
def shape(mesh):
    return prepare(mesh, 20)


def test_unit_area_around_the_centroid(mesh, shape):
    assert shape.mesh.area == pytest.approx(1, abs=1e-12)
    centres = shape.mesh.verts[shape.mesh.faces].mean(1)
    assert (centres * shape.mesh.face_areas[:, None]).sum(0).abs().max() < 1e-12
    assert shape.scale == pytest.approx(mesh.area**0.5)
    torch.testing.assert_close(shape.mesh.edge_lengths * shape.scale, mesh.edge_lengths)
    assert (shape.n_verts, shape.oriented, shape.warnings) == (642, True, [])
    assert shape.operator.startswith("cotan: ")


def test_eigenpairs_of_the_unit_mesh(mesh, shape):
    wanted = basis_of(mesh.normalized(), 20)
    torch.testing.assert_close(shape.basis.evals, wanted.evals, atol=1e-8, rtol=1e-9)
    assert basis_allclose(shape.basis.evecs, wanted.evecs, wanted.evals, wanted.mass)
    assert float(shape.basis.mass.sum()) == pytest.approx(1)


def test_robust_operator_on_demand(mesh):
    assert prepare(mesh, 5, kind="robust").operator.startswith("robust: ")


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_no_unit_changes_anything(mesh, shape, scale):
    other = prepare(mesh.moved(mesh.verts * scale), 20)
    torch.testing.assert_close(other.mesh.verts, shape.mesh.verts)
    torch.testing.assert_close(other.basis.evals, shape.basis.evals, atol=1e-8, rtol=1e-9)
    assert other.scale == pytest.approx(shape.scale * scale)
    assert torch.equal(other.samples, shape.samples)


def test_samples_follow_the_seed(mesh, shape):
    assert torch.equal(torch.sort(shape.samples).values, torch.arange(642))  # more are asked for than there are
    few, again, other = (prepare(mesh, 5, n_samples=50, seed=seed).samples for seed in (3, 3, 4))
    assert torch.equal(few, again)
    assert not torch.equal(few, other)
    assert torch.equal(few, area_samples(mesh, 50, 3))
    assert torch.equal(prepare(mesh, 5, n_samples=30, seed=3).samples, few[:30])


def test_given_eigenpairs_are_used(mesh):
    basis = basis_of(mesh, 30)  # of another scale: recognisable
    assert torch.equal(prepare(mesh, 20, basis=basis).basis.evecs, basis.evecs[:, :20])
    with pytest.raises(ValueError, match="k=31"):
        prepare(mesh, 31, basis=basis)


def test_eigenpairs_from_the_cache_are_those_that_are_computed(mesh, shape, tmp_path, monkeypatch):
    first = prepare(mesh, 20, cache_dir=tmp_path)
    monkeypatch.setattr("torchqm.spectral.cache.eigenbasis_and_note", None)  # from here on nothing can be computed
    again, fewer = prepare(mesh, 20, cache_dir=tmp_path), prepare(mesh, 9, cache_dir=tmp_path)
    monkeypatch.setenv("TORCHQM_CACHE", str(tmp_path))
    for found in (first, again, prepare(mesh, 20)):
        torch.testing.assert_close(found.basis.evals, shape.basis.evals)
        torch.testing.assert_close(found.basis.mass, shape.basis.mass)
        assert basis_allclose(found.basis.evecs, shape.basis.evecs, shape.basis.evals, shape.basis.mass)
        assert found.operator.startswith(f"{shape.operator}; eigenpairs: torchqm ")
        assert found.warnings == []
    assert torch.equal(first.basis.evecs, again.basis.evecs)
    assert again.operator.endswith(", from the cache")
    assert fewer.basis.k == 9


def test_a_damaged_cache_is_a_warning_of_the_shape(mesh, tmp_path, recwarn):
    prepare(mesh, 5, cache_dir=tmp_path)
    (path,) = tmp_path.glob("*.npz")
    path.write_bytes(b"")
    (text,) = prepare(mesh, 5, cache_dir=tmp_path).warnings
    assert text.startswith(f"{path}: damaged or foreign cache entry")
    assert prepare(mesh, 5, cache_dir=tmp_path).warnings == []
    assert len(recwarn) == 0  # told once


def test_more_eigenpairs_than_vertices(mesh):
    with pytest.raises(SpectrumError, match=r"blob2: 643 eigenpairs.*642"):
        prepare(mesh, 643)


def test_inside_out_is_turned(mesh, shape):
    turned = prepare(Mesh(mesh.verts, mesh.faces.flip(1), "sock"), 5)
    assert torch.equal(turned.mesh.faces, mesh.faces)
    assert turned.warnings == ["sock: the surface was inside out: all triangles were turned over"]
    assert turned.oriented


@pytest.mark.parametrize("inside_out", [False, True])
def test_mixed_orientation_is_repaired(mesh, inside_out):
    faces = mesh.faces.flip(1) if inside_out else mesh.faces.clone()
    faces[::3] = faces[::3].flip(1)
    mended = prepare(Mesh(mesh.verts, faces, "patchwork"), 5)
    normals = mended.mesh.face_vectors
    torch.testing.assert_close(normals, mesh.normalized().face_vectors)
    assert any("were turned over so that neighbours agree" in text for text in mended.warnings)
    assert ("inside out" in " ".join(mended.warnings)) == inside_out
    assert all(text.count("patchwork") == 1 for text in mended.warnings)


def test_a_moebius_strip_has_no_orientation():
    n, m = 40, 6
    strip = grid(n, m, 6.0, 1.0)
    s, t = strip.verts[:, 0] * (2 * torch.pi / 6), strip.verts[:, 1] - 0.5
    radius = 1 + t * torch.cos(s / 2)
    verts = torch.stack([radius * torch.cos(s), radius * torch.sin(s), t * torch.sin(s / 2)], 1)
    last, first = torch.arange(n * (m + 1), (n + 1) * (m + 1)), torch.arange(m, -1, -1)
    assert (verts[last] - verts[first]).abs().max() < 1e-12
    glued = torch.arange((n + 1) * (m + 1))
    glued[last] = first
    shape = prepare(Mesh(verts[: n * (m + 1)], glued[strip.faces], "moebius"), 5)
    assert not shape.oriented
    assert "moebius: the surface is not orientable" in shape.warnings
    assert shape.basis.evals[1] > 0.1


def test_loose_vertices_have_no_part(mesh, shape):
    loose, ids = with_loose_vertices(mesh, [0, 7, 644])
    found = prepare(loose, 20)
    assert found.basis.mass[[0, 7, 644]].tolist() == [0, 0, 0]
    assert torch.equal(torch.sort(found.samples).values, ids)
    assert basis_allclose(found.basis.evecs[ids], shape.basis.evecs, shape.basis.evals, shape.basis.mass)
    assert any("3 of 645 vertices belong to no triangle" in text for text in found.warnings)


def test_small_shapes_are_searched_completely(shape):
    assert shape.search is None
    assert torch.equal(shape.anchors, shape.samples)


def test_search_never_finds_a_vertex_of_no_face(mesh, monkeypatch):
    """They lie on the surface, and their eigenfunctions are 0: nearest of all to queries near 0."""
    monkeypatch.setattr(module, "N_ANCHORS", 150)
    loose, ids = with_loose_vertices(mesh, [3, 100, 400])
    shape = prepare(loose, K)
    assert torch.equal(shape.anchors, shape.samples[:150])
    assert shape.search is not None
    assert torch.isin(shape.search.around, ids).all()
    queries = shape.basis.evecs * torch.linspace(0, 1, 645, dtype=torch.float64)[:, None]
    found = shape.search.nearest(queries, shape.basis.evecs)
    assert torch.isin(found, ids).all()
    assert not torch.isin(nearest_rows(queries, shape.basis.evecs), ids).all()  # the queries do ask for them
    exact = shape.search.nearest(shape.basis.evecs, shape.basis.evecs)
    assert torch.equal(exact[ids], ids)


def test_search_needs_its_anchors(mesh, monkeypatch):
    monkeypatch.setattr(module, "N_ANCHORS", 150)
    assert prepare(mesh, 5, n_samples=100).search is None
    monkeypatch.setattr(module, "N_ANCHORS", 400)
    assert prepare(mesh, 5).search is None  # 642 < 800


def test_curvature_does_not_depend_on_the_number_of_threads():
    """Large enough for BLAS to divide its sums."""
    mesh, before, found = creature("quadruped", 12000).mesh, torch.get_num_threads(), []
    area = mesh.normalized().vertex_areas
    basis = SpectralBasis(torch.zeros(1).double(), torch.ones(mesh.n_verts, 1).double(), area)
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            with threadpool_limits(threads, "blas"):
                found.append(prepare(mesh, 1, basis=basis).curvature)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)
