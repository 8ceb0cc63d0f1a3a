"""Measures maps, whoever made them: geodesic errors, protocols, curves, measures without a truth, reports."""

from torchqm.evaluate.curves import area_under_curve, cumulative_curve, curve_thresholds, mean_curve
from torchqm.evaluate.distances import pair_distances, solver_used
from torchqm.evaluate.evaluation import MapEvaluation, evaluate_map
from torchqm.evaluate.metrics import SurfacePoints, TruthDistances, geodesic_errors, group_truth, spread_points
from torchqm.evaluate.protocol import (
    PROTOCOLS,
    ErrorReport,
    FlipRate,
    Protocol,
    evaluate_errors,
    flip_rate,
    make_report,
)
from torchqm.evaluate.summary import FlipSummary, Summary, summarize, summarize_flips

__all__ = [
    "PROTOCOLS",
    "ErrorReport",
    "FlipRate",
    "FlipSummary",
    "MapEvaluation",
    "Protocol",
    "Summary",
    "SurfacePoints",
    "TruthDistances",
    "area_under_curve",
    "cumulative_curve",
    "curve_thresholds",
    "evaluate_errors",
    "evaluate_map",
    "flip_rate",
    "geodesic_errors",
    "group_truth",
    "make_report",
    "mean_curve",
    "pair_distances",
    "solver_used",
    "spread_points",
    "summarize",
    "summarize_flips",
]
