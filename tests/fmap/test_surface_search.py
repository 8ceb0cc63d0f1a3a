"""torchqm.fmap.surface_search: two stages against all distances."""

import pytest
import torch
from references.pairs import K, exact_pair

from torchqm.fmap import SurfaceSearch, nearest_rows
from torchqm.geometry import area_samples


def noise(*shape, seed=0):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


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

    @pytest.mark.parametrize("guided", [False, True])
    def test_an_offset_of_all_coordinates_changes_nothing(self, problem, guided):
        shape, queries, points, _ = problem
        search = self.build(shape, 60, 30)
        guide = search if guided else None
        wanted = search.nearest(queries, points, guide)
        assert torch.equal(search.nearest(queries + 3e5, points + 3e5, guide), wanted)

    def test_of_what_is_looked_at_the_nearest_in_double_precision(self, problem):
        """Every vertex has a copy a little further away, and one that is as near: single precision sees three alike."""
        shape, queries, points, _ = problem
        search = SurfaceSearch.build(shape.mesh.verts.repeat(3, 1), area_samples(shape.mesh, 20), m=3 * 642)
        everything = torch.cat([points * (1 + 1e-10 * torch.arange(642)[:, None]), points, points])
        found = search.nearest(queries, everything)
        assert torch.equal(found, torch.stack([((everything - q) ** 2).sum(1).argmin() for q in queries]))
        assert 0 < int((found < 642).sum()) < 642


def test_coordinates_that_it_cannot_compare_are_refused():
    line = torch.arange(40.0, dtype=torch.float64)[:, None]
    search = SurfaceSearch.build(line, torch.arange(0, 40, 4), m=6)
    for place, value in ((1, torch.nan), (0, torch.inf)):  # vertex 1 is no anchor
        bad = line.clone()
        bad[place] = value
        for queries, points in ((bad, line), (line, bad)):
            with pytest.raises(ValueError, match="must be finite"):
                search.nearest(queries, points, search)
    with pytest.raises(ValueError, match="too large for single precision"):
        search.nearest(line * 1e25, line * 1e25)
