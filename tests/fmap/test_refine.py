"""torchqm.fmap.refine: exact pairs are fixed points, perturbed maps come back, one step is the printed one."""

import pytest
import torch
from references import dense
from references.shapes import basis_of, blob, renumbered
from references.unchecked import unchecked

import torchqm.fmap.refine as module
from torchqm.fmap import (
    commutativity_energy,
    correspondence_fmap,
    fmap_to_p2p,
    frequency_mask,
    growing_sizes,
    nearest_isometry,
    p2p_to_fmap,
    quotient_icp,
    semi_quotient_icp,
    semi_upsample,
    upsample,
)
from torchqm.geometry import area_samples
from torchqm.spectral import SpectralBasis
from torchqm.symmetry import symmetrized_basis
from torchqm.testing import assert_orbit_equal

K = 40


class Pair:
    """A mirror-symmetric blob, its renumbered copy, and the exact maps between all their bases."""

    def __init__(self, order=2):
        self.shape = blob(order)
        self.full_x = basis_of(self.shape.mesh, K)
        self.copy = renumbered(self.shape, K)
        self.full_y = self.copy.basis
        self.split_x = symmetrized_basis(self.full_x, self.shape.group)
        self.split_y = symmetrized_basis(self.full_y, self.copy.shape.group)
        self.even_x, self.even_y = self.split_x.even, self.split_y.even
        self.even = p2p_to_fmap(self.copy.p2p_yx, self.even_x, self.even_y)
        self.semi = p2p_to_fmap(self.copy.p2p_yx, self.full_x, self.even_y)
        self.samples = area_samples(self.shape.mesh, 300, 0)


@pytest.fixture(scope="module")
def pair():
    return Pair()


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def identity(k):
    return torch.eye(k, dtype=torch.float64)


@pytest.mark.parametrize("shape", [(5, 5), (3, 6), (6, 3)])
def test_nearest_isometry(shape):
    matrix = noise(*shape)
    found = nearest_isometry(matrix)
    torch.testing.assert_close(torch.linalg.svdvals(found), torch.ones(min(shape), dtype=torch.float64))
    torch.testing.assert_close(nearest_isometry(found), found)
    for seed in range(1, 20):  # none is nearer
        other = nearest_isometry(found + 0.3 * noise(*shape, seed=seed))
        assert (matrix - found).norm() < (matrix - other).norm()


def test_nearest_isometry_keeps_the_kernel():
    wide = noise(3, 6)
    found = nearest_isometry(wide)
    kernel = identity(6) - torch.linalg.pinv(wide) @ wide
    assert (found @ kernel).abs().max() < 1e-12


def test_frequency_mask():
    mu, lam = torch.tensor([0.0, 1.0, 4.0]).double(), torch.tensor([0.0, 2.0]).double()
    mask = frequency_mask(mu, lam, 0.5)
    assert mask.shape == (2, 3)
    assert mask[0, 0] == 1
    assert float(mask[1, 2]) == pytest.approx(torch.exp(torch.tensor(-1.0)).item())  # |4 - 2| / 4 / 0.5 = 1
    assert float(mask[0, 2]) == pytest.approx(torch.exp(torch.tensor(-4.0)).item())


@pytest.mark.parametrize("options", [{}, {"time": 0.02}, {"width": 0.1}], ids=str)
def test_one_step_is_the_printed_one(pair, options):
    samples = pair.samples[:25]
    start = pair.even + 0.1 * noise(*pair.even.shape)
    torch.testing.assert_close(
        quotient_icp(start, pair.even_x, pair.even_y, samples, steps=1, **options),
        dense.icp_step(start, pair.even_x, pair.even_y, samples, **options),
        atol=1e-9,
        rtol=0,
    )


def test_lemma_4_1(pair):
    """The exact map is an isometry, commutes, and sends deltas to deltas: a fixed point of quotient-ICP."""
    torch.testing.assert_close(pair.even @ pair.even.T, identity(pair.even_y.k), atol=1e-8, rtol=0)
    assert float(commutativity_energy(pair.even, pair.even_x.evals, pair.even_y.evals)) < 1e-12
    torch.testing.assert_close(pair.even_x.evecs @ pair.even.T, pair.even_y.evecs[pair.copy.p2p_xy], atol=1e-7, rtol=0)
    refined = quotient_icp(pair.even, pair.even_x, pair.even_y, pair.samples, steps=3)
    torch.testing.assert_close(refined, pair.even, atol=1e-7, rtol=0)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("options", [{}, {"time": 0.01}, {"width": 0.5}], ids=str)
