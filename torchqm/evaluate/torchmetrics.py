"""The measures of this package as ``torchmetrics`` classes, for training loops (Lightning logs them as they are).

Each counts a *map* once, however many points it has: what a class computes after any number of updates, on any number
of processes, is what :func:`torchqm.evaluate.summary.summarize` says of the same maps. Needs the package torchmetrics
(``pip install 'torchqm[torchmetrics]'``).

Example:
    >>> error, flips = GeodesicError("map"), FlipRate("points")
    >>> direct = torch.tensor([[0.0, 0.1], [0.4, 0.5]])  # errors against the truth and its mirror image
    >>> mirrored = torch.tensor([[0.5, 0.5], [0.0, 0.2]])
    >>> for metric in (error, flips):
    ...     metric.update(direct)
    ...     metric.update(mirrored)
    >>> round(error.compute().item(), 3), flips.compute().item()
    (0.075, 0.5)
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchqm.evaluate.curves import area_under_curve, cumulative_curve, curve_thresholds
from torchqm.evaluate.protocol import AUC_UPTO, PROTOCOLS, Protocol, evaluate_errors, flip_rate

try:
    from torchmetrics import Metric
except ImportError as error:
    raise ImportError(
        "torchqm.evaluate.torchmetrics needs the package torchmetrics (pip install 'torchqm[torchmetrics]'); "
        "the functions of torchqm.evaluate do without it"
    ) from error

__all__ = [
    "AreaUnderCurve",
    "CumulativeCurve",
    "FlipRate",
    "GeodesicError",
    "MeanMeasure",
    "MedianError",
    "ShareBelow",
]

Errors = Shaped[Tensor, "..."] | Sequence[Shaped[Tensor, "..."]]


class _MeanOverMaps(Metric):
    """A mean over maps, as a sum and a count: both add up over updates, merged metrics and processes."""

    is_differentiable = False
    full_state_update = False
    total: Tensor
    maps: Tensor

    def __init__(self, size: tuple[int, ...] = (), **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_state("total", default=torch.zeros(size, dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("maps", default=torch.tensor(0, dtype=torch.int64), dist_reduce_fx="sum")

    def _count(self, value: float | Tensor) -> None:
        self.total += torch.as_tensor(value, dtype=torch.float64, device=self.total.device)
        self.maps += 1

    def compute(self) -> Tensor:
        """Mean over all maps so far; NaN if there were none."""
        return self.total / self.maps


class MeanMeasure(_MeanOverMaps):
    """Mean over maps of any function that returns one number for a map, such as those of ``label_free``.

    Args:
        measure: called with what :meth:`update` is given.
        kwargs: options of ``torchmetrics.Metric``.

    Example:
        >>> from torchqm.evaluate.label_free import orthogonality
        >>> metric = MeanMeasure(orthogonality)
        >>> metric.update(torch.eye(3))
        >>> metric.update(torch.zeros(3, 3))
        >>> metric.compute().item()
        0.5
    """

    def __init__(self, measure: Callable[..., float | Tensor], **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.measure = measure

    def update(self, *args: Any, **kwargs: Any) -> None:
        """Measure one map."""
        self._count(self.measure(*args, **kwargs))


class _ErrorMetric(_MeanOverMaps):
    """A mean over maps of a number that follows from a map's errors under a protocol."""

    def __init__(self, protocol: str | Protocol = "plain", size: tuple[int, ...] = (), **kwargs: Any) -> None:
        super().__init__(size, **kwargs)
        if isinstance(protocol, str) and protocol not in PROTOCOLS:
            raise ValueError(f"protocol: {protocol!r} is unknown; allowed: {', '.join(PROTOCOLS)}")
        self.protocol = protocol

    def update(self, errors: Errors, weights: Errors | None = None) -> None:
        """Add one map or a batch of maps.

        Args:
            errors: of one map ``(S,)`` or ``(G, S)``, against its G true maps, the plain truth first; of a batch
                ``(B, G, S)``, or a list of B such matrices with their own numbers of points. From
                :meth:`TruthDistances.errors <torchqm.evaluate.metrics.TruthDistances.errors>` or
                :func:`~torchqm.evaluate.metrics.geodesic_errors`, or entries of a distance matrix over sqrt(area).
            weights: ``(S,)`` point weights, of all maps or, as ``(B, S)`` or a list, of each; weight 0 for padding.

        Raises:
            ValueError: if shapes do not fit, or errors or weights are unusable (NaN, negative, none).
        """
        # Measure all before counting any: a bad map in a batch leaves the metric as it was.
        for value in [self._value(*pair) for pair in _single_maps(errors, weights)]:
            self._count(value)

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> float | Tensor:
        raise NotImplementedError


class GeodesicError(_ErrorMetric):
    """Mean over maps of the mean error.

    Args:
        protocol: what counts as right, see :data:`~torchqm.evaluate.protocol.PROTOCOLS`.
        kwargs: options of ``torchmetrics.Metric``.
    """

    higher_is_better = False

    def __init__(self, protocol: str | Protocol = "plain", **kwargs: Any) -> None:
        super().__init__(protocol, **kwargs)

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> float:
        return evaluate_errors(errors, self.protocol, weights).mean


