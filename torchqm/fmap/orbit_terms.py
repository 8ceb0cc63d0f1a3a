"""The terms of the orbit losses, for dense and for sparse soft maps alike."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.checks import Sizes, require_ids
from torchqm.fmap.orbit_truth import point_weights
from torchqm.fmap.tables import require_weights
from torchqm.options import require_number
from torchqm.spectral.soft_map import SoftMap

__all__ = [
    "EPS",
    "Soft",
    "bind_distances",
    "bind_points",
    "bind_soft",
    "distances_at",
    "negative_log_mass",
    "require_eps",
    "rows_at",
    "rows_of_samples",
    "values_of",
]

Soft = SoftMap | Float[Tensor, "*B X Y"]
AnyRows = SoftMap | Tensor
"""A soft map at the samples only."""

EPS = 1e-12
"""Floor of the mass of which the logarithm is taken, unless another is given."""


def negative_log_mass(soft: AnyRows, sets: Tensor, log_weights: bool, eps: float) -> Tensor:
    """``-log`` of the mass on each of some sets of vertices ``sets (..., N, S, M)`` (-1: nobody): ``(..., N, S)``."""
    nobody = sets < 0
    if isinstance(soft, SoftMap):
        # One member after the other: never an (N, k, S, M) tensor.
        hit = torch.zeros(*sets.shape[:-1], soft.indices.shape[-1], dtype=torch.bool, device=sets.device)
        for m in range(sets.shape[-1]):
            hit = hit | (sets[..., m, None] == soft.indices[..., None, :])
        mass = (soft.weights[..., None, :] * hit).sum(-1)
    else:
        found = torch.gather(soft, -1, sets.clamp_min(0).flatten(-2)).unflatten(-1, sets.shape[-2:])
        if log_weights:
            least = torch.finfo(found.dtype).min / 4  # for minus infinity: finite, and so small that nothing is pulled
            return -torch.logsumexp(torch.where(nobody, least, found.clamp_min(least)), -1)
        mass = found.masked_fill(nobody, 0.0).sum(-1)
    # One plus eps in the dtype of the weights, so that a mass of 1 gives 0 exactly.
    return torch.log((1.0 + eps) * torch.ones_like(mass)) - torch.log(mass + eps)


def distances_at(dist_y: Tensor, targets: Tensor, soft: AnyRows) -> Tensor:
    """Distances from ``targets (..., N)`` to all vertices of y, or to the k neighbours of each row."""
    if not isinstance(soft, SoftMap):
        return rows_at(dist_y, targets)
    places = targets[..., None] * dist_y.shape[-1] + soft.indices
    return torch.gather(dist_y.flatten(-2), -1, places.flatten(-2)).unflatten(-1, soft.indices.shape[-2:])


def rows_at(values: Tensor, ids: Tensor) -> Tensor:
    """``values (..., V, C)`` in the rows ``ids (..., N)``."""
    return torch.gather(values, -2, ids[..., None].expand(*ids.shape, values.shape[-1]))


def values_of(soft: AnyRows) -> Tensor:
    """The weights of a soft map, dense ``(..., X, Y)`` or sparse ``(..., X, k)``."""
    return soft.weights if isinstance(soft, SoftMap) else soft


def rows_of_samples(soft: AnyRows, samples: Tensor | None, sizes: Sizes) -> AnyRows:
    """The rows of a soft map at the samples, or all of them."""
    if samples is None:
        return soft
    require_ids("samples", samples, sizes["X"])
    if isinstance(soft, SoftMap):
        return SoftMap(rows_at(soft.indices, samples), rows_at(soft.weights, samples), soft.n_targets)
    return rows_at(soft, samples)


def bind_soft(soft_xy: Soft, log_weights: bool = False) -> Sizes:
    """Check a soft map; learns X and Y."""
    sizes = Sizes()
    if isinstance(soft_xy, SoftMap):
        if log_weights:
            raise ValueError("log_weights: only for a dense soft_xy; a sparse map holds weights")
        sizes.bind("soft_xy", soft_xy.weights, "... X k")
        sizes.bind("soft_xy", soft_xy.indices, "... X k")
        require_ids("soft_xy", soft_xy.indices, soft_xy.n_targets)
        columns = soft_xy.weights.new_zeros(()).expand(soft_xy.n_targets)  # no memory: only its size is asked for
        sizes.bind("soft_xy", columns, "Y")
    else:
        sizes.bind("soft_xy", soft_xy, "... X Y")
    require_weights("soft_xy", values_of(soft_xy), log_weights)
    return sizes


def bind_points(
    sizes: Sizes,
    like: Tensor,
    p2p_xy: Tensor,
    mass_x: Tensor | None,
    samples: Tensor | None,
    truth_mask: Tensor | None,
) -> Tensor:
    """Check the true points and what belongs to them; their weights."""
    sizes.bind("p2p_xy", p2p_xy, "... N" if samples is not None else "... X")
    if samples is not None:
        sizes.bind("samples", samples, "... N")
    if truth_mask is not None:
        sizes.bind("truth_mask", truth_mask, "... N" if samples is not None else "... X")
    if mass_x is not None:
        sizes.bind("mass_x", mass_x, "... X")
    require_ids("p2p_xy", p2p_xy, sizes["Y"], none=True)
    return point_weights(p2p_xy, like, mass_x, samples, truth_mask)


def bind_distances(sizes: Sizes, dist_y: Tensor, group_y: Tensor) -> None:
    """Check a table of distances."""
    sizes.bind("dist_y", dist_y, "... Y Y")
    sizes.bind("group_y", group_y, "... G Y")
    require_weights("dist_y", dist_y)


def require_eps(eps: float) -> None:
    """Raise ``ValueError`` unless ``eps`` is a floor of weights."""
    require_number("eps", eps, above=0, below=1)
