"""torchqm.matching.synchronize: what is torn in two is put together, whatever points of the orbits are given."""

from dataclasses import replace

import pytest
import torch
from references.pairs import FAST

from torchqm.matching import given_symmetry, match_quotient
from torchqm.matching.candidates import full_map_from_blocks
from torchqm.matching.quotient import QuotientMatch, dense_map
from torchqm.matching.synchronize import synchronize_signs, synchronized_halves


def tube(n=300, seed=0):
    """Points around a tube with the mirror plane y = 0; displacement to the mirror image, with random signs."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * torch.pi * torch.rand(n, generator=generator, dtype=torch.float64)
    along = 6 * torch.rand(n, generator=generator, dtype=torch.float64)
    points = torch.stack([along, angle.sin(), angle.cos()], 1)
    mirror = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64)
    displacement = (points - points * mirror) / 2
    signs = torch.randint(0, 2, (n,), generator=generator).double() * 2 - 1
    return points, points * mirror, displacement, signs


@pytest.mark.parametrize("seed", range(3))
def test_random_signs_are_undone(seed):
    points, mirrored, displacement, signs = tube(seed=seed)
    found, satisfied = synchronize_signs(points, mirrored, displacement * signs[:, None])
    aligned = found * signs
    weight = displacement.norm(dim=1)
    share = float((weight * aligned).sum().abs() / weight.sum())
    assert share > 0.995
    assert satisfied > 0.999


def test_a_turned_half_and_noise_are_mended():
    """Half of the tube is turned over, and one in twenty displacements is wrong."""
    points, mirrored, displacement, _ = tube(600)
    turned = torch.where(points[:, 0] > 3, -1.0, 1.0).double()
    wrong = torch.arange(600) % 20 == 0
    anything = torch.randn(600, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = torch.where(wrong[:, None], anything, displacement * turned[:, None])
    found, satisfied = synchronize_signs(points, mirrored, noisy)
    weight = displacement.norm(dim=1) * ~wrong
    assert float((weight * found * turned).sum().abs() / weight.sum()) > 0.99
    assert 0.8 < satisfied < 1 - 1e-4  # some couplings cannot be satisfied


def test_mirror_images_decide_between_the_two_sides():
    """Without them each side has a sign of its own: both halves may go to the same half."""
    points, mirrored, displacement, _ = tube()
    inner = points[:, 1].abs() > 0.3  # two separate sides
    points, mirrored, displacement = points[inner], mirrored[inner], displacement[inner]
    folded = torch.where(points[:, 1] > 0, 1.0, -1.0).double()
    found, _ = synchronize_signs(points, mirrored, displacement * folded[:, None])
    assert abs(float((found * folded).mean())) == pytest.approx(1.0)


@pytest.fixture(scope="module")
def known(exact):
    return given_symmetry(exact.x, exact.group_x.maps), given_symmetry(exact.y, exact.group_y.maps)


@pytest.fixture(scope="module")
def found(exact):
    return match_quotient(exact.x, exact.y, exact.group_x, exact.group_y, FAST)


def test_of_an_exact_map_one_of_the_two_comes_back(exact, known, found, monkeypatch):
    """Whichever points of the orbits are given."""
    coin = torch.randint(0, 2, exact.p2p_xy.shape, generator=torch.Generator().manual_seed(0)) > 0
    mixed = torch.where(coin, exact.p2p_xy, exact.group_y.maps[1][exact.p2p_xy])
    monkeypatch.setattr(QuotientMatch, "orbit_map", lambda *_: mixed)
    halves = synchronized_halves(found, exact.x, exact.y, *known)
    true = exact.p2p_xy[halves.samples]
    assert halves.agreement(true) > 0.995
    assert halves.agreement(exact.group_y.maps[1][true]) > 0.995
    assert halves.satisfied > 0.99


def test_a_wrong_odd_block_is_given_up(exact, known, found, monkeypatch):
    """The odd block of a map that is direct in one part of the shape and mirrored in the other."""
    import torchqm.matching.candidates as candidates

    right = candidates.solve_odd

    def torn(*arguments, **options):
        odd = right(*arguments, **options)
        signs = torch.where(torch.arange(odd.fmap.shape[0]) % 2 == 0, 1.0, -1.0).double()
        return replace(odd, fmap=signs[:, None] * odd.fmap)

    monkeypatch.setattr(candidates, "solve_odd", torn)
    options = FAST.changed(local_weight=0.0, k_quotient=0)
    full = full_map_from_blocks(found, exact.x, exact.y, *known, options)
    assert full.synchronized
    assert len(full.scores) == 2
    p2p = dense_map(full.fmap, exact.x, exact.y)
    assert torch.equal(p2p, exact.p2p_xy) or torch.equal(p2p, exact.group_y.maps[1][exact.p2p_xy])


def test_a_right_odd_block_is_kept(exact, known, found):
    full = full_map_from_blocks(found, exact.x, exact.y, *known, FAST.changed(k_quotient=0))
    assert not full.synchronized
    assert full.scores == ()
