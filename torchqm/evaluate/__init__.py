"""Measures maps, whoever made them: geodesic errors, the field's protocols, curves."""

from torchqm.evaluate.curves import area_under_curve, cumulative_curve, curve_thresholds, mean_curve
from torchqm.evaluate.metrics import SurfacePoints, TruthDistances, geodesic_errors, group_truth, spread_points
from torchqm.evaluate.protocol import (
    PROTOCOLS,
    ErrorReport,
    FlipRate,
    Protocol,
    Summary,
    evaluate_errors,
    flip_rate,
    make_report,
    summarize,
)

__all__ = [
    "PROTOCOLS",
    "ErrorReport",
    "FlipRate",
    "Protocol",
    "Summary",
    "SurfacePoints",
    "TruthDistances",
    "area_under_curve",
    "cumulative_curve",
    "curve_thresholds",
    "evaluate_errors",
    "flip_rate",
    "geodesic_errors",
    "group_truth",
    "make_report",
    "mean_curve",
    "spread_points",
    "summarize",
]
