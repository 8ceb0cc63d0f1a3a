"""torchqm.matching.baselines.ours: the pipeline's own maps come through, with the symmetries that were asked for."""

import pytest
import torch
from references.pairs import FAST

from torchqm.matching import MatchError, MatchParameters
from torchqm.matching.baselines import Given, Ours
from torchqm.matching.baselines.ours import _known

SMALL = MatchParameters(k_max=80)


@pytest.mark.parametrize("method", ["quotient", "paper", "semi"])
def test_automatic_on_exact_twins_whatever_else_is_given(exact, method):
    """A wrong symmetry does no harm to what finds its own."""
    wrong = Given(exact.group_x.maps, exact.group_y.maps[[0, 0]], reference=exact.y)
    found = Ours(method, "auto", FAST).match(exact.x, exact.y, wrong)
    assert torch.equal(found.maps, exact.group_y.maps[:, exact.p2p_xy])
    assert found.labels == ("direct", "mirrored")
    assert found.notes[0] == "the symmetries come from the two shapes"
    assert found.seconds > 0


@pytest.mark.parametrize(
    ("matcher", "bound", "origin"),
    [
        (Ours("quotient", "true", SMALL), 0.03, "given"),
        (Ours("quotient", "reference", SMALL), 0.03, "reference"),
        (Ours("paper", "known"), 0.03, "reference"),
        (Ours("semi", "known"), 0.04, "reference"),
    ],
    ids=lambda value: f"{value.method}-{value.axis}" if isinstance(value, Ours) else "",
)
def test_another_pose_and_triangulation(walkers, matcher, bound, origin):
    """Nearest descriptors are above 0.07."""
    found = matcher.match(walkers.x, walkers.y, walkers.given)
    assert found.labels == ("direct", "mirrored")
    assert float(walkers.errors(found.maps[0])[0]) < bound
    assert float(walkers.errors(found.maps[1])[1]) < 0.04
    assert origin in found.notes[0]
    assert ("80 eigenfunctions instead of 300" in found.notes) == (matcher.parameters is None)


def test_a_pose_that_is_the_reference_keeps_its_own_plane(walkers):
    given = Given(reference=walkers.rest)
    found = Ours("quotient", "reference", SMALL).match(walkers.x, walkers.rest, given)
    assert found.labels == ("direct", "mirrored")
    assert [step for step in found.steps if "transfer" in step] == [f"symmetry transfer to {walkers.x.mesh.name}"]


def test_given_sides_are_used_and_the_axis_has_none(exact):
    table, side = exact.group_x.maps, exact.x.mesh.verts[:, 0]
    fixed = table[1] == torch.arange(len(side))
    for s in (1.0, -1.0):
        known = _known(exact.x, table, s * side + 1e-17)  # on the axis the side is rounding
        assert torch.equal(known.sign == 0, fixed)
        assert torch.equal(known.sign[~fixed], s * side[~fixed].sign())


def test_what_it_refuses(walkers):
    with pytest.raises(ValueError, match="method='fmap': allowed are quotient, paper, semi"):
        Ours(method="fmap")
    with pytest.raises(ValueError, match="axis='guess': allowed are auto"):
        Ours(axis="guess")
    with pytest.raises(MatchError, match="needs symmetry_y"):
        Ours(axis="true").match(walkers.x, walkers.y, Given(symmetry_x=walkers.given.symmetry_x))
    with pytest.raises(MatchError, match="needs a reference"):
        Ours(axis="reference").match(walkers.x, walkers.y)
    unmoved = walkers.given.symmetry_y[0]
    wrong = Given(walkers.given.symmetry_x, torch.stack([unmoved, unmoved.roll(1)]))
    with pytest.raises(MatchError, match="no reflection"):
        Ours(axis="true").match(walkers.x, walkers.y, wrong)
