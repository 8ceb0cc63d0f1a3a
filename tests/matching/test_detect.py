"""torchqm.matching.detect: exact reflections are found without help, none is made up, rotations are told apart."""

import pytest
import torch
from references.pairs import FAST, K

from torchqm.data.synthetic import creature, exact_maps
from torchqm.fmap import p2p_to_fmap
from torchqm.matching import MatchParameters, detect_reflection, prepare
from torchqm.matching.detect import _OrientationAgreement


def test_the_exact_reflection_of_a_blob(exact):
    found = detect_reflection(exact.x, FAST)
    assert found.verdict == "symmetric"
    assert found.warnings == []
    assert float((found.reflection == exact.group_x.maps[1]).double().mean()) > 0.99
    assert torch.equal(found.group.maps[1], found.reflection)
    assert found.parts["score"] < 1e-3
    assert found.parts["involution"] < 1e-3
    assert found.parts["orientation"] < -0.95
    side = exact.side_x
    assert float((found.sign * side)[side != 0].mean().abs()) > 0.95


@pytest.mark.parametrize("kind", ["biped", "quadruped"])
def test_poses_with_their_own_triangulation(kind):
    body = creature(kind, 1500, 0, 2, retriangulate=1)
    found = detect_reflection(prepare(body.mesh, 100), MatchParameters(k_max=100))
    mesh = body.mesh.normalized()
    truth = exact_maps(body, body).points(mesh)[1]
    assert found.verdict == "symmetric"
    assert float((mesh.verts[found.reflection] - truth).norm(dim=1).mean()) < 0.025  # the vertex spacing
    assert found.parts["moved"] > 0.9


def test_nothing_is_made_up():
    shape = prepare(creature("asymmetric", 1000, 0, 1).mesh, 100)
    found = detect_reflection(shape, MatchParameters(k_max=100))
    assert found.verdict == "asymmetric"
    assert found.group.order == 1
    assert torch.equal(found.sign, torch.zeros(shape.n_verts, dtype=torch.float64))
    (text,) = found.warnings
    assert f"commutativity {found.parts['commutativity']:.3f}" in text


def test_same_shape_same_answer(exact):
    first, again = detect_reflection(exact.x, FAST), detect_reflection(exact.x, FAST)
    assert torch.equal(first.fmap, again.fmap)
    assert first.parts == again.parts


def test_reflections_turn_the_orientation_over_and_rotations_keep_it():
    """All elements of the ellipsoid's group: three reflections, three rotations, the point reflection."""
    body = creature("ellipsoid", 1500)
    shape = prepare(body.mesh, K)
    verts = body.mesh.verts - body.mesh.verts.mean(0)
    for element in body.base_group:
        signs = [float(torch.sign((verts[:, a] * verts[element, a]).sum())) for a in range(3)]
        direct = signs[0] * signs[1] * signs[2]
        fmap = p2p_to_fmap(element, shape.basis, shape.basis)
        assert _OrientationAgreement(shape)(fmap) == pytest.approx(direct, abs=0.05)
