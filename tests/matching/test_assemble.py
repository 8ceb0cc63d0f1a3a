"""torchqm.matching.assemble: two reflections make the whole group, half a reflection makes none, errors average out."""

from dataclasses import replace

import pytest
import torch
from references.exact import K

import torchqm.matching.assemble as module
from torchqm.fmap import nearest_isometry
from torchqm.matching import MatchParameters
from torchqm.matching.assemble import LIMIT, FunctionalGroup, _whole, assemble, synchronized
from torchqm.matching.proposals import Proposal
from torchqm.symmetry import group_fault, group_name

FULL = MatchParameters(k_max=100)


@pytest.fixture(scope="module")
def whole(octopus):
    """The group that two neighbouring reflections of the octopus generate."""
    mirrors = octopus.reflections()
    a, b = next((a, b) for a in mirrors for b in mirrors if octopus.order(octopus.product(a, b)) == 8)
    return assemble([octopus.proposals[a], octopus.proposals[b]], octopus.judge, FULL)


class TestAssemble:
    def test_two_reflections_make_the_group_of_an_octopus(self, octopus, whole):
        assert whole.order == 16
        assert whole.tried == 0
        assert group_fault(whole.products) is None
        assert group_name(whole.products) == "D8"
        numbers = octopus.numbers(whole)
        assert numbers[0] == 0
        assert sorted(numbers) == list(range(16))
        for g in range(16):
            for h in range(16):
                assert numbers[int(whole.products[g, h])] == octopus.product(numbers[g], numbers[h])

    def test_what_is_known_of_its_elements(self, octopus, whole):
        assert torch.equal(whole.elements[0].fmap, torch.eye(K).double())
        for number, element in zip(octopus.numbers(whole), whole.elements, strict=True):
            assert element.orientation == int(octopus.body.orientation[number])
            assert element.involution == (octopus.order(number) <= 2)
            assert element.score < 0.05

    def test_maps_that_are_there_are_taken(self, ellipsoid, monkeypatch):
        """The products of an ellipsoid's elements are in the pool: nothing is refined, and no more is found."""
        monkeypatch.setattr(module, "_refined", None)
        found = assemble(ellipsoid.proposals[1:], ellipsoid.judge, FULL)
        assert sorted(ellipsoid.numbers(found)) == list(range(8))
        assert group_name(found.products) == "C2 x C2 x C2"

    @pytest.mark.parametrize("generator", [1, 2, 3, 4, 7])
    def test_one_rotation_makes_its_powers(self, octopus, generator):
        found = assemble([octopus.proposals[generator]], octopus.judge, FULL)
        assert found.order == octopus.order(generator)
        assert group_name(found.products) == f"C{found.order}"

    @pytest.mark.parametrize("score", [0.0, 0.02, None])
    @pytest.mark.parametrize("axis", [1, 2])
    def test_half_a_reflection_is_refused(self, biped, axis, score):
        """Whatever its own score is, it tears the body."""
        false = biped.half(1, axis, score)
        found = assemble([biped.proposals[1], false], biped.judge, FULL)
        assert found.order == 2
        assert biped.numbers(found) == [0, 1]
        assert found.tried == (score is not None)  # else its score is too large to try it
        assert torch.equal(found.products, torch.tensor([[0, 1], [1, 0]]))

    def test_half_a_reflection_does_not_keep_the_others_out(self, octopus):
        cut, a, b = octopus.reflections()[:3]
        false = octopus.half(cut, 1, 0.01)
        found = assemble([octopus.proposals[a], false, octopus.proposals[b]], octopus.judge, FULL)
        assert found.order == 2 * octopus.order(octopus.product(a, b))
        octopus.numbers(found)

    def test_products_that_are_no_symmetries_refuse_a_map(self, ellipsoid):
        """A turn by 30 degrees of a body with three different axes: its powers are refined to something else or bad."""
        turned = ellipsoid.proposals[1].fmap.clone()
        plane = torch.tensor([[0.866, -0.5], [0.5, 0.866]]).double()
        turned[1:3] = plane @ turned[1:3]
        false = Proposal(nearest_isometry(turned), 1, False, 0.01)
        good = ellipsoid.proposals[ellipsoid.reflections()[0]]
        found = assemble([good, false], ellipsoid.judge, FULL)
        numbers = ellipsoid.numbers(found)  # which are true elements, to a correlation of 0.95
        assert len(set(numbers)) == found.order
        assert {ellipsoid.product(g, h) for g in numbers for h in numbers} == set(numbers)

    def test_the_score_decides_who_may_try(self, ellipsoid):
        """3.5 times the best one, LIMIT at most."""
        first, second = (ellipsoid.proposals[g] for g in ellipsoid.reflections()[:2])
        for best, other, taken in (
            (0.03, 0.104, True),
            (0.03, 0.106, False),
            (0.1, LIMIT - 0.001, True),
            (0.1, LIMIT + 0.001, False),
        ):
            pool = [replace(first, score=best), replace(second, score=other)]
            found = assemble(pool, ellipsoid.judge, FULL)
            assert (found.order == 4) == taken

    @pytest.mark.parametrize("scores", [(0.05, 0.145, 0.12), (0.05, 0.12, 0.145), (0.06, 0.145, 0.05)])
    def test_a_good_map_after_a_bad_one_is_tried(self, ellipsoid, scores):
        """Pools are ranked by more than the score."""
        pool = [replace(ellipsoid.proposals[g], score=s) for g, s in zip(ellipsoid.reflections(), scores, strict=False)]
        assert assemble(pool, ellipsoid.judge, FULL).order == 4

    def test_a_best_map_that_is_no_symmetry_gives_no_group(self, biped):
        """Its square is not the identity and no symmetry either."""
        noise = torch.randn(K, K, generator=torch.Generator().manual_seed(0)).double()
        found = assemble([Proposal(nearest_isometry(noise), 1, False, 0.3)], biped.judge, FULL)
        assert (found.order, found.tried) == (1, 1)
        assert found.products.tolist() == [[0]]


