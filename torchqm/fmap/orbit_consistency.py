"""Orbit consistency: a map must carry the symmetries of one shape to those of the other. No truth is needed."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import Sizes, enabled, require_finite, require_ids, require_mask, require_nonnegative
from torchqm.fmap.orbit_terms import rows_at
from torchqm.fmap.orbit_truth import soft_minimum
from torchqm.fmap.tables import check_group, require_weights
from torchqm.spectral.soft_map import SoftMap
from torchqm.symmetry.algebra import inverses

__all__ = ["inner_pairings", "orbit_consistency_fmap", "orbit_consistency_points"]


def inner_pairings(products: Int[Tensor, "G G"]) -> Int[Tensor, "A G"]:
    """The different maps ``g -> h^-1 o g o h`` of a group to itself, as rows of element ids; row 0 the identity.

    If ``T o g_x = g_y o T`` for all g, another true map ``T' = h_y o T`` fulfils the same with ``h g h^-1`` in place of
    ``g`` on y. So these are the pairings under which all true maps are consistent; of a commutative group it is one.

    Args:
        products: ``(G, G)`` index of ``g o h`` (:class:`torchqm.symmetry.GroupResiduals`).

    Raises:
        ValueError: the table is no group.

    Example:
        >>> inner_pairings(torch.tensor([[0, 1], [1, 0]])).tolist()
        [[0, 1]]
    """
    inverse = inverses(products)
    rows = [products[inverse[h], products[:, h]] for h in range(products.shape[0])]
    different = list(dict.fromkeys(tuple(row.tolist()) for row in rows))
    return torch.tensor(different, dtype=products.dtype, device=products.device)


def orbit_consistency_fmap(
    fmap_xy: Float[Tensor, "*B Ky Kx"],
    symmetry_x: Float[Tensor, "*B G Kx Kx"],
    symmetry_y: Float[Tensor, "*B G Ky Ky"],
    group_mask: Bool[Tensor, "*B G"] | None = None,
    pairings: Int[Tensor, "A G"] | None = None,
    temperature: float = 0.0,
    names: Sequence[str] = ("fmap_xy", "symmetry_x", "symmetry_y"),
) -> Float[Tensor, "*B"]:
    """``mean_g || C S_x^g - S_y^g C ||^2``: the map carries the symmetries of x to those of y.

    ``S_x^g (Kx, Kx)`` takes functions on x to functions on x, C those on x to those on y. With C the pull-back along
    ``T: y -> x`` and S the pull-backs along ``g_x`` and ``g_y`` (both, or both along the inverses), the norm vanishes
    where ``g_x o T = T o g_y``.

    Element g of x is compared with element g of y: the two tables must be in corresponding order. That order is not
    unique where the group is not commutative: of the true maps ``T o h_y`` only those with h in the centre have loss
    0. With ``pairings`` from :func:`inner_pairings` *all* of them have. Where the two tables were found independently,
    outer automorphisms of the group must be among the pairings, too.

    Args:
        fmap_xy: ``(..., Ky, Kx)`` takes functions on x to functions on y.
        symmetry_x: ``(..., G, Kx, Kx)`` functional maps of the symmetries of x.
        symmetry_y: ``(..., G, Ky, Ky)`` those of y.
        group_mask: ``(..., G)`` real elements (every pairing must keep padded ones in place).
        pairings: ``(A, G)`` rows of element ids: element g of x goes with ``pairings[a, g]`` of y; the loss is the
            minimum over a.
        temperature: of that minimum (:func:`~torchqm.fmap.orbit_truth.soft_minimum`); 0: the minimum itself.
        names: what the first three are called in messages.

    Returns:
        ``(...)`` one value for each pair.

    Raises:
        ValueError: shapes do not fit, something is not finite, or ids are out of range.

    Example:
        >>> flip = torch.stack([torch.eye(2), torch.diag(torch.tensor([1.0, -1.0]))])
        >>> swapped = torch.tensor([[0.0, 1.0], [1.0, 0.0]])
        >>> orbit_consistency_fmap(torch.eye(2), flip, flip).item(), orbit_consistency_fmap(swapped, flip, flip).item()
        (0.0, 4.0)
    """
    sizes = Sizes()
    given = ((fmap_xy, "... Ky Kx"), (symmetry_x, "... G Kx Kx"), (symmetry_y, "... G Ky Ky"))
    for name, (value, dims) in zip(names, given, strict=True):
        sizes.bind(name, value, dims)
        require_finite(name, value)
    if group_mask is not None:
        sizes.bind("group_mask", group_mask, "... G")
        require_mask("group_mask", group_mask)
    left, right = fmap_xy[..., None, :, :] @ symmetry_x, symmetry_y @ fmap_xy[..., None, :, :]
    return _best_pairing(left, right, None, group_mask, pairings, temperature)


def orbit_consistency_points(
    soft_xy: SoftMap | Float[Tensor, "*B X Y"],
    group_x: Int[Tensor, "*B G X"],
    group_y: Int[Tensor, "*B G Y"],
    values_y: Float[Tensor, "*B Y C"] | None = None,
    mass_x: Float[Tensor, "*B X"] | None = None,
    group_mask: Bool[Tensor, "*B G"] | None = None,
    pairings: Int[Tensor, "A G"] | None = None,
    temperature: float = 0.0,
    names: Sequence[str] = ("soft_xy", "group_x", "group_y"),
) -> Float[Tensor, "*B"]:
    """``mean_g sum_x a_x || (Pi f)(g_x(x)) - (Pi (f o g_y))(x) ||^2``: g_x(x) goes where g_y takes the image of x.

    Row x of Pi is a distribution over y; for a point map T the two terms are ``f(T(g_x(x)))`` and ``f(g_y(T(x)))``, so
    the loss vanishes where ``T o g_x = g_y o T``, and only there if the functions f tell the points of y apart
    (symmetric ones do not: give vertex positions, or a full spectral basis). Without ``values_y`` they are the
    indicators of all vertices, which gives ``|| Pi[g_x] - Pi P_g ||^2`` with ``P_g`` moving the weight of y to
    ``g_y(y)``; a miss by one vertex then costs as much as any other. What :func:`orbit_consistency_fmap` says about
    ``pairings`` holds here, too, for the true maps ``h_y o T``.

    Args:
        soft_xy: for each x weights over the vertices of y: dense ``(..., X, Y)``, or sparse (needs ``values_y``).
        group_x: ``(..., G, X)`` symmetries of x as vertex maps, row 0 the identity.
        group_y: ``(..., G, Y)`` symmetries of y, in corresponding order.
        values_y: ``(..., Y, C)`` functions on y.
        mass_x: ``(..., X)`` vertex areas of x, scaled to weights ``a_x`` (sum 1; padding 0); all equal if not given.
        group_mask: ``(..., G)`` real elements (every pairing must keep padded ones in place).
        pairings: ``(A, G)`` element g of x goes with ``pairings[a, g]`` of y; the loss is the minimum over a.
        temperature: of that minimum; 0: the minimum itself.
        names: what the first three are called in messages.

    Returns:
        ``(...)`` one value for each pair (square of the unit of ``values_y``).

    Raises:
        ValueError: shapes do not fit, ids are out of range, weights or areas are negative, or a sparse map comes
            without ``values_y``.

    Example:
        >>> mirror = torch.tensor([[0, 1, 2], [2, 1, 0]])
        >>> shift = torch.eye(3).roll(1, 1)
        >>> maps = (torch.eye(3), torch.eye(3).flip(0), shift)
        >>> [round(orbit_consistency_points(pi, mirror, mirror).item(), 3) for pi in maps]
        [0.0, 0.0, 1.0]
    """
    sizes = Sizes()
    if isinstance(soft_xy, SoftMap):
        if values_y is None:
            raise ValueError(f"values_y: must be given with a sparse {names[0]}")
        weights = soft_xy.weights
        sizes.bind(names[0], weights, "... X k")
        require_ids(names[0], soft_xy.indices, soft_xy.n_targets)
    else:
        weights = soft_xy
        sizes.bind(names[0], soft_xy, "... X Y")
    require_weights(names[0], weights)
    for name, group, dims in zip(names[1:], (group_x, group_y), ("... G X", "... G Y"), strict=True):
        sizes.bind(name, group, dims)
        check_group(name, group, group_mask)
    if mass_x is None:
        areas = torch.full_like(weights[..., 0], 1.0 / weights.shape[-2])
    else:
        sizes.bind("mass_x", mass_x, "... X")
        require_nonnegative("mass_x", mass_x)
        total = mass_x.sum(-1, keepdim=True)
        if enabled() and not bool((total > 0).all()):
            raise ValueError("mass_x: each shape needs a vertex of positive area")
        areas = mass_x / torch.where(total > 0, total, 1.0)
    if values_y is not None:
        sizes.bind("values_y", values_y, "... Y C")
        require_finite("values_y", values_y)
    left, right = [], []
    for g in range(sizes["G"]):
        to_x, to_y = group_x[..., g, :], group_y[..., g, :]
        if values_y is None:
            image = weights  # dense, as was checked
            moved = torch.zeros_like(image).scatter_add(-1, to_y[..., None, :].expand(image.shape), image)
        else:
            image, moved = _pulled(soft_xy, values_y), _pulled(soft_xy, rows_at(values_y, to_y))
        left.append(rows_at(image, to_x))
        right.append(moved)
    return _best_pairing(torch.stack(left, -3), torch.stack(right, -3), areas, group_mask, pairings, temperature)


def _best_pairing(
    left: Tensor,
    right: Tensor,
    areas: Tensor | None,
    group_mask: Tensor | None,
    pairings: Tensor | None,
    temperature: float,
) -> Tensor:
    order = left.shape[-3]
    if pairings is None:
        return _mean_gap(left, right, areas, group_mask)
    if pairings.ndim != 2 or pairings.shape[1] != order or not pairings.shape[0]:
        raise ValueError(f"pairings: shape {tuple(pairings.shape)} given, expected (A, {order}), a row a pairing")
    require_ids("pairings", pairings, order)
    losses = [_mean_gap(left, right.index_select(-3, row), areas, group_mask) for row in pairings.unbind(0)]
    return soft_minimum(torch.stack(losses, -1), temperature)


def _mean_gap(left: Tensor, right: Tensor, areas: Tensor | None, group_mask: Tensor | None) -> Tensor:
    gaps = (left - right).square().sum(-1)
    gaps = gaps.sum(-1) if areas is None else (gaps * areas[..., None, :]).sum(-1)
    if group_mask is None:
        return gaps.mean(-1)
    return (gaps * group_mask).sum(-1) / group_mask.sum(-1).clamp_min(1)


def _pulled(soft: SoftMap | Tensor, values: Tensor) -> Tensor:
    return soft.apply(values) if isinstance(soft, SoftMap) else soft @ values
