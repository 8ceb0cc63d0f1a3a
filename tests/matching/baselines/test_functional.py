"""torchqm.matching.baselines.functional: exact where nothing is ambiguous, a mixture where it is, segments decide."""

import pytest
import torch
from references.pairs import exact_pair

from torchqm.fmap import p2p_to_fmap
from torchqm.matching import MatchError
from torchqm.matching.baselines import NOTHING, FunctionalMaps, Given, Start
from torchqm.matching.baselines.functional import segment_functions
from torchqm.matching.steps import Steps


def parts(pair, places):
    """The two halves cut by the mirror plane and by another: four parts, which tell left from right."""
    side = pair.x.mesh.verts[:, 0] > 0
    segments = side.long() + 2 * (pair.x.mesh.verts[:, places] > 0).long()
    moved = torch.empty_like(segments)
    moved[pair.p2p_xy] = segments
    return Given(segments_x=segments, segments_y=moved)


def right(found, pair):
    return float((found.best == pair.p2p_xy).double().mean())


def test_without_symmetry_the_exact_map():
    pair = exact_pair(1)
    found = FunctionalMaps().match(pair.x, pair.y)
    assert torch.equal(found.best, pair.p2p_xy)
    assert found.details["k"] == 60
    assert list(found.steps) == ["descriptors", "least squares", "ICP", "ICP in a larger basis", "point map"]


def test_with_a_symmetry_segments_decide():
    pair = exact_pair(2)
    alone = FunctionalMaps().match(pair.x, pair.y)
    mirrored = float((alone.best == pair.group_y.maps[1][pair.p2p_xy]).double().mean())
    assert right(alone, pair) < 1  # nothing tells left from right: neither of the two exact maps comes out
    assert mirrored < 1
    told = FunctionalMaps().match(pair.x, pair.y, parts(pair, 1))
    assert right(told, pair) == 1
    assert "4 corresponding segments" in told.notes[0]
    # The same parts with left and right exchanged give the mirrored map: they decide, nothing else does.
    given = parts(pair, 1)
    swapped = Given(segments_x=given.segments_x, segments_y=given.segments_y[pair.group_y.maps[1]])
    assert torch.equal(FunctionalMaps().match(pair.x, pair.y, swapped).best, pair.group_y.maps[1][pair.p2p_xy])


def test_another_pose_and_triangulation(walkers):
    """Nearest descriptors are above 0.07."""
    assert float(walkers.errors(FunctionalMaps().match(walkers.x, walkers.y).best)[0]) < 0.03


def test_segment_functions_correspond():
    """The true map carries those of the source to those of the target, and parts without a partner are left out."""
    pair = exact_pair(1)
    given = parts(pair, 2)
    given.segments_y[given.segments_y == 3] = -1
    x, y = pair.x.basis.truncate(30), pair.y.basis.truncate(30)
    f, g = segment_functions(x, y, given, 7)
    assert f.shape == g.shape == (30, 3 * 8)
    torch.testing.assert_close(p2p_to_fmap(pair.p2p_yx, x, y) @ f, g, atol=1e-6, rtol=0)
    assert int(torch.linalg.matrix_rank(f)) > 12
    with pytest.raises(MatchError, match="none are given"):
        segment_functions(x, y, NOTHING)


def test_the_start_is_the_true_map_on_exact_twins():
    pair = exact_pair(1)
    x, y = pair.x.basis.truncate(20), pair.y.basis.truncate(20)
    true = p2p_to_fmap(pair.p2p_yx, x, y)
    for splits, icp_steps in ((5, 0), (5, 20), (0, 20)):
        found = Start(splits=splits, icp_steps=icp_steps).solve(pair.x, pair.y, NOTHING, Steps())
        torch.testing.assert_close(found, true, atol=1e-5, rtol=0)


def test_more_functions_than_there_are(walkers):
    with pytest.raises(MatchError, match="at least 4"):
        FunctionalMaps(Start(k=3)).match(walkers.x, walkers.y)
    with pytest.raises(MatchError, match="entries a row"):
        FunctionalMaps().match(walkers.y, walkers.x, walkers.given)
