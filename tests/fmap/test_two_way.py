"""torchqm.fmap.two_way: exact on an exact pair, equal to a slow twin, the same from both sides."""

from itertools import pairwise
from types import SimpleNamespace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from references.pairs import K, exact_pair
from references.unchecked import unchecked

from torchqm.fmap import Places, growing_pairs, nearest_isometry, p2p_to_fmap, two_way_upsample
from torchqm.fmap.threads import one_thread
from torchqm.spectral import SpectralBasis


@pytest.fixture(scope="module")
def pair():
    return exact_pair(2)


def places(n, features=None, queries=None):
    return Places(
        torch.arange(n), torch.zeros(n, 0, dtype=torch.float64) if features is None else features, queries or n
    )


def truth(pair, k):
    return p2p_to_fmap(pair.p2p_yx, pair.x.basis.truncate(k), pair.y.basis.truncate(k))


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def test_it_grows_the_exact_map_from_a_noisy_start(pair):
    start = nearest_isometry(truth(pair, 30) + 0.03 * noise(30, 30))
    n = pair.x.n_verts
    sizes = growing_pairs((30, 30), (K, K))
    found = two_way_upsample(start, pair.x.basis, pair.y.basis, places(n), places(n), sizes, 0.0)
    torch.testing.assert_close(found, truth(pair, K), atol=1e-2, rtol=0)


def test_features_hold_a_map_that_spectra_alone_do_not(pair):
    """From a start that is half noise, exact features find every point by themselves."""
    code = noise(pair.x.n_verts, 6, seed=1)
    code = code / code.square().sum(1).mean().sqrt()
    on_x, on_y = places(pair.x.n_verts, code), places(pair.x.n_verts, code[pair.p2p_yx])
    start = nearest_isometry(noise(20, 20))
    sizes = [(20, 20), (K, K)]
    found = two_way_upsample(start, pair.x.basis, pair.y.basis, on_x, on_y, sizes, 50.0)
    torch.testing.assert_close(found, truth(pair, K), atol=1e-2, rtol=0)
    without = two_way_upsample(start, pair.x.basis, pair.y.basis, on_x, on_y, sizes, 0.0)
    assert float((without - truth(pair, K)).norm()) > 1.0


@given(st.integers(0, 1000), st.sampled_from([0.0, 0.7, 2.0]))
def test_one_step_is_that_of_the_slow_twin(seed, weight):
    bases = [
        SpectralBasis(
            torch.arange(9.0, dtype=torch.float64), noise(n, 9, seed=seed), torch.ones(n, dtype=torch.float64)
        )
        for n in (25, 30)
    ]
    looks = [noise(20, 3, seed=seed + 1), noise(22, 3, seed=seed + 2)]
    ids = [torch.randperm(n, generator=torch.Generator().manual_seed(seed))[:m] for n, m in ((25, 20), (30, 22))]
    x, y = (Places(i, d, q) for i, d, q in zip(ids, looks, (7, 22), strict=True))
    start = nearest_isometry(noise(4, 5, seed=seed + 3))
    found = two_way_upsample(start, *bases, x, y, [(8, 9)], weight)
    phi_x, phi_y = bases[0].evecs[x.ids], bases[1].evecs[y.ids]
    total = torch.zeros(8, 9, dtype=torch.float64)
    for i in range(7):
        costs = [
            (start @ phi_x[i, :5] - q[:4]).square().sum() + weight**2 * 4 * (looks[0][i] - d).square().sum()
            for q, d in zip(phi_y, looks[1], strict=True)
        ]
        total += torch.outer(phi_y[int(torch.stack(costs).argmin()), :8], phi_x[i, :9]) / 7
    for j in range(22):
        costs = [
            (start.T @ phi_y[j, :4] - q[:5]).square().sum() + weight**2 * 4 * (looks[1][j] - d).square().sum()
            for q, d in zip(phi_x, looks[0], strict=True)
        ]
        total += torch.outer(phi_y[j, :8], phi_x[int(torch.stack(costs).argmin()), :9]) / 22
    torch.testing.assert_close(found, nearest_isometry(total), atol=1e-8, rtol=0)


@given(st.integers(0, 1000))
def test_swapping_the_shapes_transposes_the_map(seed):
    bases = [
        SpectralBasis(
            torch.arange(6.0, dtype=torch.float64), noise(n, 6, seed=seed + n), torch.ones(n, dtype=torch.float64)
        )
        for n in (25, 30)
    ]
    x, y = places(25, noise(25, 2, seed=seed)), places(30, noise(30, 2, seed=seed + 1))
    start = nearest_isometry(noise(4, 4, seed=seed + 2))
    one = two_way_upsample(start, *bases, x, y, [(5, 5), (6, 6)])
    other = two_way_upsample(start.T, *bases[::-1], y, x, [(5, 5), (6, 6)])
    torch.testing.assert_close(one, other.T, atol=1e-8, rtol=0)


def test_places_inside_a_region_and_fewer():
    p = Places(torch.tensor([4, 0, 3, 1]), torch.arange(4.0, dtype=torch.float64)[:, None], 2)
    region = torch.tensor([True, False, False, True, True])
    inside = p.inside(region)
    assert inside.ids.tolist() == [4, 0, 3]
    assert inside.features[:, 0].tolist() == [0, 1, 2]
    assert inside.n_queries == 2
    assert p.inside(torch.tensor([False, True, False, False, False])).n_queries == 1
    few = p.fewer(5, 3)
    assert few.ids.tolist() == [4, 0, 3]
    assert few.n_queries == 2
    assert p.fewer(1, 9).n_queries == 1
    with pytest.raises(ValueError, match="4 ids, but features of 3"):
        unchecked(Places.__post_init__)(SimpleNamespace(ids=p.ids, features=p.features[:3]))


def test_sizes_grow_together_and_end_together():
    pairs = growing_pairs((10, 14), (40, 37))
    assert pairs[-1] == (40, 37)
    assert all(a <= c and b <= d for (a, b), (c, d) in pairwise(pairs))
    assert growing_pairs((8, 9), (8, 9)) == []


def test_bad_input_is_named(pair):
    start, n = truth(pair, 10), pair.x.n_verts
    with pytest.raises(ValueError, match="weight=-1"):
        two_way_upsample(start, pair.x.basis, pair.y.basis, places(n), places(n), [(20, 20)], -1.0)
    with pytest.raises(ValueError, match=rf"sizes \({K + 1}, 20\)"):
        two_way_upsample(start, pair.x.basis, pair.y.basis, places(n), places(n), [(K + 1, 20)])


def test_both_ways_at_once_change_nothing(pair):
    found, before = [], torch.get_num_threads()
    on_x, on_y = places(pair.x.n_verts, noise(pair.x.n_verts, 3)), places(pair.x.n_verts, noise(pair.x.n_verts, 3))
    for threads in (1, 2):
        torch.set_num_threads(threads)
        try:
            with one_thread():
                start = nearest_isometry(noise(20, 20))
                found.append(two_way_upsample(start, pair.x.basis, pair.y.basis, on_x, on_y, [(25, 25), (K, K)]))
        finally:
            torch.set_num_threads(before)
    assert torch.equal(*found)
