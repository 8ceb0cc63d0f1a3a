"""Coefficients of split descriptors, block by block: the descriptors themselves never exist (paper, section 4.1)."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, log, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.spectral.descriptors import split_descriptors

__all__ = ["Splitting"]

_ROWS = 512  # of a block: a few arrays of 512 x 100 stay in the cache of one core


@dataclass(frozen=True, eq=False)
class Splitting:
    """The intervals into which :func:`torchqm.spectral.descriptors.split_descriptors` splits the values of shapes.

    With ``u = (f - a) / sigma`` in ``[0, s]`` the bumps are ``exp(-(u - i)^2)``, and each follows from the one before
    it by two products: ``exp(-(u - i - 1)^2) = exp(-(u - i)^2) exp(2 u) exp(-2 i - 1)``. So two exponentials do for
    any number of bumps. Their products with basis functions are summed over blocks of vertices.

    Args:
        low: ``(C,)`` smallest value of each descriptor on all the shapes.
        high: ``(C,)`` largest value.
        s: number of intervals; 0 leaves the values as they are.

    Raises:
        ValueError: a negative number of intervals.

    Example:
        >>> values = torch.tensor([[0.0], [0.5], [1.0]], dtype=torch.float64)
        >>> Splitting.of([values], 2).coefficients(values, torch.eye(3, dtype=torch.float64))[1]
        tensor([1.0000, 0.3679], dtype=torch.float64)
    """

    low: Float[Tensor, " C"]
    high: Float[Tensor, " C"]
    s: int

    def __post_init__(self) -> None:
        if self.s < 0:
            raise ValueError(f"s={self.s}: the number of intervals is 0 (no splitting) or more")

    @classmethod
    def of(cls, values: Sequence[Float[Tensor, "_V C"]], s: int = 5) -> "Splitting":
        """The intervals for the values of several shapes, one ``(V, C)`` tensor each."""
        low = torch.stack([v.amin(0) for v in values]).amin(0)
        high = torch.stack([v.amax(0) for v in values]).amax(0)
        return cls(low, high, s)

    def coefficients(self, values: Float[Tensor, "V C"], weights: Float[Tensor, "V K"]) -> Float[Tensor, "K _sC"]:
        """``W^T F`` for the split descriptors ``F`` of one shape.

        Args:
            values: its values, within the range of the intervals.
            weights: W, such as basis functions times vertex areas.

        Returns:
            ``(K, s C)``; bump i of descriptor c stands in column ``c s + i``.

        References:
            Paper, section 4.1, "Increasing the rank".
        """
        if self.s == 0:
            return weights.T @ values
        n, c = values.shape
        if not 1 <= self.s <= _most(values.dtype):
            return weights.T @ split_descriptors([torch.stack([self.low, self.high]), values], self.s)[1]
        total = weights.new_zeros(self.s, weights.shape[1], c)
        tiny = torch.finfo(values.dtype).tiny
        sigma = ((self.high - self.low) / self.s).clamp_min(tiny)
        for start in range(0, n, _ROWS):
            part = weights[start : start + _ROWS].T
            u = (values[start : start + _ROWS] - self.low).div_(sigma)
            growth = (2 * u).exp_()
            bump = u.square_().neg_().exp_()
            for i in range(self.s):
                bump.mul_(growth).mul_(exp(-2 * i - 1))
                total[i].addmm_(part, bump)
        return total.permute(1, 2, 0).reshape(weights.shape[1], -1)


def _most(dtype: torch.dtype) -> int:
    """Intervals up to which the first bump, ``exp(-s^2)`` at least, is a normal number (9 or 26), as products need."""
    return int(sqrt(-log(torch.finfo(dtype).tiny)))
