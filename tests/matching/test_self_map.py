"""torchqm.matching.self_map: the true reflection solves the system; the candidate that commutes best wins."""

import pytest
import torch
from references.pairs import FAST, K

from torchqm.fmap import p2p_to_fmap
from torchqm.matching import nearest_involution
from torchqm.matching.quotient import pair_places
from torchqm.matching.self_map import (
    best_self_map,
    conjugate_reflection,
    reflection_score,
    self_map_from_halves,
    self_maps_from_halves,
    settled_self_map,
)


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def identity(k):
    return torch.eye(k, dtype=torch.float64)


def true_map(pair, k=K):
    basis = pair.x.basis.truncate(k)
    return p2p_to_fmap(pair.group_x.maps[1], basis, basis)


@pytest.mark.parametrize("refinement", ["upsample", "icp", "none"])
def test_self_map_from_the_true_halves(exact, refinement):
    """The initial system is solved exactly by the true reflection; which half is called left plays no part."""
    parameters = FAST.changed(refinement=refinement)
    found = self_map_from_halves(exact.x, exact.side_x, parameters)
    k = FAST.k if refinement == "none" else K
    small = exact.x.basis.truncate(k)
    torch.testing.assert_close(found, p2p_to_fmap(exact.group_x.maps[1], small, small), atol=1e-6, rtol=0)
    torch.testing.assert_close(self_map_from_halves(exact.x, -exact.side_x, parameters), found, atol=1e-8, rtol=0)


def test_one_candidate_a_weight_which_noisy_descriptors_tell_apart(exact):
    parameters = FAST.changed(icp_steps=0, refinement="none")
    first, second = self_maps_from_halves(exact.x, exact.side_x, parameters)
    torch.testing.assert_close(first, second, atol=1e-6, rtol=0)  # exact data: the weight plays no part
    values = noise(642, 40)
    first, second = self_maps_from_halves(exact.x, exact.side_x, parameters, values)
    assert float((first - second).norm()) > 1
    assert len(self_maps_from_halves(exact.x, exact.side_x, parameters.changed(self_commutativity=(7.0,)))) == 1


def test_the_best_candidate_wins_wherever_it_stands(exact):
    true = true_map(exact, 30)
    wrong = nearest_involution(noise(30, 30))
    for number in range(3):
        candidates = [wrong, nearest_involution(noise(30, 30, seed=1))]
        candidates.insert(number, true)
        found = best_self_map(candidates, exact.x, FAST)
        assert found.chosen == number
        assert found.scores[number] < 1e-6
        assert min(s for i, s in enumerate(found.scores) if i != number) > 0.05
        torch.testing.assert_close(found.fmap, true_map(exact), atol=1e-6, rtol=0)


def test_the_identity_is_no_reflection(exact):
    """It commutes perfectly, and would always win if too many even functions were no fault."""
    rough = nearest_involution(true_map(exact, 30) + 0.03 * noise(30, 30))
    found = best_self_map([identity(30), rough], exact.x, FAST)
    assert found.chosen == 1
    assert reflection_score(identity(25), exact.x) == pytest.approx(0.5 * (1 - 2.2 / 5))
    assert reflection_score(true_map(exact, 30), exact.x) < 1e-6


def test_a_witness_supports_its_like(exact):
    """What is added to a score is 0.3 times the mean distance between the images, here from all distances."""
    parameters = FAST.changed(refinement="none")
    true = true_map(exact, 30)
    generator = torch.linalg.matrix_exp(0.1 * (noise(30, 30) - noise(30, 30).T))
    rough = generator @ true @ generator.T
    other = nearest_involution(noise(30, 30, seed=3))
    found = best_self_map([true, rough, other], exact.x, parameters, witness=0)
    plain = best_self_map([true, rough, other], exact.x, parameters)
    gaps = [b - a for a, b in zip(plain.scores, found.scores, strict=True)]
    samples, anchors = exact.x.samples[: parameters.n_samples], exact.x.anchors
    points = exact.x.basis.evecs[:, :30]
    images = [
        exact.x.mesh.verts[anchors[torch.cdist(points[samples] @ fmap.T, points[anchors]).argmin(1)]]
        for fmap in (true, rough, other)
    ]
    wanted = [0.3 * float((image - images[0]).norm(dim=1).mean()) for image in images]
    assert gaps == pytest.approx(wanted, abs=1e-9)
    assert wanted[1] < wanted[2]


