"""Refinement that looks for partners both ways, and wants them to look alike: less drift than spectral upsampling."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.fmap.nearest import nearest_rows
from torchqm.fmap.refine import FMap, growing_sizes, nearest_isometry
from torchqm.fmap.threads import in_parallel
from torchqm.spectral.basis import SpectralBasis

__all__ = ["Places", "growing_pairs", "two_way_upsample"]


@dataclass(frozen=True, eq=False)
class Places:
    """Points of a shape that take part in a two-way search, and what they look like.

    Args:
        ids: ``(S,)`` vertex ids, drawn by area: any first part is a sample, too.
        features: ``(S, D)`` coordinates that are close where two shapes look alike; D = 0 leaves them out.
        n_queries: the first so many look for a partner; all of them are looked at.

    Raises:
        ValueError: numbers of ids and features differ.
    """

    ids: Int[Tensor, " S"]
    features: Float[Tensor, "S D"]
    n_queries: int

    def __post_init__(self) -> None:
        if len(self.ids) != len(self.features):
            raise ValueError(f"{len(self.ids)} ids, but features of {len(self.features)} points")

    def fewer(self, n_queries: int, n_points: int) -> "Places":
        """The first of them."""
        return Places(self.ids[:n_points], self.features[:n_points], min(n_queries, n_points, self.n_queries))

    def inside(self, region: Bool[Tensor, " V"]) -> "Places":
        """Those in a region of the shape, such as one fundamental domain; as many queries as before, if it has them."""
        kept = region[self.ids]
        return Places(self.ids[kept], self.features[kept], min(self.n_queries, int(kept.sum())))


def two_way_upsample(
    fmap_xy: FMap,
    basis_x: SpectralBasis,
    basis_y: SpectralBasis,
    places_x: Places,
    places_y: Places,
    sizes: Sequence[tuple[int, int]],
    weight: float = 2.0,
    project: Callable[[Tensor], Tensor] = nearest_isometry,
    back: bool = True,
) -> Float[Tensor, "Ly Lx"]:
    """Spectral upsampling with partners of x on y and of y on x, near in spectral coordinates and alike in features.

    With ``C`` between the first m functions, the partner of x is ``argmin_y || C phi(x) - phi(y) ||^2 + w^2 m || d(x) -
    d(y) ||^2``, that of y is found with ``C^T``; the next map is the isometry nearest to the sum of both correspondence
    matrices in more functions. Commutativity alone has many fixed points near the true map of a real pose, and one-way
    upsampling stops at one of them even if it begins at the truth; features hold it in its place.

    Args:
        fmap_xy: initial map between the first functions of the bases.
        basis_x: basis of x, full or even.
        basis_y: basis of y, likewise.
        places_x: points of x, with features of root mean square length 1.
        places_y: points of y.
        sizes: functions of y and of x, one pair after the other.
        weight: w; 0 leaves the features out.
        project: what is made of the correspondence matrix at each step.
        back: whether the points of y look for partners, too; of an involution they would find the same ones.

    Returns:
        The map at the last size.

    Raises:
        ValueError: a size that a basis does not have, or a negative weight.

    References:
        Melzi et al. 2019 for the growing basis; Ren et al. 2018, section 5.1 for searching both ways.
    """
    if weight < 0:
        raise ValueError(f"weight={weight}: must not be negative")
    for size_y, size_x in sizes:
        if size_y > basis_y.k or size_x > basis_x.k:
            raise ValueError(f"sizes ({size_y}, {size_x}): the bases have {basis_y.k} and {basis_x.k} functions")
    x, y = (_Side(basis.evecs[p.ids], p) for basis, p in ((basis_x, places_x), (basis_y, places_y)))
    for size_y, size_x in sizes:
        scale = weight * fmap_xy.shape[0] ** 0.5
        ways = [partial(_correspondence, x, y, fmap_xy, (size_y, size_x), scale)]
        if back:
            ways.append(partial(_correspondence, y, x, fmap_xy.T, (size_x, size_y), scale))
        forth, *more = in_parallel(ways)
        fmap_xy = project(forth + more[0].T if more else forth)
    return fmap_xy


class _Side(NamedTuple):
    """What a search needs of a shape: ``(S, K)`` functions at its places, and these."""

    evecs: Float[Tensor, "S K"]
    places: Places


def _correspondence(
    here: _Side, there: _Side, fmap: Float[Tensor, "Kt Kh"], size: tuple[int, int], scale: float
) -> Float[Tensor, "Lt Lh"]:
    """Mean of ``phi(T(x)) phi(x)^T`` in ``size`` functions of either side, T found with a map from here to there."""
    (k_there, k_here), n = fmap.shape, here.places.n_queries
    images = torch.cat([here.evecs[:n, :k_here] @ fmap.T, scale * here.places.features[:n]], 1)
    points = torch.cat([there.evecs[:, :k_there], scale * there.places.features], 1)
    partners = nearest_rows(images, points, exact=False)
    halves = zip(partners.chunk(2), here.evecs[:n].chunk(2), strict=True)
    products = [partial(_product, there.evecs, ids, rows, size) for ids, rows in halves]
    return torch.stack(in_parallel(products)).sum(0) / n


def _product(evecs: Tensor, ids: Tensor, rows: Tensor, size: tuple[int, int]) -> Tensor:
    return evecs[ids, : size[0]].T @ rows[:, : size[1]]


def growing_pairs(start: tuple[int, int], stop: tuple[int, int], ratio: float = 1.2) -> list[tuple[int, int]]:
    """:func:`torchqm.fmap.refine.growing_sizes` for two bases at once, each as far as it goes.

    Example:
        >>> growing_pairs((10, 12), (20, 15), 1.5)
        [(15, 15), (20, 15)]
    """
    one, other = (growing_sizes(a, b, ratio) or [b] for a, b in zip(start, stop, strict=True))
    length = max(len(one), len(other))
    if start == stop:
        return []
    one, other = (s + [s[-1]] * (length - len(s)) for s in (one, other))
    return list(zip(one, other, strict=True))
