"""Functions on a surface brought to one size."""

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["unit_mean_square"]


def unit_mean_square(values: Float[Tensor, "*B V C"], mass: Float[Tensor, "*B V"]) -> Float[Tensor, "*B V C"]:
    """``f / sqrt(1 / area sum_v m_v |f_v|^2)``: vectors at the vertices whose mean squared length is 1.

    One number for all channels of a shape, so what they are to each other stays; values that are 0 everywhere stay 0.

    Args:
        values: ``(..., V, C)`` values at the vertices.
        mass: ``(..., V)`` vertex areas; 0 at padding.

    Example:
        >>> unit_mean_square(torch.tensor([[3.0], [3.0]]), torch.tensor([0.5, 1.5])).tolist()
        [[1.0], [1.0]]
    """
    area = mass.sum(-1)
    square = (mass * values.square().sum(-1)).sum(-1) / torch.where(area > 0, area, 1.0)
    # The root of 0 has no derivative, and a value below the smallest normal number none that is finite.
    tiny = square <= torch.finfo(values.dtype).tiny
    root = torch.where(tiny, 1.0, square).sqrt()
    return values / root[..., None, None]