class MedianError(_ErrorMetric):
    """Mean over maps of the median error.

    Args:
        protocol: what counts as right.
        kwargs: options of ``torchmetrics.Metric``.
    """

    higher_is_better = False

    def __init__(self, protocol: str | Protocol = "plain", **kwargs: Any) -> None:
        super().__init__(protocol, **kwargs)

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> float:
        return evaluate_errors(errors, self.protocol, weights).median


class AreaUnderCurve(_ErrorMetric):
    """Mean over maps of the area under the cumulative curve up to a threshold, divided by it.

    Args:
        protocol: what counts as right.
        upto: the threshold, in sqrt(area).
        kwargs: options of ``torchmetrics.Metric``.

    Raises:
        ValueError: if ``upto`` is not positive.
    """

    higher_is_better = True

    def __init__(self, protocol: str | Protocol = "plain", upto: float = AUC_UPTO, **kwargs: Any) -> None:
        if not upto > 0:
            raise ValueError(f"upto: expected a positive threshold, got {upto}")
        super().__init__(protocol, **kwargs)
        self.upto = upto

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> float:
        return area_under_curve(evaluate_errors(errors, self.protocol, weights).errors, self.upto, weights)


class ShareBelow(_ErrorMetric):
    """Mean over maps of the share of points with an error of at most a threshold.

    Args:
        threshold: in sqrt(area).
        protocol: what counts as right.
        kwargs: options of ``torchmetrics.Metric``.
    """

    higher_is_better = True

    def __init__(self, threshold: float = 0.05, protocol: str | Protocol = "plain", **kwargs: Any) -> None:
        super().__init__(protocol, **kwargs)
        self.threshold = threshold

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> Tensor:
        report = evaluate_errors(errors, self.protocol, weights)
        return report.curve(torch.tensor([self.threshold], dtype=torch.float64))[0]


class CumulativeCurve(_ErrorMetric):
    """Mean over maps of the cumulative curve.

    Args:
        protocol: what counts as right.
        thresholds: ``(N,)`` the abscissa, :func:`~torchqm.evaluate.curves.curve_thresholds` if left out.
        kwargs: options of ``torchmetrics.Metric``.
    """

    def __init__(
        self,
        protocol: str | Protocol = "plain",
        thresholds: Float[Tensor, " N"] | None = None,
        **kwargs: Any,
    ) -> None:
        thresholds = curve_thresholds() if thresholds is None else thresholds
        super().__init__(protocol, size=tuple(thresholds.shape), **kwargs)
        self.thresholds = thresholds

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> Tensor:
        return cumulative_curve(evaluate_errors(errors, self.protocol, weights).errors, self.thresholds, weights)


class FlipRate(_ErrorMetric):
    """How much is mirrored: share of points, share of whole maps, or share of points in flipped patches.

    Args:
        level: ``points``, ``map`` or ``patches``, the fields of :class:`torchqm.evaluate.protocol.FlipRate`.
        margin: a point counts only if the other image is nearer by more than this.
        kwargs: options of ``torchmetrics.Metric``.

    Raises:
        ValueError: if the level is unknown or the margin negative.
    """

    higher_is_better = False

    def __init__(self, level: str = "points", margin: float = 0.0, **kwargs: Any) -> None:
        if level not in ("points", "map", "patches"):
            raise ValueError(f"level: {level!r} is unknown; allowed: points, map, patches")
        if not margin >= 0:
            raise ValueError(f"margin: expected a number >= 0, got {margin}")
        super().__init__(**kwargs)
        self.level, self.margin = level, margin

    def _value(self, errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> float:
        return float(getattr(flip_rate(errors, self.margin, weights), self.level))


def _single_maps(errors: Errors, weights: Errors | None) -> Iterator[tuple[Tensor, Tensor | None]]:
    """Each map's ``(G, S)`` errors and ``(S,)`` weights."""
    if isinstance(errors, Tensor):
        if errors.ndim not in (1, 2, 3):
            raise ValueError(f"errors: expected shape (S,), (G, S) or (B, G, S), got {tuple(errors.shape)}")
        batch = list(errors) if errors.ndim == 3 else [errors]
    else:
        batch = list(errors)
    if weights is None or (isinstance(weights, Tensor) and weights.ndim == 1):
        of_each: list[Any] = [weights] * len(batch)
    else:
        of_each = list(weights)
    if len(of_each) != len(batch):
        raise ValueError(f"weights: expected one row for each of the {len(batch)} maps, got {len(of_each)}")
    for one, weight in zip(batch, of_each, strict=True):
        if one.ndim not in (1, 2):
            raise ValueError(f"errors: expected each map's as (S,) or (G, S), got {tuple(one.shape)}")
        yield one.reshape(-1, one.shape[-1]), weight
