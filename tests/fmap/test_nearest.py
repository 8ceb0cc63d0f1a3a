"""torchqm.fmap.nearest: both ways of searching against all distances."""

import pytest
import torch
from references import dense
from references.unchecked import unchecked

import torchqm.fmap.nearest as module
from torchqm.fmap import nearest_rows


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(params=["product", "faiss"])
def search(request, monkeypatch):
    if request.param == "faiss":
        monkeypatch.setattr(module, "_SMALL", 0)
    return nearest_rows


@pytest.mark.parametrize(("q", "p", "d"), [(200, 300, 12), (7, 1, 3), (1, 50, 1), (0, 5, 2)])
def test_agrees_with_all_distances(search, q, p, d):
    queries, points = noise(q, d), noise(p, d, seed=1)
    found = search(queries, points)
    assert found.dtype == torch.int64
    assert found.shape == (q,)
    if q:
        assert torch.equal(found, dense.nearest_rows(queries, points))


def test_points_find_themselves(search):
    points = noise(100, 5)
    assert torch.equal(search(points, points), torch.arange(100))


def test_both_ways_take_any_layout_and_single_precision(search):
    queries, points = noise(5, 40).T, noise(5, 60, seed=1).T  # not contiguous
    wanted = dense.nearest_rows(queries, points)
    assert torch.equal(search(queries, points), wanted)
    assert torch.equal(search(queries.float(), points.float()), wanted)
    assert torch.equal(search(queries.clone().requires_grad_(), points), wanted)


def test_refusals(search):
    search = unchecked(search)
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