def test_quotient_icp_comes_back_to_the_exact_map(pair, seed, options):
    start = pair.even + 0.08 * noise(*pair.even.shape, seed=seed)
    before = fmap_to_p2p(start, pair.even_x, pair.even_y)
    with pytest.raises(AssertionError):
        assert_orbit_equal(before, pair.copy.p2p_xy, pair.copy.shape.group.orbits)
    refined = quotient_icp(start, pair.even_x, pair.even_y, pair.samples, steps=30, **options)
    torch.testing.assert_close(refined, pair.even, atol=1e-7, rtol=0)
    after = fmap_to_p2p(refined, pair.even_x, pair.even_y)
    assert_orbit_equal(after, pair.copy.p2p_xy, pair.copy.shape.group.orbits)


@pytest.mark.parametrize("order", [4, 8])
def test_quotient_icp_with_larger_groups(order):
    pair = Pair(order)
    start = pair.even + 0.08 * noise(*pair.even.shape)
    refined = quotient_icp(start, pair.even_x, pair.even_y, pair.samples, steps=30)
    found = fmap_to_p2p(refined, pair.even_x, pair.even_y)
    assert_orbit_equal(found, pair.copy.p2p_xy, pair.copy.shape.group.orbits)


def test_it_stops_when_the_map_stays(pair, monkeypatch):
    calls = []
    search = module.nearest_used
    monkeypatch.setattr(module, "nearest_used", lambda *a, **options: calls.append(1) or search(*a, **options))
    quotient_icp(pair.even, pair.even_x, pair.even_y, pair.samples, steps=50)
    assert len(calls) == 1
    start = pair.even + 0.08 * noise(*pair.even.shape)
    quotient_icp(start, pair.even_x, pair.even_y, pair.samples, steps=50)
    assert 3 < len(calls) < 20


@pytest.mark.parametrize("steps", [1, 4])
def test_a_restricted_target_is_searched_at_those_vertices_only(pair, steps):
    """Restricting a basis is the same as keeping those vertices of it; partners come from among them."""
    ids = torch.randperm(642, generator=torch.Generator().manual_seed(1))[:150]
    small = pair.even_y.restricted(ids)
    rows = SpectralBasis(pair.even_y.evals, pair.even_y.evecs[ids], pair.even_y.mass[ids])
    start = pair.even + 0.08 * noise(*pair.even.shape)
    for width in (None, 0.3):
        options = {"steps": steps, "width": width}
        found = quotient_icp(start, pair.even_x, small, pair.samples, **options)
        assert torch.equal(found, quotient_icp(start, pair.even_x, rows, pair.samples, **options))
        assert not torch.equal(found, quotient_icp(start, pair.even_x, pair.even_y, pair.samples, **options))
    few = pair.samples[:40]
    once = quotient_icp(start, pair.even_x, small, few, steps=1)
    torch.testing.assert_close(once, dense.icp_step(start, pair.even_x, rows, few), atol=1e-9, rtol=0)
    everything = torch.randperm(642, generator=torch.Generator().manual_seed(2))  # in another order only
    found = quotient_icp(start, pair.even_x, pair.even_y.restricted(everything), pair.samples, steps=30)
    torch.testing.assert_close(found, pair.even, atol=1e-7, rtol=0)


def test_upsampling_among_some_vertices_comes_close(pair):
    ids = torch.randperm(642, generator=torch.Generator().manual_seed(1))[:400]
    exact = p2p_to_fmap(pair.copy.p2p_yx, pair.full_x, pair.full_y)
    found = upsample(exact[:15, :15], pair.full_x, pair.full_y.restricted(ids), torch.arange(642), growing_sizes(15, K))
    assert (found - exact).norm() < 0.1 * exact.norm()


def test_no_steps_change_nothing(pair):
    assert quotient_icp(pair.even, pair.even_x, pair.even_y, pair.samples, steps=0) is pair.even


