"""torchqm.matching.quotient: on exact pairs every step gives the exact map."""

import pytest
import torch
from references.pairs import FAST, K, exact_pair, with_loose_vertices

from torchqm.fmap import p2p_to_fmap
from torchqm.matching import (
    QuotientMatch,
    choose_halves,
    match_quotient,
    prepare,
    refine_by_icp,
)
from torchqm.matching.quotient import dense_map, pair_places, refine_fmap
from torchqm.symmetry import SymmetryGroup
from torchqm.testing import assert_orbit_equal


@pytest.fixture(scope="module")
def found(exact):
    return match_quotient(exact.x, exact.y, exact.group_x, exact.group_y, FAST)


def truth(pair, k=K):
    return p2p_to_fmap(pair.p2p_yx, pair.x.basis.truncate(k), pair.y.basis.truncate(k))


def noise(*shape):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("order", [1, 2, 4, 8])
def test_the_even_block_and_the_orbits_are_exact(order):
    pair = exact_pair(order)
    found = match_quotient(pair.x, pair.y, pair.group_x, pair.group_y, FAST)
    assert found.source.even.k + found.source.odd.k == FAST.k
    wanted = p2p_to_fmap(pair.p2p_yx, found.source.even, found.target.even)
    torch.testing.assert_close(found.fmap, wanted, atol=1e-6, rtol=0)
    assert_orbit_equal(found.orbit_map(pair.x, pair.y), pair.p2p_xy, pair.group_y.orbits)


@pytest.mark.parametrize("changes", [{"time": 0.005}, {"n_samples": 200}, {"descriptor": "hks"}, {"k": 20}], ids=str)
def test_other_parameters(exact, changes):
    parameters = FAST.changed(**changes)
    found = match_quotient(exact.x, exact.y, exact.group_x, exact.group_y, parameters)
    assert found.source.full.k == parameters.k
    assert found.time == parameters.time
    assert_orbit_equal(found.orbit_map(exact.x, exact.y), exact.p2p_xy, exact.group_y.orbits)


def test_the_wrong_group_gives_another_answer(exact):
    """The test above is not passed by just anything: without the source's symmetry there is no square isometry."""
    trivial = SymmetryGroup.trivial(642)
    found = match_quotient(exact.x, exact.y, trivial, exact.group_y, FAST)
    assert found.fmap.shape == (found.target.even.k, FAST.k)
    with pytest.raises(ValueError, match="group acts on 642 vertices"):
        match_quotient(exact.x, prepare(with_loose_vertices(exact.y.mesh, [0])[0], K), trivial, exact.group_y, FAST)


class TestChooseHalves:
    def orbit_map(self, pair):
        """The exact map with half of its images replaced by their mirror images."""
        other = torch.rand(642, generator=torch.Generator().manual_seed(0)) < 0.5
        return torch.where(other, pair.group_y.maps[1][pair.p2p_xy], pair.p2p_xy)

    def test_both_consistent_maps(self, exact):
        orbit_map = self.orbit_map(exact)
        mirrored = exact.group_y.maps[1][exact.p2p_xy]
        assert 0.3 < float((orbit_map == exact.p2p_xy).double().mean()) < 0.7
        first = choose_halves(orbit_map, exact.group_y, exact.side_x, exact.side_y)
        second = choose_halves(orbit_map, exact.group_y, exact.side_x, -exact.side_y)
        assert torch.equal(first, exact.p2p_xy)
        assert torch.equal(second, mirrored)

    def test_vertices_on_no_side_keep_their_point(self, exact):
        orbit_map = self.orbit_map(exact)
        nowhere = torch.zeros(642, dtype=torch.float64)
        assert torch.equal(choose_halves(orbit_map, exact.group_y, nowhere, exact.side_y), orbit_map)

    def test_orbits_without_the_wanted_half_keep_their_point(self, exact):
        orbit_map = self.orbit_map(exact)
        for side in (torch.ones(642).double(), torch.zeros(642).double()):
            assert torch.equal(choose_halves(orbit_map, exact.group_y, -torch.ones(642).double(), side), orbit_map)

    def test_an_axis_is_no_half(self):
        """Where the target's signs are not symmetric themselves, a vertex on no side still keeps its point."""
        group = SymmetryGroup(torch.tensor([[0, 1, 2], [1, 0, 2]]))
        signs = torch.tensor([[0.0, 1.0, -1.0], [1.0, 0.0, -1.0]], dtype=torch.float64)
        assert choose_halves(torch.zeros(3).long(), group, *signs).tolist() == [0, 0, 0]

    @pytest.mark.parametrize("order", [1, 4])
    def test_other_groups(self, exact, order):
        pair = exact_pair(order)
        with pytest.raises(ValueError, match=f"group_y has {order} elements"):
            choose_halves(pair.p2p_xy, pair.group_y, exact.side_x, exact.side_y)


