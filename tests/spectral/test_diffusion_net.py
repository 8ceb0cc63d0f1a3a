"""torchqm.spectral.diffusion_net: files made by diffusion-net's recipe become the basis of the mesh, checked."""

import hashlib
import warnings

import numpy as np
import potpourri3d as pp3d
import pytest
import robust_laplacian
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import torch
from references.shapes import basis_of, blob, icosphere

from torchqm.geometry import Mesh
from torchqm.spectral import CacheWarning, cached_basis, mesh_basis
from torchqm.spectral.diffusion_net import DiffusionNetError, diffusion_net_files, read_diffusion_net
from torchqm.testing import basis_allclose

MESH = blob(1).mesh  # 642 vertices
K = 24


def name_of(verts, faces, bucket=0):
    digest = hashlib.sha1()
    for array in (verts, faces):
        digest.update(np.ascontiguousarray(array).view(np.uint8))
    return f"{digest.hexdigest()}_{bucket}.npz"


def operators(verts, faces, k, kind="cotan"):
    """The arrays that diffusion-net keeps, by the recipe of its ``compute_operators``."""
    v = verts.astype(np.float64)
    if kind == "cotan":
        stiffness, mass = pp3d.cotan_laplacian(v, faces, denom_eps=1e-10), pp3d.vertex_areas(v, faces)
        mass = mass + 1e-8 * mass.mean()
    else:
        stiffness, matrix = robust_laplacian.mesh_laplacian(v, faces)
        mass = matrix.diagonal()
    shifted = (stiffness + 1e-8 * sp.identity(len(v))).tocsc()
    start = np.random.default_rng(0).standard_normal(len(v))
    evals, evecs = spla.eigsh(shifted, k=k, M=sp.diags(mass), sigma=1e-8, v0=start)
    out = {"verts": verts, "faces": faces, "k_eig": k, "frames": np.zeros((len(v), 3, 3), np.float32)}
    out |= {name: np.asarray(a, np.float32) for name, a in (("mass", mass), ("evals", evals), ("evecs", evecs))}
    for name in ("L", "gradX", "gradY"):
        matrix = stiffness.tocsc().astype(np.float32)
        out |= {f"{name}_{part}": getattr(matrix, part) for part in ("data", "indices", "indptr", "shape")}
    return out


def write(folder, mesh=MESH, dtype=np.float32, ids=np.int64, k=K, kind="cotan", bucket=0, normalise=False, **changes):
    verts, faces = mesh.numpy()[0].astype(dtype), mesh.numpy()[1].astype(ids)
    if normalise:  # diffusion_net.geometry.normalize_positions
        verts = verts - verts.mean(0)
        verts = verts / np.linalg.norm(verts, axis=1).max()
    path = folder / name_of(verts, faces, bucket)
    np.savez(path, **(operators(verts, faces, k, kind) | changes))
    return path


def agrees(basis, mesh=MESH, kind="auto"):
    """Whether it is the mesh's own basis: orthonormal in its mass in double precision, eigenvalues to 1e-7."""
    truth = basis_of(mesh, basis.k) if kind == "auto" else mesh_basis(mesh, basis.k, kind)
    evals = torch.where(truth.evals < 1e-6 * truth.evals[-1], 0.0, truth.evals)  # zeros are a cluster
    gram = basis.evecs.T @ (basis.mass[:, None] * basis.evecs)
    return (
        torch.equal(basis.mass, truth.mass)
        and float((gram - torch.eye(basis.k, dtype=torch.float64)).abs().max()) < 1e-12
        and float(((basis.evals - evals) / evals[evals > 0][0]).abs().max()) < 1e-7
        and basis_allclose(basis.evecs, truth.evecs, evals, truth.mass, atol=1e-4)
    )


def cached(mesh, k, folder, kind="auto"):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return cached_basis(mesh, k, kind, folder)


def test_a_file_is_used_and_named_and_left_as_it_is(tmp_path):
    path = write(tmp_path)
    before = path.read_bytes()
    basis = cached(MESH, K, tmp_path)
    assert basis.report.outcome == "diffusion-net"
    assert basis.report.source == f"diffusion-net, {path.name}"
    assert (basis.report.kind, basis.k) == ("cotan", K)
    assert agrees(basis)
    assert path.read_bytes() == before
    assert basis.report.path.exists()
    again = cached(MESH, 10, tmp_path)  # from its own entry now, and fewer
    assert (again.report.outcome, again.report.source) == ("read", basis.report.source)
    assert torch.equal(again.evecs, basis.evecs[:, :10])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("ids", [np.int32, np.int64])
def test_the_name_is_found_for_every_type_of_numbers(tmp_path, dtype, ids):
    path = write(tmp_path, dtype=dtype, ids=ids, k=8)
    assert diffusion_net_files(tmp_path, MESH) == [path]
    assert agrees(read_diffusion_net(path, MESH).basis)


@pytest.mark.parametrize("shift", [0.0, 30.0])
def test_a_file_of_the_moved_and_scaled_mesh_is_found_by_its_content(tmp_path, shift):
    mesh = MESH.moved(MESH.verts * 87.5 + shift)
    path = write(tmp_path, mesh, normalise=True)
    write(tmp_path, blob(2).mesh, normalise=True)  # the same triangles, another shape
    write(tmp_path, icosphere(2), k=5)  # other triangles
    (tmp_path / f"{'0' * 40}_0.npz").write_text("damaged, and nobody's")
    assert diffusion_net_files(tmp_path, mesh) == [path]
    basis = cached(mesh, 12, tmp_path)
    assert basis.report.source.endswith(path.name)
    assert agrees(basis, mesh)
    assert float(basis.mass.sum()) == pytest.approx(mesh.area)


