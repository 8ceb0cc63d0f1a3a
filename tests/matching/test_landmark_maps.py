"""torchqm.matching.landmark_maps: true permutations give the true maps, involutions are exact and mostly even."""

from functools import lru_cache
from itertools import permutations

import pytest
import torch

from torchqm.data.synthetic import creature
from torchqm.fmap import p2p_to_fmap
from torchqm.matching import prepare
from torchqm.matching.landmark_maps import LandmarkMaps, _balanced_involution
from torchqm.spectral.descriptors import wave_energies, wave_kernel_signature
from torchqm.symmetry.landmarks import LandmarkPermutation, find_landmarks

KINDS = ("biped", "quadruped", "ellipsoid", "octopus")


class Case:
    """A creature at rest, whose symmetries are exact, and everything that its maps are made of."""

    def __init__(self, kind):
        self.body = creature(kind, 1000)
        self.shape = prepare(self.body.mesh, 100)
        self.landmarks = find_landmarks(self.shape.mesh, self.shape.basis)
        basis = self.shape.basis
        self.values = wave_kernel_signature(basis, wave_energies([basis], 20))
        self.maps = LandmarkMaps(self.shape, self.landmarks, self.values)
        self.k = len(self.maps.evals)

    def true(self, g):
        """The permutation that an element makes, and its functional map: ``C delta_x = delta_g(x)``."""
        number = {v: a for a, tip in enumerate(self.landmarks.tips) for v in tip.tolist()}
        element = self.body.base_group[g]
        images = tuple(number[int(element[tip[0]])] for tip in self.landmarks.tips)
        basis = self.shape.basis.truncate(self.k)
        fmap = p2p_to_fmap(element.argsort(), basis, basis)
        return LandmarkPermutation(images, int(self.body.orientation[g]), 0.0), fmap

    def any(self, n=40):
        """Permutations, most of them no symmetries at all."""
        drawn = torch.Generator().manual_seed(0)
        for i in range(n):
            images = tuple(torch.randperm(self.landmarks.n, generator=drawn).tolist())
            yield LandmarkPermutation(images, (-1) ** i, 0.0)


@lru_cache
def case(kind):
    return Case(kind)


@pytest.mark.parametrize("kind", KINDS)
def test_true_permutations_give_the_true_maps(kind):
    """In the right direction, too: those of order 8 are far from their inverses."""
    for g in range(len(case(kind).body.base_group)):
        permutation, wanted = case(kind).true(g)
        found = case(kind).maps.solve(permutation)
        assert float((found * wanted).sum()) / case(kind).k > 0.9
        if not permutation.involutive:
            assert float((found.T * wanted).sum()) / case(kind).k < 0.5


@pytest.mark.parametrize("weights", [(0.1, 1.0, 1.0), (0.1, 0.3, 1.0), (0.3, 0.3, 3.0), (1.0, 1.0, 1.0)])
def test_all_weights_in_use_do(weights):
    """The reflections of a biped and of a quadruped, to the last digit that symmetric triangles leave."""
    for kind in ("biped", "quadruped"):
        permutation, wanted = case(kind).true(1)
        torch.testing.assert_close(case(kind).maps.solve(permutation, *weights), wanted, atol=1e-3, rtol=0)


@pytest.mark.parametrize("powers", [(1.0,), (2.0,), (1.0, 2.0)])
def test_other_green_functions_do_too(powers):
    body = case("quadruped")
    maps = LandmarkMaps(body.shape, body.landmarks, body.values, 20, 40, powers)
    k = len(maps.evals)
    assert k <= 20
    assert len(maps.green) == len(maps.turned) == len(powers)
    permutation, wanted = body.true(1)
    torch.testing.assert_close(maps.solve(permutation), wanted[:k, :k], atol=1e-3, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_involutions_are_exact_and_at_least_half_even(kind):
    """Also of permutations that no symmetry makes, of which least squares alone knows nothing."""
    n, k = case(kind).landmarks.n, case(kind).k
    identity = torch.eye(k).double()
    swaps = []
    for a, b in permutations(range(n), 2):
        images = list(range(n))
        images[a], images[b] = b, a
        swaps.append(LandmarkPermutation(tuple(images), -1 if a < b else 1, 0.0))
    for permutation in swaps:
        fmap = case(kind).maps.solve(permutation)
        torch.testing.assert_close(fmap @ fmap, identity, atol=1e-12, rtol=0)
        torch.testing.assert_close(fmap, fmap.T, atol=1e-12, rtol=0)
        odd = int((torch.linalg.eigvalsh(fmap) < 0).sum())
        assert 2 * odd <= k
        assert float(fmap[0, 0]) > 0.9  # the constant stays


def test_the_nearest_balanced_involution():
    """What is half even stays, though its weights are all equal; of more odd functions the least odd become even."""
    turn = torch.linalg.qr(torch.randn(6, 6, generator=torch.Generator().manual_seed(0)).double())[0]
    for weights, signs in (
        ([1.0, 1, 1, -1, -1, -1], [1, 1, 1, -1, -1, -1]),
        ([0.9, 0.1, 0.2, 0.3, -0.1, -0.9], [1, 1, 1, 1, -1, -1]),
        ([0.9, -0.1, -0.2, -0.3, -0.4, -0.9], [1, 1, 1, -1, -1, -1]),
        ([1.0, 1, 1, 1, 1, 1], [1, 1, 1, 1, 1, 1]),
    ):
        for q in (turn, torch.eye(6).double()):
            found = _balanced_involution((q * torch.tensor(weights)) @ q.T)
            torch.testing.assert_close(found, (q * torch.tensor(signs)) @ q.T, atol=1e-12, rtol=0)


def test_other_permutations_give_isometries():
    body = case("octopus")
    others = [p for p in body.any() if not p.involutive]
    assert len(others) > 30
    for permutation in others:
        fmap = body.maps.solve(permutation)
        torch.testing.assert_close(fmap @ fmap.T, torch.eye(body.k).double(), atol=1e-10, rtol=0)
    permutation, _ = body.true(1)
    back = torch.tensor(permutation.images).argsort()
    inverse = body.maps.solve(LandmarkPermutation(tuple(back.tolist()), permutation.orientation, 0.0))
    torch.testing.assert_close(inverse, body.maps.solve(permutation).T, atol=0.05, rtol=0)


def test_orientation_alone_tells_a_rotation_from_a_reflection():
    """The six tips of an ellipsoid go to the same places by an element and by its product with a mirror that fixes
    some of them; where two elements make one permutation, the maps are nearly each other's opposite on odd functions.
    """
    body = case("ellipsoid")
    by_images = {}
    for g in range(8):
        permutation, wanted = body.true(g)
        by_images.setdefault(permutation.images, []).append((permutation, wanted))
    twins = [pair for pair in by_images.values() if len(pair) == 2]
    assert len(twins) == 4
    for (one, right), (other, wrong) in twins:
        assert one.orientation == -other.orientation
        found = body.maps.solve(one)
        assert float((found * right).sum()) / body.k > 0.9
        assert float((found * wrong).sum()) / body.k < 0.5


def test_one_landmark():
    """Nothing to be permuted and no pairs: the descriptors and the Laplacian are left, and they want the identity."""
    body = case("biped")
    alone = find_landmarks(body.shape.mesh, body.shape.basis, most=1)
    maps = LandmarkMaps(body.shape, alone, body.values)
    assert maps.turned == []
    fmap = maps.solve(LandmarkPermutation((0,), 1, 0.0))
    torch.testing.assert_close(fmap, torch.eye(body.k).double(), atol=1e-10, rtol=0)