def test_equal_candidates_have_equal_scores(exact):
    rough = nearest_involution(true_map(exact, 30) + 0.03 * noise(30, 30))
    found = best_self_map([rough, rough.clone()], exact.x, FAST)
    assert found.scores[0] == found.scores[1]
    assert found.chosen == 0
    with pytest.raises(ValueError, match="candidates: there must be at least one"):
        best_self_map([], exact.x, FAST)


def test_the_reflection_of_the_other_shape_seen_from_here(exact):
    """``C^-1 S_y C`` with the true map is the true reflection of x."""
    fmap = p2p_to_fmap(exact.p2p_yx, exact.x.basis, exact.y.basis)
    torch.testing.assert_close(conjugate_reflection(fmap, exact.group_y, exact.y), true_map(exact), atol=1e-9, rtol=0)


@pytest.mark.parametrize("refinement", ["upsample", "icp"])
def test_refinement_goes_on_to_k_max(exact, refinement):
    start = true_map(exact, 30) + 0.03 * noise(30, 30)
    parameters = FAST.changed(refinement=refinement)
    found = best_self_map([start], exact.x, parameters).fmap
    torch.testing.assert_close(found, true_map(exact), atol=1e-6, rtol=0)
    assert best_self_map([found], exact.x, parameters).fmap is found  # there already
    assert best_self_map([start], exact.x, parameters.changed(refinement="none")).fmap is start


def test_refinement_projects_to_involutions(exact):
    found = best_self_map([noise(30, 30)], exact.x, FAST).fmap  # whatever it starts from
    torch.testing.assert_close(found @ found, identity(K), atol=1e-9, rtol=0)
    torch.testing.assert_close(found, found.T, atol=1e-9, rtol=0)


def test_nearest_involution():
    matrix = noise(6, 6)
    found = nearest_involution(matrix)
    torch.testing.assert_close(found @ found, identity(6))
    torch.testing.assert_close(found, found.T)
    torch.testing.assert_close(nearest_involution(found), found)
    for seed in range(1, 30):
        other = nearest_involution(found + 0.5 * noise(6, 6, seed=seed))
        assert (matrix - found).norm() <= (matrix - other).norm() + 1e-12


@pytest.mark.parametrize("involution", [True, False])
def test_settling_mends_a_noisy_map_and_keeps_an_exact_one(exact, involution):
    wanted, k = true_map(exact), min(K, 60)
    start = nearest_involution(true_map(exact) + 0.03 * noise(K, K))
    parameters = FAST.changed(n_samples=642)
    places, _ = pair_places(exact.x, exact.x, parameters)
    for begun in (wanted, start):
        found = settled_self_map(begun, exact.x, parameters, places, involution, start=30)
        torch.testing.assert_close(found[:k, :k], wanted[:k, :k], atol=1e-2, rtol=0)
    if involution:
        torch.testing.assert_close(found, found.T, atol=1e-10, rtol=0)
    torch.testing.assert_close(found @ found.T, identity(K), atol=1e-8, rtol=0)


def test_features_alone_do_not_turn_left_to_right(exact):
    """They are the same at both: from the identity, the identity comes back, not the reflection."""
    places, _ = pair_places(exact.x, exact.x, FAST.changed(n_samples=642))
    found = settled_self_map(identity(K), exact.x, FAST, places, False, start=30)
    torch.testing.assert_close(found, identity(K), atol=1e-2, rtol=0)
