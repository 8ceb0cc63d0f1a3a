"""torchqm.matching.transfer: on exact pairs both ways give back the exact reflection."""

from dataclasses import replace

import pytest
import torch
from references.pairs import FAST, K, exact_pair

import torchqm.matching.transfer as module
from torchqm.fmap import p2p_to_fmap
from torchqm.matching import transfer_symmetry
from torchqm.symmetry import LeftRight


def transfer(pair, way="full_map", **options):
    return transfer_symmetry(pair.x, pair.y, pair.group_y, pair.side_y, FAST, way, **options)


def moved_wrongly(pair, reflection):
    """Distance from the vertex where each should go, in edge lengths."""
    verts = pair.x.mesh.verts
    wrong = (verts[reflection] - verts[pair.group_x.maps[1]]).norm(dim=1)
    return wrong / float(pair.x.mesh.edge_lengths.mean())


@pytest.mark.parametrize(
    "options", [{}, {"way": "clustering"}, {"way": "clustering", "distance": "extrinsic"}], ids=str
)
def test_the_exact_reflection_comes_over(either, options):
    found = transfer(either, **options)
    assert float((moved_wrongly(either, found.group.maps[1]) < 1).double().mean()) >= 0.99
    assert float(moved_wrongly(either, found.group.maps[1]).mean()) < 0.02
    assert found.warnings == []
    assert found.fmap.shape == (K, K)
    exact = p2p_to_fmap(either.group_x.maps[1], either.x.basis, either.x.basis)
    assert (found.fmap - exact).norm() < 0.05 * exact.norm()
    side = either.side_x
    agree = found.sign * side
    off_axis = side != 0
    assert float(agree[off_axis].mean().abs()) > 0.97


def test_what_each_way_brings_along(exact):
    full, cut = transfer(exact), transfer(exact, "clustering")
    assert full.halves is None
    assert full.odd.residual_direct < 1e-6
    assert full.odd.separated
    assert cut.odd is None
    assert cut.halves.margin > 10
    assert cut.halves.balance > 0.95
    assert torch.equal(cut.sign, cut.halves.sign)


def test_through_the_full_map_left_stays_left(either):
    """The direct map to the reference sends left to left, whatever the known vertex map of the pair does."""
    keeps = 1.0 if torch.allclose(either.x.mesh.verts, either.y.mesh.verts[either.p2p_xy]) else -1.0
    found = transfer(either)
    wanted = keeps * either.side_y[either.p2p_xy]
    off_axis = wanted != 0
    assert torch.equal(found.sign[off_axis], wanted[off_axis])
    assert float((found.sign[~off_axis] == 0).double().mean()) > 0.9


def test_refusals(exact):
    with pytest.raises(ValueError, match="way='guess': allowed are 'clustering' and 'full_map'"):
        transfer(exact, "guess")
    with pytest.raises(ValueError, match="group_y has 1 elements"):
        transfer_symmetry(exact.x, exact.y, exact_pair(1).group_y, exact.side_y, FAST)
    four = exact_pair(4)
    with pytest.raises(ValueError, match="group_y has 4 elements"):
        transfer_symmetry(four.x, four.y, four.group_y, four.side_y, FAST)


def test_a_symmetry_that_moves_little_is_told(exact, monkeypatch):
    one_side = LeftRight(torch.ones(642, dtype=torch.float64), (), 1.0, 0.0)
    monkeypatch.setattr(module, "halves_by_clustering", lambda *_: one_side)
    other = exact_pair(1).x  # without symmetry
    found = transfer_symmetry(other, exact.y, exact.group_y, exact.side_y, FAST, "clustering")
    assert one_side.warning in found.warnings
    assert any("only 0% of the area" in text for text in found.warnings)


def test_an_unclear_side_is_told_with_its_residuals(exact, monkeypatch):
    solve = module.solve_odd
    monkeypatch.setattr(
        module, "solve_odd", lambda *a: replace(solve(*a), residual_direct=0.91, residual_mirrored=1.23)
    )
    (text,) = transfer(exact).warnings
    assert "0.91" in text
    assert "1.23" in text
