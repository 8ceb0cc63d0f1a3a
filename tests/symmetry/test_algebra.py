"""torchqm.symmetry.algebra: groups that everybody knows, written as tables in more than one way."""

import re
from functools import reduce
from itertools import chain
from math import sqrt

import pytest
import torch
from references.unchecked import unchecked

from torchqm.symmetry import (
    central_idempotents,
    conjugacy_classes,
    element_orders,
    group_fault,
    group_name,
    inverses,
    real_degrees,
    subgroup,
)


def generated(*generators):
    """The table of a permutation group: ``(g o h)(x) = g(h(x))``."""
    elements = [tuple(range(len(generators[0])))]
    for e in elements:
        elements += {tuple(s[x] for x in e) for s in generators} - set(elements)
    number = {e: i for i, e in enumerate(elements)}
    return torch.tensor([[number[tuple(g[x] for x in h)] for h in elements] for g in elements])


def semidirect(n, m, r):
    """``<a, b | a^n, b^m, b a b^-1 = a^r>`` with element ``m i + j`` for ``a^i b^j``; a direct product for r = 1."""
    i, j = torch.arange(n).repeat_interleave(m), torch.arange(m).repeat(n)
    power = torch.tensor([pow(r, k, n) for k in range(m)])
    return (i[:, None] + i * power[j][:, None]) % n * m + (j[:, None] + j) % m


def times(*tables):
    def two(a, b):
        n = len(a) * len(b)
        return (a[:, None, :, None] * len(b) + b[None, :, None, :]).reshape(n, n)

    return reduce(two, tables)


def cyclic(n):
    return semidirect(n, 1, 1)


def dihedral(n):
    return semidirect(n, 2, n - 1)


def boolean(rank):
    i = torch.arange(2**rank)
    return i[:, None] ^ i


A4 = generated((1, 2, 0, 3), (1, 0, 3, 2))
S4 = generated((1, 0, 2, 3), (1, 2, 3, 0))
A5 = generated((1, 2, 0, 3, 4), (0, 1, 3, 4, 2))
QUATERNIONS = generated((1, 2, 3, 0, 5, 6, 7, 4), (4, 7, 6, 5, 2, 1, 0, 3))

NAMED = {
    "trivial": cyclic(1),
    "C2": cyclic(2),
    "C3": cyclic(3),
    "C6": times(cyclic(2), cyclic(3)),
    "C30": times(cyclic(5), cyclic(2), cyclic(3)),
    "C60": cyclic(60),
    "C2 x C2": boolean(2),
    "C2 x C2 x C2": boolean(3),
    "C2 x C4": times(cyclic(4), cyclic(2)),
    "C4 x C4": times(cyclic(4), cyclic(4)),
    "C2 x C8": times(cyclic(2), cyclic(8)),
    "C2 x C12": times(cyclic(6), cyclic(4)),
    "C3 x C6": times(cyclic(3), cyclic(2), cyclic(3)),
    "D3": generated((1, 0, 2), (1, 2, 0)),
    "D4": dihedral(4),
    "D5": dihedral(5),
    "D6": times(dihedral(3), cyclic(2)),
    "D8": dihedral(8),
    "D30": dihedral(30),
    "D4 x C2": times(cyclic(2), dihedral(4)),
    "D6 x C2": times(dihedral(3), boolean(2)),
    "D4 x C2 x C2": times(boolean(1), dihedral(4), boolean(1)),
    "A4": A4,
    "A4 x C2": times(A4, cyclic(2)),
    "S4": S4,
    "S4 x C2": times(cyclic(2), S4),
    "A5": A5,
    "A5 x C2": times(A5, cyclic(2)),
    # None of these is a symmetry group in space, and each has a neighbour above that it must not be taken for.
    "order 8": QUATERNIONS,
    "order 12": semidirect(3, 4, 2),
    "order 16": semidirect(8, 2, 5),  # the orders of its elements are those of C2 x C8
    "order 21": semidirect(7, 3, 2),
    "order 24": times(dihedral(4), cyclic(3)),
    "order 120": generated((1, 0, 2, 3, 4), (1, 2, 3, 4, 0)),
}
UNNAMED = {
    "semidihedral": semidirect(8, 2, 3),
    "C4 : C4": semidirect(4, 4, 3),  # the orders of its elements are those of Q8 x C2
    "Q8 x C2": times(QUATERNIONS, cyclic(2)),
    "S3 x C4": times(dihedral(3), cyclic(4)),
    "C3 : C8": semidirect(3, 8, 2),
    "S3 x S3": times(dihedral(3), dihedral(3)),
}


