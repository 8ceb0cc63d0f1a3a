"""Exact nearest neighbours between two sets of spectral coordinates, in bounded memory."""

from functools import cache
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["nearest_rows"]

_SMALL = 2_000_000  # distance entries below which one dense product beats building an index


@cache
def _faiss() -> ModuleType:
    import faiss

    return faiss


def nearest_rows(queries: Float[Tensor, "Q D"], points: Float[Tensor, "P D"]) -> Int[Tensor, " Q"]:
    """For each query the index of the nearest point: ``argmin_p || q - p ||``.

    Distances are computed in float32 by faiss' flat (exhaustive) index, which never holds the Q x P matrix; small
    problems are solved in the precision they come in. Where several points are equally near, one of them comes back.

    Raises:
        ValueError: the coordinates have different dimensions, there are no points, or some are not finite.

    Example:
        >>> nearest_rows(torch.tensor([[0.9]]), torch.tensor([[0.0], [1.0]])).tolist()
        [1]
    """
    if queries.shape[1] != points.shape[1]:
        raise ValueError(f"queries have {queries.shape[1]} coordinates, points have {points.shape[1]}")
    if points.shape[0] == 0:
        raise ValueError("points: there are none to choose from")
    if not (bool(torch.isfinite(queries).all()) and bool(torch.isfinite(points).all())):
        raise ValueError("queries and points must be finite; a spectral coordinate is NaN or infinite")
    if queries.shape[0] * points.shape[0] <= _SMALL:
        # || q - p ||^2 without || q ||^2, which is the same for all points
        return torch.argmax(queries @ points.T - points.square().sum(1) / 2, dim=1)
    index = _faiss().IndexFlatL2(points.shape[1])
    index.add(np.ascontiguousarray(points.detach().numpy(), dtype=np.float32))
    _, found = index.search(np.ascontiguousarray(queries.detach().numpy(), dtype=np.float32), 1)
    return torch.from_numpy(found[:, 0])
