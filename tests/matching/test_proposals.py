"""torchqm.matching.proposals: exact symmetries score 0 and are proposed, everything else scores worse."""

from dataclasses import replace

import pytest
import torch
from references.shapes import icosphere

from torchqm.geometry import Mesh
from torchqm.matching import MatchParameters, prepare
from torchqm.matching.proposals import (
    SAME,
    Judge,
    Proposal,
    _ranked,
    _unseen,
    correlation,
    different,
    grown,
    propose,
    regrown,
)
from torchqm.matching.quality import displacement, distance_change
from torchqm.matching.self_map import nearest_involution, reflection_score

FULL = MatchParameters(k_max=100)


def test_correlation_of_orthogonal_maps(octopus):
    identity = torch.eye(98).double()
    assert correlation(identity, identity) == pytest.approx(1)
    assert correlation(identity, -identity) == pytest.approx(-1)
    for i, one in enumerate(octopus.fmaps):
        for j, other in enumerate(octopus.fmaps):
            assert correlation(one, other) == pytest.approx(correlation(other, one), abs=1e-12)
            assert correlation(one, other) == pytest.approx(1, abs=1e-6) if i == j else correlation(one, other) < 0.4


def test_different_keeps_the_first_of_each_kind():
    signs = [(1, 1, 1, 1), (1, 1, 1, -1), (-1, 1, 1, 1), (-1, -1, 1, 1), (1, 1, 1, 1)]
    maps = [Proposal(torch.diag(torch.tensor(s).double()), 1, True, float(i)) for i, s in enumerate(signs)]
    scores = {most: [p.score for p in different(maps, 9, most)] for most in (0.95, 0.5, 0.4, -1.1)}
    assert scores == {0.95: [0, 1, 2, 3], 0.5: [0, 1, 2, 3], 0.4: [0, 3], -1.1: [0]}
    assert [p.score for p in different(maps, 2)] == [0, 1]
    assert different([], 3) == []


@pytest.mark.parametrize("kind", ["ellipsoid", "octopus", "biped"])
def test_reflections_turn_the_orientation_over_and_rotations_keep_it(kind, request):
    """All elements: of the ellipsoid three reflections, three rotations, the point reflection."""
    exact = request.getfixturevalue(kind)
    for fmap, direct in zip(exact.fmaps, exact.orientation, strict=True):
        assert exact.judge.orientation(fmap) == pytest.approx(direct, abs=0.02)


def test_orientation_is_that_of_the_positions(ellipsoid):
    """Which way each element moves the axes says whether it turns space over."""
    verts = ellipsoid.shape.mesh.verts - ellipsoid.shape.mesh.verts.mean(0)
    for element, fmap in zip(ellipsoid.body.base_group, ellipsoid.fmaps, strict=True):
        signs = [float(torch.sign((verts[:, a] * verts[element, a]).sum())) for a in range(3)]
        assert ellipsoid.judge.orientation(fmap) == pytest.approx(signs[0] * signs[1] * signs[2], abs=0.05)