def renumbered(table, seed):
    """The same group with its elements in another order, the identity first."""
    order = torch.randperm(len(table) - 1, generator=torch.Generator().manual_seed(seed)) + 1
    order = torch.cat([torch.zeros(1, dtype=torch.int64), order])
    return torch.argsort(order)[table[order][:, order]]


@pytest.fixture(params=list(NAMED))
def named(request):
    return request.param, NAMED[request.param]


def test_names(named):
    name, table = named
    assert group_fault(table) is None
    assert group_name(table) == name
    assert group_name(renumbered(table, 1)) == name


@pytest.mark.parametrize("which", list(UNNAMED))
def test_groups_without_a_name_are_called_by_their_order(which):
    assert group_name(UNNAMED[which]) == f"order {len(UNNAMED[which])}"


@pytest.mark.parametrize(
    ("table", "fault"),
    [
        ([[1, 0], [0, 1]], "element 0 is no identity: 0 o 0 = 1"),
        ([[0, 1, 2], [2, 0, 1], [1, 2, 0]], "element 0 is no identity: 1 o 0 = 2"),
        ([[0, 1], [1, 2]], "names elements 0 to 2, there are 0 to 1"),
        ([[0, -1], [1, 0]], "names elements -1 to 1, there are 0 to 1"),
        ([[0, 1, 2], [1, 0, 0], [2, 0, 1]], "row 1 of the table holds element 0 2 times"),
        ([[0, 1, 2, 3], [1, 0, 3, 2], [2, 1, 0, 3], [3, 2, 1, 0]], "column 1 of the table holds element 1 2 times"),
        # a loop: identity, Latin square, every element its own inverse
        (
            [[0, 1, 2, 3, 4], [1, 0, 3, 4, 2], [2, 4, 0, 1, 3], [3, 2, 4, 0, 1], [4, 3, 1, 2, 0]],
            r"not associative: \(1 o 1\) o 2 = 2, 1 o \(1 o 2\) = 4",
        ),
    ],
)
def test_what_is_no_group(table, fault):
    table = torch.tensor(table)
    assert re.search(fault, unchecked(group_fault)(table))
    for function in (group_name, inverses, element_orders, conjugacy_classes, central_idempotents):
        with pytest.raises(ValueError, match=f"products: .*{fault}"):
            unchecked(function)(table)
    with pytest.raises(ValueError, match=fault):
        unchecked(subgroup)(table, [0])


def test_a_table_is_square():
    for shape in ((2, 3), (0, 0), (4,)):
        fault = unchecked(group_fault)(torch.zeros(shape, dtype=torch.int64))
        assert fault == f"the table has shape {shape}, a square with at least one element is needed"


def test_inverses_and_orders():
    square = dihedral(4)  # element 2 i + j is a^i b^j
    assert inverses(square).tolist() == [0, 1, 6, 3, 4, 5, 2, 7]
    assert element_orders(square).tolist() == [1, 2, 4, 2, 2, 2, 4, 2]
    assert element_orders(cyclic(12)).tolist() == [1, 12, 6, 4, 3, 12, 2, 12, 3, 4, 6, 12]
    assert element_orders(boolean(4)).tolist() == [1] + [2] * 15


@pytest.mark.parametrize(
    ("table", "sizes"),
    [
        (cyclic(5), [1] * 5),
        (dihedral(4), [1, 1, 2, 2, 2]),
        (dihedral(5), [1, 2, 2, 5]),
        (S4, [1, 3, 6, 6, 8]),
        (A4, [1, 3, 4, 4]),
        (A5, [1, 12, 12, 15, 20]),
        (QUATERNIONS, [1, 1, 2, 2, 2]),
    ],
)
def test_class_sizes(table, sizes):
    classes = conjugacy_classes(table)
    assert sorted(map(len, classes)) == sizes
    assert sorted(chain.from_iterable(classes)) == list(range(len(table)))
    assert classes == sorted(map(sorted, classes))
    orders = element_orders(table)
    assert all(len(orders[c].unique()) == 1 for c in classes)


def test_subgroups():
    table = cyclic(12)
    assert subgroup(table, []) == [0]
    assert subgroup(table, [8]) == [0, 4, 8]
    assert subgroup(table, [6, 4]) == [0, 2, 4, 6, 8, 10]
    assert subgroup(dihedral(4), [1, 4]) == [0, 1, 4, 5]
    for wrong in ([12], [-1]):
        with pytest.raises(ValueError, match="the elements are 0 to 11"):
            subgroup(table, wrong)


