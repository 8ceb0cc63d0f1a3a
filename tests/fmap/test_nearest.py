"""torchqm.fmap.nearest: all ways of searching against all distances."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from references import dense
from references.pairs import exact_pair
from references.unchecked import unchecked

import torchqm.fmap.nearest as module
from torchqm.fmap import nearest_rows
from torchqm.fmap.threads import one_thread


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("q", "p", "d"), [(200, 300, 12), (7, 1, 3), (1, 50, 1), (0, 5, 2)])
def test_agrees_with_all_distances(q, p, d):
    queries, points = noise(q, d), noise(p, d, seed=1)
    found = nearest_rows(queries, points)
    assert found.dtype == torch.int64
    assert found.shape == (q,)
    if q:
        assert torch.equal(found, dense.nearest_rows(queries, points))


def test_what_all_points_share_costs_no_digits():
    """Descriptors are such points: large, and all nearly the same."""
    queries, points = noise(200, 12), noise(300, 12, seed=1)
    assert torch.equal(nearest_rows(queries + 3e5, points + 3e5), dense.nearest_rows(queries, points))


def test_points_find_themselves():
    points = noise(100, 5)
    assert torch.equal(nearest_rows(points, points), torch.arange(100))


def test_all_ways_take_any_layout_and_single_precision():
    queries, points = noise(5, 40).T, noise(5, 60, seed=1).T  # not contiguous
    wanted = dense.nearest_rows(queries, points)
    assert torch.equal(nearest_rows(queries, points), wanted)
    assert torch.equal(nearest_rows(queries.float(), points.float()), wanted)
    assert torch.equal(nearest_rows(queries.clone().requires_grad_(), points), wanted)


@pytest.mark.parametrize("q", [1, 63, 64, 65, 200])
def test_blocks_of_any_size_are_put_together(q):
    queries, points = noise(q, 6), noise(300, 6, seed=1)
    wanted = dense.nearest_rows(queries, points)
    for rows, columns in ((1, 300), (7, 299), (64, 64), (64, 1), (256, 8192)):
        found = module._blocked(queries.float().numpy(), points.float().numpy(), rows, columns)
        assert torch.equal(torch.from_numpy(found), wanted)


@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_workers_share_the_queries(n, monkeypatch):
    """As many ranges as there are workers, and the same answer."""
    queries, points = noise(2000, 6), noise(40, 6, seed=1)
    ranges = []
    improve = module._improve
    monkeypatch.setattr(module, "_improve", lambda q, *rest: ranges.append(len(q)) or improve(q, *rest))
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        with one_thread():
            found = nearest_rows(queries, points)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found, dense.nearest_rows(queries, points))
    assert len(ranges) == min(n, 8)
    assert sum(ranges) == 2000


def test_refusals():
    search = unchecked(nearest_rows)
    with pytest.raises(ValueError, match="queries have 3 coordinates, points have 2"):
        search(noise(4, 3), noise(4, 2))
    with pytest.raises(ValueError, match="points: there are none"):
        search(noise(4, 3), noise(0, 3))
    for bad in (torch.nan, torch.inf):
        spoilt = noise(4, 3)
        spoilt[1, 2] = bad
        with pytest.raises(ValueError, match="must be finite"):
            search(spoilt, noise(4, 3))
        with pytest.raises(ValueError, match="must be finite"):
            search(noise(4, 3), spoilt)


def test_an_offset_of_all_points_costs_no_digits():
    """In single precision the squares of coordinates near 1000 would hide differences of 0.01."""
    queries, points = 1e3 + 0.01 * noise(200, 6), 1e3 + 0.01 * noise(300, 6, seed=1)
    assert float((nearest_rows(queries, points) == dense.nearest_rows(queries, points)).double().mean()) == 1


def mirrored(n, d, seed=0):
    """Points and their mirror images, mixed, and queries on the mirror plane: all nearest points come in pairs."""
    points, queries = noise(n, d, seed=seed), noise(60, d, seed=seed + 1)
    queries[:, 0] = 0
    both = torch.cat([points, points * torch.tensor([-1.0] + [1.0] * (d - 1))])
    return queries, both[torch.randperm(2 * n, generator=torch.Generator().manual_seed(seed))]


@pytest.mark.parametrize(("rows", "columns"), [(256, 8192), (7, 16), (64, 50)])
def test_of_mirror_images_the_first(rows, columns):
    queries, points = mirrored(300, 20)
    wanted = dense.nearest_rows(queries, points)
    found = module._blocked(queries.numpy(), points.numpy(), rows, columns)
    assert torch.equal(torch.from_numpy(found), wanted)
    apart = torch.cdist(queries, points).sort(1).values
    assert float((apart[:, 1] - apart[:, 0]).max()) < 1e-12  # they do come in pairs


def test_without_the_second_step_one_of_those_that_rounding_does_not_tell_apart():
    generic, points = noise(500, 12), noise(900, 12, seed=1)
    assert torch.equal(nearest_rows(generic, points, exact=False), nearest_rows(generic, points))
    queries, points = mirrored(600, 10)
    found, best = (nearest_rows(queries, points, exact=exact) for exact in (False, True))
    assert torch.equal(found, nearest_rows(queries, points, exact=False))
    distances = torch.cdist(queries, points)
    rows = torch.arange(len(queries))
    torch.testing.assert_close(distances[rows, found], distances[rows, best], atol=1e-5, rtol=0)
    assert not torch.equal(found, best)  # there are ties here, and only the second step looks for the first


def test_what_single_precision_cannot_tell_apart():
    """Each point among copies that are further by less than a part in 10 million."""
    points = noise(50, 30)
    queries = points + 0.1 * noise(50, 30, seed=1)
    away = points + (points - queries) * 1e-9 * torch.tensor([3.0, 1.0, -1.0, 2.0])[:, None, None]
    found = nearest_rows(queries, away.reshape(-1, 30))
    assert torch.equal(found, 100 + torch.arange(50))
    assert torch.equal(found, dense.nearest_rows(queries, away.reshape(-1, 30)))


def test_clusters_far_from_each_other():
    """No centre is near to all of them: products of numbers near 1000 hide differences of 0.001."""
    places = 1e3 * noise(4, 8)
    points = (places[:, None] + 1e-3 * noise(4, 60, 8, seed=1)).reshape(-1, 8)
    queries = points[::3] + 1e-4 * noise(80, 8, seed=2)
    assert torch.equal(nearest_rows(queries, points), dense.nearest_rows(queries, points))


@given(st.integers(1, 4), st.integers(1, 60), st.integers(0, 10_000), st.sampled_from([0, 1, 256]))
@settings(max_examples=30, deadline=None)
def test_ties_of_whole_numbers_go_to_the_first(d, n, seed, many):
    """Squares of whole numbers are exact, and many are equal; also where all distances of a block are computed."""
    rng = np.random.default_rng(seed)
    queries, points = (torch.from_numpy(rng.integers(-2, 3, (size, d)).astype(np.float64)) for size in (40, n))
    wanted = dense.nearest_rows(queries, points)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_MANY", many)
        for rows, columns in ((256, 8192), (9, 16)):
            found = module._blocked(queries.numpy(), points.numpy(), rows, columns)
            assert torch.equal(torch.from_numpy(found), wanted)


@pytest.mark.parametrize("scale", [1e-200, 1e-30, 1e25, 1e200])
def test_any_scale(scale):
    queries, points = ((1024 * v).round() / 1024 for v in mirrored(100, 5))  # sums below are exact
    exponent = 2.0 ** round(np.log2(scale))
    wanted = dense.nearest_rows(queries, points)
    assert torch.equal(nearest_rows(queries * exponent, points * exponent), wanted)
    assert torch.equal(nearest_rows(queries * exponent + 3 * exponent, points * exponent + 3 * exponent), wanted)


def test_points_in_one_place():
    for value in (0.0, 0.1, 1e200):
        points = torch.full((40, 2), value, dtype=torch.float64)
        assert nearest_rows(points[:3], points).tolist() == [0, 0, 0]
    assert nearest_rows(noise(3, 2), torch.full((40, 2), 0.1, dtype=torch.float64)).tolist() == [0, 0, 0]


@given(st.integers(1, 300), st.integers(0, 10_000), st.sampled_from([1.0, 1e-6, 1e6]))
@settings(max_examples=40, deadline=None)
def test_the_bound_holds_for_any_product_in_single_precision(d, seed, ratio):
    """Against long double; terms of one sign, of which rounding errors add up most, and of both."""
    rng = np.random.default_rng(seed)
    q, p = rng.standard_normal((30, d)), ratio * rng.standard_normal((40, d))
    if seed % 2:
        q, p = np.abs(q), np.abs(p)
    q32, p32 = q.astype(np.float32), p.astype(np.float32)
    longer = np.concatenate([q32, np.ones((30, 1), np.float32)], 1)
    block = np.concatenate([p32, -np.einsum("pd,pd->p", p32, p32)[:, None] / 2], 1)
    exact = q.astype(np.longdouble) @ p.T.astype(np.longdouble) - (p.astype(np.longdouble) ** 2).sum(1) / 2
    bound = module.rounding_bound(np.linalg.norm(q32, axis=1)[:, None], np.linalg.norm(p32, axis=1), d)
    one_by_one = np.cumsum(longer[:, None] * block[None], axis=2, dtype=np.float32)[..., -1]
    for products in (longer @ block.T, one_by_one):
        assert (np.abs(products - exact) <= bound).all()


def test_few_candidates_are_left_on_a_real_embedding(monkeypatch):
    """Else double precision would cost what it is to save."""
    points = exact_pair().x.basis.evecs
    queries = points + 0.1 * noise(*points.shape)
    seen = []
    decide = module.settled
    monkeypatch.setattr(
        module, "settled", lambda q, p, rows, columns: seen.append(len(rows)) or decide(q, p, rows, columns)
    )
    nearest_rows(queries, points)
    assert sum(seen) < 0.02 * len(points)


@pytest.mark.parametrize("seed", range(4))
def test_many_candidates_are_told_apart_as_few_are(seed):
    """Columns of very different scale: hundreds of points are equally near in single precision."""
    generator = np.random.default_rng(seed)
    points, queries = (
        generator.standard_normal((n, 8)) * 10.0 ** generator.integers(-20, 20, (1, 8)) for n in (438, 363)
    )
    apart = [query - points for query in queries]
    wanted = np.array([np.einsum("nd,nd->n", a, a).argmin() for a in apart])
    found = nearest_rows(torch.from_numpy(queries), torch.from_numpy(points))
    assert np.array_equal(found.numpy(), wanted)


@pytest.mark.parametrize(("dtype", "size"), [(torch.float32, 3e38), (torch.float16, 3e4), (torch.float64, 1e308)])
def test_coordinates_whose_sum_is_too_large(dtype, size):
    points = torch.tensor([[size, 0.0], [-size, 0.0], [size, size]], dtype=dtype)
    assert nearest_rows(points, points).tolist() == [0, 1, 2]
