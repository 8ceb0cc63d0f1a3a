"""torchqm.symmetry.group: the table, its axioms measured, what is refused."""

from itertools import product

import pytest
import torch
from references.shapes import rotation
from references.unchecked import unchecked

from torchqm.symmetry import GroupResiduals, SymmetryGroup


def test_trivial_and_reflection():
    trivial = SymmetryGroup.trivial(4)
    assert (trivial.order, trivial.n_verts, trivial.maps.tolist()) == (1, 4, [[0, 1, 2, 3]])
    swap = SymmetryGroup.from_reflection(torch.tensor([1, 0, 2]))
    assert swap.maps.tolist() == [[0, 1, 2], [1, 0, 2]]
    assert swap.orbits.tolist() == [[0, 1], [1, 0], [2, 2]]


def test_exact_groups_have_no_residual(blob):
    found = blob.group.residuals(blob.mesh.verts)
    assert (found.closure, found.inverse) == (0, 0)
    signs = list(product((1, -1), repeat=blob.group.order.bit_length() - 1))
    for (g, a), (h, b) in product(enumerate(signs), repeat=2):
        assert int(found.products[g, h]) == signs.index(tuple(x * y for x, y in zip(a, b, strict=True)))


def test_products_of_a_group_that_does_not_commute(prism):
    group, found = prism.group, prism.group.residuals(prism.mesh.verts)
    assert (found.closure, found.inverse) == (0, 0)
    for g, h in product(range(16), repeat=2):
        assert torch.equal(group.maps[found.products[g, h]], group.maps[g][group.maps[h]])
    assert not torch.equal(found.products, found.products.T)
    assert bool((found.products.sort(dim=1).values == torch.arange(16)).all())  # a Latin square


def test_residuals_measure_what_is_missing():
    points = torch.arange(4.0, dtype=torch.float64)[:, None]
    turn = torch.tensor([1, 2, 3, 0])
    cyclic = SymmetryGroup(torch.stack([torch.arange(4), turn, turn[turn], turn[turn[turn]]]))
    assert (cyclic.residuals(points).closure, cyclic.residuals(points).inverse) == (0, 0)
    half = SymmetryGroup(torch.stack([torch.arange(4), turn]))  # turn o turn is missing, and so is the inverse
    found = half.residuals(points)
    assert found.closure == pytest.approx(1.5)  # mean |turn turn - turn| = (1 + 1 + 3 + 1) / 4
    assert found.inverse == pytest.approx(1.5)  # mean |turn - id|
    fold = SymmetryGroup.from_reflection(torch.tensor([0, 0, 3, 3]))  # vertex maps need not be permutations
    assert fold.residuals(points).inverse == pytest.approx(0.5)


def turns(axis, n):
    """Rotation by ``2 pi / n`` about a coordinate axis."""
    angle = torch.tensor(2 * torch.pi / n, dtype=torch.float64)
    matrix = torch.eye(3, dtype=torch.float64)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix[i, i] = matrix[j, j] = angle.cos()
    matrix[j, i], matrix[i, j] = angle.sin(), -angle.sin()
    return matrix


def nearest_maps(verts, matrices, seed=3):
    """Vertex maps of rotations about axes that the mesh knows nothing of: each sends to the nearest vertex only."""
    frame = rotation(seed)
    return [torch.cdist(verts @ (frame @ m @ frame.T).T, verts).argmin(1) for m in matrices]


def test_names(blob):
    name = {1: "trivial", 2: "C2", 4: "C2 x C2", 8: "C2 x C2 x C2"}[blob.group.order]
    found = blob.group.residuals(blob.mesh.verts)
    assert (found.name, found.is_group, found.fault) == (name, True, None)


def test_name_of_what_is_no_group():
    found = GroupResiduals(0.1, 0.1, torch.tensor([[0, 1], [1, 1]]))
    assert (found.name, found.is_group) == ("no group", False)
    assert "Latin square" in found.fault


def test_residuals_are_weighted_by_area():
    points = torch.arange(4.0, dtype=torch.float64)[:, None]
    fold = SymmetryGroup.from_reflection(
        torch.tensor([0, 0, 3, 3])
    )  # fold o fold = fold: 1 from the identity at 1 and 2
    assert fold.residuals(points, torch.tensor([1.0, 3.0, 0.0, 4.0])).inverse == pytest.approx(3 / 8)
    assert fold.residuals(points, torch.tensor([1.0, 0.0, 0.0, 4.0])).inverse == 0


def test_residuals_of_many_vertices_and_elements():
    """More than are compared, and more elements than are looked at closely: the exact products all the same."""
    generator = torch.Generator().manual_seed(0)
    n, order = 3000, 24
    ring = torch.randperm(n, generator=generator).reshape(order, -1)
    turn = torch.empty(n, dtype=torch.int64)
    turn[ring] = ring.roll(-1, 0)
    maps = [torch.arange(n)]
    for _ in range(order - 1):
        maps.append(turn[maps[-1]])
    points = torch.randn(n, 2, dtype=torch.float64, generator=generator)
    found = SymmetryGroup(torch.stack(maps)).residuals(points)
    everyone = torch.arange(order)
    assert torch.equal(found.products, (everyone[:, None] + everyone) % order)
    assert (found.closure, found.inverse, found.name) == (0, 0, "C24")


