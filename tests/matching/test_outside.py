"""torchqm.matching.outside: descriptors from outside are what the first map is solved from."""

import pytest
import torch
from references.pairs import FAST

from torchqm.fmap import p2p_to_fmap
from torchqm.matching import Collection, MatchError, match, match_quotient, match_semi_quotient
from torchqm.matching.outside import describe_pair
from torchqm.testing import assert_orbit_equal

PLAIN = FAST.changed(local_weight=0.0, commutativity=0.0)  # nothing but the descriptors


def smooth(pair, seed=0, n=40):
    """Smooth functions on y that are not symmetric, and the same on x."""
    generator = torch.Generator().manual_seed(seed)
    few = pair.y.basis.evecs[:, : FAST.k]
    values = few @ torch.randn(few.shape[1], n, dtype=torch.float64, generator=generator)
    return values[pair.p2p_xy], values


def test_exact_descriptors_give_the_exact_block_and_only_their_even_part_counts(exact):
    values = smooth(exact)
    even = [(v + v[g.maps[1]]) / 2 for v, g in zip(values, (exact.group_x, exact.group_y), strict=True)]
    assert float((even[0] - values[0]).abs().max()) > 0.1
    found = [
        match_quotient(exact.x, exact.y, exact.group_x, exact.group_y, PLAIN, values=given)
        for given in (values, tuple(even))
    ]
    wanted = p2p_to_fmap(exact.p2p_yx, found[0].source.even, found[0].target.even)
    for one in found:
        torch.testing.assert_close(one.initial, wanted, atol=1e-6, rtol=0)


@pytest.mark.parametrize("method", ["quotient", "semi"])
def test_they_decide_where_they_contradict_the_shapes(exact, method):
    """Descriptors whose columns are exchanged on one shape are believed by the least-squares map."""
    values, first = smooth(exact), PLAIN.changed(icp_steps=0, refinement="none", k_quotient=0)
    blocks = []
    for right in (values[1], values[1].roll(1, dims=1)):
        table = {id(exact.x): values[0], id(exact.y): right}
        collection = Collection(
            method=method, parameters=first, descriptors=lambda shape, table=table: table[id(shape)]
        )
        blocks.append(collection.match(exact.x, exact.y, exact.group_y.maps, exact.group_x.maps).fmap_even)
    assert float((blocks[0] - blocks[1]).norm()) > 0.5 * float(blocks[0].norm())


@pytest.mark.parametrize("method", ["quotient", "paper", "semi"])
def test_every_method_takes_them(exact, method):
    values = smooth(exact)
    asked = []

    def describe(shape):
        asked.append(shape)
        return values[0] if shape is x else values[1].float()

    collection = Collection(method=method, parameters=PLAIN, descriptors=describe)
    x, y = collection.shape(exact.x), collection.shape(exact.y)
    found = collection.match(x, y, exact.group_y.maps, exact.group_x.maps)
    assert asked == [x, y]
    assert_orbit_equal(found.maps[0], exact.p2p_xy, exact.group_y.orbits)
    assert found.details["n_descriptors"] == 40
    assert found.details["descriptors"] == repr(describe)
    assert "descriptors" in found.seconds


def test_they_are_made_with_the_threads_of_the_caller(exact):
    """A network on one thread would take as many times as long as there are cores; the rest of a match has one."""
    values, seen, before = smooth(exact), [], torch.get_num_threads()

    def describe(shape):
        seen.append(torch.get_num_threads())
        return values[len(seen) - 1]

    torch.set_num_threads(3)
    try:
        Collection(parameters=PLAIN, descriptors=describe).match(
            exact.x, exact.y, exact.group_y.maps, exact.group_x.maps
        )
        assert torch.get_num_threads() == 3
    finally:
        torch.set_num_threads(before)
    assert seen == [3, 3]


def test_semi_quotient_solves_from_them(exact):
    found = match_semi_quotient(exact.x, exact.y, exact.group_y, PLAIN.changed(icp_steps=0), smooth(exact))
    wanted = p2p_to_fmap(exact.p2p_yx, exact.x.basis.truncate(FAST.k), found.target.even)
    assert float((found.fmap - wanted).norm()) < 1e-3 * float(wanted.norm())


def test_match_hands_them_on(exact):
    with pytest.raises(MatchError, match=r"descriptors of .*: torch.float32 of shape \(3, 2\); expected"):
        match(exact.x.mesh, exact.y.mesh, parameters=FAST, symmetry="none", descriptors=lambda shape: torch.ones(3, 2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, is_x: v[:-1], r"of shape \(\d+, 40\); expected \(\d+, C\), a row for each vertex"),
        (lambda v, is_x: v[:, 0], r"expected \(\d+, C\)"),
        (lambda v, is_x: v[:, :0], "one column at least"),
        (lambda v, is_x: v.long(), "torch.int64 .* expected real numbers"),
        (lambda v, is_x: v.index_fill(0, torch.tensor([5]), float("nan")), "40 of them are not finite"),
        (lambda v, is_x: v[:, : 40 - is_x], "has 39 and .* 40; the same columns are needed"),
    ],
)
def test_what_is_no_table_of_descriptors_is_named(exact, change, message):
    values = smooth(exact)
    with pytest.raises(MatchError, match=message):
        describe_pair(
            exact.x, exact.y, lambda shape: change(values[0 if shape is exact.x else 1], int(shape is exact.x))
        )
