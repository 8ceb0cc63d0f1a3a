"""Supervision of a whole map up to symmetry: one element of the target's group for all points.

The conventions are those of :mod:`torchqm.fmap.orbit_loss`, whose losses choose a member of the orbit for each point.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import require_ids
from torchqm.fmap.orbit_terms import (
    EPS,
    Soft,
    bind_distances,
    bind_points,
    bind_soft,
    distances_at,
    negative_log_mass,
    require_eps,
    rows_of_samples,
    values_of,
)
from torchqm.fmap.orbit_truth import images_of, soft_minimum
from torchqm.fmap.tables import check_group

__all__ = ["map_orbit_loss"]


def map_orbit_loss(
    soft_xy: Soft,
    p2p_xy: Int[Tensor, "*B N"],
    group_y: Int[Tensor, "*B G Y"],
    dist_y: Float[Tensor, "*B Y Y"] | None = None,
    temperature: float = 0.1,
    mass_x: Float[Tensor, "*B X"] | None = None,
    samples: Int[Tensor, "*B N"] | None = None,
    truth_mask: Bool[Tensor, "*B N"] | None = None,
    group_mask: Bool[Tensor, "*B G"] | None = None,
    log_weights: bool = False,
    eps: float = EPS,
) -> Float[Tensor, "*B"]:
    """``-t log mean_g exp(-L_g / t)``: the loss against ``g o T`` for the best element g of the whole map, softly.

    Without ``dist_y``, ``L_g = -sum_x a_x log Pi(x, g(T(x)))`` (with ``eps`` as in
    :func:`~torchqm.fmap.orbit_loss.assignment_orbit_loss`); with it,
    ``L_g = sum_x a_x sum_y Pi(x, y) d(y, g(T(x)))^2``. Unlike the losses of single points this one does not accept a
    map that takes one g here and another there. ``t -> 0`` gives ``min_g L_g``; equal ``L_g`` give their value.

    With a dense map and distances, G tensors ``(N, Y)`` are kept for the backward pass; of a sparse one, ``(N, k)``.

    Args:
        soft_xy: for each x weights over the vertices of y: dense ``(..., X, Y)``, or sparse.
        p2p_xy: ``(..., N)`` true vertices of y; -1: no truth.
        group_y: ``(..., G, Y)`` symmetries of y, row 0 the identity.
        dist_y: ``(..., Y, Y)`` geodesic distances on y (length).
        temperature: t, in the unit of ``L_g`` (nats or length^2); 0 for the hard minimum.
        mass_x: ``(..., X)`` vertex areas of x; all equal if not given.
        samples: ``(..., N)`` the points, vertices of x; all in order if not given.
        truth_mask: ``(..., N)`` false: no truth.
        group_mask: ``(..., G)`` real elements; a padded element that is not masked would count as another identity.
        log_weights: ``soft_xy`` holds ``log Pi``; dense and without ``dist_y`` only.
        eps: floor of the weights.

    Returns:
        ``(...)`` one value for each shape.

    Raises:
        ValueError: as the other losses; also a negative temperature.

    Example:
        >>> mirror = torch.tensor([[0, 1, 2], [2, 1, 0]])
        >>> flipped = torch.eye(3).flip(0)
        >>> map_orbit_loss(flipped, torch.tensor([0, 1, 2]), mirror, temperature=0.0).item()
        0.0
    """
    require_eps(eps)
    if log_weights and dist_y is not None:
        raise ValueError("log_weights: distances need the weights themselves")
    sizes = bind_soft(soft_xy, log_weights)
    sizes.bind("group_y", group_y, "... G Y")
    weights = bind_points(sizes, values_of(soft_xy), p2p_xy, mass_x, samples, truth_mask)
    check_group("group_y", group_y, group_mask)
    require_ids("p2p_xy", p2p_xy, sizes["Y"], none=True)
    images = images_of(p2p_xy, group_y)
    soft = rows_of_samples(soft_xy, samples, sizes)
    if dist_y is None:
        losses = (weights[..., None] * negative_log_mass(soft, images[..., None], log_weights, eps)).sum(-2)
    else:
        bind_distances(sizes, dist_y, group_y)
        per_element = [
            (weights * (values_of(soft) * distances_at(dist_y, images[..., g], soft).square()).sum(-1)).sum(-1)
            for g in range(images.shape[-1])
        ]
        losses = torch.stack(per_element, -1)
    return soft_minimum(losses, temperature, group_mask)