def test_few_triangles_are_enough(octopus):
    thinned = Judge(octopus.shape, n_faces=octopus.shape.mesh.n_faces // 3)
    for fmap, direct in zip(octopus.fmaps, octopus.orientation, strict=True):
        assert thinned.orientation(fmap) * direct > 0.7


def test_few_functions_are_enough(ellipsoid):
    """Smaller than anything that the judge looks at, down to the first functions of the maps."""
    for fmap, direct in zip(ellipsoid.fmaps, ellipsoid.orientation, strict=True):
        assert ellipsoid.judge.orientation(fmap[:20, :20]) * direct > 0.9
    small = Judge(prepare(ellipsoid.body.mesh, 10))
    assert small.orientation(torch.eye(10).double()) == pytest.approx(1)


@pytest.mark.parametrize("kind", ["ellipsoid", "octopus", "biped"])
def test_exact_symmetries_score_nothing(kind, request):
    exact = request.getfixturevalue(kind)
    for fmap, direct in zip(exact.fmaps[1:], exact.orientation[1:], strict=True):
        assert exact.judge.score(fmap, direct) < 1e-6
        # the wrong orientation: half of what -1 lacks to 0.5
        assert exact.judge.score(fmap, -direct) == pytest.approx(0.75, abs=0.01)
    assert exact.judge.score(exact.fmaps[0], 1) > 0.3  # the identity has too many even functions


@pytest.mark.parametrize("axis", [1, 2])
def test_what_is_no_symmetry_scores_worse(biped, axis):
    half = biped.half(1, axis).fmap
    for orientation in (1, -1):
        assert biped.judge.score(half, orientation) > 0.3
    noise = torch.randn(98, 98, generator=torch.Generator().manual_seed(0)).double()
    near = nearest_involution(biped.fmaps[1] + 0.02 * noise)
    nearer = nearest_involution(biped.fmaps[1] + 0.01 * noise)
    assert biped.judge.score(nearest_involution(noise), -1) > biped.judge.score(near, -1)
    assert biped.judge.score(near, -1) > biped.judge.score(nearer, -1) > 0.01


def test_without_orientation_nothing_is_said_of_it(ellipsoid):
    judge = Judge(replace(ellipsoid.shape, oriented=False))
    for fmap in ellipsoid.fmaps:
        for orientation in (1, -1):
            assert judge.score(fmap, orientation) == reflection_score(fmap, ellipsoid.shape)


def test_grown_reaches_the_true_map(octopus):
    """Also those that are no involutions, which only stay what they are if they are not made one."""
    for g in (1, octopus.orientation.index(-1)):
        wanted, direct = octopus.fmaps[g], octopus.orientation[g]
        start = Proposal(wanted[:30, :30], direct, correlation(wanted @ wanted, torch.eye(98).double()) > 0.9)
        found = grown(start, octopus.judge, FULL, 98, 1000, 3000)
        assert found.fmap.shape == (98, 98)
        assert correlation(found.fmap, wanted) > 0.97
        assert found.score == octopus.judge.score(found.fmap, direct) < 0.05
        assert (found.orientation, found.involution) == (direct, start.involution)
        forced = grown(replace(start, involution=True), octopus.judge, FULL, 98, 1000, 3000)
        assert (correlation(forced.fmap, wanted) < 0.5) == (not start.involution)


def test_regrown_is_never_worse(biped):
    """A map that is right in its low functions is made right in the others; a right one stays as it is."""
    right = Proposal(biped.fmaps[1], -1, True, 0.0)
    assert regrown(right, biped.judge, FULL) is right
    spoilt = biped.fmaps[1].clone()
    spoilt[50:, 50:] = torch.eye(48).double()
    poor = Proposal(spoilt, -1, True, biped.judge.score(spoilt, -1))
    better = regrown(poor, biped.judge, FULL)
    assert better.score < 0.02 < poor.score
    assert correlation(better.fmap, biped.fmaps[1]) > 0.97
    hopeless = Proposal(-biped.fmaps[0], -1, True, float("-inf"))
    assert regrown(hopeless, biped.judge, FULL) is hopeless


def test_all_symmetries_of_an_ellipsoid_are_proposed(ellipsoid):
    """Its seven elements come before everything else, each once, with the right orientation."""
    pool = propose(ellipsoid.judge, FULL)
    found = set()
    for proposal in pool[:7]:
        near = [correlation(proposal.fmap, fmap) for fmap in ellipsoid.fmaps]
        g = near.index(max(near))
        assert near[g] > 0.95
        assert proposal.orientation == ellipsoid.orientation[g]
        assert proposal.score < 0.05
        found.add(g)
    assert found == set(range(1, 8))
    for i, one in enumerate(pool):
        assert all(correlation(one.fmap, other.fmap) <= SAME for other in pool[:i])


def test_a_likely_permutation_is_not_dropped_for_beginning_badly(biped):
    """Of those with the same number the first stands for all; nothing is grown that was there already."""
    right, half = biped.fmaps[1][:40, :40], biped.half(1, 1).fmap[:40, :40]
    rough = [
        Proposal(half, -1, True, 0.1, likely=-1),
        Proposal(half, -1, True, 0.2, likely=0),
        Proposal(right, -1, True, 0.8, likely=3),
        Proposal(half, -1, True, 0.9, likely=3),
    ]
    (found,) = _unseen(rough, [replace(rough[1], fmap=biped.half(1, 1).fmap[:60, :60])], biped.judge, FULL)
    assert (found.likely, found.fmap.shape) == (3, (60, 60))
    assert correlation(found.fmap, biped.fmaps[1][:60, :60]) > 0.97
    kept = [
        replace(rough[1], fmap=biped.half(1, 1).fmap[:60, :60]),
        Proposal(biped.fmaps[1][:60, :60], -1, True, 0.1, likely=-1),
    ]
    assert _unseen(rough, kept, biped.judge, FULL) == []  # the map is there, from another permutation


def test_between_close_maps_distances_decide(biped):
    """Of a right and a wrong map with close scores; one whose score is far above the best stays behind it."""
    right, half = biped.fmaps[1], biped.half(1, 1).fmap
    change = [distance_change(fmap, biped.shape, biped.shape) for fmap in (right, half)]
    assert change[0] < change[1]
    wrong, close = Proposal(half, -1, True, 0.10), Proposal(right, -1, True, 0.12)
    far = replace(close, score=0.13)
    assert _ranked([wrong, close], biped.shape) == [close, wrong]
    assert _ranked([far, wrong], biped.shape) == [wrong, far]
    turning = replace(close, orientation=1, score=0.101)
    assert _ranked([turning, replace(close, score=0.11)], biped.shape)[0].orientation == -1


def test_a_map_that_hardly_moves_points_is_not_praised_for_changing_no_distances(biped):
    """The identity but for some high functions changes distances less than an inexact symmetry does."""
    exact = biped.fmaps[1]
    noise = torch.randn(exact.shape, generator=torch.Generator().manual_seed(0), dtype=exact.dtype)
    still = torch.ones(len(exact), dtype=torch.float64)
    still[40:] = -1.0
    right = Proposal(nearest_involution(exact + 0.16 * (noise + noise.T)), -1, True, 0.11)
    idle = Proposal(torch.diag(still), -1, True, 0.10)
    changes = [distance_change(p.fmap, biped.shape, biped.shape) for p in (right, idle)]
    moved = [displacement(p.fmap, biped.shape.basis.evals) for p in (right, idle)]
    assert changes[1] < changes[0] < changes[1] * moved[0] / moved[1]
    assert _ranked([idle, right], biped.shape) == [right, idle]


def test_signs_of_eigenfunctions_where_there_are_few_tips():
    """A smooth ellipsoid has two tips; the signs of its first functions have the rest. Any number of functions will do,
    also fewer than those in which landmarks are compared."""
    ball = icosphere(3)
    egg = prepare(Mesh(ball.verts * torch.tensor([1.0, 1.3, 1.7]).double(), ball.faces, "egg"), 60)
    pool = propose(Judge(egg), MatchParameters(k=10, k_max=12))
    assert {p.fmap.shape for p in pool} == {(12, 12)}
    assert len(pool) >= 7
    assert max(p.score for p in pool[:7]) < 1e-6
    assert sorted(p.orientation for p in pool[:7]) == [-1, -1, -1, -1, 1, 1, 1]
