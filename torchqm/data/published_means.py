"""Means, curves and times of published methods, recomputed from their result files (:mod:`torchqm.data.published`)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.data.published import PublishedResult, load_published
from torchqm.evaluate.curves import cumulative_curve, curve_thresholds, mean_curve

__all__ = ["PublishedSummary", "published_summary", "summarize_published"]


@dataclass(frozen=True, eq=False)
class PublishedSummary:
    """Means over pairs of the per-pair numbers of one method; every mean comes with its number of pairs.

    Args:
        method: name of the method.
        n_pairs: pairs behind ``plain`` and ``curve``.
        plain: mean error at the 1024 samples against the plain truth.
        n_landmark_pairs: pairs behind ``landmarks``, ``landmark_curve`` and ``flipped``.
        landmarks: mean error at the landmarks, a flip of the whole map forgiven; None without such blocks.
        flipped: share of the maps that the benchmark calls flipped; None without such blocks.
        n_timed: pairs that state a running time.
        median_seconds: median running time over them; None if no pair states one (GMDS and the heat kernel maps).
        thresholds: ``(N,)`` abscissa of the curves, in sqrt(area).
        curve: ``(N,)`` mean over pairs of the share of samples with an error of at most each threshold (plain truth).
        landmark_curve: ``(N,)`` the same at the landmarks, a flip of the whole map forgiven.
    """

    method: str
    n_pairs: int
    plain: float
    n_landmark_pairs: int
    landmarks: float | None
    flipped: float | None
    n_timed: int
    median_seconds: float | None
    thresholds: Float[Tensor, " N"]
    curve: Float[Tensor, " N"]
    landmark_curve: Float[Tensor, " N"] | None


def published_summary(
    root: str | Path,
    method: str = "BlendedMap",
    pairs: Sequence[tuple[str, str]] | None = None,
    thresholds: Float[Tensor, " N"] | None = None,
) -> PublishedSummary:
    """Mean, curve and time of a published method, recomputed from its result files.

    Args:
        root: as for :func:`torchqm.data.load_published`.
        method: as in the file names, see :data:`PUBLISHED_METHODS`.
        pairs: only these, so that another method's mean over the same pairs can stand beside it; all 80 if left out.
        thresholds: see :func:`summarize_published`.

    Raises:
        FileNotFoundError: if there is no result of the method.
        ValueError: if a file is malformed, or one of ``pairs`` has no result.
    """
    results = {(result.source, result.target): result for result in load_published(root, method)}
    if pairs is not None and (absent := [pair for pair in pairs if pair not in results]):
        names = ", ".join(f"{a} -> {b}" for a, b in absent[:5])
        raise ValueError(f"pairs: {len(absent)} of {len(pairs)} have no result of {method} in {root}: {names}")
    return summarize_published([results[pair] for pair in (results if pairs is None else pairs)], thresholds)


def summarize_published(
    results: Sequence[PublishedResult], thresholds: Float[Tensor, " N"] | None = None
) -> PublishedSummary:
    """Mean of the per-pair means and curves, plain and flip-forgiven, and the median running time.

    Args:
        results: of one method.
        thresholds: ``(N,)`` of the curves; :func:`torchqm.evaluate.curves.curve_thresholds` if left out.

    Raises:
        ValueError: if there are no results, or results of several methods.
    """
    methods = sorted({result.method for result in results})
    if len(methods) != 1:
        raise ValueError(
            f"results: expected the results of one method, got {len(results)} results of {methods or 'none'}"
        )
    thresholds = curve_thresholds() if thresholds is None else thresholds
    marks = [result.landmarks for result in results if result.landmarks is not None]
    times = [result.seconds for result in results if result.seconds is not None]
    return PublishedSummary(
        method=methods[0],
        n_pairs=len(results),
        plain=_mean([float(result.plain.errors.mean()) for result in results]),
        n_landmark_pairs=len(marks),
        landmarks=_mean([float(block.errors.mean()) for block in marks]) if marks else None,
        flipped=_mean([float(bool(block.flipped)) for block in marks]) if marks else None,
        n_timed=len(times),
        median_seconds=float(torch.tensor(times, dtype=torch.float64).quantile(0.5)) if times else None,
        thresholds=thresholds,
        curve=mean_curve([cumulative_curve(result.plain.errors, thresholds) for result in results]),
        landmark_curve=mean_curve([cumulative_curve(block.errors, thresholds) for block in marks]) if marks else None,
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)
