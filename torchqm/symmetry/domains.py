"""Fundamental domains of a group acting on a shape (paper, section 4.4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.symmetry.algebra import group_fault
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["FundamentalDomains", "fundamental_domains"]

ROUNDING = 1e-9
"""Distances this close, in units of the distances between images, are ties."""


@dataclass(frozen=True, eq=False)
class FundamentalDomains:
    """A decomposition of a shape into the images of one fundamental domain under the elements of its group.

    Args:
        element: ``(V,)`` int64; vertex x lies in the image of the first domain under element ``element[x]``.
        start: the vertex whose images are the centres of the domains; it lies in domain 0 where the group is exact.
        centres: ``(G,)`` its images.
        separation: smallest distance between two of the centres (unit of the points; infinite for one centre).
        shares: ``(G,)`` area of each domain as a part of the whole, where vertices on a boundary count in equal parts
            to the domains that meet there; all are 1 / |G| for an exact symmetry.
        boundary: ``(V,)`` whether a vertex is equally near to several centres; ``element`` names the lowest of them.
    """

    element: Int[Tensor, " V"]
    start: int
    centres: Int[Tensor, " G"]
    separation: float
    shares: Float[Tensor, " G"]
    boundary: Bool[Tensor, " V"]

    @property
    def imbalance(self) -> float:
        """Largest relative deviation of an area share from 1 / |G|."""
        return float((self.shares * self.shares.shape[0] - 1).abs().max())


def fundamental_domains(
    group: SymmetryGroup,
    points: Float[Tensor, "V D"],
    weights: Float[Tensor, " V"],
    start: int | None = None,
    products: Int[Tensor, "G G"] | None = None,
) -> FundamentalDomains:
    """Dirichlet domains of an orbit: each vertex belongs to the image of ``start`` that is nearest to it.

    With ``s_g = g(start)`` the domain of g is ``{x : |x - s_g| <= |x - s_h| for all h}``, or, what is the same for
    isometries, but keeps a bent shape's domains images of each other, the x for which

        ``mean_h |h(x) - s_(h o g)|^2``  is smallest.

    Then ``g(D_0) = D_g`` as far as the maps are a group, and the domains cover the shape and overlap in their
    boundaries only. A vertex on a boundary (one that some element keeps, say) goes to the lowest of its elements.

    Args:
        group: the symmetries.
        points: ``(V, D)`` positions in which the symmetries are isometries: of vertices if they are rigid, else
            spectral coordinates; ``evecs / evals`` without the constant one gave the domains with the fewest islands.
        weights: ``(V,)`` areas; vertices without one are never chosen as ``start``.
        start: a vertex that no element but the identity keeps. If not given: the one whose images are farthest apart
            (their smallest distance is the largest), the first of those that are equal up to rounding.
        products: ``(G, G)`` index of ``g o h``; measured in the points if not given.

    Returns:
        The domain of each vertex, with area shares by which to judge them.

    Raises:
        ValueError: numbers of vertices or elements differ, no weight is positive, the products are no group, ``start``
            is no vertex, or two images of ``start`` (of every vertex, if it is not given) lie in the same place.

    Example:
        >>> line = torch.tensor([[-2.0], [-1.0], [0.0], [1.0], [2.0]])
        >>> mirror = SymmetryGroup.from_reflection(torch.tensor([4, 3, 2, 1, 0]))
        >>> found = fundamental_domains(mirror, line, torch.tensor([0.5, 1.0, 1.0, 1.0, 0.5]))
        >>> found.element.tolist(), found.start, found.separation
        ([0, 0, 0, 1, 1], 0, 4.0)

    References:
        Paper, section 4.4 (the decomposition into fundamental domains, used there for one reflection).
    """
    n = group.n_verts
    if points.shape[0] != n or weights.shape[0] != n:
        raise ValueError(f"{points.shape[0]} points and {weights.shape[0]} weights, but the group acts on {n} vertices")
    if not bool((weights > 0).any()):
        raise ValueError("weights: none is positive")
    if start is not None and not 0 <= start < n:
        raise ValueError(f"start is {start}, allowed are 0 to {n - 1}")
    if products is None:
        products = group.residuals(points, weights).products
    fault = group_fault(products)
    if fault is None and products.shape[0] != group.order:
        fault = f"it has {products.shape[0]} elements, the symmetry {group.order}"
    if fault is not None:
        raise ValueError(f"products: the table does not belong to the group: {fault}")
    points = points.double() - points.double().mean(0)
    if start is None:
        start, separation = _most_generic(group, points, (weights > 0).nonzero()[:, 0])
    else:
        separation = float(_separations(points[group.orbits[start]][None])[0])
    if group.order > 1 and separation <= ROUNDING * float(points.abs().max()):
        raise ValueError(
            f"two elements send vertex {start} to the same place (and every other one, if start was not given), so "
            f"there is no domain for each of the {group.order} elements"
        )
    centres = group.orbits[start]
    # h runs over all elements, and so does h o g: of the squared distances only the inner products depend on g.
    score = torch.zeros(n, group.order, dtype=points.dtype)
    for element, row in zip(group.maps, products, strict=True):
        score += points[element] @ points[centres[row]].T / group.order
    slack = ROUNDING * separation**2 if group.order > 1 else 0.0
    nearest = score >= score.amax(1, keepdim=True) - slack
    ways = nearest.sum(1)
    shares = (weights / ways) @ nearest.to(weights.dtype) / weights.sum()
    return FundamentalDomains(nearest.int().argmax(1), start, centres, separation, shares, ways > 1)


def _separations(orbits: Tensor) -> Tensor:
    """Smallest distance within each of some orbits ``(S, G, D)``; infinite if they have one point."""
    gaps = torch.cdist(orbits, orbits, compute_mode="donot_use_mm_for_euclid_dist")
    return (gaps + torch.diag(torch.full(gaps.shape[1:2], torch.inf, dtype=gaps.dtype))).amin((1, 2))


def _most_generic(group: SymmetryGroup, points: Tensor, allowed: Tensor, block: int = 256) -> tuple[int, float]:
    """The vertex whose images are farthest apart, and their smallest distance.

    The distances of a vertex from its own images bound this from above (and are equal to it where the group is exact),
    so vertices are looked at in descending order of the bound and only as long as it can still win.
    """
    bound = torch.full(allowed.shape, torch.inf, dtype=points.dtype)
    for element in group.maps[1:]:
        bound = torch.minimum(bound, (points[element[allowed]] - points[allowed]).norm(dim=1))
    ranking = torch.argsort(bound, descending=True, stable=True)
    exact = torch.full_like(bound, -1.0)
    best = -1.0
    for ids in ranking.split(block):
        if float(bound[ids[0]]) < best * (1 - ROUNDING):
            break
        exact[ids] = _separations(points[group.orbits[allowed[ids]]])
        best = max(best, float(exact[ids].max()))
    winner = int((exact >= best * (1 - ROUNDING)).int().argmax())
    return int(allowed[winner]), float(exact[winner])
