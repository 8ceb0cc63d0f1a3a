"""torchqm.spectral.features: equal at mirror images, the same for renumbered and moved copies, flat on a sphere."""

import pytest
import torch
from references.shapes import icosphere, rotation

from torchqm.data.synthetic import creature
from torchqm.geometry import Mesh
from torchqm.spectral import local_features, mesh_basis, smooth_curvature


@pytest.fixture(scope="module")
def animal():
    body = creature("quadruped", 1000)
    mesh = body.mesh.normalized()
    return body, mesh, mesh_basis(mesh, 60)


def everywhere(mesh):
    return torch.arange(mesh.n_verts)


def test_a_point_and_its_mirror_image_look_alike(animal):
    body, mesh, basis = animal
    (found,) = local_features([basis], [smooth_curvature(mesh)], [everywhere(mesh)])
    assert float(found.square().sum(1).mean()) == pytest.approx(1)
    torch.testing.assert_close(found[body.base_group[1]], found, atol=1e-4, rtol=0)
    wave, bend = found[:, :-1], found[:, -1]
    assert float(wave.square().sum(1).mean()) == pytest.approx(0.5)
    assert float(bend.square().mean()) == pytest.approx(0.5)
    nearest = torch.cdist(found, found).fill_diagonal_(float("inf")).argmin(1)
    assert float((nearest == body.base_group[1]).double().mean()) > 0.9  # and no other point looks as much alike


def test_a_moved_and_renumbered_copy_has_the_same(animal):
    _, mesh, basis = animal
    order = torch.randperm(mesh.n_verts, generator=torch.Generator().manual_seed(0))
    inverse = order.argsort()
    copy = Mesh((mesh.verts @ rotation(1).T + 3.0)[order], inverse[mesh.faces])
    first, second = local_features(
        [basis, mesh_basis(copy, 60)], [smooth_curvature(mesh), smooth_curvature(copy)], [order, everywhere(copy)]
    )
    torch.testing.assert_close(first, second, atol=1e-4, rtol=0)


def test_inside_out_only_the_curvature_differs_and_not_if_orientation_is_unknown(animal):
    _, mesh, basis = animal
    turned = Mesh(mesh.verts, mesh.faces.flip(1))
    ids, bends = [everywhere(mesh)] * 2, [smooth_curvature(mesh), smooth_curvature(turned)]
    first, second = local_features([basis, basis], bends, ids)
    torch.testing.assert_close(first[:, :-1], second[:, :-1])
    torch.testing.assert_close(first[:, -1], -second[:, -1])
    first, second = local_features([basis, basis], bends, ids, oriented=False)
    torch.testing.assert_close(first, second)


def test_a_sphere_has_no_features_but_rounding(animal):
    sphere = icosphere(2).normalized()
    (found,) = local_features([mesh_basis(sphere, 49)], [smooth_curvature(sphere)], [everywhere(sphere)])
    assert torch.isfinite(found).all()


def test_one_of_each_is_needed(animal):
    _, mesh, basis = animal
    with pytest.raises(ValueError, match="2 bases, 1 curvatures, 1 sets"):
        local_features([basis, basis], [smooth_curvature(mesh)], [everywhere(mesh)])
