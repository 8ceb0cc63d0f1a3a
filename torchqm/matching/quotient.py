"""Quotient-space matching of two shapes with known symmetry (paper, section 4, Algorithm 1)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.convert import deltas, fmap_to_p2p, nearest_used
from torchqm.fmap.refine import correspondence_fmap, growing_sizes, quotient_icp, upsample
from torchqm.fmap.threads import in_parallel
from torchqm.fmap.two_way import Places, two_way_upsample
from torchqm.matching.described import pair_descriptors
from torchqm.matching.initial import basis_size, curvature_descriptors, fmap_from_coefficients, split_bases
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.shape import PreparedShape
from torchqm.spectral.features import local_features
from torchqm.symmetry.basis import EvenOddBasis
from torchqm.symmetry.group import SymmetryGroup

__all__ = [
    "QuotientMatch",
    "choose_halves",
    "dense_map",
    "match_quotient",
    "pair_places",
    "refine_by_icp",
    "refine_fmap",
]


@dataclass(frozen=True, eq=False)
class QuotientMatch:
    """The map between symmetric functions: the same for all the isometries between the shapes (paper, Lemma 3.2).

    Args:
        source: the source's basis, split.
        target: the target's basis, split.
        fmap: ``(K+_y, K+_x)`` the even block C+.
        time: diffusion time of the deltas.
        first: the least-squares map that ``fmap`` began at, if it is of the same size.
    """

    source: EvenOddBasis
    target: EvenOddBasis
    fmap: Float[Tensor, "Key Kex"]
    time: float = 0.0
    first: Float[Tensor, "Key Kex"] | None = None

    @property
    def initial(self) -> Float[Tensor, "Key Kex"]:
        """The map before quotient ICP."""
        return self.fmap if self.first is None else self.first

    def orbit_map(self, x: PreparedShape, y: PreparedShape) -> Int[Tensor, " Vx"]:
        """The point-to-orbit map: for each source vertex a target vertex whose *orbit* is the image (section 4.4).

        Which point of the orbit stands here is arbitrary, and neighbours may differ in it.
        """
        return fmap_to_p2p(self.fmap, self.source.even, self.target.even, self.time, y.search, x.search)

    def orbit_map_of(self, ids: Int[Tensor, " S"]) -> Int[Tensor, " S"]:
        """The same of some source vertices, compared with all target vertices."""
        images = deltas(self.source.even.restricted(ids), self.time) @ self.fmap.T
        return nearest_used(images, self.target.even, self.time, exact=False)  # the points of an orbit are equally near


def match_quotient(
    x: PreparedShape,
    y: PreparedShape,
    group_x: SymmetryGroup,
    group_y: SymmetryGroup,
    parameters: MatchParameters,
    k: int | None = None,
    values: tuple[Float[Tensor, "Vx C"], Float[Tensor, "Vy C"]] | None = None,
) -> QuotientMatch:
    """Algorithm 1 up to the point-to-orbit map: bases of L2+, descriptors, commutativity, least squares, quotient-ICP.

    Args:
        x: source.
        y: target.
        group_x: symmetry group of the source.
        group_y: symmetry group of the target.
        parameters: ``k``, descriptors, ``commutativity``, ``icp_steps``, ``time``, ``n_samples`` are used; with
            ``local_weight`` above 0 curvature is a descriptor, too.
        k: functions instead of ``parameters.k``: of a large group only few of these are symmetric.
        values: descriptors of both in the place of wave or heat kernel signatures.

    References:
        Paper, section 4.3 and 4.4.
    """
    k = basis_size([x.basis, y.basis], parameters.k if k is None else k)
    curved = parameters.local_weight > 0
    beside: list[Callable[[], Any]] = [partial(split_bases, x, y, k, group_x, group_y)]
    beside += [partial(curvature_descriptors, x, y)] if curved else []
    (source, target), *bends = in_parallel(beside)
    if values is None:
        described = pair_descriptors(x, y, parameters, k).coefficients
    else:
        described = source.full.coefficients(values[0]), target.full.coefficients(values[1])
    columns_x, columns_y = (s.even_coeffs.T @ c[:k] for s, c in zip((source, target), described, strict=True))
    more = None
    if curved:
        more = source.even.coefficients(bends[0][0]), target.even.coefficients(bends[0][1])
    first = fmap_from_coefficients(
        (columns_x, columns_y), source.even.evals, target.even.evals, parameters.commutativity, more
    )
    samples, among = x.samples[: parameters.n_samples], target.even.restricted(y.anchors)
    fmap = quotient_icp(
        first, source.even, among, samples, parameters.icp_steps, parameters.time, tolerance=parameters.icp_tolerance
    )
    return QuotientMatch(source, target, fmap, parameters.time, first)


def choose_halves(
    orbit_map: Int[Tensor, " Vx"],
    group_y: SymmetryGroup,
    sign_x: Float[Tensor, " Vx"],
    sign_y: Float[Tensor, " Vy"],
) -> Int[Tensor, " Vx"]:
    """From point-to-orbit to point-to-point: of the orbit of ``T(x)`` take the point in the half that belongs to x's.

    Vertices on an axis (sign 0), or whose orbit has no point in the wanted half, keep the point they have.

    Args:
        orbit_map: for each vertex of x a vertex of y.
        group_y: ``{id, S}`` of y.
        sign_x: left-right map of x, -1 and +1.
        sign_y: left-right map of y; swap its sign for the second consistent map.

    Raises:
        ValueError: the group has other than two elements; fundamental domains of more need more than a sign.

    References:
        Paper, section 4.4, fundamental domains; section 6.2, step 3.
    """
    if group_y.order != 2:
        raise ValueError(f"group_y has {group_y.order} elements; left and right are halves of a single reflection")
    other = group_y.maps[1][orbit_map]
    swap = (sign_y[orbit_map] != sign_x) & (sign_y[other] == sign_x) & (sign_x != 0)
    return torch.where(swap, other, orbit_map)


def refine_by_icp(
    p2p_xy: Int[Tensor, " Vx"], x: PreparedShape, y: PreparedShape, parameters: MatchParameters
) -> Float[Tensor, "K K"]:
    """The paper's last step: the point map as a functional map at k = 100, ICP there (5 steps) and at ``k_max`` (3).

    Smaller bases are used as far as ``k_max`` allows.

    References:
        Paper, section 7.4; Ovsjanikov et al. 2012, section 8.1.
    """
    k = min(100, parameters.k_max, x.basis.k, y.basis.k)
    samples = x.samples[: parameters.n_samples]
    fmap = correspondence_fmap(p2p_xy, x.basis.truncate(k), y.basis.truncate(k), samples)
    return _icp_at_100_and(fmap, x, y, parameters)


def refine_fmap(
    fmap: Float[Tensor, "K0 K0"],
    x: PreparedShape,
    y: PreparedShape,
    parameters: MatchParameters,
    places: tuple[Places, Places] | None = None,
) -> Float[Tensor, "K K"]:
    """The last refinement of a full map, by the way that ``parameters.refinement`` names, up to ``k_max`` functions.

    ``none`` leaves the map as it is, ``icp`` iterates at k = 100 and at ``k_max`` (section 7.4), ``upsample`` grows the
    basis step by step and looks for partners both ways (:func:`torchqm.fmap.two_way.two_way_upsample`) between
    ``places``, which are made if they are not given (:func:`pair_places`).
    """
    k_max = min(parameters.k_max, x.basis.k, y.basis.k)
    if parameters.refinement == "none" or k_max <= fmap.shape[0]:
        return fmap
    if parameters.refinement == "icp":
        return _icp_at_100_and(fmap, x, y, parameters)
    on_x, on_y = pair_places(x, y, parameters) if places is None else places
    sizes = [(k, k) for k in growing_sizes(fmap.shape[0], k_max, parameters.growth)]
    return two_way_upsample(fmap, x.basis, y.basis, on_x, on_y, sizes, parameters.local_weight)


def pair_places(x: PreparedShape, y: PreparedShape, parameters: MatchParameters) -> tuple[Places, Places]:
    """The anchors of two shapes with local features that are comparable between them.

    Args:
        x: one shape.
        y: the other.
        parameters: ``local_weight`` (0: there are no features), ``n_samples``, ``k_max`` are used.
    """
    shapes = (x,) if x is y else (x, y)
    ids = [s.anchors for s in shapes]
    if parameters.local_weight == 0:
        features = [torch.zeros(len(i), 0, dtype=x.basis.evecs.dtype) for i in ids]
    else:
        bases = [s.basis.truncate(min(parameters.k_max, s.basis.k)) for s in shapes]
        oriented = x.oriented and y.oriented
        features = local_features(bases, [s.curvature for s in shapes], ids, oriented)
    places = [Places(i, f, min(parameters.n_samples, len(i))) for i, f in zip(ids, features, strict=True)]
    return places[0], places[-1]


def _icp_at_100_and(
    fmap: Float[Tensor, "K0 K0"], x: PreparedShape, y: PreparedShape, parameters: MatchParameters
) -> Float[Tensor, "K K"]:
    """Five steps at 100 functions, then three at ``k_max``; one stage only where ``k_max`` is no larger than 100."""
    samples, among = x.samples[: parameters.n_samples], y.basis.restricted(y.anchors)
    k_max = min(parameters.k_max, x.basis.k, y.basis.k)
    k = min(100, k_max)
    fmap = upsample(fmap, x.basis, among, samples, [k], steps=5)
    return upsample(fmap, x.basis, among, samples, [k_max], steps=3) if k_max > k else fmap


def dense_map(fmap: Float[Tensor, "Ky Kx"], x: PreparedShape, y: PreparedShape) -> Int[Tensor, " Vx"]:
    """The vertex of y for each vertex of x, from a functional map between the first functions of their full bases."""
    small_x, small_y = x.basis.truncate(fmap.shape[1]), y.basis.truncate(fmap.shape[0])
    return fmap_to_p2p(fmap, small_x, small_y, search=y.search, guide=x.search)
