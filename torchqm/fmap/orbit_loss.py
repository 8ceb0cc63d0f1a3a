"""Supervision that does not care which point of an orbit is hit: four losses, each invariant under the target's group.

In all of them ``T = p2p_xy (..., N)`` gives for points x of one shape their true vertices on y (-1: no truth), x runs
over all vertices or over ``samples (..., N)``, and the ``a_x`` are areas that sum to 1
(:func:`~torchqm.fmap.orbit_truth.point_weights`). The target's group is a table of vertex maps ``group_y (..., G, Y)``,
row 0 the identity. Every function returns one value for each shape of the batch; points without truth have weight 0.
The invariance is as exact as the table is a group: one of nearest vertices sends some mirror images back to a neighbour
of the vertex they came from, whose orbit is another.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import Sizes, require_finite, require_ids
from torchqm.fmap.orbit_map_loss import map_orbit_loss
from torchqm.fmap.orbit_terms import (
    EPS,
    Soft,
    bind_distances,
    bind_points,
    bind_soft,
    distances_at,
    negative_log_mass,
    require_eps,
    rows_at,
    rows_of_samples,
    values_of,
)
from torchqm.fmap.orbit_truth import orbit_members
from torchqm.fmap.tables import require_weights
from torchqm.spectral.soft_map import SoftMap

__all__ = ["assignment_orbit_loss", "distance_orbit_loss", "map_orbit_loss", "spectral_orbit_loss"]


def spectral_orbit_loss(
    fmap_even: Float[Tensor, "*B Ky Kx"],
    evecs_even_x: Float[Tensor, "*B X Kx"],
    evecs_even_y: Float[Tensor, "*B Y Ky"],
    p2p_xy: Int[Tensor, "*B N"],
    mass_x: Float[Tensor, "*B X"] | None = None,
    samples: Int[Tensor, "*B N"] | None = None,
    truth_mask: Bool[Tensor, "*B N"] | None = None,
) -> Float[Tensor, "*B"]:
    """``sum_x a_x || C phi+_x - phi+_T(x) ||^2``: the even map sends the delta of a point to that of its true orbit.

    ``phi+_x`` is row x of the even basis, the coefficients of the symmetrised delta. The rows of the points of one
    orbit are equal, so the loss is invariant without knowing the group (as nearly as the basis is even).

    Args:
        fmap_even: ``(..., Ky, Kx)`` takes even functions on x to even functions on y; 0 at padded functions.
        evecs_even_x: ``(..., X, Kx)`` even basis of x, at all its vertices.
        evecs_even_y: ``(..., Y, Ky)`` even basis of y.
        p2p_xy: ``(..., N)`` true vertices of y; -1: no truth.
        mass_x: ``(..., X)`` vertex areas of x; all equal if not given.
        samples: ``(..., N)`` the points, vertices of x; all in order if not given.
        truth_mask: ``(..., N)`` false: no truth.

    Returns:
        ``(...)`` one value for each shape, without unit where bases are orthonormal on shapes of area 1.

    Raises:
        ValueError: shapes do not fit, ids are out of range, areas are negative, something is not finite, or a shape has
            no point with a truth and an area.

    Example:
        >>> basis = torch.tensor([[[1.0], [1.0]]])
        >>> spectral_orbit_loss(torch.tensor([[[3.0]]]), basis, basis, torch.tensor([[1, 0]])).tolist()
        [4.0]

    References:
        Paper, sections 4.2 (symmetrised deltas) and 4.4.
    """
    sizes = Sizes()
    sizes.bind("fmap_even", fmap_even, "... Ky Kx")
    sizes.bind("evecs_even_x", evecs_even_x, "... X Kx")
    sizes.bind("evecs_even_y", evecs_even_y, "... Y Ky")
    for name, value in (("fmap_even", fmap_even), ("evecs_even_x", evecs_even_x), ("evecs_even_y", evecs_even_y)):
        require_finite(name, value)
    weights = bind_points(sizes, fmap_even, p2p_xy, mass_x, samples, truth_mask)
    if samples is not None:
        require_ids("samples", samples, sizes["X"])
        evecs_even_x = rows_at(evecs_even_x, samples)
    images = evecs_even_x @ fmap_even.transpose(-1, -2)
    gaps = (images - rows_at(evecs_even_y, p2p_xy.clamp_min(0))).square().sum(-1)
    return (weights * gaps).sum(-1)


def assignment_orbit_loss(
    soft_xy: Soft,
    p2p_xy: Int[Tensor, "*B N"],
    group_y: Int[Tensor, "*B G Y"],
    mass_x: Float[Tensor, "*B X"] | None = None,
    samples: Int[Tensor, "*B N"] | None = None,
    truth_mask: Bool[Tensor, "*B N"] | None = None,
    group_mask: Bool[Tensor, "*B G"] | None = None,
    log_weights: bool = False,
    eps: float = EPS,
) -> Float[Tensor, "*B"]:
    """``-sum_x a_x log sum_{y in orbit(T(x))} Pi(x, y)``: the mass that a soft map puts on the orbit of the truth.

    A member that the table names twice (a fixed point's image) counts once. Weights enter as
    ``log((m + eps) / (1 + eps))``, m the mass on the orbit: 0 at m = 1, finite at m = 0, where the derivative is
    ``-1 / eps``, so a gradient still pulls, as far as the softmax passes it on. For weights far below ``eps`` give
    logarithms (``log_weights``): then the loss is ``-logsumexp`` over the orbit, without ``eps``, and pulls from any
    distance. Of a sparse map the mass that its k neighbours have on the orbit counts; where none of them lies on it the
    value is ``-log(eps / (1 + eps))`` without gradient: have :func:`torchqm.fmap.soft.soft_map` ``include`` the orbit.

    Args:
        soft_xy: for each x weights over the vertices of y: dense ``(..., X, Y)``, or sparse.
        p2p_xy: ``(..., N)`` true vertices of y; -1: no truth.
        group_y: ``(..., G, Y)`` symmetries of y, row 0 the identity.
        mass_x: ``(..., X)`` vertex areas of x; all equal if not given.
        samples: ``(..., N)`` the points, vertices of x; all in order if not given.
        truth_mask: ``(..., N)`` false: no truth.
        group_mask: ``(..., G)`` real elements.
        log_weights: ``soft_xy`` holds ``log Pi`` (``torch.log_softmax``), minus infinity allowed; dense only.
        eps: floor of the mass.

    Returns:
        ``(...)`` one value for each shape (nats).

    Raises:
        ValueError: as :func:`spectral_orbit_loss`; also negative weights, ``eps`` not in ``(0, 1)``, or row 0 of the
            table is not the identity.

    Example:
        >>> mirror = torch.tensor([[0, 1, 2], [2, 1, 0]])
        >>> uniform = torch.full((3, 3), 1 / 3)
        >>> assignment_orbit_loss(uniform, torch.tensor([0, -1, 2]), mirror).mul(100).round().item()  # -log(2 / 3)
        41.0
    """
    require_eps(eps)
    sizes = bind_soft(soft_xy, log_weights)
    sizes.bind("group_y", group_y, "... G Y")
    weights = bind_points(sizes, values_of(soft_xy), p2p_xy, mass_x, samples, truth_mask)
    members = orbit_members(p2p_xy, group_y, group_mask)
    soft = rows_of_samples(soft_xy, samples, sizes)
    losses = negative_log_mass(soft, members[..., None, :], log_weights, eps)[..., 0]
    return (weights * losses).sum(-1)


def distance_orbit_loss(
    soft_xy: Soft,
    p2p_xy: Int[Tensor, "*B N"],
    group_y: Int[Tensor, "*B G Y"] | None = None,
    dist_y: Float[Tensor, "*B Y Y"] | None = None,
    orbit_dist: Float[Tensor, "*B N Y"] | None = None,
    mass_x: Float[Tensor, "*B X"] | None = None,
    samples: Int[Tensor, "*B N"] | None = None,
    truth_mask: Bool[Tensor, "*B N"] | None = None,
    group_mask: Bool[Tensor, "*B G"] | None = None,
) -> Float[Tensor, "*B"]:
    """``sum_x a_x sum_y Pi(x, y) d(y, orbit(T(x)))^2``: the expected squared distance to the orbit of the truth.

    Args:
        soft_xy: for each x weights over the vertices of y: dense ``(..., X, Y)``, or sparse. Of a sparse map distances
            at its k neighbours only are looked up: nothing of size ``(N, Y)`` is made.
        p2p_xy: ``(..., N)`` true vertices of y; -1: no truth.
        group_y: ``(..., G, Y)`` symmetries of y, row 0 the identity; with ``dist_y``.
        dist_y: ``(..., Y, Y)`` geodesic distances on y (length); symmetric.
        orbit_dist: ``(..., N, Y)`` distances of all vertices of y from the orbit of each truth, instead of ``dist_y``
            and the group.
        mass_x: ``(..., X)`` vertex areas of x; all equal if not given.
        samples: ``(..., N)`` the points, vertices of x; all in order if not given.
        truth_mask: ``(..., N)`` false: no truth.
        group_mask: ``(..., G)`` real elements.

    Returns:
        ``(...)`` one value for each shape (length^2).

    Raises:
        ValueError: as :func:`assignment_orbit_loss`; also negative distances, not exactly one of ``dist_y`` (with
            ``group_y``) and ``orbit_dist``, or a group beside ``orbit_dist``, which would have no say.

    Example:
        >>> mirror = torch.tensor([[0, 1, 2], [2, 1, 0]])
        >>> line = torch.tensor([[0.0, 1.0, 2.0], [1.0, 0.0, 1.0], [2.0, 1.0, 0.0]])
        >>> distance_orbit_loss(torch.eye(3), torch.tensor([2, 1, 1]), mirror, line, samples=torch.tensor([0, 1, 2]))
        tensor(0.3333)
    """
    sizes = bind_soft(soft_xy)
    weights = bind_points(sizes, values_of(soft_xy), p2p_xy, mass_x, samples, truth_mask)
    if (dist_y is None) == (orbit_dist is None):
        raise ValueError("dist_y, orbit_dist: exactly one of them must be given")
    for name, value in (("group_y", group_y), ("group_mask", group_mask)):
        if orbit_dist is not None and value is not None:
            raise ValueError(
                f"{name}: given with orbit_dist, which holds distances from orbits already; give it with dist_y, or "
                "orbit_dist alone"
            )
    soft = rows_of_samples(soft_xy, samples, sizes)
    if orbit_dist is not None:
        sizes.bind("orbit_dist", orbit_dist, "... X Y" if samples is None else "... N Y")
        require_weights("orbit_dist", orbit_dist)
        require_ids("p2p_xy", p2p_xy, sizes["Y"], none=True)
        gaps = torch.gather(orbit_dist, -1, soft.indices) if isinstance(soft, SoftMap) else orbit_dist
    else:
        if group_y is None or dist_y is None:
            raise ValueError("group_y: must be given with dist_y")
        bind_distances(sizes, dist_y, group_y)
        members = orbit_members(p2p_xy, group_y, group_mask)
        # What is left over repeats a member, which changes no minimum.
        members = torch.where(members < 0, members[..., :1].clamp_min(0), members)
        gaps = distances_at(dist_y, members[..., 0], soft)
        for g in range(1, members.shape[-1]):
            gaps = torch.minimum(gaps, distances_at(dist_y, members[..., g], soft))
    return (weights * (values_of(soft) * gaps.square()).sum(-1)).sum(-1)