@pytest.mark.parametrize(
    ("table", "degrees"),
    [
        (cyclic(1), [1]),
        (cyclic(6), [1, 1, 2, 2]),  # conjugate pairs are one real representation
        (boolean(3), [1] * 8),
        (dihedral(3), [1, 1, 2]),
        (dihedral(8), [1, 1, 1, 1, 2, 2, 2]),
        (times(dihedral(4), cyclic(2)), [1] * 8 + [2, 2]),
        (A4, [1, 2, 3]),
        (S4, [1, 1, 2, 3, 3]),
        (A5, [1, 3, 3, 4, 5]),
        (QUATERNIONS, [1, 1, 1, 1, 4]),  # the quaternions themselves
        (times(dihedral(4), cyclic(3)), [1, 1, 1, 1, 2, 2, 2, 2, 2, 4]),  # the last one complex, of degree 2
    ],
)
def test_real_degrees(table, degrees):
    found = central_idempotents(table)
    assert real_degrees(table, found).tolist() == degrees
    assert bool((found[:, 0].diff() > -1e-9).all())  # by their dimension in the regular representation
    torch.testing.assert_close(found[0], torch.full((len(table),), 1 / len(table), dtype=torch.float64))


def test_idempotents_of_boolean_groups_are_their_parities():
    """One for each subset of the mirrors, with the sign of the parity of the mirrors that both have."""
    found = central_idempotents(boolean(3)) * 8
    parities = torch.tensor([[(-1.0) ** (s & g).bit_count() for g in range(8)] for s in range(8)], dtype=torch.float64)
    torch.testing.assert_close(found, parities[[0, 4, 2, 6, 1, 5, 3, 7]])  # descending rows


def test_idempotents_are_the_known_characters():
    turn = 2 * torch.pi * torch.arange(5, dtype=torch.float64) / 5
    found = central_idempotents(cyclic(5))
    for row, k in zip(found[1:], (1, 2), strict=True):
        torch.testing.assert_close(row, 2 / 5 * torch.cos(k * turn))
    golden = (1 + sqrt(5)) / 2
    characters = central_idempotents(A5) * 60 / torch.tensor([1, 3, 3, 4, 5])[:, None]
    orders = element_orders(A5)
    for order, values in ((2, [1, -1, -1, 0, 1]), (3, [1, 0, 0, 1, -1])):
        expected = torch.tensor(values, dtype=torch.float64)[:, None].expand(5, int((orders == order).sum()))
        torch.testing.assert_close(characters[:, orders == order], expected)
    fives = characters[:, orders == 5]
    torch.testing.assert_close(fives[1] + fives[2], torch.ones(24, dtype=torch.float64))
    torch.testing.assert_close(
        fives[1].unique_consecutive().sort().values[[0, -1]], fives.new_tensor([1 - golden, golden])
    )


def test_idempotents_of_all_cyclic_and_dihedral_groups():
    """As many as classes up to inversion, however close their values are."""
    for n in range(1, 121, 7):
        assert len(central_idempotents(cyclic(n))) == n // 2 + 1
    for n in range(3, 61, 7):
        assert len(central_idempotents(dihedral(n))) == (n - 1) // 2 + (4 if n % 2 == 0 else 2)


def test_convolution(named):
    """``e_i e_j = delta_ij e_i``, they sum to the identity, and they are the same on classes and inverses."""
    _, table = named
    found, inverse = central_idempotents(table), inverses(table)
    quotient = table[inverse]  # g^-1 h
    product = torch.einsum("ig,jgh->ijh", found, found[:, quotient])
    expected = torch.zeros_like(product)
    for i, e in enumerate(found):
        expected[i, i] = e
    torch.testing.assert_close(product, expected, atol=1e-10, rtol=0)
    delta = torch.zeros(len(table), dtype=torch.float64)
    delta[0] = 1
    torch.testing.assert_close(found.sum(0), delta, atol=1e-10, rtol=0)
    assert torch.equal(found[:, inverse], found)
    for c in conjugacy_classes(table):
        assert torch.equal(found[:, c], found[:, c[:1]].expand(-1, len(c)))


def test_idempotents_follow_a_renumbering():
    order = torch.tensor([0, 4, 2, 7, 1, 6, 3, 5])
    table = dihedral(4)
    other = torch.argsort(order)[table[order][:, order]]
    rows = {tuple(r) for r in central_idempotents(table)[:, order].mul(1e6).round().long().tolist()}
    assert rows == {tuple(r) for r in central_idempotents(other).mul(1e6).round().long().tolist()}


def test_real_degrees_need_the_group_of_the_idempotents():
    with pytest.raises(ValueError, match="3 columns for a group of 2 elements"):
        unchecked(real_degrees)(cyclic(2), central_idempotents(cyclic(3)))
