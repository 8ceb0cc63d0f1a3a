"""The largest symmetry that two shapes have in common, and which subgroups of them belong together."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.matching.known import KnownSymmetry, no_symmetry
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.algebra import group_name, subgroup
from torchqm.symmetry.basis import symmetrized_basis

__all__ = ["common_symmetry", "first_reflection", "one_reflection", "subgroups"]

N_COMPARED = 60
"""Functions whose symmetric part is compared to tell subgroups of a shape apart."""

Elements = tuple[int, ...]


def subgroups(products: Int[Tensor, "G G"], n_generators: int = 3) -> list[Elements]:
    """All subgroups that up to three elements generate, the largest first; element 0 is in each.

    That is all of them for the finite groups of rotations and reflections in space.

    Args:
        products: multiplication table.
        n_generators: at most.

    Example:
        >>> table = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
        >>> subgroups(table)
        [(0, 1, 2, 3), (0, 1), (0, 2), (0, 3), (0,)]
    """
    order = products.shape[0]
    subgroup(products, [0])  # is it a group? once, and not for each of its parts
    found: set[Elements] = {(0,)}
    frontier: set[Elements] = {(0,)}
    for _ in range(n_generators):
        larger = {
            tuple(sorted(subgroup(products, [*have, new], check=False)))
            for have in frontier
            for new in range(order)
            if new not in have
        }
        frontier = larger - found
        found |= larger
    return sorted(found, key=lambda elements: (-len(elements), elements))


def common_symmetry(
    x: PreparedShape, y: PreparedShape, known_x: KnownSymmetry, known_y: KnownSymmetry
) -> tuple[KnownSymmetry, KnownSymmetry]:
    """The largest subgroups of the same kind of two groups, cut out of both; the groups themselves if they are equal.

    Of one kind are subgroups of the same name that turn over the orientation with as many elements (which is not asked
    of surfaces without an orientation). Where several pairs
    are, that one is taken whose symmetric functions have the most similar eigenvalues: the quotients of isometric
    shapes by matching groups are isometric.

    Args:
        x: source.
        y: target.
        known_x: symmetry of the source.
        known_y: symmetry of the target.

    References:
        Paper, Lemma 3.2.
    """
    oriented = x.oriented and y.oriented
    kind_x, kind_y = (_kind(known, tuple(range(known.group.order)), oriented) for known in (known_x, known_y))
    if kind_x == kind_y:
        return known_x, known_y
    own, other = _by_kind(known_x, oriented), _by_kind(known_y, oriented)
    shared = [kind for kind in own if kind in other]
    largest = max(shared, key=lambda kind: (len(own[kind][0]), kind[1]))
    return _best_pair(x, y, known_x, known_y, own[largest], other[largest])


def one_reflection(
    x: PreparedShape, y: PreparedShape, known_x: KnownSymmetry, known_y: KnownSymmetry
) -> tuple[KnownSymmetry, KnownSymmetry]:
    """One reflection of each shape, those that belong together; nothing where one of them has none.

    Arguments as in :func:`common_symmetry`.
    """
    if all(known.group.order == 1 or known.reflection for known in (known_x, known_y)):
        return known_x, known_y
    own, other = (_by_kind(known).get(("C2", 1), []) for known in (known_x, known_y))
    if not own or not other:
        return no_symmetry(x, known_x.warnings), no_symmetry(y, known_y.warnings)
    return _best_pair(x, y, known_x, known_y, own, other)


def first_reflection(x: PreparedShape, known: KnownSymmetry) -> KnownSymmetry | None:
    """The group of the first reflection in a group; None if there is none in it."""
    found = _by_kind(known).get(("C2", 1), [])
    return known.subset(found[0], x, {}) if found else None


def _kind(known: KnownSymmetry, elements: Elements, oriented: bool = True) -> tuple[str, int]:
    chosen = list(elements)
    table = known.products[chosen][:, chosen]
    number = {old: new for new, old in enumerate(chosen)}
    small = torch.tensor([[number[int(v)] for v in row] for row in table])
    return group_name(small), int((known.orientation[chosen] < 0).sum()) if oriented else 0


def _by_kind(known: KnownSymmetry, oriented: bool = True) -> dict[tuple[str, int], list[Elements]]:
    found: dict[tuple[str, int], list[Elements]] = {}
    for elements in subgroups(known.products):
        found.setdefault(_kind(known, elements, oriented), []).append(elements)
    return found


def _best_pair(
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    of_x: list[Elements],
    of_y: list[Elements],
) -> tuple[KnownSymmetry, KnownSymmetry]:
    spectra_x = [_even_evals(x, known_x, elements) for elements in of_x]
    spectra_y = [_even_evals(y, known_y, elements) for elements in of_y]
    gaps = torch.tensor([[_gap(a, b) for b in spectra_y] for a in spectra_x])
    i, j = divmod(int(gaps.argmin()), len(of_y))
    tried = {"subgroups_tried": [len(of_x), len(of_y)], "spectral_difference": float(gaps[i, j])}
    return known_x.subset(of_x[i], x, tried), known_y.subset(of_y[j], y, tried)


def _even_evals(x: PreparedShape, known: KnownSymmetry, elements: Elements) -> Float[Tensor, " K"]:
    basis = x.basis.truncate(min(N_COMPARED, x.basis.k))
    return symmetrized_basis(basis, known.group.subset(list(elements))).even_evals


def _gap(a: Tensor, b: Tensor) -> float:
    n = min(len(a), len(b))
    return float((a[:n] - b[:n]).norm() / b[:n].norm().clamp_min(1e-300))
