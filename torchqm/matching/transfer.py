"""Symmetry transfer: from a reference shape with a known reflection to another pose of it (paper, section 6.1)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.convert import fmap_to_p2p
from torchqm.fmap.refine import growing_sizes, upsample
from torchqm.fmap.threads import in_parallel
from torchqm.matching.described import pair_descriptors
from torchqm.matching.odd import OddMap, join_blocks, solve_odd
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.quotient import pair_places
from torchqm.matching.self_map import (
    K_CHOICE,
    best_self_map,
    conjugate_reflection,
    self_maps_from_halves,
    settled_self_map,
)
from torchqm.matching.semi_quotient import SemiQuotientMatch, match_semi_quotient, pull_back, sharpen_orbit_map
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.group import SymmetryGroup
from torchqm.symmetry.leftright import LeftRight, displacement, persistence_clusters

__all__ = [
    "SymmetryTransfer",
    "halves_by_clustering",
    "halves_by_full_map",
    "transfer_symmetry",
]


@dataclass(frozen=True, eq=False)
class SymmetryTransfer:
    """The symmetry of a shape as it came over from a reference.

    Args:
        group: ``{id, S}`` of the source, as vertex maps.
        sign: ``(V,)`` its left-right map: -1, +1, 0 where undecided.
        fmap: ``(k, k)`` the functional map of S in the source's first k eigenfunctions.
        semi: the semi-quotient match that it came from.
        halves: the clustering, if that was the way.
        odd: the odd block of the map to the reference, if that was the way.
        scores: :attr:`torchqm.matching.self_map.SelfMap.scores` of the candidates: the reference's own reflection seen
            from here (``full_map`` only), then one for each of ``parameters.self_commutativity``.
        warnings: assumptions that did not hold, with numbers.
    """

    group: SymmetryGroup
    sign: Float[Tensor, " V"]
    fmap: Float[Tensor, "K K"]
    semi: SemiQuotientMatch
    halves: LeftRight | None = None
    odd: OddMap | None = None
    scores: tuple[float, ...] = ()
    warnings: list[str] = field(default_factory=list)


def transfer_symmetry(
    x: PreparedShape,
    y: PreparedShape,
    group_y: SymmetryGroup,
    side_y: Float[Tensor, " Vy"],
    parameters: MatchParameters,
    way: str = "full_map",
    distance: str = "intrinsic",
) -> SymmetryTransfer:
    """Semi-quotient match to the reference, left and right of the source, self-map of the source.

    Args:
        x: the shape whose symmetry is wanted.
        y: the reference.
        group_y: its reflection, ``{id, S}``.
        side_y: a function of opposite signs left and right on the reference, such as the distance from its plane.
        parameters: of the matching.
        way: how left and right are found: ``clustering`` (the paper's, :func:`halves_by_clustering`) or ``full_map``
            (:func:`halves_by_full_map`, which measures better and also knows direct from mirrored).
        distance: for ``clustering``: ``intrinsic`` or ``extrinsic``.

    Raises:
        ValueError: the group is not one reflection, or an unknown ``way``.

    References:
        Paper, section 6.1.
    """
    if group_y.order != 2:
        raise ValueError(f"group_y has {group_y.order} elements: symmetry transfer needs one reflection, {{id, S}}")
    semi = match_semi_quotient(x, y, group_y, parameters)
    halves, odd, more = None, None, []
    warnings: list[str] = []
    if way == "clustering":
        phi = displacement(y.mesh, group_y.maps[1], distance, side_y)
        halves = halves_by_clustering(x, y, group_y, phi, semi, parameters)
        sign = halves.sign
        warnings += [halves.warning] if halves.warning else []
    elif way == "full_map":
        sign, odd, full = halves_by_full_map(x, y, side_y, semi, parameters)
        more = [conjugate_reflection(full, group_y, y)]
        if not odd.separated:
            warnings.append(
                f"left and right could not be told apart clearly (residuals {odd.residual_direct:.2f} for the direct "
                f"and {odd.residual_mirrored:.2f} for the mirrored map to the reference; 1.5 times is clear)"
            )
    else:
        raise ValueError(f"way={way!r}: allowed are 'clustering' and 'full_map'")
    candidates = [*more, *self_maps_from_halves(x, sign, parameters, pair_descriptors(x, y, parameters))]
    settle = way == "full_map" and parameters.refinement == "upsample" and parameters.local_weight > 0
    at_choice = parameters.changed(k_max=max(parameters.k, min(K_CHOICE, parameters.k_max)))
    choose = partial(best_self_map, candidates, x, at_choice if settle else parameters, witness=0 if more else None)
    if settle:  # local features would flatter the candidates; one that is chosen they hold in its place
        beside: list[Callable[[], Any]] = [choose, partial(pair_places, x, x, parameters)]
        found, (places, _) = in_parallel(beside)
        fmap = settled_self_map(found.fmap, x, parameters, places)
    else:
        found = choose()
        fmap = found.fmap
    basis = x.basis.truncate(fmap.shape[0])
    group = SymmetryGroup.from_reflection(fmap_to_p2p(fmap, basis, basis, search=x.search, guide=x.search))
    moved = float(((sign != sign[group.maps[1]]) * x.mesh.vertex_areas).sum())
    if moved < 0.7:
        warnings.append(
            f"the transferred symmetry sends only {moved:.0%} of the area to the other side (nearly all is expected)"
        )
    return SymmetryTransfer(group, sign, fmap, semi, halves, odd, found.scores, warnings)


def halves_by_clustering(
    x: PreparedShape,
    y: PreparedShape,
    group_y: SymmetryGroup,
    phi: Float[Tensor, " Vy"],
    semi: SemiQuotientMatch,
    parameters: MatchParameters,
    k_sharp: int = 100,
) -> LeftRight:
    """The paper's way: pull ``phi(y) = d(y, S(y))`` back along the point-to-orbit map and cut the result in two.

    Args:
        x: the shape.
        y: the reference.
        group_y: its reflection.
        phi: ``(Vy,)`` its displacement function.
        semi: the semi-quotient match.
        parameters: of the matching.
        k_sharp: functions in which the point-to-orbit map is refined before it pulls anything back; at
            ``parameters.k`` it stays as it is, and on animals the clustering then fails
            (:func:`torchqm.fmap.refine.semi_upsample`).

    References:
        Paper, section 6.1, steps 1 to 3.
    """
    orbit_map = semi.orbit_map
    if k_sharp > parameters.k:
        orbit_map = sharpen_orbit_map(semi, x, y, group_y, parameters, k_sharp)
    return persistence_clusters(x.mesh, pull_back(phi[:, None], orbit_map)[:, 0])


def halves_by_full_map(
    x: PreparedShape,
    y: PreparedShape,
    side_y: Float[Tensor, " Vy"],
    semi: SemiQuotientMatch,
    parameters: MatchParameters,
    k_sharp: int = 100,
) -> tuple[Float[Tensor, " Vx"], OddMap, Float[Tensor, "K K"]]:
    """Through the full map to the reference: the kernel of the semi-quotient map is L2- of the source.

    With both halves of the source's basis the odd block can be solved for (:func:`torchqm.matching.odd.solve_odd`); the
    two blocks make a full map, which is upsampled and brings left and right over as a function. No clustering is
    needed.

    Returns:
        ``(Vx,)`` signs, the odd block with its residuals, and the full map.
    """
    in_parallel([lambda: semi.source.even, lambda: semi.source.odd, lambda: semi.target.odd])
    odd = solve_odd(x.mesh, y.mesh, semi.source.even, semi.target.even, semi.even, semi.source.odd, semi.target.odd)
    fmap = join_blocks(semi.source, semi.target, semi.even, odd.fmap)
    k = min(max(k_sharp, parameters.k), x.basis.k, y.basis.k)
    samples = x.samples[: parameters.n_samples]
    if k > fmap.shape[0]:
        sizes = growing_sizes(fmap.shape[0], k, parameters.growth)
        fmap = upsample(fmap, x.basis, y.basis.restricted(y.anchors), samples, sizes)
    # The sign as a function, not point by point: as right within 1.5 % of the area on every
    # tuning shape of TOSCA, and no dense search is needed.
    coeffs = y.basis.truncate(fmap.shape[0]).coefficients(torch.sign(side_y)[:, None])
    values = (x.basis.evecs[:, : fmap.shape[0]] @ (fmap.T @ coeffs))[:, 0]
    return torch.where(values.abs() > 1e-6 * values.abs().max(), torch.sign(values), 0.0), odd, fmap
