"""torchqm.matching.subgroups: all of them, and those of two shapes that belong together."""

from dataclasses import replace
from itertools import permutations

import pytest
import torch

from torchqm.data.synthetic import creature
from torchqm.matching import extrinsic_symmetry, given_symmetry, no_symmetry, prepare
from torchqm.matching.subgroups import common_symmetry, first_reflection, one_reflection, subgroups


def dihedral(n):
    """Elements ``turn^a flip^b`` as number ``a + n b``."""
    table = torch.empty(2 * n, 2 * n, dtype=torch.int64)
    for g in range(2 * n):
        for h in range(2 * n):
            a, b, c, d = g % n, g // n, h % n, h // n
            table[g, h] = (a + (-c if b else c)) % n + n * (b ^ d)
    return table


def symmetric(n):
    everyone = list(permutations(range(n)))
    number = {p: i for i, p in enumerate(everyone)}
    return torch.tensor([[number[tuple(p[i] for i in q)] for q in everyone] for p in everyone])


@pytest.mark.parametrize(
    ("table", "count"),
    [
        (torch.zeros(1, 1, dtype=torch.int64), 1),
        (dihedral(3), 6),
        (dihedral(4), 10),
        (dihedral(8), 19),
        (symmetric(4), 30),
        (torch.arange(8)[:, None] ^ torch.arange(8), 16),
    ],
    ids=["trivial", "D3", "D4", "D8", "S4", "C2^3"],
)
def test_all_subgroups(table, count):
    """The numbers of subgroups are those of the tables in the books."""
    found = subgroups(table)
    assert len(found) == len(set(found)) == count
    assert found[0] == tuple(range(len(table)))
    assert found[-1] == (0,)
    for elements in found:
        chosen = list(elements)
        assert set(table[chosen][:, chosen].flatten().tolist()) == set(elements)  # closed


@pytest.fixture(scope="module")
def eggs():
    """Two triangulations of one body with three mirror planes, and what is known of them."""
    shapes = [prepare(creature("ellipsoid", 1000, retriangulate=seed).mesh, 60) for seed in (1, 2)]
    return [(shape, extrinsic_symmetry(shape)) for shape in shapes]


def test_equal_groups_stay(eggs):
    (x, known_x), (y, known_y) = eggs
    assert common_symmetry(x, y, known_x, known_y) == (known_x, known_y)


def test_the_subgroups_that_belong_together(eggs):
    (x, known_x), (y, known_y) = eggs
    for elements in subgroups(known_x.products)[1:-1]:
        part = known_x.subset(elements, x, {})
        own, other = common_symmetry(x, y, part, known_y)
        assert own.group.order == other.group.order == len(elements)
        assert own.name == other.name
        assert int((own.orientation < 0).sum()) == int((other.orientation < 0).sum())
        assert other.details["spectral_difference"] < 0.02  # others differ by 0.05 and more


def test_one_reflection(eggs):
    (x, known_x), (y, known_y) = eggs
    own, other = one_reflection(x, y, known_x, known_y)
    assert own.reflection
    assert other.reflection
    assert other.details["spectral_difference"] < 0.02
    assert one_reflection(x, y, own, other) == (own, other)
    rotations = known_x.subset([0, *(known_x.orientation > 0).nonzero().flatten().tolist()[1:]], x, {})
    assert rotations.group.order == 4
    assert [known.group.order for known in one_reflection(x, y, rotations, known_y)] == [1, 1]
    assert first_reflection(x, rotations) is None
    first = first_reflection(x, known_x)
    assert first is not None
    assert first.reflection
    none = no_symmetry(x)
    assert one_reflection(x, y, none, other) == (none, other)


def test_orientation_is_not_asked_of_surfaces_that_have_none():
    """What noise made of the parity of an element must not part two equal groups."""
    body = creature("ellipsoid", 1000)
    x = prepare(body.mesh, 60)
    known = given_symmetry(x, body.base_group)
    pair = [known.subset([0, int((known.orientation * sign > 0).nonzero()[-1])], x, {}) for sign in (1, -1)]
    own, other = common_symmetry(x, x, *pair)
    assert own.group.order == other.group.order == 1
    bare = replace(x, oriented=False)
    own, other = common_symmetry(bare, bare, *pair)
    assert own.group.order == other.group.order == 2
