"""Which of the two points of an orbit each point goes to: chosen for all at once, from the even block alone.

The odd block says it too, but on some poses it joins a direct upper body to a mirrored lower one. Neighbours see that:
a map that is direct here and mirrored there is torn in between.
"""

import heapq
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.matching.known import KnownSymmetry
from torchqm.matching.quotient import QuotientMatch
from torchqm.matching.shape import PreparedShape

__all__ = ["SynchronizedHalves", "neighbour_weights", "sample_weights", "synchronize_signs", "synchronized_halves"]

N_POINTS = 1000
"""Samples that are synchronized; the map is grown from these."""

NEIGHBOURS = 10
"""Neighbours of each sample, and of its mirror image, that have a say."""

N_EMBEDDING = 100
"""Functions of the biharmonic embedding in which neighbours and displacements are measured."""


@dataclass(frozen=True, eq=False)
class SynchronizedHalves:
    """A point of the orbit for each sample, the same way for all.

    Args:
        samples: ``(S,)`` vertices of x.
        images: ``(S,)`` vertices of y; their mirror images are the other, equally good choice.
        weights: ``(S,)`` squared distance of the two points of an orbit: how much a wrong choice costs.
        satisfied: share of the couplings between samples that the choice satisfies; 1 where there is no contradiction.
    """

    samples: Int[Tensor, " S"]
    images: Int[Tensor, " S"]
    weights: Float[Tensor, " S"]
    satisfied: float

    def agreement(self, images: Int[Tensor, " S"]) -> float:
        """Weighted share of samples with the same choice as in another map, up to exchanging all; 0.5 to 1."""
        same = _share((self.weights * (images == self.images)).sum(), self.weights.sum())
        return max(same, 1 - same)


def sample_weights(x: PreparedShape, known_x: KnownSymmetry) -> Float[Tensor, "S S"]:
    """:func:`neighbour_weights` of the first :data:`N_POINTS` samples of a shape with a reflection."""
    samples = x.samples[:N_POINTS]
    here, there = (_embedded(x, ids) for ids in (samples, known_x.group.maps[1][samples]))
    return neighbour_weights(here, there)


def _embedded(shape: PreparedShape, ids: Int[Tensor, " S"]) -> Float[Tensor, "S P"]:
    return shape.basis.truncate(min(N_EMBEDDING, shape.basis.k)).restricted(ids).biharmonic()


def synchronized_halves(
    match: QuotientMatch,
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    weights: Float[Tensor, "S S"] | None = None,
) -> SynchronizedHalves:
    """Choose among the points of each orbit so that neighbours stay neighbours, and mirror images mirror images.

    With ``b`` the biharmonic embedding of y, a sample x whose orbit is ``{T, S T}`` has the displacement
    ``m(x) = (b(T) - b(S T)) / 2``. For two neighbours, choosing alike instead of unlike changes the sum of squared
    distances of their images by ``-8 <m(x), m(x')>``; for a sample and the mirror image of its neighbour the sign is
    turned. So the signs that maximise ``sum_xx' w s s' <m, m'>`` are looked for, see :func:`synchronize_signs`.

    Args:
        match: the even block.
        x: source.
        y: target.
        known_x: one reflection.
        known_y: one reflection.
        weights: of the source (:func:`sample_weights`), if they are there already.

    References:
        Beyond the paper; takes the place of the left-right partition of section 6.1 in section 6.2, step 3.
    """
    samples = x.samples[:N_POINTS]
    orbit_map = match.orbit_map_of(samples)
    mirror = known_y.group.maps[1]
    displacement = (_embedded(y, orbit_map) - _embedded(y, mirror[orbit_map])) / 2
    signs, satisfied = _signs(sample_weights(x, known_x) if weights is None else weights, displacement)
    chosen = torch.where(signs > 0, orbit_map, mirror[orbit_map])
    return SynchronizedHalves(samples, chosen, displacement.square().sum(1), satisfied)


