"""Quick errors of point maps for the course of a training: straight lines through space instead of geodesics.

They need no solver and no mesh, take microseconds, and bound the geodesic errors of :mod:`torchqm.evaluate` from below.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.checks import Sizes, require_ids
from torchqm.fmap.orbit_truth import images_of
from torchqm.fmap.tables import check_group

__all__ = ["error_means", "straight_errors"]


def straight_errors(
    p2p_xy: Int[Tensor, "*B X"],
    truth_xy: Int[Tensor, "*B N"],
    samples: Int[Tensor, "*B N"],
    verts_y: Float[Tensor, "*B Y 3"],
    mass_y: Float[Tensor, "*B Y"],
    group_y: Int[Tensor, "*B G Y"],
) -> Float[Tensor, "*B G N"]:
    """``| v_{p(x)} - v_{g(T(x))} | / sqrt(area)`` for each element g and sample x: row 0 is the error to the truth.

    Args:
        p2p_xy: the map to measure, for each vertex of x a vertex of y.
        truth_xy: true vertices of y of the samples.
        samples: which vertices of x they are.
        verts_y: positions.
        mass_y: vertex areas.
        group_y: symmetries of y as vertex maps, row 0 the identity; rows that are padding repeat it and change neither
            a minimum over the rows nor a flip.

    Raises:
        ValueError: sizes that do not fit, or ids out of range.

    Example:
        >>> line, mirror = torch.tensor([[0.0, 0, 0], [2.0, 0, 0]]), torch.tensor([[0, 1], [1, 0]])
        >>> ids = torch.arange(2)
        >>> straight_errors(ids.flip(0), ids, ids, line, torch.ones(2) / 2, mirror).tolist()
        [[2.0, 2.0], [0.0, 0.0]]
    """
    sizes = Sizes()
    given = {"p2p_xy": p2p_xy, "truth_xy": truth_xy, "samples": samples, "verts_y": verts_y, "mass_y": mass_y}
    for (name, value), dims in zip(given.items(), ("... X", "... N", "... N", "... Y 3", "... Y"), strict=True):
        sizes.bind(name, value, dims)
    sizes.bind("group_y", group_y, "... G Y")
    check_group("group_y", group_y, None)
    require_ids("p2p_xy", p2p_xy, sizes["Y"])
    require_ids("truth_xy", truth_xy, sizes["Y"])
    require_ids("samples", samples, sizes["X"])
    found = _positions(verts_y, torch.gather(p2p_xy, -1, samples))
    wanted = images_of(truth_xy, group_y).mT  # (..., G, N)
    at = _positions(verts_y, wanted.flatten(-2)).unflatten(-2, wanted.shape[-2:])
    gaps = (found[..., None, :, :] - at).square().sum(-1).sqrt()
    return gaps / mass_y.sum(-1).sqrt()[..., None, None]


def error_means(errors: Float[Tensor, "*B G N"], weights: Float[Tensor, "*B N"]) -> dict[str, Float[Tensor, "*B"]]:
    """What is said of a map by its errors to each true map, row 0 the plain truth.

    * ``plain_error``: mean of row 0. ``orbit_error``: mean of the least of each column.
    * ``flipped_map``: 1 where the mean of another row is below that of row 0, else 0. ``flipped_points``: share of the
      points that are nearer to another image of the truth. Both as in :func:`torchqm.evaluate.protocol.flip_rate`.

    Args:
        errors: ``(..., G, N)`` of :func:`straight_errors`.
        weights: ``(..., N)`` of the points, sum 1, 0 at padding: :func:`torchqm.fmap.orbit_truth.point_weights`.

    Example:
        >>> means = error_means(torch.tensor([[4.0, 0.0], [0.0, 1.0]]), torch.tensor([0.5, 0.5]))
        >>> {name: value.item() for name, value in means.items()}
        {'plain_error': 2.0, 'orbit_error': 0.0, 'flipped_map': 1.0, 'flipped_points': 0.5}
    """
    means = (errors * weights[..., None, :]).sum(-1)
    least = errors.amin(-2)
    return {
        "plain_error": means[..., 0],
        "orbit_error": (least * weights).sum(-1),
        "flipped_map": (means.amin(-1) < means[..., 0]).to(errors.dtype),
        "flipped_points": ((least < errors[..., 0, :]) * weights).sum(-1),
    }


def _positions(verts: Tensor, ids: Tensor) -> Tensor:
    return torch.gather(verts, -2, ids[..., None].expand(*ids.shape, 3))
