"""The algebra of a finite group given by its multiplication table, whatever it acts on.

A table ``products (G, G)`` holds in row g and column h the index of ``g o h`` (h first, then g); element 0 is the
identity. :meth:`torchqm.symmetry.SymmetryGroup.residuals` measures one on a shape. Every function here except
:func:`group_fault` refuses a table that is no group.
"""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = [
    "central_idempotents",
    "conjugacy_classes",
    "element_orders",
    "group_fault",
    "group_name",
    "inverses",
    "real_degrees",
    "subgroup",
]

# Orders of the elements, and how many elements have each. In a group of 12 or 24 elements eight of order 3 mean four
# Sylow 3-subgroups, which the group permutes by conjugation. If it has 12 elements it is A4 (Dummit and Foote, section
# 4.5); if it has 24, a kernel of that action would hold 2 elements and make one of order 6, so without these it is S4.
# In a group of 60 elements, 24 of order 5 mean six Sylow 5-subgroups, so it is simple, hence A5.
_BY_ORDERS = {
    ((1, 1), (2, 3), (3, 8)): "A4",
    ((1, 1), (2, 9), (3, 8), (4, 6)): "S4",
    ((1, 1), (2, 15), (3, 20), (5, 24)): "A5",
}


def group_fault(products: Int[Tensor, "G G"]) -> str | None:
    """What keeps a table from being the multiplication table of a group, in words; None if nothing does.

    Tested are the identity (element 0), the Latin square (every element once in each row and column, so that there are
    inverses) and associativity.

    Args:
        products: ``(G, G)`` int64 index of ``g o h``.

    Example:
        >>> group_fault(torch.tensor([[0, 1], [1, 0]])) is None
        True
        >>> group_fault(torch.tensor([[0, 1], [1, 1]]))
        'row 1 of the table holds element 1 2 times (it is no Latin square)'
    """
    if products.ndim != 2 or products.shape[0] != products.shape[1] or products.shape[0] == 0:
        return f"the table has shape {tuple(products.shape)}, a square with at least one element is needed"
    order = products.shape[0]
    if int(products.min()) < 0 or int(products.max()) >= order:
        return f"the table names elements {int(products.min())} to {int(products.max())}, there are 0 to {order - 1}"
    everyone = torch.arange(order)
    for way, line in (("0 o {}", products[0]), ("{} o 0", products[:, 0])):
        if not torch.equal(line, everyone):
            wrong = int((line != everyone).int().argmax())
            return f"element 0 is no identity: {way.format(wrong)} = {int(line[wrong])}"
    for way, table in (("row", products), ("column", products.T)):
        for g, line in enumerate(table):
            counts = torch.bincount(line, minlength=order)
            if int(counts.max()) > 1:
                twice = int(counts.argmax())
                return (
                    f"{way} {g} of the table holds element {twice} {int(counts[twice])} times (it is no Latin square)"
                )
    for g in range(order):
        left, right = products[products[g]], products[g][products]  # (g h) k and g (h k)
        if not torch.equal(left, right):
            h, k = (left != right).nonzero()[0].tolist()
            return (
                f"it is not associative: ({g} o {h}) o {k} = {int(left[h, k])}, {g} o ({h} o {k}) = {int(right[h, k])}"
            )
    return None


def inverses(products: Int[Tensor, "G G"]) -> Int[Tensor, " G"]:
    """The inverse of each element: ``g o inverses[g] = 0``.

    Raises:
        ValueError: the table is no group, with what fails.

    Example:
        >>> inverses(torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]])).tolist()
        [0, 2, 1]
    """
    _check(products)
    return _inverses(products)


def element_orders(products: Int[Tensor, "G G"]) -> Int[Tensor, " G"]:
    """The order of each element: the smallest n >= 1 with ``g^n = id``.

    Raises:
        ValueError: the table is no group, with what fails.

    Example:
        >>> element_orders(torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]])).tolist()
        [1, 3, 3]
    """
    _check(products)
    return _orders(products)


def conjugacy_classes(products: Int[Tensor, "G G"]) -> list[list[int]]:
    """The classes ``{h o g o h^-1}`` as ascending lists of elements, ordered by their smallest element.

    Raises:
        ValueError: the table is no group, with what fails.

    Example:
        >>> conjugacy_classes(torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]]))
        [[0], [1], [2]]
    """
    _check(products)
    first = _conjugates(products).amin(0)
    return [(first == c).nonzero()[:, 0].tolist() for c in first.unique().tolist()]


