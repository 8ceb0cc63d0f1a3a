"""Whether a functional map and a soft point map say the same, and the points that several functional maps name."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchqm.checks import Sizes, require_finite
from torchqm.fmap.soft import feature_neighbours

__all__ = ["alignment_energy", "points_of_blocks"]


def alignment_energy(
    fmap_xy: Float[Tensor, "*B Ky Kx"],
    soft_yx: Float[Tensor, "*B Y X"],
    evecs_x: Float[Tensor, "*B X Kx"],
    evecs_trans_y: Float[Tensor, "*B Ky Y"],
) -> Float[Tensor, "*B"]:
    """``|| C_xy - Phi_y^T A_y Pi_yx Phi_x ||^2``: a functional map against the pull-back along a soft point map.

    Args:
        fmap_xy: takes functions on x to functions on y; 0 at padded functions.
        soft_yx: for each vertex of y weights over the vertices of x; rows and columns of padding are 0.
        evecs_x: basis of x; 0 at padding.
        evecs_trans_y: that of y, transposed, times its vertex areas; 0 at padding.

    Returns:
        ``(...)`` one value for each pair.

    Raises:
        ValueError: sizes that do not fit, or a number that is not finite.

    Example:
        >>> basis = torch.eye(2)
        >>> alignment_energy(torch.eye(2), basis.flip(0), basis, basis).item()
        4.0

    References:
        Cao, Roetzer, Bernard, Unsupervised learning of robust spectral shape matching, 2023, section 4.3.
    """
    sizes = Sizes()
    given = {"fmap_xy": fmap_xy, "soft_yx": soft_yx, "evecs_x": evecs_x, "evecs_trans_y": evecs_trans_y}
    for (name, value), dims in zip(given.items(), ("... Ky Kx", "... Y X", "... X Kx", "... Ky Y"), strict=True):
        sizes.bind(name, value, dims)
        require_finite(name, value)
    return (fmap_xy - evecs_trans_y @ (soft_yx @ evecs_x)).square().sum((-2, -1))


def points_of_blocks(
    fmaps_xy: Sequence[Float[Tensor, "..."]],
    evecs_x: Sequence[Float[Tensor, "..."]],
    evecs_y: Sequence[Float[Tensor, "..."]],
    verts_mask_y: Bool[Tensor, "*B Y"] | None = None,
) -> Int[Tensor, "*B X"]:
    """``T(x) = argmin_y sum_b || C_b phi^b_x - phi^b_y ||^2``: the point map of a block-diagonal functional map.

    With the even block alone it is a point-to-orbit map: which of the points of an orbit comes back is arbitrary.

    Args:
        fmaps_xy: ``(..., Ky, Kx)`` each, take functions on x to functions on y; 0 at padded functions.
        evecs_x: ``(..., X, Kx)`` bases of x, one for each block; 0 at padding.
        evecs_y: ``(..., Y, Ky)`` bases of y.
        verts_mask_y: ``(..., Y)`` real vertices of y; only these are named.

    Returns:
        ``p2p_xy (..., X)``; rows of padded vertices mean nothing.

    Raises:
        ValueError: other numbers of maps and of bases, or none, or as in :func:`torchqm.fmap.soft.feature_neighbours`.

    Example:
        >>> even, odd = torch.ones(2, 1), torch.tensor([[1.0], [-1.0]])
        >>> points_of_blocks([torch.eye(1), -torch.eye(1)], [even, odd], [even, odd]).tolist()
        [1, 0]
    """
    if not 0 < len(fmaps_xy) == len(evecs_x) == len(evecs_y):
        raise ValueError(
            f"fmaps_xy: {len(fmaps_xy)} given, with {len(evecs_x)} bases of x and {len(evecs_y)} of y; one of each for "
            "each block is needed"
        )
    images = torch.cat([basis @ fmap.mT for basis, fmap in zip(evecs_x, fmaps_xy, strict=True)], -1)
    return feature_neighbours(images, torch.cat(list(evecs_y), -1), 1, verts_mask_y, kind="distance")[..., 0]
