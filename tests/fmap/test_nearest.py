"""torchqm.fmap.nearest: all ways of searching against all distances."""

import pytest
import torch
from references import dense
from references.pairs import K, exact_pair
from references.unchecked import unchecked

import torchqm.fmap.nearest as module
from torchqm.fmap import SurfaceSearch, nearest_rows
from torchqm.fmap.threads import one_thread
from torchqm.geometry import area_samples


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(params=["product", "blocks"])
def search(request, monkeypatch):
    if request.param != "product":
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


def test_what_all_points_share_costs_no_digits(search):
    """Descriptors are such points: large, and all nearly the same."""
    queries, points = noise(200, 12), noise(300, 12, seed=1)
    assert torch.equal(search(queries + 3e5, points + 3e5), dense.nearest_rows(queries, points))


def test_points_find_themselves(search):
    points = noise(100, 5)
    assert torch.equal(search(points, points), torch.arange(100))


def test_all_ways_take_any_layout_and_single_precision(search):
    queries, points = noise(5, 40).T, noise(5, 60, seed=1).T  # not contiguous
    wanted = dense.nearest_rows(queries, points)
    assert torch.equal(search(queries, points), wanted)
    assert torch.equal(search(queries.float(), points.float()), wanted)
    assert torch.equal(search(queries.clone().requires_grad_(), points), wanted)


def test_each_way_is_taken(search, request, monkeypatch):
    """Else the other tests would compare one and the same way with itself."""
    taken = []
    blocked = module._blocked
    monkeypatch.setattr(module, "_blocked", lambda *a: taken.append("blocks") or blocked(*a))
    search(noise(20, 4), noise(30, 4))
    wanted = request.node.callspec.params["search"]
    assert taken == ([] if wanted == "product" else [wanted])


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
    monkeypatch.setattr(module, "_SMALL", 0)
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


class TestSurfaceSearch:
    """On a real embedding: the exact pair's eigenfunctions, queries somewhat off the surface."""

    @pytest.fixture(scope="class")
    @classmethod
    def problem(cls):
        shape = exact_pair().x
        points = shape.basis.evecs
        queries = points + 0.1 * noise(642, K)
        return shape, queries, points, nearest_rows(queries, points)

    def build(self, shape, n_anchors=100, m=96):
        return SurfaceSearch.build(shape.mesh.verts, area_samples(shape.mesh, n_anchors), m)

    @pytest.mark.parametrize("n_anchors", [1, 3, 100])
    @pytest.mark.parametrize("m", [642, 10_000])
    def test_exact_where_all_vertices_are_looked_at(self, problem, n_anchors, m):
        shape, queries, points, wanted = problem
        search = self.build(shape, n_anchors, m)
        assert search.around.shape == (n_anchors, 642)
        found = search.nearest(queries, points)
        assert found.dtype == torch.int64
        assert torch.equal(found, wanted)

    def test_nearly_always_right_on_a_smooth_embedding(self, problem):
        shape, queries, points, wanted = problem
        search = self.build(shape, 200, 30)  # a twentieth of the vertices, which lie in space where queries do not
        found = search.nearest(queries, points)
        assert float((found == wanted).double().mean()) > 0.99
        assert float((search.nearest(points, points) == torch.arange(642)).double().mean()) > 0.99

    def test_the_best_of_what_is_around_the_nearest_anchor(self, problem):
        """Query by query; few vertices around few anchors, so that it misses, and misses the same way."""
        shape, queries, points, wanted = problem
        search = self.build(shape, 60, 8)
        near = search.around[torch.cdist(queries, points[search.anchors]).argmin(1)]
        best = torch.cdist(queries[:, None], points[near])[:, 0].argmin(1)
        found = search.nearest(queries, points)
        assert torch.equal(found, near[torch.arange(642), best])
        assert not torch.equal(found, wanted)

    def test_a_guide_offers_the_partners_of_the_anchors_close_by(self, problem):
        """The same, query by query, with another set of anchors on the side of the queries."""
        shape, queries, points, _ = problem
        search = self.build(shape, 60, 8)
        guide = SurfaceSearch.build(shape.mesh.verts, area_samples(shape.mesh, 50, 1), n=3)
        verts, anchor_points = shape.mesh.verts, points[search.anchors]
        for query, found in zip(range(642), search.nearest(queries, points, guide).tolist(), strict=True):
            apart = torch.cdist(verts[query][None], verts[guide.anchors])[0]
            close = guide.anchors[apart.topk(3, largest=False).indices]
            partners = torch.cdist(queries[close], anchor_points).argmin(1)
            best = partners[(queries[query] - anchor_points[partners]).norm(dim=1).argmin()]
            near = search.around[best]
            assert found == near[(queries[query] - points[near]).norm(dim=1).argmin()]

    def test_a_guide_changes_little(self, problem):
        shape, queries, points, wanted = problem
        search = self.build(shape, 200, 30)
        found = search.nearest(queries, points, search)
        assert float((found == wanted).double().mean()) > 0.98
        assert not torch.equal(search.nearest(queries, points, self.build(shape, 3)), found)  # it is used
        with pytest.raises(ValueError, match="guide: has 642 vertices, but there are 600 queries"):
            search.nearest(queries[:600], points, search)

    def test_around_each_anchor(self, problem):
        shape, *_ = problem
        search = self.build(shape, 20, 9)
        assert torch.equal(search.around[:, 0], search.anchors)
        distance = torch.cdist(shape.mesh.verts[search.anchors], shape.mesh.verts)
        wanted = distance.topk(9, largest=False).values
        torch.testing.assert_close(distance.gather(1, search.around), wanted, atol=1e-7, rtol=0)

    def test_layout_and_precision(self, problem):
        shape, queries, points, _ = problem
        search = self.build(shape)
        wanted = search.nearest(queries, points)
        assert torch.equal(search.nearest(queries.T.contiguous().T, points.float().requires_grad_()), wanted)

    def test_one_vertex_around_each(self, problem):
        shape, queries, points, _ = problem
        search = self.build(shape, 30, 1)
        found = search.nearest(queries, points)
        assert torch.equal(found, search.anchors[nearest_rows(queries, points[search.anchors])])


def test_an_offset_of_all_points_costs_no_digits(search):
    """In single precision the squares of coordinates near 1000 would hide differences of 0.01."""
    queries, points = 1e3 + 0.01 * noise(200, 6), 1e3 + 0.01 * noise(300, 6, seed=1)
    assert float((search(queries, points) == dense.nearest_rows(queries, points)).double().mean()) == 1
