"""The ways from the first even block to the full map, and the choice between what they give."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.refine import nearest_isometry
from torchqm.fmap.threads import in_parallel
from torchqm.fmap.two_way import Places, growing_pairs, two_way_upsample
from torchqm.matching.initial import basis_size, split_bases
from torchqm.matching.known import KnownSymmetry
from torchqm.matching.odd import OddMap, join_blocks, solve_odd
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.quality import commutator_norm, distance_change
from torchqm.matching.quotient import QuotientMatch, pair_places, refine_fmap
from torchqm.matching.shape import PreparedShape
from torchqm.matching.synchronize import sample_weights, synchronized_halves
from torchqm.symmetry.basis import EvenOddBasis

__all__ = ["FullMap", "full_map_from_blocks", "sharpened"]

K_CHOICE = 100
"""Functions at which candidates are compared."""

AGREEMENT = 0.9
"""Share of the shape, weighted by the distance of mirror images, on which odd block and neighbours must agree."""

CLEARLY = 0.97
"""Share of the best other score that a synchronized candidate must stay below: the odd block has more evidence."""

FIRST_STEPS = 3
"""Two-way steps at the first size: more of them spread errors of the first map, instead of mending them."""


@dataclass(frozen=True, eq=False)
class FullMap:
    """The orientation-preserving functional map, and how it was chosen.

    Args:
        fmap: ``(K, K)`` at ``k_max``.
        quotient: the even block that it grew from.
        odd: the odd block, with its two residuals.
        scores: of each candidate, at :data:`K_CHOICE` functions: commutator with the Laplacian times change of
            distances; 0 is exact.
        synchronized: whether the odd block was given up for :mod:`torchqm.matching.synchronize`; then which of the two
            maps this is, direct or mirrored, is not known from the blocks.
    """

    fmap: Float[Tensor, "K K"]
    quotient: QuotientMatch
    odd: OddMap
    scores: tuple[float, ...]
    synchronized: bool = False


def full_map_from_blocks(
    first: QuotientMatch,
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    parameters: MatchParameters,
) -> FullMap:
    """The odd block from orientation, joined with the even one; the full map refined. The best candidate is kept.

    One candidate is the even block as quotient ICP leaves it. The other is grown in the quotient first
    (:func:`sharpened`): better where few functions do not fix the map, worse where the two symmetries differ a little.
    Where neighbours contradict the odd block (:func:`_synchronized`), the map without it is a candidate, too.
    All are grown to a hundred functions. The commutator alone prefers smooth maps that stretch a limb, distances alone
    prefer rough ones; their product chose rightly on nearly all pairs of TOSCA's tuning classes.

    Args:
        first: the even block at ``parameters.k``.
        x: source, consistently oriented.
        y: target, likewise.
        known_x: one reflection.
        known_y: one reflection.
        parameters: ``k_quotient``, ``k_max``, ``growth``, ``n_samples``, ``local_weight`` are used.
    """
    even_blocks = [first]
    places, weights = None, None
    if parameters.refinement == "upsample":
        beside: list[Callable[[], Any]] = [partial(pair_places, x, y, parameters), partial(sample_weights, x, known_x)]
        places, weights = in_parallel(beside)
    if places is not None and min(parameters.k_quotient, parameters.k_max) > parameters.k:
        even_blocks.append(sharpened(first, x, y, known_x, known_y, parameters, places))

    def maps_of(block: QuotientMatch) -> tuple[FullMap, FullMap | None]:
        odd = solve_odd(
            x.mesh, y.mesh, block.source.even, block.target.even, block.fmap, block.source.odd, block.target.odd
        )
        one = FullMap(join_blocks(block.source, block.target, block.fmap, odd.fmap), block, odd, ())
        return one, None if weights is None else _synchronized(one, x, y, known_x, known_y, weights)

    both = in_parallel([partial(maps_of, block) for block in even_blocks])
    found = [one for one, _ in both] + [more for _, more in both if more is not None]
    if places is None or len(found) == 1:
        return replace(found[0], fmap=refine_fmap(found[0].fmap, x, y, parameters, places))
    few = places[0].fewer(1000, 3000), places[1].fewer(1000, 3000)
    smaller = parameters.changed(k_max=max(parameters.k, min(K_CHOICE, parameters.k_max)))

    def grown(fmap: Tensor) -> tuple[Tensor, float]:
        larger = refine_fmap(fmap, x, y, smaller, few)
        return larger, _score(larger, x, y)

    pairs = in_parallel([partial(grown, f.fmap) for f in found])
    found = [replace(f, fmap=larger) for f, (larger, _) in zip(found, pairs, strict=True)]
    scores = tuple(score for _, score in pairs)
    best = found[min(range(len(found)), key=lambda i: scores[i] / (CLEARLY if found[i].synchronized else 1))]
    return replace(best, fmap=refine_fmap(best.fmap, x, y, parameters, places), scores=scores)


def _score(fmap: Float[Tensor, "K K"], x: PreparedShape, y: PreparedShape) -> float:
    k_y, k_x = fmap.shape
    return commutator_norm(fmap, x.basis.evals[:k_x], y.basis.evals[:k_y]) * distance_change(fmap, x, y)


def _synchronized(
    full: FullMap,
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    weights: Float[Tensor, "S S"],
) -> FullMap | None:
    """The map whose halves are chosen by neighbours, if the odd block chose otherwise on a tenth of the shape."""
    halves = synchronized_halves(full.quotient, x, y, known_x, known_y, weights)
    source, target = full.quotient.source.full, full.quotient.target.full
    at_x = source.evecs[halves.samples]
    both = torch.stack([halves.images, known_y.group.maps[1][halves.images]])
    gaps = (target.evecs[both] - at_x @ full.fmap.T).square().sum(2)
    if halves.agreement(both.gather(0, gaps.argmin(0)[None])[0]) > AGREEMENT:
        return None
    fmap = nearest_isometry(target.evecs[halves.images].T @ at_x)
    return replace(full, fmap=fmap, synchronized=True)


def sharpened(
    first: QuotientMatch,
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    parameters: MatchParameters,
    places: tuple[Places, Places],
) -> QuotientMatch:
    """The even block grown to the symmetric among ``k_quotient`` functions, without the odd ones.

    Symmetric functions are the same on both halves: half of the points and of the coordinates are searched, those of
    one fundamental domain. It begins at the least-squares map, not at what quotient ICP made of it.

    Args:
        first: the even block at ``parameters.k``.
        x: source.
        y: target.
        known_x: one reflection.
        known_y: one reflection.
        parameters: ``k_quotient``, ``growth``, ``local_weight`` are used.
        places: points of the two shapes with features (:func:`torchqm.matching.quotient.pair_places`).

    References:
        Paper, section 4.4: a fundamental domain of the quotient is enough.
    """
    k = basis_size([x.basis, y.basis], min(parameters.k_quotient, parameters.k_max))
    source, target = split_bases(x, y, k, known_x.group, known_y.group)
    places_x, places_y = _half(places[0], known_x), _half(places[1], known_y)
    size = (first.fmap.shape[0], first.fmap.shape[1])
    fmap = two_way_upsample(
        first.initial,
        first.source.even,
        first.target.even,
        places_x,
        places_y,
        [size] * FIRST_STEPS,
        parameters.local_weight,
    )
    fmap = nearest_isometry(_handed_over(first.target, target) @ fmap @ _handed_over(first.source, source).T)
    sizes = growing_pairs((fmap.shape[0], fmap.shape[1]), (target.even.k, source.even.k), parameters.growth)
    fmap = two_way_upsample(fmap, source.even, target.even, places_x, places_y, sizes, parameters.local_weight)
    return QuotientMatch(source, target, fmap, first.time)


def _half(places: Places, known: KnownSymmetry) -> Places:
    """The places in one half of the shape, its boundary included; all of them if left and right are not known."""
    return places.inside(known.sign >= 0)


def _handed_over(small: EvenOddBasis, large: EvenOddBasis) -> Float[Tensor, "K K"]:
    """Even functions of a smaller basis written in the first even functions of a larger one."""
    n = min(small.even.k, large.even.k)
    return large.even_coeffs[: small.full.k, :n].T @ small.even_coeffs
