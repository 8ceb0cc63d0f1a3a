"""What the orbit losses have in common: orbits of the true points, weights of the points, the soft minimum."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import enabled, require_ids, require_nonnegative
from torchqm.fmap.tables import check_group
from torchqm.options import require_number

__all__ = ["images_of", "orbit_members", "point_weights", "require_temperature", "soft_minimum"]

COLDEST = 1e-30
"""Smallest temperature but zero: its inverse is finite in float32."""


def orbit_members(
    p2p_xy: Int[Tensor, "*B N"],
    group_y: Int[Tensor, "*B G Y"],
    group_mask: Bool[Tensor, "*B G"] | None = None,
) -> Int[Tensor, "*B N G"]:
    """The orbit of each true point, each member once: ascending vertex ids, and -1 in the places left over.

    Args:
        p2p_xy: ``(..., N)`` vertices of y; -1 for a point without truth (its row is all -1).
        group_y: ``(..., G, Y)`` symmetries of y as vertex maps, row 0 the identity.
        group_mask: ``(..., G)`` real elements.

    Example:
        >>> mirror = torch.tensor([[0, 1, 2], [2, 1, 0]])
        >>> orbit_members(torch.tensor([2, 1, -1]), mirror).tolist()
        [[0, 2], [1, -1], [-1, -1]]
    """
    check_group("group_y", group_y, group_mask)
    require_ids("p2p_xy", p2p_xy, group_y.shape[-1], none=True)
    images = images_of(p2p_xy, group_y)
    if group_mask is not None:  # what is padding repeats the vertex itself
        images = torch.where(group_mask[..., None, :], images, images[..., :1])
    # Sorted, so that an orbit looks the same from each of its members, to the last bit of what is summed over it.
    images = images.sort(-1).values
    again = torch.cat([torch.zeros_like(images[..., :1], dtype=torch.bool), images[..., 1:] == images[..., :-1]], -1)
    return torch.where(again | (p2p_xy < 0)[..., None], -1, images)


def images_of(p2p_xy: Tensor, group_y: Tensor) -> Tensor:
    """``(..., N, G)``: g(T(x)) for each element, where there is no truth that of vertex 0."""
    at = p2p_xy.clamp_min(0)[..., None, :].expand(*group_y.shape[:-1], p2p_xy.shape[-1])
    return torch.gather(group_y, -1, at).transpose(-1, -2)


def point_weights(
    p2p_xy: Int[Tensor, "*B N"],
    like: Float[Tensor, "..."],
    mass_x: Float[Tensor, "*B X"] | None = None,
    samples: Int[Tensor, "*B N"] | None = None,
    truth_mask: Bool[Tensor, "*B N"] | None = None,
) -> Float[Tensor, "*B N"]:
    """``a_x``: share of each point in the mean over a shape, by its area; sums to 1, and is 0 where there is no truth.

    Args:
        p2p_xy: ``(..., N)`` true points; -1: none.
        like: a tensor of the wanted dtype and device.
        mass_x: ``(..., X)`` vertex areas of x (any unit; padding 0); all equal if not given.
        samples: ``(..., N)`` the vertices of x that have a truth; all of them in order (N = X) if not given.
        truth_mask: ``(..., N)`` false: no truth.

    Raises:
        ValueError: a sample or a shape does not fit, a mass is negative, or some shape has no point with weight.
    """
    if truth_mask is not None and truth_mask.dtype != torch.bool:
        raise ValueError(f"truth_mask: dtype {truth_mask.dtype} given, expected torch.bool (true: has a truth)")
    known = p2p_xy >= 0 if truth_mask is None else truth_mask & (p2p_xy >= 0)
    if mass_x is None:
        weights = known.to(like.dtype)
    else:
        require_nonnegative("mass_x", mass_x)
        if samples is None and mass_x.shape[-1] != p2p_xy.shape[-1]:
            raise ValueError(
                f"p2p_xy: {p2p_xy.shape[-1]} points given, but mass_x has {mass_x.shape[-1]} vertices; "
                "samples must say which of them have a truth"
            )
        if samples is not None:
            require_ids("samples", samples, mass_x.shape[-1])
            mass_x = torch.gather(mass_x, -1, samples)
        weights = torch.where(known, mass_x.to(like.dtype), 0.0)
    total = weights.sum(-1, keepdim=True)
    if enabled() and not bool((total > 0).all()):
        row = int((total.reshape(-1) <= 0).nonzero()[0, 0])
        raise ValueError(f"p2p_xy: no point of shape {row} has both a truth and a positive area; each needs one")
    return weights / torch.where(total > 0, total, 1.0)


def soft_minimum(
    values: Float[Tensor, "*B G"], temperature: float, mask: Bool[Tensor, "*B G"] | None = None
) -> Float[Tensor, "*B"]:
    """``-t log mean_g exp(-v_g / t)``: between minimum (``t`` = 0) and mean (``t`` large); of equal values, that value.

    Args:
        values: ``(..., G)``.
        temperature: t, in the unit of the values; 0 for the minimum itself.
        mask: ``(..., G)`` values that count.

    Example:
        >>> soft_minimum(torch.tensor([1.0, 1.0, 3.0]), 0.0).item(), soft_minimum(torch.ones(4), 0.5).item()
        (1.0, 1.0)
    """
    require_temperature(temperature)
    counted = values if mask is None else values.masked_fill(~mask, torch.finfo(values.dtype).max)
    if temperature == 0:
        return counted.amin(-1)
    least = counted.detach().amin(-1, keepdim=True)  # the result does not depend on it, so it needs no gradient
    powers = torch.exp(-(counted - least) / temperature)
    mean = powers.mean(-1) if mask is None else (powers * mask).sum(-1) / mask.sum(-1).clamp_min(1)
    return least[..., 0] - temperature * torch.log(mean)


def require_temperature(temperature: float) -> None:
    """Raise ``ValueError`` unless a soft minimum can have this temperature: 0, or a number with a finite inverse."""
    require_number("temperature", temperature, least=0)
    if 0 < temperature < COLDEST:
        raise ValueError(f"temperature: {temperature} given, expected 0 or a number from {COLDEST} on")
