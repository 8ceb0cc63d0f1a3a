"""torchqm.matching.baselines.symmetry_factored: the graph, its embedding, the estimated L2+, and the maps."""

import pytest
import torch
from references.pairs import exact_pair

from torchqm.matching import MatchError, MatchParameters
from torchqm.matching.baselines import SymmetryFactored
from torchqm.matching.baselines.symmetry_factored import (
    correspondence_graph,
    even_projector,
    symmetry_factored_embedding,
)
from torchqm.symmetry import symmetrized_basis


def test_orbits_are_cliques_and_come_to_one_place():
    """Orbits of 3 points with equal descriptors: the graph averages over them, the embedding separates them."""
    features = torch.randn(20, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).repeat(3, 1)
    graph = correspondence_graph(features, 3)
    torch.testing.assert_close(graph, graph.T)
    torch.testing.assert_close(graph.sum(1), torch.ones(60, dtype=torch.float64), atol=1e-3, rtol=0)
    same = torch.arange(60)[:, None] % 20 == torch.arange(60)[None] % 20
    embedding = symmetry_factored_embedding(graph)
    torch.testing.assert_close(embedding @ embedding.T, graph, atol=5e-3, rtol=0)
    gaps = torch.cdist(embedding, embedding)
    assert float(gaps[same].max()) < 1e-6
    assert float(gaps[~same].min()) > 0.1


@pytest.mark.parametrize("order", [2, 4])
def test_the_symmetric_functions_of_a_blob(order):
    """All functions taken for even are; of the true ones nearly all are found."""
    pair = exact_pair(order)
    true = symmetrized_basis(pair.x.basis.truncate(30), pair.group_x)
    found = SymmetryFactored().split(pair.x, 30)
    inside = (true.even_coeffs.T @ found.even_coeffs).norm(dim=0)
    assert float(inside.min()) > 0.99
    assert found.even.k >= 0.8 * true.even.k


def test_the_projector_of_exact_orbits():
    """All vertices as samples, orbits as cliques: the true projector."""
    pair = exact_pair(2)
    basis, n = pair.x.basis.truncate(20), pair.x.n_verts
    graph = torch.zeros(n, n, dtype=torch.float64)
    graph[torch.arange(n), torch.arange(n)] += 0.5
    graph[torch.arange(n), pair.group_x.maps[1]] += 0.5
    found = even_projector(basis, torch.arange(n), symmetry_factored_embedding(graph))
    true = symmetrized_basis(basis, pair.group_x)
    torch.testing.assert_close(found, true.even_coeffs @ true.even_coeffs.T, atol=1e-6, rtol=0)


def test_exact_twins():
    pair = exact_pair(2)
    found = SymmetryFactored().match(pair.x, pair.y)
    assert found.labels == ("direct", "mirrored")
    assert torch.equal(found.maps[0], pair.p2p_xy)
    assert torch.equal(found.maps[1], pair.group_y.maps[1][pair.p2p_xy])


def test_another_pose_and_triangulation(walkers):
    """Nearest descriptors are above 0.07."""
    found = SymmetryFactored().match(walkers.x, walkers.y)
    assert found.labels == ("direct", "mirrored")
    assert float(walkers.errors(found.maps[0])[0]) < 0.03
    assert float(walkers.errors(found.maps[1])[1]) < 0.03


def test_too_few_points(walkers):
    with pytest.raises(ValueError, match="neighbours=5: allowed are 1 to 3"):
        correspondence_graph(torch.zeros(4, 2), 5)
    with pytest.raises(MatchError, match="n_embedded=20: more than 30"):
        SymmetryFactored(n_embedded=20).match(walkers.x, walkers.y)
    with pytest.raises(MatchError, match="entries a row"):
        SymmetryFactored(parameters=MatchParameters(k=20)).match(walkers.y, walkers.x, walkers.given)
