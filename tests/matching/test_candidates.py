"""torchqm.matching.candidates: both candidates are exact on exact pairs; of a good and a bad one the good is kept."""

from dataclasses import replace

import pytest
import torch
from references.pairs import FAST, K

from torchqm.fmap import nearest_isometry, p2p_to_fmap
from torchqm.matching import full_map_from_blocks, given_symmetry, match_quotient
from torchqm.matching.candidates import sharpened
from torchqm.matching.quotient import dense_map, pair_places

BOTH = FAST.changed(k_quotient=60)


@pytest.fixture(scope="module")
def known(either):
    return given_symmetry(either.x, either.group_x.maps), given_symmetry(either.y, either.group_y.maps)


@pytest.fixture(scope="module")
def found(either):
    return match_quotient(either.x, either.y, either.group_x, either.group_y, FAST)


def direct(pair):
    same = torch.allclose(pair.x.mesh.verts, pair.y.mesh.verts[pair.p2p_xy])
    return pair.p2p_xy if same else pair.group_y.maps[1][pair.p2p_xy]


@pytest.mark.parametrize("k_quotient", [0, 60])
def test_odd_block_and_upsampling_give_the_direct_map(either, known, found, k_quotient):
    full = full_map_from_blocks(found, either.x, either.y, *known, FAST.changed(k_quotient=k_quotient))
    assert full.fmap.shape == (K, K)
    assert full.odd.separated
    assert len(full.scores) == (2 if k_quotient else 0)
    assert all(score < 1e-3 for score in full.scores)
    assert torch.equal(dense_map(full.fmap, either.x, either.y), direct(either))


def test_the_quotient_grows_exactly(either, known, found):
    grown = sharpened(found, either.x, either.y, *known, BOTH, pair_places(either.x, either.y, BOTH))
    assert grown.source.full.k == 60
    wanted = p2p_to_fmap(either.p2p_yx, grown.source.even, grown.target.even)
    torch.testing.assert_close(grown.fmap, wanted, atol=1e-2, rtol=0)


@pytest.mark.parametrize("bad", ["icp", "start"])
def test_the_better_candidate_is_kept(exact, bad):
    """One candidate begins at what ICP made, the other at the least-squares map; either may be spoilt."""
    known = given_symmetry(exact.x, exact.group_x.maps), given_symmetry(exact.y, exact.group_y.maps)
    found = match_quotient(exact.x, exact.y, exact.group_x, exact.group_y, FAST)
    noise = torch.randn(found.fmap.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    wrong = nearest_isometry(noise)
    spoilt = replace(found, fmap=wrong) if bad == "icp" else replace(found, first=wrong)
    # Features would mend the second one.
    full = full_map_from_blocks(spoilt, exact.x, exact.y, *known, BOTH.changed(local_weight=0.0))
    assert full.scores.index(min(full.scores)) == (1 if bad == "icp" else 0)
    assert max(full.scores) > 10 * min(full.scores)
    assert torch.equal(dense_map(full.fmap, exact.x, exact.y), exact.p2p_xy)
