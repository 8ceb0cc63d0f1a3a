"""torchqm.matching.baselines.axis_curves: exact twins, another pose, and what it refuses."""

from dataclasses import replace

import pytest
import torch
from references.pairs import exact_pair

from torchqm.matching import MatchError
from torchqm.matching.baselines import AxisCurves, Given
from torchqm.matching.baselines.axis_curves import nearest_by_side


@pytest.mark.parametrize("with_sides", [True, False])
def test_exact_twins(with_sides):
    pair = exact_pair(2)
    sides = (pair.x.mesh.verts[:, 0], -pair.y.mesh.verts[:, 0]) if with_sides else (None, None)
    found = AxisCurves().match(pair.x, pair.y, Given(pair.group_x.maps, pair.group_y.maps, *sides))
    assert found.labels == ("direct", "mirrored")
    assert float((found.maps[0] == pair.p2p_xy).double().mean()) > 0.98
    assert float((found.maps[1] == pair.group_y.maps[1][pair.p2p_xy]).double().mean()) > 0.98
    assert found.details["cost"] < 0.2 * found.details["cost_other_direction"]


def test_another_pose_and_triangulation(walkers):
    """Nearest descriptors are above 0.07."""
    found = AxisCurves().match(walkers.x, walkers.y, walkers.given)
    direct, mirrored = (walkers.errors(p2p) for p2p in found.maps)
    assert found.labels == ("direct", "mirrored")
    assert float(direct[0]) < 0.04
    assert float(mirrored[1]) < 0.04
    assert found.notes == []


def test_nothing_is_said_of_orientation_where_there_is_none(walkers):
    found = AxisCurves().match(replace(walkers.x, oriented=False), walkers.y, walkers.given)
    assert found.labels == ("unknown", "unknown")
    assert float(torch.stack([walkers.errors(p2p).min() for p2p in found.maps]).max()) < 0.04


def test_nearest_by_side():
    rows_x = torch.tensor([[0.0], [1.0], [2.0], [float("inf")]])
    rows_y = torch.tensor([[float("inf")], [2.0], [1.2], [0.1], [0.9]])
    side_x, side_y = torch.tensor([-1.0, 1.0, 0.0, 1.0]), torch.tensor([1.0, -1.0, -1.0, 1.0, 0.0])
    # left: vertices 1, 2, 4; right: 3, 4; on the axis: all that can be reached; unreachable: the first reachable one
    assert nearest_by_side(rows_x, rows_y, side_x, side_y).tolist() == [4, 4, 1, 1]
    assert nearest_by_side(rows_x, rows_y, side_x, -torch.ones(5)).tolist() == [3, 4, 1, 1]


def test_what_it_refuses(walkers):
    with pytest.raises(MatchError, match="axis-curves: needs symmetry_x"):
        AxisCurves().match(walkers.x, walkers.y)
    unmoved = walkers.given.symmetry_y[0]
    wrong = Given(walkers.given.symmetry_x, torch.stack([unmoved, unmoved.roll(1)]))
    with pytest.raises(MatchError, match="is no reflection"):
        AxisCurves().match(walkers.x, walkers.y, wrong)
    pair = exact_pair(4)
    with pytest.raises(MatchError, match="axis-curves: the symmetry of blob4 is a rotation"):
        AxisCurves().match(pair.x, pair.y, Given(pair.group_x.maps[[0, 3]], pair.group_y.maps[[0, 3]]))
    with pytest.raises(ValueError, match="n_anchors=200"):
        AxisCurves(n_anchors=200)