def test_generators_of_exact_groups(prism):
    maps, verts = prism.group.maps, prism.mesh.verts
    square = SymmetryGroup.from_generators([maps[1], maps[2], maps[8 + 4]], verts, tolerance=1e-3)
    assert torch.equal(square.maps[:4], torch.stack([maps[0], maps[1], maps[2], maps[12]]))
    assert {tuple(m.tolist()) for m in square.maps} <= {tuple(m.tolist()) for m in maps}
    assert square.residuals(verts).name == "D4 x C2"
    assert torch.equal(SymmetryGroup.from_generators([], verts, tolerance=0.0).maps, maps[:1])
    same = SymmetryGroup.from_generators([maps[0], maps[3], maps[3]], verts, tolerance=0.0)
    assert torch.equal(same.maps, maps[[0, 3]])


@pytest.mark.parametrize(
    ("matrices", "order", "name"),
    [
        ([turns(2, 7)], 7, "C7"),
        ([turns(2, 5), turns(0, 2)], 10, "D5"),
        ([turns(0, 4), turns(1, 4)], 24, "S4"),
        ([turns(0, 2), torch.eye(3, dtype=torch.float64)[[1, 2, 0]]], 12, "A4"),
        ([turns(2, 4), -torch.eye(3, dtype=torch.float64)], 8, "C2 x C4"),
    ],
    ids=["C7", "D5", "S4", "A4", "C2 x C4"],
)
def test_generators_of_maps_to_nearest_vertices(sphere, matrices, order, name):
    generators = nearest_maps(sphere.verts, matrices)
    group = SymmetryGroup.from_generators(generators, sphere.verts, tolerance=0.3, weights=sphere.vertex_areas)
    assert torch.equal(group.maps[1], generators[0])
    found = group.residuals(sphere.verts, sphere.vertex_areas)
    assert (group.order, found.name) == (order, name)
    assert 0.02 < found.closure < 0.25  # a part of an edge (0.15) is lost at every step
    with pytest.raises(ValueError, match=r"do not close: .* tolerance=1e-06.* new were 0\.0.* known 0 or less"):
        SymmetryGroup.from_generators(generators, sphere.verts, tolerance=1e-6)


def test_a_group_larger_than_allowed():
    corners = torch.eye(5, dtype=torch.float64)
    turn, swap = torch.tensor([1, 2, 3, 4, 0]), torch.tensor([1, 0, 2, 3, 4])
    assert SymmetryGroup.from_generators([turn, swap], corners, tolerance=0.1).order == 120
    with pytest.raises(ValueError, match=r"more than most=119 .* new were 0\.566 or more .* known 0 or less"):
        SymmetryGroup.from_generators([turn, swap], corners, tolerance=0.1, most=119)


def test_generators_that_close_but_have_no_inverse():
    points = torch.arange(4.0)[:, None]
    with pytest.raises(ValueError, match=r"2 elements found .* are no group, row 1 .* Latin square"):
        SymmetryGroup.from_generators([torch.tensor([0, 0, 3, 3])], points, tolerance=0.1)


def test_subset():
    maps = torch.stack([torch.arange(6).roll(-i) for i in range(6)])
    group = SymmetryGroup(maps)
    assert torch.equal(group.subset([0, 4, 2]).maps, maps[[0, 4, 2]])
    for wrong in ([], [2, 0], [0, 2, 2], [0, 6], [0, -1]):
        with pytest.raises(ValueError, match="0 first, then different ones of 1 to 5"):
            group.subset(wrong)


@pytest.mark.parametrize(
    ("maps", "message"),
    [
        ([[1, 0], [0, 1]], "row 0 must be the identity"),
        ([[0, 1], [0, 2]], r"ids must lie in 0\.\.1, got 0\.\.2"),
        ([[0, 1], [-1, 0]], r"ids must lie in 0\.\.1, got -1\.\.1"),
    ],
)
def test_refusals(maps, message):
    with pytest.raises(ValueError, match=message):
        SymmetryGroup(torch.tensor(maps))


def test_refusals_of_points_weights_and_generators():
    group, points = SymmetryGroup(torch.tensor([[0, 1], [1, 0]])), torch.zeros(2, 3)
    with pytest.raises(ValueError, match="points: 3 given, but the group acts on 2"):
        group.residuals(torch.zeros(3, 3))
    with pytest.raises(ValueError, match="weights: 2 areas, some of them positive"):
        group.residuals(points, torch.zeros(2))
    make = unchecked(SymmetryGroup.from_generators.__func__)
    for generator in ([0, 1, 2], [0, 2], [-1, 0]):
        with pytest.raises(ValueError, match="number 1 is no map of 2 vertices"):
            make(SymmetryGroup, [torch.tensor([1, 0]), torch.tensor(generator)], points, 0.1)
    for tolerance, most in ((-1.0, 5), (float("nan"), 5), (0.1, 0)):
        with pytest.raises(ValueError, match="allowed are tolerance >= 0 and most >= 1"):
            make(SymmetryGroup, [], points, tolerance, most)


def test_shape_is_refused():
    table = object.__new__(SymmetryGroup)  # past the annotations
    for maps in (torch.arange(3), torch.zeros(0, 3, dtype=torch.int64)):
        object.__setattr__(table, "maps", maps)
        with pytest.raises(ValueError, match=r"expected a \(G, V\) table"):
            table.__post_init__()