def test_the_scale_of_mass_and_functions_does_not_matter(tmp_path):
    content = operators(*(a.copy() for a in MESH.numpy()), K)
    path = write(tmp_path, mass=content["mass"] / content["mass"].sum(), evecs=-3 * content["evecs"])
    assert agrees(read_diffusion_net(path, MESH).basis)


def test_which_laplacian_it_is_of_is_found_out(tmp_path):
    path = write(tmp_path, kind="robust")
    assert cached(MESH, 9, tmp_path, "robust").report.outcome == "diffusion-net"
    found = read_diffusion_net(path, MESH)
    assert found.kind == "robust"
    assert path.name in found.reason
    assert agrees(found.basis, kind="robust")
    with pytest.raises(DiffusionNetError, match="not orthonormal in the cotan mass"):
        read_diffusion_net(path, MESH, "cotan")
    with pytest.warns(CacheWarning, match=f"{path.name}.*not used"):
        basis = cached_basis(MESH, 9, "cotan", tmp_path)
    assert (basis.report.kind, basis.report.outcome) == ("cotan", "computed")
    assert len(basis.report.problems) == 1


def test_where_a_mesh_needs_the_robust_laplacian_cotangent_pairs_are_refused(tmp_path):
    folded = Mesh(MESH.verts, torch.cat([MESH.faces, torch.tensor([[*MESH.faces[0, :2].tolist(), 600]])]))
    with pytest.raises(DiffusionNetError, match="robust"):
        read_diffusion_net(write(tmp_path, folded), folded)


def test_too_few_functions_are_a_note(tmp_path):
    path = write(tmp_path, k=8)
    basis = cached(MESH, 9, tmp_path)
    assert basis.report.outcome == "computed"
    assert basis.report.notes == (f"{path}: has 8 functions, 9 were asked for",)


def test_the_next_bucket_is_tried(tmp_path):
    first, second = write(tmp_path, faces=MESH.numpy()[1][::-1].copy()), write(tmp_path, bucket=1)
    assert diffusion_net_files(tmp_path, MESH) == [first, second]
    with pytest.warns(CacheWarning, match="its faces are not those of"):
        basis = cached_basis(MESH, 9, cache_dir=tmp_path)
    assert basis.report.source.endswith(second.name)
    assert agrees(basis)


def higher(content):
    """All but the constant function."""
    return {"evals": content["evals"][1:], "evecs": content["evecs"][:, 1:]}


FAULTS = {
    "verts are not those": lambda c: {"verts": c["verts"] * np.float32([1, 1, 1.01])},
    "do not fit 642 vertices": lambda c: {"evecs": c["evecs"][:, :-1]},
    "not orthonormal": lambda c: {"evecs": c["evecs"] * np.linspace(1, 1.5, K)},
    "zero or not finite": lambda c: {"evecs": c["evecs"] * np.nan},
    "constant function is not among": higher,
    "cannot be read": lambda c: {"evecs": np.array([{"pickled": 1}])},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_file_that_does_not_hold_the_basis_is_told_and_not_used(tmp_path, fault):
    content = operators(MESH.numpy()[0].astype(np.float32), MESH.numpy()[1], K)
    path = write(tmp_path, **FAULTS[fault](content))
    with pytest.raises(DiffusionNetError, match=fault) as raised:
        read_diffusion_net(path, MESH)
    assert str(raised.value).startswith(str(path))
    with pytest.warns(CacheWarning, match=path.name):
        basis = cached_basis(MESH, 9, cache_dir=tmp_path)
    assert basis.report.outcome == "computed"
    assert agrees(basis)


def test_functions_of_another_frequency_are_seen(tmp_path):
    """Orthonormal, with the constant, but one of them is a mixture of two eigenfunctions."""
    more = basis_of(MESH, K + 20)
    evecs = more.evecs[:, :K].clone()
    evecs[:, -1] = (more.evecs[:, K - 1] + more.evecs[:, K + 15]) / 2**0.5
    path = write(tmp_path, evecs=evecs.numpy().astype(np.float32))
    with pytest.raises(DiffusionNetError, match=r"not eigenfunctions of the cotan Laplacian \(residual"):
        read_diffusion_net(path, MESH)


def test_vertices_without_triangles(tmp_path):
    """diffusion-net gives them a little mass; here they have none, and take no part."""
    mesh = Mesh(torch.cat([MESH.verts, torch.full((1, 3), 2.0, dtype=torch.float64)]), MESH.faces)
    write(tmp_path, mesh, k=12)
    basis = cached(mesh, 9, tmp_path)
    assert basis.report.outcome == "diffusion-net"
    assert basis.evecs[-1].abs().max() == 0
    assert agrees(basis, mesh)


def test_a_shape_of_two_pieces_has_two_zeros(tmp_path):
    twice = Mesh(torch.cat([MESH.verts, MESH.verts * 0.7 + 5]), torch.cat([MESH.faces, MESH.faces + 642]))
    write(tmp_path, twice, k=12)
    basis = cached(twice, 12, tmp_path)
    assert basis.report.outcome == "diffusion-net"
    assert agrees(basis, twice)


def test_no_folder_no_files(tmp_path):
    assert diffusion_net_files(tmp_path / "gone", MESH) == []
    assert diffusion_net_files(tmp_path, MESH) == []
