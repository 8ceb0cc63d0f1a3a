"""The layers and the classical matcher are the same functions: given the same descriptors they give the same maps."""

import pytest
import torch
from references.pairs import FAST, exact_pair

from torchqm.matching import match_quotient
from torchqm.matching.initial import shared_descriptors
from torchqm.nn import FunctionalMapSolver, QuotientICP, SymmetrizedBasis
from torchqm.symmetry import symmetrized_basis
from torchqm.testing import assert_orbit_equal, gradcheck64

PARAMETERS = FAST.changed(local_weight=0.0)


@pytest.fixture(scope="module")
def exact():
    return exact_pair()


@pytest.fixture(scope="module")
def matched(exact):
    return match_quotient(exact.x, exact.y, exact.group_x, exact.group_y, PARAMETERS)


@pytest.fixture(scope="module")
def layered(exact, matched):
    """Both halves of each shape, and the maps before and after ICP, from layers."""
    bases = [side.full for side in (matched.source, matched.target)]
    groups = (exact.group_x, exact.group_y)
    halves = [
        SymmetrizedBasis()(b.evals[None], b.evecs[None], b.mass[None], group=g.maps[None])
        for b, g in zip(bases, groups, strict=True)
    ]
    values = shared_descriptors([exact.x.basis, exact.y.basis], PARAMETERS)
    coeffs = [h.evecs_trans_even @ v for h, v in zip(halves, values, strict=True)]
    weights = 2 / sum(c.square().sum(-2) for c in coeffs)  # descriptors of unit norm on both shapes together
    lmbda = PARAMETERS.commutativity * values[0].shape[1] / halves[0].evals_even.shape[-1]
    solver = FunctionalMapSolver(lmbda, commutativity="normalized", ridge=1e-9)
    evals, trans = ([getattr(h, name) for h in halves] for name in ("evals_even", "evecs_trans_even"))
    first, _ = solver(*(v[None] for v in values), *evals, *trans, weights=weights)
    icp = QuotientICP(PARAMETERS.icp_steps, tau=1e-8).double()
    samples, anchors = exact.x.samples[: PARAMETERS.n_samples], exact.y.anchors
    refined = icp(first, halves[0].evecs_even[:, samples], halves[1].evecs_even[:, anchors])
    return halves, first, refined


def test_gradients_of_the_whole_chain():
    """From a soft self-map through the split and the default solver to a loss: nothing large times rounding."""
    generator = torch.Generator().manual_seed(0)
    n, k = 10, 6
    angle = 2 * torch.pi * torch.arange(n, dtype=torch.float64) / n
    columns = [torch.ones(n).double(), *(f(m * angle) for m in (1, 2, 3) for f in (torch.cos, torch.sin))]
    evecs = torch.linalg.qr(torch.stack(columns, 1)).Q[:, :k]
    evals = torch.tensor([0.0, 1.0, 1.05, 4.0, 4.1, 9.0], dtype=torch.float64)
    mass = torch.ones(n, dtype=torch.float64)
    feat_x, feat_y = (torch.randn(n, 8, generator=generator, dtype=torch.float64) for _ in range(2))
    mirror = torch.nn.functional.one_hot((-torch.arange(n)) % n, n).double()
    logits = 6 * mirror + 0.1 * torch.randn(n, n, generator=generator, dtype=torch.float64)
    split, solver = SymmetrizedBasis(), FunctionalMapSolver(lmbda=1.0)

    def loss(logits, higher, feat_x):
        half = split(torch.cat([evals[:1], higher]), evecs, mass, soft_map=logits.softmax(-1))
        fmap, _ = solver(feat_x, feat_y, *[half.evals_even] * 2, *[half.evecs_trans_even] * 2)
        return (half.evecs_even @ fmap @ half.evecs_trans_even).square().sum()

    gradcheck64(loss, logits, evals[1:], feat_x)  # at 0 the root in the resolvent has no slope


def in_full_bases(halves, fmap):
    """Free of the gauge of the even functions."""
    return (halves[1].coeffs_even @ fmap @ halves[0].coeffs_even.mT)[0]


def test_the_same_even_functions(exact, matched, layered):
    for half, side, group in zip(
        layered[0], (matched.source, matched.target), (exact.group_x, exact.group_y), strict=True
    ):
        torch.testing.assert_close(half.evals_even[0], symmetrized_basis(side.full, group).even.evals)


def test_the_same_least_squares_map(matched, layered):
    halves, first, _ = layered
    expected = matched.target.even_coeffs @ matched.initial @ matched.source.even_coeffs.T
    torch.testing.assert_close(in_full_bases(halves, first), expected, atol=1e-9, rtol=0)


def test_the_same_refined_map_and_orbits(exact, matched, layered):
    halves, _, refined = layered
    expected = matched.target.even_coeffs @ matched.fmap @ matched.source.even_coeffs.T
    torch.testing.assert_close(in_full_bases(halves, refined), expected, atol=1e-6, rtol=0)
    images = halves[0].evecs_even[0] @ refined[0].T
    found = torch.cdist(images, halves[1].evecs_even[0], compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
    assert_orbit_equal(found, matched.orbit_map(exact.x, exact.y), exact.group_y.orbits)
