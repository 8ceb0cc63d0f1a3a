"""From single self-maps to the group that they make."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p
from torchqm.fmap.refine import nearest_isometry
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.proposals import CHOICE, Judge, Proposal, correlation, grown, regrown
from torchqm.matching.quality import torn_length
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.algebra import group_fault

__all__ = ["FunctionalGroup", "assemble", "synchronized"]

ALIKE = 0.6
"""Correlation above which a product is taken for an element; those of different elements are 0.4 at most."""

MOST = 48
"""Elements of the largest group that is put together: that of the cube."""

LIMIT, LIMIT_TORN, TORN = 0.14, 0.125, 0.045
"""Largest score of an element after the first one; largest mean of scores with torn edges; what torn edges of length 1
(sqrt(area)) count. The elements of posed octopuses and ellipsoids have 0.03 to 0.12 in all, the front-to-back maps of a
biped 0.12 to 0.25."""


@dataclass(frozen=True, eq=False)
class FunctionalGroup:
    """Self-maps that are closed under composition.

    Args:
        elements: the identity first.
        products: ``(G, G)`` which element is nearest to ``C_g C_h``.
        tried: how many further maps were tried as generators and refused.
    """

    elements: tuple[Proposal, ...]
    products: Int[Tensor, "G G"]
    tried: int = 0

    @property
    def order(self) -> int:
        """Number of elements."""
        return len(self.elements)


def assemble(pool: Sequence[Proposal], judge: Judge, parameters: MatchParameters) -> FunctionalGroup:
    """The group that good self-maps generate.

    The best map comes first, with its powers. Each further one is taken in if all the products that it makes with those
    that are there are good maps, too (after refinement), and their number stays finite. A map that mirrors the arms and
    leaves the legs may be good enough by itself; its product with the true reflection, which mirrors the legs alone, is
    not, or the two are a group indeed.

    A map is good if its score is at most :data:`LIMIT` and 3.5 times the best one (or 0.03); and the new elements
    together, made consistent with each other, must not exceed :data:`LIMIT_TORN` on average when torn edges
    (:func:`torchqm.matching.quality.torn_length`) are added.

    Args:
        pool: different self-maps, the best first.
        judge: of the shape.
        parameters: of the refinement.
    """
    limit = min(LIMIT, max(0.03, 3.5 * min(p.score for p in pool)))
    one = torch.eye(pool[0].fmap.shape[0], dtype=pool[0].fmap.dtype)
    group = FunctionalGroup((Proposal(one, 1, True, 0.0),), torch.zeros(1, 1, dtype=torch.int64))
    refused = 0
    for new in pool:
        first = group.order == 1
        if not first and new.score > limit:
            continue  # the pool is not in the order of scores alone
        if any(correlation(new.fmap, g.fmap) > ALIKE for g in group.elements):
            continue
        larger = _closed([*group.elements, new], pool, judge, parameters, max(limit, pool[0].score))
        if larger is not None and (first or _whole(larger, group.order, judge.x)):
            group = larger
        else:
            refused += 1
    return replace(group, tried=refused)


def _whole(group: FunctionalGroup, old: int, x: PreparedShape) -> bool:
    """Whether the elements from number ``old`` on are whole, taken together."""
    totals = []
    for element in group.elements[old:]:
        basis = x.basis.truncate(element.fmap.shape[0])
        p2p = fmap_to_p2p(element.fmap, basis, basis, search=x.search, guide=x.search)
        totals.append(element.score + TORN * torn_length(x.mesh, p2p))
    return sum(totals) <= LIMIT_TORN * len(totals)


def _closed(
    group: list[Proposal], pool: Sequence[Proposal], judge: Judge, parameters: MatchParameters, limit: float
) -> FunctionalGroup | None:
    """All products of some maps, made consistent; None if one of them is no symmetry, or there are too many."""
    group = list(group)
    pending = [(a, b) for a in range(1, len(group)) for b in range(1, len(group))]
    while pending:
        a, b = pending.pop(0)
        product = group[a].fmap @ group[b].fmap
        if max(correlation(product, g.fmap) for g in group) > ALIKE:
            continue
        known = max(pool, key=lambda p: correlation(product, p.fmap))
        if correlation(product, known.fmap) <= ALIKE:
            known = _refined(product, group[a].orientation * group[b].orientation, judge, parameters)
        if known.score > limit or len(group) == MOST:
            return None
        n = len(group)
        group.append(known)
        pending += [(i, n) for i in range(1, n + 1)] + [(n, i) for i in range(1, n)]
    products = _products(torch.stack([g.fmap for g in group]))
    if group_fault(products) is not None:
        return None
    found = synchronized(FunctionalGroup(tuple(group), products))
    scored = [replace(e, score=judge.score(e.fmap, e.orientation)) for e in found.elements[1:]]
    return replace(found, elements=(found.elements[0], *scored))


def _refined(fmap: Tensor, orientation: int, judge: Judge, parameters: MatchParameters) -> Proposal:
    twice = correlation(fmap @ fmap, torch.eye(len(fmap), dtype=fmap.dtype))
    start = Proposal(fmap[:60, :60], orientation, twice > ALIKE)
    return regrown(grown(start, judge, parameters, CHOICE, 1000, 3000), judge, parameters)


def _products(maps: Float[Tensor, "G K K"]) -> Int[Tensor, "G G"]:
    pairs = torch.einsum("gij,hjk->ghik", maps, maps)
    return torch.einsum("ghik,eik->ghe", pairs, maps).argmax(2)


def synchronized(group: FunctionalGroup) -> FunctionalGroup:
    """Each element replaced by the isometry nearest to the mean of all the products that should equal it.

    Errors of single maps average out, and the table of products holds more exactly.
    """
    maps = torch.stack([e.fmap for e in group.elements])
    means = torch.zeros_like(maps)
    for g in range(group.order):
        for h in range(group.order):
            means[group.products[g, h]] += maps[g] @ maps[h]
    elements = [group.elements[0]]
    elements += [replace(e, fmap=nearest_isometry(m)) for e, m in zip(group.elements[1:], means[1:], strict=True)]
    return FunctionalGroup(tuple(elements), group.products, group.tried)
