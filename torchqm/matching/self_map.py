"""The functional map of a shape's own reflection: candidates, the best of them, its refinement (section 6.1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.fmap.convert import nearest_used, p2p_to_fmap
from torchqm.fmap.refine import growing_sizes, nearest_isometry, quotient_icp, upsample
from torchqm.fmap.solve import solve_fmap
from torchqm.fmap.threads import in_parallel
from torchqm.fmap.two_way import Places, growing_pairs, two_way_upsample
from torchqm.matching.described import PairDescriptors, pair_descriptors
from torchqm.matching.initial import basis_size, unit_columns_pair
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.quality import commutator_norm
from torchqm.matching.shape import N_ANCHORS, PreparedShape
from torchqm.symmetry.group import SymmetryGroup

__all__ = [
    "K_CHOICE",
    "SelfMap",
    "best_self_map",
    "conjugate_reflection",
    "grow_self_map",
    "nearest_involution",
    "reflection_score",
    "self_map_from_halves",
    "self_maps_from_halves",
    "settled_self_map",
]

SelfFMap = Float[Tensor, "K K"]

K_CHOICE = 100
"""Functions at which candidates are compared: at 30 a good and a bad one commute nearly as well."""


@dataclass(frozen=True, eq=False)
class SelfMap:
    """The functional map of a reflection, and the candidates that it was chosen from.

    Args:
        fmap: ``(K, K)`` refined.
        chosen: which of the candidates it grew from.
        scores: :func:`reflection_score` of each candidate where they were compared; 0 is an exact isometry.
    """

    fmap: SelfFMap
    chosen: int
    scores: tuple[float, ...]


def self_map_from_halves(
    x: PreparedShape, sign: Float[Tensor, " V"], parameters: MatchParameters
) -> Float[Tensor, "K K"]:
    """The refined functional map of a reflection whose left and right are known (paper, section 6.1, step 4)."""
    return best_self_map(self_maps_from_halves(x, sign, parameters), x, parameters).fmap


def self_maps_from_halves(
    x: PreparedShape,
    sign: Float[Tensor, " V"],
    parameters: MatchParameters,
    values: Float[Tensor, "V C"] | PairDescriptors | None = None,
) -> list[Float[Tensor, "K K"]]:
    """Solve ``S f = f`` and ``S (eps f) = -eps f`` for all descriptors f, then refine by ICP; one map a weight.

    Args:
        x: the shape.
        sign: its left-right map eps.
        parameters: ``k``, descriptors, ``icp_steps``; each of ``self_commutativity`` gives a candidate, as no single
            weight is best on all shapes.
        values: descriptors f, if they are there already, or those that x, the first of two shapes, shares with another.

    References:
        Paper, section 6.1, symmetry reconstruction.
    """
    basis = x.basis.truncate(basis_size([x.basis], parameters.k))
    if isinstance(values, Tensor):
        even, odd = basis.coefficients(values), basis.coefficients(sign[:, None] * values)
    else:
        described = values or pair_descriptors(x, x, parameters)
        even, odd = described.coefficients[0][: basis.k], described.weighted(x, basis.k, sign)
    f, g = unit_columns_pair(torch.cat([even, odd], 1), torch.cat([even, -odd], 1))
    samples, among = x.samples[: parameters.n_samples], basis.restricted(x.anchors)

    def solved(weight: float) -> Tensor:
        fmap = solve_fmap(f, g, basis.evals, basis.evals, weight * f.shape[1] / basis.k, ridge=1e-9)
        fmap = quotient_icp(
            fmap, basis, among, samples, parameters.icp_steps, parameters.time, tolerance=parameters.icp_tolerance
        )
        return fmap if parameters.refinement == "icp" else nearest_involution(fmap)

    return in_parallel([partial(solved, weight) for weight in parameters.self_commutativity])


def conjugate_reflection(
    fmap_xy: Float[Tensor, "K K"], group_y: SymmetryGroup, y: PreparedShape
) -> Float[Tensor, "K K"]:
    """The reflection of y seen from x: ``C^-1 S_y C``, made an involution.

    Args:
        fmap_xy: orthonormal map of the functions on x to those on y.
        group_y: ``{id, S_y}``.
        y: the shape that the map goes to.
    """
    basis = y.basis.truncate(fmap_xy.shape[0])
    return nearest_involution(fmap_xy.T @ p2p_to_fmap(group_y.maps[1], basis, basis) @ fmap_xy)


def best_self_map(
    candidates: Sequence[Float[Tensor, "_K _K"]],
    x: PreparedShape,
    parameters: MatchParameters,
    witness: int | None = None,
) -> SelfMap:
    """Grow all candidates to a hundred functions, keep the one with the least :func:`reflection_score`, refine it.

    Args:
        candidates: functional maps of the shape to itself, of any sizes.
        x: the shape.
        parameters: of the refinement.
        witness: a candidate that was found in another way than the rest: the mean distance between its images and those
            of another candidate (times 0.3) is added to the score of that one. Two that agree support each other.

    Raises:
        ValueError: there are no candidates.
    """
    if not candidates:
        raise ValueError("candidates: there must be at least one")
    k = min(K_CHOICE, parameters.k_max, x.basis.k)
    alike: list[int] = []  # for each candidate the first one that is nearly the same, and grows for both
    for number, candidate in enumerate(candidates):
        twins = [j for j in range(number) if candidates[j].shape == candidate.shape]
        near = [j for j in twins if float((candidates[j] - candidate).norm()) < 0.05 * float(candidate.norm())]
        alike.append(alike[near[0]] if near else number)
    different = sorted(set(alike))

    def grow(number: int) -> tuple[Tensor, Tensor | None]:
        fmap = grow_self_map(candidates[number], x, parameters, k)
        return fmap, None if witness is None else _images(fmap, x, parameters)

    results = dict(zip(different, in_parallel([partial(grow, j) for j in different]), strict=True))
    grown = [results[j][0] for j in alike]
    scores = [reflection_score(fmap, x) for fmap in grown]
    if witness is not None:
        images = [image for j in alike if (image := results[j][1]) is not None]
        gaps = [float((image - images[witness]).norm(dim=1).mean()) for image in images]
        scores = [score + 0.3 * gap for score, gap in zip(scores, gaps, strict=True)]
    chosen = scores.index(min(scores))
    return SelfMap(grow_self_map(grown[chosen], x, parameters, parameters.k_max), chosen, tuple(scores))


def reflection_score(fmap: Float[Tensor, "K K"], x: PreparedShape) -> float:
    """How little a functional map looks like a reflection of the whole shape; needs no truth.

    The commutator with the Laplacian, 0 for an isometry, is nearly always least for the candidate of least error (on
    TOSCA). But what moves only a part of the shape commutes as well, the identity perfectly. Such maps have too many
    even functions: of a reflection the even ones outnumber the odd ones by about ``l sqrt(k / pi)`` among the first k
    (Weyl; l is the length of the axis / sqrt(area), 3 on most bodies), the trace. Half of what the trace has
    above ``2.2 sqrt(k)``, as a share of k, is added.

    Args:
        fmap: in the first K functions of the shape.
        x: the shape.
    """
    k = fmap.shape[0]
    evals = x.basis.evals[:k]
    excess = float(fmap.diagonal().sum()) / k - 2.2 / k**0.5
    return commutator_norm(fmap, evals, evals) + 0.5 * max(0.0, excess)


def _images(fmap: Tensor, x: PreparedShape, parameters: MatchParameters) -> Tensor:
    """Where the samples go, in space."""
    small = x.basis.truncate(fmap.shape[0])
    samples, among = x.samples[: parameters.n_samples], small.restricted(x.anchors)
    partners = nearest_used(small.evecs[samples] @ fmap.T, among, exact=False)
    return x.mesh.verts[x.anchors[partners]]


def settled_self_map(
    fmap: Float[Tensor, "K K"],
    x: PreparedShape,
    parameters: MatchParameters,
    places: Places,
    involution: bool = True,
    start: int = 60,
    weight: float = 1.0,
) -> Float[Tensor, "K2 K2"]:
    """Grow a good self-map once more from its first functions, held in its place by local features.

    Only for maps that were chosen already: features make a wrong map look better than it is. Half the weight that they
    have between two shapes, as a shape is more like itself in wrong places than like another one.

    Args:
        fmap: in the first K functions.
        x: the shape.
        parameters: ``growth`` and ``k_max`` are used.
        places: points of the shape with features (:func:`torchqm.matching.quotient.pair_places`).
        involution: whether it is one, and is made one after each step.
        start: functions that are kept.
        weight: of the features (:func:`torchqm.fmap.two_way.two_way_upsample`).
    """
    start, k = min(start, fmap.shape[0]), min(parameters.k_max, x.basis.k)
    project = nearest_involution if involution else nearest_isometry
    sizes = growing_pairs((start, start), (max(start, k), max(start, k)), parameters.growth)
    return two_way_upsample(
        project(fmap[:start, :start]), x.basis, x.basis, places, places, sizes, weight, project, back=not involution
    )


def nearest_involution(matrix: Float[Tensor, "K K"]) -> Float[Tensor, "K K"]:
    """The involution ``C = C^T = C^-1`` nearest to a matrix: the eigenvalues of its symmetric part become +-1.

    Example:
        >>> nearest_involution(torch.tensor([[0.1, 0.9], [0.7, 0.0]])).abs().round().tolist()
        [[0.0, 1.0], [1.0, 0.0]]
    """
    weights, vectors = torch.linalg.eigh((matrix + matrix.T) / 2)
    return (vectors * torch.where(weights < 0, -1.0, 1.0)) @ vectors.T


def grow_self_map(
    fmap: Float[Tensor, "K K"],
    x: PreparedShape,
    parameters: MatchParameters,
    k: int,
    n_anchors: int = N_ANCHORS,
    involution: bool = True,
) -> Float[Tensor, "K2 K2"]:
    """Refine a self-map up to ``k`` functions by the way that ``parameters.refinement`` names.

    Args:
        fmap: in the first K functions.
        x: the shape.
        parameters: ``refinement``, ``growth`` and ``n_samples`` are used.
        k: functions to reach; at most ``k_max`` and what the basis holds.
        n_anchors: vertices among which partners are looked for.
        involution: whether it is one, and is made one after each step of ``upsample``.
    """
    k = min(k, parameters.k_max, x.basis.k)
    if parameters.refinement == "none" or k <= fmap.shape[0]:
        return fmap
    samples, among = x.samples[: parameters.n_samples], x.basis.truncate(k).restricted(x.samples[:n_anchors])
    if parameters.refinement == "icp":  # section 7.4: five steps at 100, three at 300
        return upsample(fmap, x.basis, among, samples, [k], steps=5 if k <= K_CHOICE else 3)
    # Without the projection a self-map drifts towards the identity, the best map of a shape to itself.
    project = nearest_involution if involution else nearest_isometry
    return upsample(fmap, x.basis, among, samples, growing_sizes(fmap.shape[0], k, parameters.growth), project=project)