def test_what_tears_is_not_whole(biped):
    """A score that would do by itself, and a tear across the waist."""
    half = biped.half(1, 1, score=LIMIT / 2)
    both = FunctionalGroup((biped.proposals[0], half), torch.tensor([[0, 1], [1, 0]]))
    assert not _whole(both, 1, biped.shape)
    assert _whole(FunctionalGroup(tuple(biped.proposals), both.products), 1, biped.shape)


def turned_by(angle, seed):
    """A small rotation of all functions but the constant: a map and its errors."""
    skew = torch.randn(K, K, generator=torch.Generator().manual_seed(seed)).double()
    skew[0] = skew[:, 0] = 0
    return torch.linalg.matrix_exp(angle * (skew - skew.T))


class TestSynchronized:
    @pytest.fixture
    def exact(self, octopus):
        table = torch.tensor([[octopus.product(g, h) for h in range(16)] for g in range(16)])
        return FunctionalGroup(tuple(octopus.proposals), table, 3)

    def test_an_exact_group_stays(self, exact):
        found = synchronized(exact)
        assert torch.equal(found.products, exact.products)
        assert found.tried == 3
        for new, old in zip(found.elements, exact.elements, strict=True):
            torch.testing.assert_close(new.fmap, old.fmap, atol=1e-8, rtol=0)
            assert (new.orientation, new.involution, new.score) == (old.orientation, old.involution, old.score)

    def test_errors_average_out(self, exact):
        """Each map comes nearer to the truth, by more than half, and products hold better."""
        noisy = [exact.elements[0]]
        noisy += [replace(e, fmap=turned_by(0.02, i) @ e.fmap) for i, e in enumerate(exact.elements[1:])]
        before = replace(exact, elements=tuple(noisy))
        after = synchronized(before)
        assert torch.equal(after.elements[0].fmap, exact.elements[0].fmap)
        for old, new, true in zip(before.elements[1:], after.elements[1:], exact.elements[1:], strict=True):
            assert float((new.fmap - true.fmap).norm()) < 0.5 * float((old.fmap - true.fmap).norm())
            torch.testing.assert_close(new.fmap @ new.fmap.T, torch.eye(K).double(), atol=1e-10, rtol=0)
        assert self.closure(after) < 0.5 * self.closure(before)

    @staticmethod
    def closure(group):
        maps = torch.stack([e.fmap for e in group.elements])
        gaps = [maps[g] @ maps[h] - maps[group.products[g, h]] for g in range(16) for h in range(16)]
        return float(torch.stack(gaps).norm())

    def test_the_trivial_group(self, exact):
        trivial = FunctionalGroup(exact.elements[:1], torch.zeros(1, 1, dtype=torch.int64))
        found = synchronized(trivial)
        assert found.order == 1
        assert torch.equal(found.elements[0].fmap, trivial.elements[0].fmap)
