"""torchqm.matching.baselines.orientation: exact operators, an exact minimiser, and the reflection of a posed body."""

from dataclasses import replace

import pytest
import torch
from references.pairs import exact_pair

from torchqm.fmap import nearest_isometry, p2p_to_fmap
from torchqm.geometry import distances
from torchqm.matching import MatchError
from torchqm.matching.baselines import OrientationWeights, OrientRev
from torchqm.matching.baselines.orientation import _commutator, orientation_fmap, orientation_operators


def random(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_operators_change_their_sign_under_a_reflection_and_not_under_an_isometry():
    pair = exact_pair(2)
    values = pair.x.basis.evecs[:, [3, 5]].square()  # even: squares of functions that are even or odd
    omega = orientation_operators(pair.x, values, 20)
    basis = pair.x.basis.truncate(20)
    mirror = p2p_to_fmap(pair.group_x.maps[1], basis, basis)
    assert float(omega.norm()) > 1
    torch.testing.assert_close(mirror @ omega, -omega @ mirror, atol=1e-6, rtol=0)
    other = orientation_operators(pair.y, values[pair.p2p_yx], 20)
    direct = p2p_to_fmap(pair.p2p_yx, basis, pair.y.basis.truncate(20))
    torch.testing.assert_close(direct @ omega, other @ direct, atol=1e-6, rtol=0)


def test_the_quadratic_form_of_a_commutator():
    at_x, at_y, fmap = random(3, 5, 5), random(3, 4, 4, seed=1), random(4, 5, seed=2)
    energy = (fmap @ at_x - at_y @ fmap).square().sum()
    form = fmap.reshape(-1) @ _commutator(at_x, at_y) @ fmap.reshape(-1)
    torch.testing.assert_close(form, energy)


@pytest.mark.parametrize("weights", [None, OrientationWeights(1, 0, 1, 10), OrientationWeights(1, 1, 0, 1)])
def test_exact_maps_of_both_orientations(weights):
    pair = exact_pair(2)
    x, y = pair.x.basis.truncate(20), pair.y.basis.truncate(20)
    direct = p2p_to_fmap(pair.p2p_yx, x, y)
    mirror = p2p_to_fmap(pair.group_x.maps[1], x, x)
    found = [nearest_isometry(orientation_fmap(pair.x, pair.y, 20, turn, weights)) for turn in (False, True)]
    torch.testing.assert_close(found[0], direct, atol=1e-3, rtol=0)
    torch.testing.assert_close(found[1], direct @ mirror, atol=1e-3, rtol=0)


def test_without_orientation_only_the_even_functions_are_known():
    """What the term is for: odd functions have no descriptors and come out as 0."""
    pair = exact_pair(2)
    found = orientation_fmap(pair.x, pair.y, 20, True, OrientationWeights(1, 0, 1, 0))
    basis = pair.x.basis.truncate(20)
    mirror = p2p_to_fmap(pair.group_x.maps[1], basis, basis)
    odd = (torch.eye(20, dtype=torch.float64) - mirror) / 2
    assert float((found @ odd).norm()) < 1e-3
    assert float((found @ (torch.eye(20, dtype=torch.float64) - odd)).norm()) > 3


def test_exact_reflection():
    pair = exact_pair(2)
    found = OrientRev().match(pair.x, pair.x)
    assert torch.equal(found.best, pair.group_x.maps[1])
    assert found.labels == ("mirrored",)


def test_reflection_of_a_posed_body(walkers):
    """Nearest descriptors of the shape to itself give the identity, 0.2 away."""
    x = walkers.x
    found = OrientRev().match(x, x).best[walkers.at]
    true = walkers.symmetry_x[1][walkers.at]
    rows = distances(x.mesh, true)
    assert float(rows[torch.arange(100), found].mean()) < 0.02
    assert float(rows[torch.arange(100), walkers.at].mean()) > 0.15


def test_two_shapes_or_no_orientation_are_refused(walkers):
    with pytest.raises(MatchError, match="orient-rev: finds the symmetry of one shape"):
        OrientRev().match(walkers.x, walkers.y)
    flat = replace(walkers.x, oriented=False)
    with pytest.raises(MatchError, match="not consistently orientable"):
        OrientRev().match(flat, flat)
