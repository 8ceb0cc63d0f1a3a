"""From a point-to-orbit map to a full map, for any finite group (paper, section 4.4, fundamental domains)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.refine import nearest_isometry
from torchqm.fmap.solve import solve_fmap
from torchqm.matching.initial import basis_size
from torchqm.matching.known import KnownSymmetry
from torchqm.matching.parameters import MatchError, MatchParameters
from torchqm.matching.quotient import QuotientMatch
from torchqm.matching.shape import PreparedShape
from torchqm.symmetry.domains import fundamental_domains

__all__ = ["OrbitMatch", "full_map_from_orbits", "quotient_size"]

N_EMBEDDING = 100
"""Functions of the biharmonic embedding in which domains are told apart."""


@dataclass(frozen=True, eq=False)
class OrbitMatch:
    """A full map that agrees with a point-to-orbit map.

    Args:
        fmap: ``(K, K)`` functions on x to functions on y; which of the |G| equally good ones is arbitrary.
        start: vertex of x around which the choice was made, and where it goes.
        residual: root mean square distance, in the spectral coordinates of the map, between the image of a sample and
            the nearest point of its orbit, relative to that between images and the orbit's points on average; 0 is
            exact.
    """

    fmap: Float[Tensor, "K K"]
    start: tuple[int, int]
    residual: float


def quotient_size(order: int, parameters: MatchParameters) -> int:
    """How many functions a quotient match needs: about one in ``order`` of them is symmetric, and ten are wanted."""
    return min(parameters.k_max, max(parameters.k, 10 * order))


def full_map_from_orbits(
    match: QuotientMatch,
    x: PreparedShape,
    y: PreparedShape,
    known_x: KnownSymmetry,
    known_y: KnownSymmetry,
    parameters: MatchParameters,
    steps: int = 20,
    n_starts: int = 12,
) -> OrbitMatch:
    """Choose one fundamental domain on each shape, match these, and extend the map to the whole.

    A generic point of x and any point of the orbit that it goes to are the centres of Dirichlet domains. What lies in
    the first domain of x goes to that point of its orbit that lies in the first domain of y. A functional map is fitted
    to these pairs, and then to all samples in turn with the choice, among the points of each orbit, that it makes
    itself: a nearest-point search among |G| points. From some domains this ends in a map that is direct here and
    mirrored there; so several are tried, and the map that comes nearest to the orbits is kept.

    Args:
        match: the map between symmetric functions.
        x: source.
        y: target.
        known_x: its symmetry.
        known_y: that of y, with as many elements.
        parameters: ``k``, ``n_samples`` are used.
        steps: iterations of the choice.
        n_starts: domains that are tried.

    Raises:
        ValueError: the groups have different orders.
        MatchError: no sample has as many different images as the groups have elements.

    References:
        Paper, section 4.4: of the orbit of ``T(x)`` the point in the fundamental domain that belongs to x's.
    """
    if known_x.group.order != known_y.group.order:
        raise ValueError(f"groups of {known_x.group.order} and {known_y.group.order} elements: they must be the same")
    samples = x.samples[: parameters.n_samples]
    orbit_map = match.orbit_map(x, y)
    orbits = known_y.group.maps[:, orbit_map[samples]]
    points_x, points_y = x.basis.biharmonic(N_EMBEDDING), y.basis.biharmonic(N_EMBEDDING)
    k = basis_size([x.basis, y.basis], parameters.k)
    small_x, small_y = x.basis.truncate(k), y.basis.truncate(k)
    at_x, at_orbits = small_x.evecs[samples], small_y.evecs[orbits]
    # The centre of a domain must be far from its own images, and so must the point that it goes to.
    room = torch.minimum(_separation(points_x, known_x.group.orbits[samples]), _separation(points_y, orbits.T))
    found: list[OrbitMatch] = []
    if float(room.max()) <= 0:
        raise MatchError(
            f"{x.mesh.label} -> {y.mesh.label}: of the samples none has {known_x.group.order} different images under "
            "both groups, so none can be the centre of a fundamental domain; the meshes are too coarse for the group"
        )
    for number in _spread(points_x[samples], room, n_starts):
        start, goal = int(samples[number]), int(orbit_map[samples[number]])
        domains_x = fundamental_domains(known_x.group, points_x, x.basis.mass, start, known_x.products)
        domains_y = fundamental_domains(known_y.group, points_y, y.basis.mass, goal, known_y.products)
        inside = domains_y.element[orbits] == 0
        use = (domains_x.element[samples] == 0) & inside.any(0)
        chosen = orbits.gather(0, inside.int().argmax(0)[None])[0]
        f, g = at_x[use].T, small_y.evecs[chosen[use]].T
        weight = float(f.square().sum()) / k
        fmap = nearest_isometry(solve_fmap(f, g, small_x.evals, small_y.evals, weight, ridge=1e-9))
        fmap, residual = _fitted(fmap, at_x, at_orbits, steps)
        found.append(OrbitMatch(fmap, (start, goal), residual))
    return min(found, key=lambda one: one.residual)


def _fitted(
    fmap: Float[Tensor, "K K"], at_x: Float[Tensor, "S K"], at_orbits: Float[Tensor, "G S K"], steps: int
) -> tuple[Float[Tensor, "K K"], float]:
    """ICP in which a sample may only go to the points of its orbit; and how far it stays away from these."""
    numbers = torch.arange(len(at_x))
    for _ in range(steps):
        nearest = (at_orbits - at_x @ fmap.T).square().sum(2).argmin(0)
        last, fmap = fmap, nearest_isometry(at_orbits[nearest, numbers].T @ at_x)
        if float((fmap - last).norm()) < 1e-3 * float(fmap.norm()):
            break
    gaps = (at_orbits - at_x @ fmap.T).square().sum(2)
    return fmap, float((gaps.amin(0).mean() / gaps.mean().clamp_min(1e-300)).sqrt())


def _spread(places: Float[Tensor, "S D"], room: Float[Tensor, " S"], n: int) -> list[int]:
    """Up to n samples with much room, not close to each other: each is best in room times distance to those before."""
    chosen = [int(room.argmax())]
    distance = (places - places[chosen[0]]).norm(dim=1)
    while len(chosen) < min(n, int((room > 0).sum())):
        chosen.append(int((room * distance).argmax()))
        distance = torch.minimum(distance, (places - places[chosen[-1]]).norm(dim=1))
    return chosen


def _separation(points: Float[Tensor, "V D"], orbits: Int[Tensor, "S G"]) -> Float[Tensor, " S"]:
    """Smallest distance between two points of each orbit, relative to the mean distance of points."""
    places = points[orbits]
    gaps = torch.cdist(places, places) + torch.diag(torch.full((orbits.shape[1],), torch.inf, dtype=points.dtype))
    return gaps.amin((1, 2)) / points.square().sum(1).mean().sqrt()