def subgroup(products: Int[Tensor, "G G"], generators: Sequence[int], check: bool = True) -> list[int]:
    """The elements of the smallest subgroup that contains the generators, ascending (so the identity is first).

    Args:
        products: multiplication table.
        generators: numbers of elements.
        check: whether it is checked that the table is a group, which takes longest where it is large.

    Raises:
        ValueError: the table is no group, or a generator is no element of it.

    Example:
        >>> subgroup(torch.tensor([[0, 1, 2, 3], [1, 2, 3, 0], [2, 3, 0, 1], [3, 0, 1, 2]]), [2])
        [0, 2]
    """
    if check:
        _check(products)
    order = products.shape[0]
    if any(not 0 <= g < order for g in generators):
        raise ValueError(f"generators are {list(generators)}, but the elements are 0 to {order - 1}")
    return _generated(products, generators)


def group_name(products: Int[Tensor, "G G"]) -> str:
    """The name of the abstract group: "trivial", "C3", "C2 x C4", "D4", "D4 x C2", "A4", "S4 x C2", ... or "order 24".

    ``C_n`` is cyclic with n elements and ``D_n`` dihedral with **2n** elements (the geometers' index: the symmetries of
    a regular n-gon), n >= 3. A commutative group is named by its invariant factors, so ``C6`` is not "C2 x C3", and
    ``C2 x C2`` is not called D2. A single name wins over a product: D3 x C2 is "D6". Every finite group of rotations
    and reflections of space is among the names; many others are called by their order.

    The decisions are proofs: a commutative group is known by the orders of its elements; a group with a cyclic
    subgroup of index 2 outside which all elements are involutions is dihedral; a factor C2 splits off exactly where a
    central involution lies outside the subgroup generated by all squares, and what is left is then unique
    (Krull-Remak-Schmidt); A4, S4 and A5 are the only groups with their orders of elements.

    Args:
        products: ``(G, G)`` int64 index of ``g o h``, element 0 the identity.

    Raises:
        ValueError: the table is no group, with what fails.

    Example:
        >>> group_name(torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]]))
        'C2 x C2'
    """
    _check(products)
    orders = _orders(products)
    size = products.shape[0]
    if torch.equal(products, products.T):
        return _commutative_name(orders)
    # In D_n with n >= 3 the elements of order n are rotations, so any one of them generates all the others.
    for turn in (orders == size // 2).nonzero()[:1, 0].tolist():
        outside = torch.ones(size, dtype=torch.bool)
        outside[_generated(products, [turn])] = False
        if bool((orders[outside] == 2).all()):
            return f"D{size // 2}"
    statistics = tuple(sorted(Counter(orders.tolist()).items()))
    if statistics in _BY_ORDERS:
        return _BY_ORDERS[statistics]
    rest = _complement_of_an_involution(products, orders)
    if rest is not None:
        name = group_name(_restricted(products, rest))
        if not name.startswith("order"):
            return f"{name} x C2"
    return f"order {size}"


def central_idempotents(products: Int[Tensor, "G G"]) -> Float[Tensor, "N G"]:
    """The primitive central idempotents of the real group algebra, one for each real irreducible representation.

    ``e_i(g) = chi(id) / |G| chi(g^-1)``, summed over chi and its complex conjugate where they differ. In any
    representation rho the projector onto the i-th isotypic component is ``sum_g e_i(g) rho(g)``. The weights are the
    same for g and its inverse and for all conjugates, so pull-backs (which reverse products) are projected as well.

    They are the joint eigenspaces of the class sums ``K_c + K_c^-1`` in the regular representation, found from one
    fixed generic combination of them; there are as many as there are classes up to inversion, which is checked.

    Args:
        products: ``(G, G)`` int64 index of ``g o h``, element 0 the identity.

    Returns:
        ``(N, G)`` float64, the trivial one (``1 / |G|`` everywhere) first, then by the dimension of the component in
        the regular representation, then in descending lexicographic order.

    Raises:
        ValueError: the table is no group, with what fails.

    Example:
        >>> central_idempotents(torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]]))
        tensor([[ 0.3333,  0.3333,  0.3333],
                [ 0.6667, -0.3333, -0.3333]], dtype=torch.float64)

    References:
        J.-P. Serre, "Linear Representations of Finite Groups", sections 2.6 and 6.3.
    """
    _check(products)
    order, inverse = products.shape[0], _inverses(products)
    conjugates = _conjugates(products)
    _, label = torch.minimum(conjugates.amin(0), conjugates[:, inverse].amin(0)).unique(return_inverse=True)
    sizes = torch.bincount(label).double()
    # No combination of sin(1), sin(4), sin(9), ... with algebraic numbers, which characters are, vanishes
    # (Lindemann-Weierstrass), so different representations have different eigenvalues.
    generic = torch.sin(torch.arange(1, len(sizes) + 1).double() ** 2) / sizes
    evals, evecs = torch.linalg.eigh(generic[label[products[:, inverse]]])  # entry (a, b) weighs a o b^-1
    starts = [0, *((evals.diff() > 1e-9).nonzero()[:, 0] + 1).tolist(), order]
    if len(starts) - 1 != len(sizes):
        raise RuntimeError(f"products: {len(starts) - 1} components found for {len(sizes)} classes up to inversion")
    rows = []
    for a, b in pairwise(starts):
        weights = evecs[:, a:b] @ evecs[0, a:b]  # the projector applied to the identity
        mean = torch.zeros_like(sizes).index_add_(0, label, weights) / sizes
        rows.append(mean[label])
    rows.sort(key=lambda e: (round(float(e[0]) * order), *(-e).round(decimals=9).tolist()))
    return torch.stack(rows)


def real_degrees(products: Int[Tensor, "G G"], idempotents: Float[Tensor, "N G"]) -> Int[Tensor, " N"]:
    """Dimension of the real irreducible representation of each central idempotent.

    The component has dimension ``d = |G| e(id)`` in the regular representation and Frobenius-Schur sum
    ``s = sum_g e(g^2)``. A real representation of degree n has ``d = n^2, s = n``; a complex one with its conjugate has
    ``d = 2 n^2, s = 0`` and real dimension 2n; a quaternionic one ``d = n^2, s = -n`` and real dimension 2n.

    Args:
        products: ``(G, G)`` table of the group.
        idempotents: ``(N, G)`` from :func:`central_idempotents`.

    Raises:
        ValueError: the table is no group, or the idempotents have another number of columns.

    Example:
        >>> turns = torch.tensor([[0, 1, 2], [1, 2, 0], [2, 0, 1]])
        >>> real_degrees(turns, central_idempotents(turns)).tolist()
        [1, 2]

    References:
        J.-P. Serre, "Linear Representations of Finite Groups", section 13.2.
    """
    _check(products)
    if idempotents.shape[1] != products.shape[0]:
        raise ValueError(f"idempotents: {idempotents.shape[1]} columns for a group of {products.shape[0]} elements")
    regular = idempotents[:, 0] * products.shape[0]
    indicator = idempotents[:, products.diagonal()].sum(1)
    root = torch.where(indicator.abs() < 0.5, regular * 2, torch.where(indicator > 0, regular, regular * 4)).sqrt()
    return root.round().long()


def _check(products: Tensor) -> None:
    fault = group_fault(products)
    if fault is not None:
        raise ValueError(f"products: {fault}")


def _inverses(products: Tensor) -> Tensor:
    return (products == 0).int().argmax(1)


def _orders(products: Tensor) -> Tensor:
    everyone = torch.arange(products.shape[0])
    power, orders = everyone, torch.ones_like(everyone)
    while bool((power != 0).any()):
        orders += power != 0
        power = torch.where(power == 0, 0, products[power, everyone])
    return orders


def _conjugates(products: Tensor) -> Tensor:
    """``h o g o h^-1`` in row h and column g."""
    return products[products, _inverses(products)[:, None]]


def _generated(products: Tensor, generators: Sequence[int]) -> list[int]:
    times = products[:, list(generators)].tolist()
    found, new = {0}, {0}
    while new:
        new = {product for g in new for product in times[g]} - found
        found |= new
    return sorted(found)


def _restricted(products: Tensor, elements: list[int]) -> Tensor:
    """The table of a subgroup, its elements renumbered in the given order."""
    number = torch.full((products.shape[0],), -1)
    number[elements] = torch.arange(len(elements))
    return number[products[elements][:, elements]]


def _commutative_name(orders: Tensor) -> str:
    """Invariant factors ``C_a x C_b x ...``, each dividing the next, from how many elements each power kills."""
    size = orders.shape[0]
    factors: list[int] = []
    for p in (p for p in range(2, size + 1) if size % p == 0 and all(p % q for q in range(2, p))):
        # Of the cyclic factors of order p^j or more there are log_p of the number that p^j kills and p^(j-1) does not.
        counts, j = [1], 1
        while size % p**j == 0:
            counts.append(int((p**j % orders == 0).sum()))
            j += 1
        ranks = [_log(b // a, p) for a, b in pairwise(counts)]
        for i in range(ranks[0]):
            if i == len(factors):
                factors.append(1)
            factors[i] *= p ** sum(rank > i for rank in ranks)
    return " x ".join(f"C{f}" for f in sorted(factors)) or "trivial"


def _log(number: int, base: int) -> int:
    power = 0
    while number > 1:
        number, power = number // base, power + 1
    return power


def _complement_of_an_involution(products: Tensor, orders: Tensor) -> list[int] | None:
    """A subgroup H with ``G = H x {id, z}`` for some central involution z, or None if there is none."""
    squares = _generated(products, products.diagonal().unique().tolist())
    central = (products == products.T).all(1) & (orders == 2)
    central[squares] = False
    for z in central.nonzero()[:1, 0].tolist():
        # Modulo the squares the group is a vector space over F_2: a maximal subgroup without z is a hyperplane.
        kept = set(squares)
        for g in range(products.shape[0]):
            coset = set(products[sorted(kept), g].tolist())
            if z not in coset:
                kept |= coset
        return sorted(kept)
    return None
