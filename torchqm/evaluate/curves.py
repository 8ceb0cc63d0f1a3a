"""Cumulative error curves and the area under them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

__all__ = ["area_under_curve", "cumulative_curve", "curve_thresholds", "mean_curve"]


def curve_thresholds(upto: float = 0.25, count: int = 201) -> Float[Tensor, " N"]:
    """Evenly spaced thresholds ``0 .. upto`` (in units of sqrt(area)), the abscissa of the field's curves.

    Example:
        >>> curve_thresholds(0.25, 6).tolist()
        [0.0, 0.05, 0.1, 0.15, 0.2, 0.25]
    """
    if not upto > 0 or count < 2:
        raise ValueError(f"upto, count: expected upto > 0 and count >= 2, got {upto} and {count}")
    return torch.arange(count, dtype=torch.float64) * upto / (count - 1)


def cumulative_curve(
    errors: Float[Tensor, " S"], thresholds: Float[Tensor, " N"], weights: Float[Tensor, " S"] | None = None
) -> Float[Tensor, " N"]:
    """Share of points (or of area) whose error is at most each threshold.

    Args:
        errors: ``(S,)`` errors; infinite ones are above every threshold.
        thresholds: ``(N,)`` in the unit of the errors; float64, where an error may equal one (0.1 is no float32).
        weights: ``(S,)`` nonnegative point weights, e.g. vertex areas; equal if left out.

    Returns:
        ``(N,)`` float64 shares in [0, 1].

    Raises:
        ValueError: if there are no errors, one is NaN or negative, or the weights are unusable.

    Example:
        >>> cumulative_curve(torch.tensor([0.0, 0.1, 0.3]), torch.tensor([0.0, 0.2])).tolist()
        [0.3333333333333333, 0.6666666666666666]
    """
    errors, share = checked_errors(errors, weights)
    order = errors.argsort()
    cumulated = torch.cat([share.new_zeros(1), share[order].cumsum(0)])
    cumulated[-1] = 1.0  # not 1 - 1e-16
    return cumulated[torch.searchsorted(errors[order], thresholds.to(errors).contiguous(), right=True)]


def area_under_curve(
    errors: Float[Tensor, " S"], upto: float = 0.25, weights: Float[Tensor, " S"] | None = None
) -> float:
    """Area under the cumulative curve on ``[0, upto]`` divided by ``upto``; 1 is perfect, exact (no thresholds).

    ``1/T int_0^T mean(e <= t) dt = mean(max(0, 1 - e / T))``

    Example:
        >>> area_under_curve(torch.tensor([0.0, 0.125, 1.0]), 0.25)
        0.5
    """
    if not upto > 0:
        raise ValueError(f"upto: expected a positive threshold, got {upto}")
    errors, share = checked_errors(errors, weights)
    return float((share * (1 - errors / upto).clamp_min(0)).sum())


def mean_curve(curves: Sequence[Float[Tensor, " N"]]) -> Float[Tensor, " N"]:
    """Mean over pairs of per-pair curves, so that every pair counts alike whatever its number of points.

    Example:
        >>> mean_curve([torch.tensor([0.0, 1.0]), torch.tensor([1.0, 1.0])]).tolist()
        [0.5, 1.0]
    """
    if not curves or len({len(curve) for curve in curves}) != 1:
        raise ValueError(
            f"curves: expected one or more curves of one length, got lengths {[len(curve) for curve in curves]}"
        )
    return torch.stack(list(curves)).mean(0)


def checked_errors(
    errors: Float[Tensor, " S"], weights: Float[Tensor, " S"] | None = None
) -> tuple[Float[Tensor, " S"], Float[Tensor, " S"]]:
    """Errors as float64 and the share of each point (sum one); ValueError on what no mean can be taken of."""
    errors = errors.detach().to(torch.float64)
    if len(errors) == 0 or bool(errors.isnan().any()) or bool((errors < 0).any()):
        bad = int((errors.isnan() | (errors < 0)).sum())
        raise ValueError(f"errors: expected one or more errors >= 0, got {len(errors)} of which {bad} negative or NaN")
    if weights is None:
        return errors, torch.full_like(errors, 1 / len(errors))
    weights = weights.detach().to(errors)
    total = float(weights.sum())
    if len(weights) != len(errors) or not bool((weights >= 0).all()) or not 0 < total < float("inf"):
        raise ValueError(
            f"weights: expected {len(errors)} finite weights >= 0, not all 0, got {len(weights)} with sum {total}"
        )
    return errors, weights / total
