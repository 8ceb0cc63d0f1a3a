"""torchqm.symmetry.group: the table, its axioms measured, what is refused."""

from itertools import product

import pytest
import torch

from torchqm.symmetry import SymmetryGroup, common_order


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


def test_common_order():
    two, four = SymmetryGroup.from_reflection(torch.tensor([1, 0])), SymmetryGroup.trivial(2)
    assert common_order(two, two) == 2
    assert common_order(two, four) == 1


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


def test_shape_is_refused():
    table = object.__new__(SymmetryGroup)  # past the annotations
    for maps in (torch.arange(3), torch.zeros(0, 3, dtype=torch.int64)):
        object.__setattr__(table, "maps", maps)
        with pytest.raises(ValueError, match=r"expected a \(G, V\) table"):
            table.__post_init__()
