"""torchqm.matching.orbits: from points to orbits to points, exactly where the answer is known."""

import pytest
import torch
import trimesh

from torchqm.data.synthetic import creature, exact_maps
from torchqm.fmap import fmap_to_p2p
from torchqm.geometry import Mesh
from torchqm.matching import MatchError, MatchParameters, given_symmetry, match_quotient, no_symmetry, prepare
from torchqm.matching.orbits import full_map_from_orbits, quotient_size

SMALL = MatchParameters(k_max=150)


@pytest.mark.parametrize("kind", ["octopus", "ellipsoid"])
def test_one_of_the_true_maps(kind):
    """The same triangles in another pose, and the true group of both: whichever element comes out, it is whole."""
    source, target = creature(kind, 1000, pose=2), creature(kind, 1000)
    x, y = (prepare(c.mesh, 150) for c in (source, target))
    known_x, known_y = given_symmetry(x, source.base_group), given_symmetry(y, target.base_group)
    order = known_x.group.order
    match = match_quotient(x, y, known_x.group, known_y.group, SMALL, quotient_size(order, SMALL))
    found = full_map_from_orbits(match, x, y, known_x, known_y, SMALL)
    k = found.fmap.shape[0]
    assert torch.allclose(found.fmap.T @ found.fmap, torch.eye(k, dtype=torch.float64), atol=1e-9)
    p2p = fmap_to_p2p(found.fmap, x.basis.truncate(k), y.basis.truncate(k))
    truth = exact_maps(source, target).points(y.mesh)
    assert float((y.mesh.verts[p2p] - truth).norm(dim=2).mean(1).min()) < 0.05
    assert 0 < found.residual < 0.25
    again = full_map_from_orbits(match, x, y, known_x, known_y, SMALL)
    assert torch.equal(again.fmap, found.fmap)


def test_identity_for_a_shape_and_itself():
    body = creature("ellipsoid", 1000)
    x = prepare(body.mesh, 100)
    known = given_symmetry(x, body.base_group)
    match = match_quotient(x, x, known.group, known.group, SMALL, 80)
    assert torch.allclose(match.fmap, torch.eye(len(match.fmap), dtype=torch.float64), atol=1e-6)
    found = full_map_from_orbits(match, x, x, known, known, SMALL)
    assert found.residual < 1e-6
    p2p = fmap_to_p2p(found.fmap, x.basis.truncate(len(found.fmap)), x.basis.truncate(len(found.fmap)))
    same = (p2p == body.base_group).double().mean(1)
    assert float(same.max()) > 0.99  # one element of the group


def test_orders_must_agree():
    body = creature("ellipsoid", 1000)
    x = prepare(body.mesh, 60)
    known = given_symmetry(x, body.base_group)
    match = match_quotient(x, x, known.group, known.group, SMALL)
    with pytest.raises(ValueError, match="groups of 8 and 1 elements"):
        full_map_from_orbits(match, x, x, known, no_symmetry(x), SMALL)


def test_functions_that_a_group_needs():
    assert quotient_size(2, MatchParameters()) == 30
    assert quotient_size(8, MatchParameters()) == 80
    assert quotient_size(48, MatchParameters()) == 200


def test_a_mesh_that_is_too_coarse_for_its_group_is_named():
    """Each vertex of this ellipsoid lies on a mirror plane: none has eight different images."""
    ball = trimesh.creation.icosphere(subdivisions=0)
    signs = torch.tensor([[a, b, c] for a in (1, -1) for b in (1, -1) for c in (1, -1)], dtype=torch.float64)
    mesh = Mesh.from_arrays(ball.vertices * [1.0, 1.3, 1.7], ball.faces, "coarse")
    images = torch.stack([torch.cdist(s * mesh.verts, mesh.verts).argmin(1) for s in signs])
    x = prepare(mesh, 6)
    known = given_symmetry(x, images)
    parameters = MatchParameters(k=4, k_max=6)
    match = match_quotient(x, x, known.group, known.group, parameters)
    with pytest.raises(MatchError, match=r"coarse -> coarse: .*none has 8 different images"):
        full_map_from_orbits(match, x, x, known, known, parameters)