def synchronize_signs(
    points: Float[Tensor, "S P"], mirrored: Float[Tensor, "S P"], displacement: Float[Tensor, "S D"]
) -> tuple[Float[Tensor, " S"], float]:
    """Signs that maximise ``sum w_ij s_i s_j <m_i, m_j>`` over neighbours, by greedy joining.

    The two groups of samples with the strongest coupling are joined again and again, one of them turned if the coupling
    is negative. Exact where the couplings do not contradict each other; and one wrong coupling does not turn a limb, as
    it would in a spanning tree, because couplings between groups are summed.

    Args:
        points: ``(S, P)`` places of samples in an embedding.
        mirrored: ``(S, P)`` places of their mirror images.
        displacement: ``(S, D)`` the vectors m.

    Returns:
        ``(S,)`` signs, and the share of the couplings that they satisfy.

    Example:
        >>> line = torch.arange(4.0)[:, None]
        >>> signs, satisfied = synchronize_signs(line, line + 100, torch.tensor([[1.0], [-1.0], [1.0], [1.0]]))
        >>> (signs[0] * signs).tolist(), satisfied
        ([1.0, -1.0, 1.0, 1.0], 1.0)
    """
    return _signs(neighbour_weights(points, mirrored), displacement)


def neighbour_weights(points: Float[Tensor, "S P"], mirrored: Float[Tensor, "S P"]) -> Float[Tensor, "S S"]:
    """``w_ij``: positive between neighbours, negative between a sample and neighbours of its mirror image.

    Args:
        points: ``(S, P)`` places of samples in an embedding.
        mirrored: ``(S, P)`` places of their mirror images.
    """
    n = len(points)
    k = min(NEIGHBOURS, n - 1)
    near = torch.cdist(points, points).fill_diagonal_(torch.inf).topk(k, dim=1, largest=False)
    across = torch.cdist(mirrored, points).topk(k, dim=1, largest=False)
    scale = near.values.mean().clamp_min(torch.finfo(points.dtype).tiny)
    total = points.new_zeros(n, n)
    for found, sign in ((near, 1.0), (across, -1.0)):
        weight = torch.zeros_like(total).scatter_(1, found.indices, torch.exp(-((found.values / scale) ** 2)))
        total += sign * torch.maximum(weight, weight.T)
    return total.fill_diagonal_(0.0)


def _signs(weights: Float[Tensor, "S S"], displacement: Float[Tensor, "S D"]) -> tuple[Float[Tensor, " S"], float]:
    couplings = weights * (displacement @ displacement.T)
    signs = torch.tensor(_joined(couplings), dtype=weights.dtype, device=weights.device)
    satisfied = _share((signs[:, None] * couplings * signs).sum(), couplings.abs().sum())
    return signs, (1 + satisfied) / 2


def _share(part: Tensor, whole: Tensor) -> float:
    return float(part / whole.clamp_min(torch.finfo(whole.dtype).tiny))


def _joined(couplings: Float[Tensor, "S S"]) -> list[float]:
    n = len(couplings)
    neighbours: list[dict[int, float]] = [{} for _ in range(n)]
    first, second = couplings.triu(1).nonzero().T.tolist()
    heap = []
    for i, j, c in zip(first, second, couplings[first, second].tolist(), strict=True):
        neighbours[i][j] = neighbours[j][i] = c
        heap.append((-abs(c), i, j))
    heapq.heapify(heap)
    members = [[i] for i in range(n)]
    signs = [1.0] * n
    while heap:
        strength, i, j = heapq.heappop(heap)
        if j not in neighbours[i] or abs(neighbours[i][j]) != -strength:
            continue  # joined or changed since
        if len(members[i]) < len(members[j]):
            i, j = j, i
        turn = -1.0 if neighbours[i].pop(j) < 0 else 1.0
        for k in members[j]:
            signs[k] *= turn
        members[i] += members[j]
        for k, c in neighbours[j].items():
            if k == i:
                continue
            del neighbours[k][j]
            both = neighbours[i].get(k, 0.0) + turn * c
            neighbours[i][k] = neighbours[k][i] = both
            heapq.heappush(heap, (-abs(both), i, k))
        neighbours[j] = {}
    return signs
