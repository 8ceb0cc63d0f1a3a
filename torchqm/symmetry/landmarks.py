"""The tips of a shape (hands, feet, ears) as landmarks, and which permutations of them a symmetry could make."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis, cluster_end
from torchqm.symmetry.orientation import orientation_form

__all__ = ["LandmarkPermutation", "Landmarks", "find_landmarks", "green_functions", "landmark_permutations", "peaks"]

N_SMOOTH = 60
"""Eigenfunctions in which landmarks are compared: few, so that fingers of a hand are one place."""


@dataclass(frozen=True, eq=False)
class Landmarks:
    """The tips of a shape and what can be measured between them; nothing depends on how the shape lies in space.

    Args:
        tips: vertex ids; tips close together (the fingers of a hand) are one landmark.
        heights: ``(n,)`` Green's function of the Laplacian at each with itself: how far out it is.
        distances: ``(n, n)`` biharmonic distances between them (area).
        volumes: ``(n, n, n)`` the alternating form ``int G_c dG_a ^ dG_b`` of their (smooth) Green's functions: a
            reflection turns its sign over.
        volume_scale: norm of the same form with absolute values under the integral.
    """

    tips: tuple[Int[Tensor, " _T"], ...]
    heights: Float[Tensor, " n"]
    distances: Float[Tensor, "n n"]
    volumes: Float[Tensor, "n n n"]
    volume_scale: float

    @property
    def n(self) -> int:
        """Number of landmarks."""
        return len(self.tips)


@dataclass(frozen=True)
class LandmarkPermutation:
    """Where a symmetry may send the landmarks.

    Args:
        images: landmark ``a`` goes to landmark ``images[a]``.
        orientation: +1 if the symmetry keeps the orientation of the surface, -1 if it turns it over.
        cost: relative squared change of distances and volumes; 0 for an exact symmetry.
    """

    images: tuple[int, ...]
    orientation: int
    cost: float

    @property
    def involutive(self) -> bool:
        """Whether it undoes itself."""
        return all(self.images[image] == a for a, image in enumerate(self.images))

    @property
    def trivial(self) -> bool:
        """Whether it is that of the identity."""
        return self.orientation > 0 and all(image == a for a, image in enumerate(self.images))


def peaks(mesh: Mesh, height: Float[Tensor, " V"]) -> tuple[Int[Tensor, " P"], Float[Tensor, " P"]]:
    """Local maxima of a function on a mesh with their persistences, the most persistent first.

    Each vertex belongs to the peak that it reaches by steepest ascent; two peaks meet at the highest edge between their
    basins, and there the lower one ends. The highest peak of each component never ends: its persistence is its height
    above the component's lowest vertex.

    Args:
        mesh: the shape.
        height: ``(V,)`` a function on it.

    Returns:
        ``(P,)`` vertex ids and ``(P,)`` persistences; vertices without triangle are no peaks.

    Example:
        >>> strip = Mesh.from_arrays([[i, i % 2, 0] for i in range(6)], [[i, i + 1, i + 2] for i in range(4)])
        >>> ids, persistence = peaks(strip, torch.tensor([1.0, 0.9, 0.2, 0.1, 0.3, 0.5]))
        >>> ids.tolist(), [round(p, 3) for p in persistence.tolist()]
        ([0, 5], [0.9, 0.3])
    """
    h = height.detach().numpy()
    used = np.flatnonzero(mesh.referenced.numpy())
    rank = np.empty(len(h), dtype=np.int64)
    rank[np.lexsort((np.arange(len(h)), h))] = np.arange(len(h))  # heights made different
    edges = mesh.edges.numpy()
    up = rank.copy()
    np.maximum.at(up, edges[:, 0], rank[edges[:, 1]])
    np.maximum.at(up, edges[:, 1], rank[edges[:, 0]])
    by_rank = np.empty_like(rank)
    by_rank[rank] = np.arange(len(h))
    top = by_rank[up]
    while (top != top[top]).any():
        top = top[top]
    a, b = top[edges[:, 0]], top[edges[:, 1]]
    apart = a != b
    saddle = np.minimum(rank[edges[:, 0]], rank[edges[:, 1]])[apart]
    order = np.argsort(-saddle, kind="stable")
    a, b, saddle = a[apart][order], b[apart][order], saddle[order]
    tops = np.unique(top[used])
    leader = {int(t): int(t) for t in tops}
    lived: dict[int, float] = {}

    def find(t: int) -> int:
        while leader[t] != t:
            t = leader[t]
        return t

    for one, other, place in zip(a.tolist(), b.tolist(), saddle.tolist(), strict=True):
        one, other = find(one), find(other)
        if one != other:
            high, low = (one, other) if rank[one] > rank[other] else (other, one)
            leader[low] = high
            lived[low] = float(h[low] - h[by_rank[place]])
    lowest = np.full(len(h), np.inf)
    np.minimum.at(lowest, top[used], h[used])
    bottom: dict[int, float] = {}
    for t in tops.tolist():
        root = find(t)
        bottom[root] = min(bottom.get(root, np.inf), float(lowest[t]))
    lived |= {root: float(h[root]) - low for root, low in bottom.items()}
    ids = np.array(sorted(lived, key=lambda t: (-lived[t], t)), dtype=np.int64)
    return torch.from_numpy(ids), torch.tensor([lived[int(t)] for t in ids], dtype=height.dtype)


def green_functions(
    basis: SpectralBasis, ids: Int[Tensor, " P"], power: float = 1.0, k: int = N_SMOOTH
) -> Float[Tensor, "V P"]:
    """``G_p(x) = sum_i lambda_i^-power phi_i(p) phi_i(x)``, the constant left out: a smooth bump at each point.

    Args:
        basis: eigenfunctions.
        ids: points p.
        power: 1 for the Green's function of the Laplacian, 2 for the biharmonic one.
        k: functions used, at most; the sum is smoother for fewer.

    Example:
        >>> basis = SpectralBasis(torch.tensor([0.0, 4.0]), torch.tensor([[1.0, 1.0], [1.0, -1.0]]), torch.ones(2) / 2)
        >>> green_functions(basis, torch.tensor([0]))[:, 0].tolist()
        [0.25, -0.25]
    """
    small = _whole_clusters(basis, k)
    weight = small.evals[1:].clamp_min(torch.finfo(small.evals.dtype).tiny) ** -power
    return small.evecs[:, 1:] @ (weight[:, None] * small.evecs[ids, 1:].T)


def find_landmarks(
    mesh: Mesh, basis: SpectralBasis, most: int = 8, least: float = 0.15, apart: float = 0.3
) -> Landmarks:
    """The tips of a shape: peaks of the Green's function with itself, ``G(x, x) = sum_i phi_i(x)^2 / lambda_i``.

    A point is far out where heat finds it hard to leave. In TOSCA's poses the tips of limbs, tails, ears and fingers
    are found on both sides of the body alike, down to the vertex where the triangles are symmetric.

    Args:
        mesh: the shape, of area 1, consistently oriented (else the volumes mean nothing).
        basis: its eigenfunctions; 200 are used at most.
        most: landmarks kept, by persistence.
        least: persistence of the weakest tip, as a share of the second largest persistence.
        apart: tips nearer to each other than this share of the largest distance are one landmark.

    Example:
        >>> from torchqm.data.synthetic import creature
        >>> from torchqm.spectral import mesh_basis
        >>> mesh = creature("octopus", 600).mesh.normalized()
        >>> find_landmarks(mesh, mesh_basis(mesh, 60)).n
        8
    """
    wide = _whole_clusters(basis, 200)
    tiny = torch.finfo(wide.evals.dtype).tiny
    height = (wide.evecs[:, 1:].square() / wide.evals[1:].clamp_min(tiny)).sum(1)
    ids, persistence = peaks(mesh, height)
    reference = persistence[1] if len(persistence) > 1 else persistence[0]
    ids = ids[persistence > least * reference][: 2 * most]
    ids = ids[height[ids].argsort(descending=True, stable=True)]
    small = _whole_clusters(basis, N_SMOOTH)
    places = small.biharmonic()[ids]
    between = torch.cdist(places, places)
    groups: list[list[int]] = []
    for i in range(len(ids)):
        near = [float(between[i, g[0]]) for g in groups]
        if groups and min(near) <= apart * float(between.max()):
            groups[near.index(min(near))].append(i)
        else:
            groups.append([i])
    groups = groups[:most]
    centres = torch.stack([places[g].mean(0) for g in groups])
    tips = tuple(ids[g] for g in groups)
    values = torch.stack([green_functions(basis, t).mean(1) for t in tips], 1)
    volumes, scale = _volumes(mesh, values / values.abs().amax(0))
    heights = torch.stack([height[t].max() for t in tips])
    return Landmarks(tips, heights, torch.cdist(centres, centres), volumes, scale)


def _whole_clusters(basis: SpectralBasis, k: int) -> SpectralBasis:
    """The first k functions or a few less: of equal eigenvalues all or none, as a symmetry mixes their functions."""
    return basis.truncate(cluster_end(basis.evals, min(k, basis.k), rtol=1e-4))


def _volumes(mesh: Mesh, values: Float[Tensor, "V n"]) -> tuple[Float[Tensor, "n n n"], float]:
    n = values.shape[1]
    a, b = pairs = torch.triu_indices(n, n, 1)
    form, means = orientation_form(mesh, values, pairs), values[mesh.faces].mean(1)
    found = form.T @ means
    volumes = values.new_zeros(n, n, n)
    volumes[a, b], volumes[b, a] = found, -found
    return volumes, 2**0.5 * float((form.abs().T @ means.abs()).norm())


def landmark_permutations(
    landmarks: Landmarks,
    most: int = 40,
    rtol_height: float = 0.3,
    rtol_distance: float = 0.4,
    width: int = 300,
    both: int = 8,
) -> list[LandmarkPermutation]:
    """The permutations that change heights, distances and volumes least, best first; the identity's is left out.

    A beam search: landmarks are placed one after the other, and after each the best partial permutations are kept.
    Where all landmarks lie on one curve or plane their volumes say little about orientation; so the best permutations
    (and that of the identity) are proposed with both.

    Args:
        landmarks: of the shape.
        most: permutations that come back, besides those that ``both`` adds at the end.
        rtol_height: two landmarks whose heights differ by more (natural logarithm) are not exchanged.
        rtol_distance: change of a distance, relative to the mean of itself and the average, that ends a permutation.
        width: partial permutations kept at each step, for each orientation.
        both: permutations that are proposed with both orientations.

    Example:
        >>> tips, heights = (torch.tensor([3]), torch.tensor([8]), torch.tensor([5])), torch.tensor([1.0, 1.0, 5.0])
        >>> distances = torch.tensor([[0.0, 2.0, 3.0], [2.0, 0.0, 3.0], [3.0, 3.0, 0.0]])
        >>> found = landmark_permutations(Landmarks(tips, heights, distances, torch.zeros(3, 3, 3), 1.0))
        >>> [(p.images, p.orientation) for p in found]
        [((1, 0, 2), 1), ((0, 1, 2), -1), ((1, 0, 2), -1)]
    """
    n, heights = landmarks.n, landmarks.heights.numpy()
    distances, volumes = landmarks.distances.numpy(), landmarks.volumes.numpy()
    alike = np.abs(np.log(heights[:, None] / heights[None])) <= rtol_height
    total = max(float((distances**2).sum()), 1e-300)
    average = distances.sum() / max(n * (n - 1), 1)
    found: list[LandmarkPermutation] = []
    for orientation in (1, -1):
        chosen, cost = np.zeros((1, 0), dtype=np.int64), np.zeros(1)
        for i in range(n):
            image = np.tile(np.arange(n), len(chosen))
            chosen, cost = np.repeat(chosen, n, 0), np.repeat(cost, n)
            fits = alike[i, image] & ~(chosen == image[:, None]).any(1)
            change = distances[i, :i] - distances[image[:, None], chosen]
            middle = (distances[i, :i] + distances[image[:, None], chosen]) / 2
            fits &= (np.abs(change) <= rtol_distance * (middle + average) / 2).all(1)
            chosen, image, cost, change = chosen[fits], image[fits], cost[fits], change[fits]
            a, b = np.triu_indices(i, 1)
            turned = volumes[i, a, b] - orientation * volumes[image[:, None], chosen[:, a], chosen[:, b]]
            # Each distance stands twice in the matrix, each volume six times in the tensor.
            cost = (
                cost + 2 * (change**2).sum(1) / total + 6 * (turned**2).sum(1) / max(landmarks.volume_scale**2, 1e-300)
            )
            chosen = np.concatenate([chosen, image[:, None]], 1)
            order = np.argsort(cost, kind="stable")[:width]
            chosen, cost = chosen[order], cost[order]
        found += [
            LandmarkPermutation(tuple(images), orientation, value)
            for images, value in zip(chosen.tolist(), cost.tolist(), strict=True)
        ]
    found.sort(key=lambda p: p.cost)
    kept = found[:most]
    known = {(p.images, p.orientation) for p in kept}
    turned = [LandmarkPermutation(p.images, -p.orientation, p.cost) for p in found[:both]]
    return [p for p in [*kept, *(t for t in turned if (t.images, t.orientation) not in known)] if not p.trivial]