def test_lemma_5_1(pair):
    """R = pi+ T: commutes; the complement of its kernel is L2+(M), on which it is an isometry; deltas go to deltas."""
    fmap = pair.semi
    assert fmap.shape == (pair.even_y.k, K)
    assert float(commutativity_energy(fmap, pair.full_x.evals, pair.even_y.evals)) < 1e-12
    torch.testing.assert_close(torch.linalg.svdvals(fmap), torch.ones(pair.even_y.k).double(), atol=1e-8, rtol=0)
    on_even = pair.split_x.even_coeffs @ pair.split_x.even_coeffs.T
    torch.testing.assert_close(fmap.T @ fmap, on_even, atol=1e-8, rtol=0)
    assert (fmap @ pair.split_x.odd_coeffs).abs().max() < 1e-8
    torch.testing.assert_close(pair.full_x.evecs @ fmap.T, pair.even_y.evecs[pair.copy.p2p_xy], atol=1e-7, rtol=0)


@pytest.mark.parametrize("seed", [0, 1])
def test_semi_quotient_icp_comes_back_to_the_exact_map(pair, seed):
    start = pair.semi + 0.05 * noise(*pair.semi.shape, seed=seed)
    everywhere = torch.arange(642)
    refined = semi_quotient_icp(start, pair.full_x, pair.even_y, everywhere, steps=30)
    found = fmap_to_p2p(refined, pair.full_x, pair.even_y)
    orbits = pair.copy.shape.group.orbits
    right = (orbits[found] == pair.copy.p2p_xy[:, None]).any(1).double().mean()
    before = fmap_to_p2p(start, pair.full_x, pair.even_y)
    wrong_before = 1 - (orbits[before] == pair.copy.p2p_xy[:, None]).any(1).double().mean()
    assert right > 0.99
    assert wrong_before > 0.05
    on_even = pair.split_x.even_coeffs @ pair.split_x.even_coeffs.T
    assert (refined.T @ refined - on_even).norm() < 0.1 * (start.T @ start - on_even).norm()


def test_growing_sizes():
    assert growing_sizes(30, 60, 1.5) == [45, 60]
    assert growing_sizes(1, 4, 1.01) == [2, 3, 4]  # by one at least
    assert growing_sizes(30, 30) == growing_sizes(30, 20) == []
    sizes = growing_sizes(30, 200)
    assert sizes[-1] == 200
    assert all(a < b <= max(a + 1, round(1.2 * a)) for a, b in zip([30, *sizes], sizes, strict=False))
    for start, ratio in ((30, 1.0), (0, 1.2)):
        with pytest.raises(ValueError, match=f"ratio={ratio}, start={start}"):
            growing_sizes(start, 50, ratio)


@pytest.mark.parametrize("steps", [1, 3])
def test_upsample_reaches_the_exact_map(pair, steps):
    start = pair.even[:10, :10] + 0.05 * noise(10, 10)
    sizes = growing_sizes(10, pair.even_x.k)
    found = upsample(start, pair.even_x, pair.even_y, pair.samples, sizes, steps)
    assert found.shape == (pair.even_y.k, pair.even_x.k)
    torch.testing.assert_close(found, pair.even, atol=1e-7, rtol=0)
    assert_orbit_equal(fmap_to_p2p(found, pair.even_x, pair.even_y), pair.copy.p2p_xy, pair.copy.shape.group.orbits)


def test_upsample_full_bases_finds_the_isometry(pair):
    exact = p2p_to_fmap(pair.copy.p2p_yx, pair.full_x, pair.full_y)
    start = exact[:15, :15] + 0.05 * noise(15, 15)
    found = upsample(start, pair.full_x, pair.full_y, pair.samples, growing_sizes(15, K))
    torch.testing.assert_close(found, exact, atol=1e-7, rtol=0)
    assert torch.equal(fmap_to_p2p(found, pair.full_x, pair.full_y), pair.copy.p2p_xy)


@pytest.mark.parametrize("width", [0.2, None])
def test_semi_upsample_reaches_the_exact_map(pair, width):
    start = p2p_to_fmap(pair.copy.p2p_yx, pair.full_x.truncate(15), pair.even_y.truncate(9)) + 0.02 * noise(9, 15)
    everywhere = torch.arange(642)
    found = semi_upsample(start, pair.full_x, pair.even_y, everywhere, growing_sizes(15, K), width)
    assert found.shape == (pair.even_y.k, K)
    orbits = pair.copy.shape.group.orbits
    at = fmap_to_p2p(found, pair.full_x, pair.even_y)
    assert (orbits[at] == pair.copy.p2p_xy[:, None]).any(1).double().mean() > 0.98


