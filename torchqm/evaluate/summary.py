"""Numbers over many pairs: every pair counts once, however many points it has."""

from collections.abc import Sequence
from dataclasses import dataclass

from torchqm.evaluate.protocol import SHARES, ErrorReport, FlipRate

__all__ = ["FlipSummary", "Summary", "summarize", "summarize_flips"]


@dataclass(frozen=True)
class FlipSummary:
    """Flip rates over pairs; every pair counts once.

    Args:
        n_pairs: number of pairs; print it with them.
        points: mean over pairs of the share of flipped points (point-level).
        maps: share of pairs whose map is flipped as a whole (map-level).
        patches: mean over pairs of the share of points in flipped patches.
    """

    n_pairs: int
    points: float
    maps: float
    patches: float


@dataclass(frozen=True)
class Summary:
    """Means over pairs of the per-pair numbers; every pair counts once, however many points it has.

    Args:
        protocol: the one protocol of all reports.
        n_pairs: number of pairs behind the means; print it with them.
        mean, median, auc, share_below: means of the reports' numbers.
        worst: the largest per-pair mean.
        solver: the geodesic solver behind the errors, all of them if there were several ("fast_marching, heat"); None
            where a report does not say.
    """

    protocol: str
    n_pairs: int
    mean: float
    median: float
    auc: float
    share_below: dict[float, float]
    worst: float
    solver: str | None = None

    def to_dict(self) -> dict[str, object]:
        """The numbers, ready for JSON (thresholds become strings)."""
        return {
            **self.__dict__,
            "share_below": {str(threshold): share for threshold, share in self.share_below.items()},
        }


def summarize(reports: Sequence[ErrorReport]) -> Summary:
    """Means over pairs of per-pair numbers.

    Raises:
        ValueError: if there are no reports or they mix protocols.

    Example:
        >>> import torch
        >>> from torchqm.evaluate.protocol import make_report
        >>> a, b = make_report("plain", torch.tensor([0.0, 0.2])), make_report("plain", torch.tensor([0.3]))
        >>> summary = summarize([a, b])
        >>> summary.n_pairs, round(summary.mean, 3)
        (2, 0.2)
    """
    names = sorted({report.protocol for report in reports})
    if len(names) != 1:
        raise ValueError(
            f"reports: expected one or more reports of one protocol, got {len(reports)} of {names or 'none'}"
        )
    count, solvers = len(reports), {report.solver for report in reports}
    return Summary(
        protocol=names[0],
        n_pairs=count,
        mean=sum(report.mean for report in reports) / count,
        median=sum(report.median for report in reports) / count,
        auc=sum(report.auc for report in reports) / count,
        share_below={t: sum(report.share_below[t] for report in reports) / count for t in SHARES},
        worst=max(report.mean for report in reports),
        solver=None if None in solvers else ", ".join(sorted({str(solver) for solver in solvers})),
    )


def summarize_flips(rates: Sequence[FlipRate]) -> FlipSummary:
    """Flip rates over pairs: the mean share of flipped points, and the share of flipped maps.

    Raises:
        ValueError: if there are none.

    Example:
        >>> summarize_flips([FlipRate(0.1, False, 0.1), FlipRate(0.9, True, 0.1)])
        FlipSummary(n_pairs=2, points=0.5, maps=0.5, patches=0.1)
    """
    if not rates:
        raise ValueError("rates: expected one or more flip rates, got none")
    count = len(rates)
    return FlipSummary(
        n_pairs=count,
        points=sum(rate.points for rate in rates) / count,
        maps=sum(rate.map for rate in rates) / count,
        patches=sum(rate.patches for rate in rates) / count,
    )