def test_icp_mends_a_damaged_map(exact):
    """A fifth of the vertices sent anywhere: the isometry nearest to what is left is the exact one."""
    damaged = exact.p2p_xy.clone()
    damaged[::5] = damaged[::5].roll(17)
    found = refine_by_icp(damaged, exact.x, exact.y, FAST)
    torch.testing.assert_close(found, truth(exact), atol=1e-6, rtol=0)
    assert torch.equal(dense_map(found, exact.x, exact.y), exact.p2p_xy)
    assert refine_by_icp(damaged, exact.x, exact.y, FAST.changed(k_max=40)).shape == (40, 40)


def test_upsampling_ends_at_k_max(exact):
    start = truth(exact, 30) + 0.03 * noise(30, 30)
    torch.testing.assert_close(refine_fmap(start, exact.x, exact.y, FAST), truth(exact), atol=1e-6, rtol=0)
    assert refine_fmap(start, exact.x, exact.y, FAST.changed(k_max=1000)).shape == (K, K)  # what the bases have
    assert refine_fmap(start, exact.x, exact.y, FAST.changed(k_max=30)) is start
    assert refine_fmap(start, exact.x, exact.y, FAST.changed(refinement="none")) is start


def test_dense_maps_take_any_size_and_no_loose_vertex(exact):
    assert torch.equal(dense_map(truth(exact), exact.x, exact.y), exact.p2p_xy)
    assert dense_map(truth(exact, 40)[:35], exact.x, exact.y).shape == (642,)
    mesh, ids = with_loose_vertices(exact.y.mesh, [0, 300])
    y = prepare(mesh, K)
    fmap = y.basis.coefficients(torch.zeros(644, K).double().index_copy(0, ids, exact.x.basis.evecs[exact.p2p_yx]))
    assert torch.equal(dense_map(fmap, exact.x, y), ids[exact.p2p_xy])
    assert torch.isin(dense_map(0 * fmap, exact.x, y), ids).all()  # images at 0, where loose vertices are, too


def test_orbit_map_uses_the_time(exact, found):
    """Coordinates of high frequency are damped: of a map spoilt there, the heat of some time sees nothing."""
    wanted = p2p_to_fmap(exact.p2p_yx, found.source.even, found.target.even)
    spoilt = wanted.clone()
    spoilt[-3:] = 0.0
    right = []
    for time in (0.0, 0.05):
        at = QuotientMatch(found.source, found.target, spoilt, time).orbit_map(exact.x, exact.y)
        right.append(float((exact.group_y.orbits[at] == exact.p2p_xy[:, None]).any(1).double().mean()))
    assert right[1] > right[0]


def test_no_more_points_ask_than_there_are(exact):
    for places in pair_places(exact.x, exact.y, FAST):
        assert places.n_queries == len(places.ids) == 642
    bare = pair_places(exact.x, exact.y, FAST.changed(local_weight=0.0))[0]
    assert bare.features.shape == (642, 0)
    assert pair_places(exact.x, exact.y, FAST.changed(n_samples=50))[1].n_queries == 50


def test_orbits_of_some_vertices_are_those_of_an_exhaustive_search(exact, found):
    ids = exact.x.samples[:50]
    images = found.source.even.evecs[ids] @ found.fmap.T
    distances = torch.cdist(images, found.target.even.evecs)
    mine = found.orbit_map_of(ids)
    torch.testing.assert_close(distances[torch.arange(50), mine], distances.amin(1), atol=1e-6, rtol=0)