def test_semi_upsample_takes_the_symmetric_functions_as_low_as_those_of_x(pair):
    start = pair.semi[:9, :15]
    for size in (20, 33):
        found = semi_upsample(start, pair.full_x, pair.even_y, pair.samples, [size])
        low = int((pair.even_y.evals <= pair.full_x.evals[size - 1] + 1e-6).sum())
        assert found.shape == (low, size)


def test_correspondence_fmap_of_an_exact_map(pair):
    everywhere = torch.arange(642)
    found = correspondence_fmap(pair.copy.p2p_xy, pair.full_x, pair.full_y, everywhere)
    torch.testing.assert_close(found, p2p_to_fmap(pair.copy.p2p_yx, pair.full_x, pair.full_y), atol=1e-7, rtol=0)
    torch.testing.assert_close(found @ found.T, identity(K), atol=1e-10, rtol=0)


@pytest.mark.parametrize("steps", [1, 2])
def test_upsample_projects_at_each_step(pair, steps):
    """``project`` gets the correspondence matrix of each step, and what it makes of it is the next map."""
    seen, made = [], []

    def project(matrix):
        seen.append(matrix)
        made.append(nearest_isometry(matrix) + 0.01 * noise(*matrix.shape, seed=len(seen)))
        return made[-1]

    start = pair.even[:10, :10] + 0.05 * noise(10, 10)
    sizes = [12, 15, 19]
    found = upsample(start, pair.even_x, pair.even_y, pair.samples, sizes, steps, project)
    assert found is made[-1]
    assert [m.shape[0] for m in seen] == [size for size in sizes for _ in range(steps)]
    for fmap, matrix in zip([start, *made], seen, strict=False):
        images, size = pair.even_x.evecs[pair.samples, : len(fmap)] @ fmap.T, len(matrix)
        partners = torch.cdist(images, pair.even_y.evecs[:, : len(fmap)]).argmin(1)
        wanted = sum(
            torch.outer(pair.even_y.evecs[y, :size], pair.even_x.evecs[x, :size])
            for x, y in zip(pair.samples.tolist(), partners.tolist(), strict=True)
        )
        torch.testing.assert_close(matrix, wanted, atol=1e-9, rtol=0)


def test_upsample_projects_to_the_nearest_isometry_by_default(pair):
    start = pair.even[:10, :10] + 0.05 * noise(10, 10)
    arguments = (start, pair.even_x, pair.even_y, pair.samples, [12, 15, 19])
    found = upsample(*arguments)
    assert torch.equal(found, upsample(*arguments, project=nearest_isometry))
    assert not torch.equal(found, upsample(*arguments, project=lambda matrix: matrix))


def test_upsample_projecting_to_the_truth_stays_there(pair):
    """A self-map that is made a reflection at each step ends as the reflection, also from a few functions."""
    truth = p2p_to_fmap(pair.shape.group.maps[1], pair.full_x, pair.full_x)
    signs = torch.sign(truth.diagonal())
    start = torch.diag(signs[:12])
    found = upsample(
        start,
        pair.full_x,
        pair.full_x,
        pair.samples,
        growing_sizes(12, K),
        project=lambda matrix: torch.diag(torch.sign(matrix.diagonal())),
    )
    assert torch.equal(found, torch.diag(signs))
    torch.testing.assert_close(found, truth, atol=1e-8, rtol=0)


def test_upsample_without_sizes_changes_nothing(pair):
    assert upsample(pair.even, pair.even_x, pair.even_y, pair.samples, []) is pair.even


def test_refusals(pair):
    arguments = (pair.even_x, pair.even_y, pair.samples)
    with pytest.raises(ValueError, match="steps=-1"):
        quotient_icp(pair.even, *arguments, steps=-1)
    with pytest.raises(ValueError, match=rf"expected shape \({pair.even_y.k}, {pair.even_x.k}\), got \(3, 3\)"):
        unchecked(quotient_icp)(identity(3), *arguments)
    with pytest.raises(ValueError, match=f"target has {K} symmetric functions, the source only {pair.even_x.k}"):
        semi_quotient_icp(pair.semi.T, pair.even_x, pair.full_y, pair.samples)
    with pytest.raises(ValueError, match=f"sizes up to 41: the bases have {pair.even_x.k} and {pair.even_y.k}"):
        upsample(pair.even, *arguments, [12, 41])
    with pytest.raises(ValueError, match="k=0"):
        upsample(pair.even, *arguments, [0])
