"""What counts as right: the protocols of the paper's figures, as small named objects over one matrix of errors.

Input everywhere is the matrix ``errors (G, S)``: at each of S points the distance of *one* predicted map from the g-th
true map, row 0 being the plain (direct) truth and the other rows its images under the symmetry group of the target
(:func:`torchqm.evaluate.metrics.group_truth`).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from torchqm.evaluate.curves import area_under_curve, checked_errors, cumulative_curve, curve_thresholds

__all__ = [
    "PROTOCOLS",
    "SHARES",
    "ErrorReport",
    "FlipRate",
    "Protocol",
    "evaluate_errors",
    "flip_rate",
    "make_report",
]

SHARES = (0.05, 0.1, 0.25)
"""Thresholds of :attr:`ErrorReport.share_below`."""

AUC_UPTO = 0.25
"""Upper threshold of :attr:`ErrorReport.auc`."""


@dataclass(frozen=True)
class Protocol:
    """A way to turn errors against each true map into one error a point.

    Args:
        name: ``plain``, ``map``, ``orbit`` or ``symmetry``.
        description: one line for tables and ``--help``.
        forgives: ``nothing`` (row 0 counts), ``map`` (the row with the least mean counts) or ``point`` (the least at
            each point).
    """

    name: str
    description: str
    forgives: str


PROTOCOLS: dict[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol("plain", "distance from the direct truth, no flip forgiven", "nothing"),
        Protocol(
            "map",
            "truth of the group element with the least mean for the whole map (Figure 10, BIM's benchmark)",
            "map",
        ),
        Protocol("orbit", "least distance over the group at every point (Figure 6)", "point"),
        Protocol("symmetry", "self-map of one shape against its true symmetry (Figure 8)", "nothing"),
    )
}
"""The protocols by name."""


@dataclass(frozen=True, eq=False)
class ErrorReport:
    """Errors of one map under one protocol and the numbers that the field prints.

    Args:
        protocol: name of the protocol.
        errors: ``(S,)`` float64, geodesic distance / sqrt(area of the target); infinite between components.
        mean: (weighted) mean.
        median: least error that at least half of the points (or area) do not exceed.
        auc: area under the cumulative curve up to 0.25, divided by 0.25; larger is better.
        share_below: share of points with error at most 0.05, 0.1, 0.25, by threshold.
        n_points: S.
        element: which row of the error matrix counted (``map``: the best one); None where it differs from point to
            point.
        solver: the geodesic solver behind the errors (:attr:`TruthDistances.method`); None where nobody said.
        weights: ``(S,)`` the point weights behind the numbers; None if equal.
    """

    protocol: str
    errors: Float[Tensor, " S"]
    mean: float
    median: float
    auc: float
    share_below: dict[float, float]
    n_points: int
    element: int | None
    solver: str | None = None
    weights: Float[Tensor, " S"] | None = None

    def curve(self, thresholds: Float[Tensor, " N"] | None = None) -> Float[Tensor, " N"]:
        """The cumulative curve at thresholds, those of :func:`~torchqm.evaluate.curves.curve_thresholds` if not given.

        Example:
            >>> make_report("plain", torch.tensor([0.0, 0.2])).curve(torch.tensor([0.1, 0.2])).tolist()
            [0.5, 1.0]
        """
        thresholds = curve_thresholds() if thresholds is None else thresholds
        return cumulative_curve(self.errors, thresholds, self.weights)

    def to_row(self) -> dict[str, float | int | None]:
        """The numbers as columns of a table of pairs: ``plain_mean``, ``plain_median``, ``plain_below_0.05``, ...

        Example:
            >>> list(make_report("map", torch.tensor([0.0])).to_row())[:3]
            ['map_mean', 'map_median', 'map_auc']
        """
        numbers = {"mean": self.mean, "median": self.median, "auc": self.auc}
        numbers |= {f"below_{threshold}": share for threshold, share in self.share_below.items()}
        return {f"{self.protocol}_{key}": value for key, value in numbers.items()}

    def to_dict(self) -> dict[str, object]:
        """The numbers without the per-point errors, ready for JSON (thresholds become strings)."""
        return {
            "protocol": self.protocol,
            "mean": self.mean,
            "median": self.median,
            "auc": self.auc,
            "share_below": {str(threshold): share for threshold, share in self.share_below.items()},
            "n_points": self.n_points,
            "element": self.element,
            "solver": self.solver,
        }


@dataclass(frozen=True)
class FlipRate:
    """How much of a map is mirrored.

    Args:
        points: share of points strictly nearer to an image of the truth than to the truth itself.
        map: whether an image of the truth has a smaller mean error than the truth: the map as a whole is flipped.
        patches: share of points strictly nearer to another image than to the best one for the whole map: flipped
            patches in a map that is otherwise direct or otherwise mirrored, the part that the ``map`` protocol does
            not forgive.
    """

    points: float
    map: bool
    patches: float


def evaluate_errors(
    errors: Float[Tensor, "G S"],
    protocol: str | Protocol = "map",
    weights: Float[Tensor, " S"] | None = None,
    solver: str | None = None,
) -> ErrorReport:
    """Apply a protocol to the errors of one map.

    Args:
        errors: ``(G, S)`` errors against the G true maps, row 0 the plain truth.
        protocol: a :class:`Protocol` or its name.
        weights: ``(S,)`` point weights, e.g. the vertex areas of the source at the points; equal if left out.
        solver: what computed the distances, to be named in the result.

    Raises:
        ValueError: if the protocol is unknown, or the errors or weights are unusable (NaN, negative, none).

    Example:
        >>> flipped = torch.tensor([[0.4, 0.0, 0.4], [0.0, 0.1, 0.0]])
        >>> [round(evaluate_errors(flipped, name).mean, 4) for name in ("plain", "map", "orbit")]
        [0.2667, 0.0333, 0.0]
    """
    protocol = _protocol(protocol)
    if errors.shape[0] == 0:
        raise ValueError("errors: expected a row for each true map, got none")
    if protocol.forgives == "point":
        return make_report(protocol.name, errors.min(0).values, weights, None, solver)
    element = int(_means(errors, weights).argmin()) if protocol.forgives == "map" else 0
    return make_report(protocol.name, errors[element], weights, element, solver)


def make_report(
    protocol: str,
    errors: Float[Tensor, " S"],
    weights: Float[Tensor, " S"] | None = None,
    element: int | None = None,
    solver: str | None = None,
) -> ErrorReport:
    """Report of errors that are already one a point, e.g. published ones."""
    values, share = checked_errors(errors, weights)
    order = values.argsort()
    # 1e-12: a sum of equal weights may fall short of one half by rounding
    median = float(values[order][int((share[order].cumsum(0) < 0.5 - 1e-12).sum())])
    curve = cumulative_curve(values, torch.tensor(SHARES, dtype=torch.float64), weights)
    return ErrorReport(
        protocol=protocol,
        errors=values,
        mean=_weighted_mean(values, share),
        median=median,
        auc=area_under_curve(values, AUC_UPTO, weights),
        share_below=dict(zip(SHARES, curve.tolist(), strict=True)),
        n_points=len(values),
        element=element,
        solver=solver,
        weights=weights,
    )


def flip_rate(
    errors: Float[Tensor, "G S"], margin: float = 0.0, weights: Float[Tensor, " S"] | None = None
) -> FlipRate:
    """How much of a map is mirrored, at points and as a whole; nothing is where the group is trivial.

    Args:
        errors: ``(G, S)`` errors against the G true maps, row 0 the plain truth.
        margin: a point counts only if the other image is nearer by more than this. Near the axis the images of the
            truth coincide and noise alone decides which is nearer; a margin such as 0.05 leaves only real flips.
        weights: ``(S,)`` point weights; equal if left out.

    Raises:
        ValueError: if the margin is negative, or the errors or weights are unusable.

    Example:
        >>> flip_rate(torch.tensor([[0.0, 0.0, 0.0, 0.5], [0.5, 0.5, 0.5, 0.0]]))
        FlipRate(points=0.25, map=False, patches=0.25)
    """
    if not margin >= 0:
        raise ValueError(f"margin: expected a number >= 0, got {margin}")
    if errors.shape[0] == 0:
        raise ValueError("errors: expected a row for each true map, got none")
    means = _means(errors, weights)
    best, (nearest, share) = int(means.argmin()), checked_errors(errors.min(0).values, weights)

    def nearer_elsewhere(row: int) -> float:
        return float(share[nearest < errors[row].to(torch.float64) - margin].sum())

    return FlipRate(points=nearer_elsewhere(0), map=bool(means[best] < means[0]), patches=nearer_elsewhere(best))


def _protocol(protocol: str | Protocol) -> Protocol:
    if isinstance(protocol, Protocol):
        return protocol
    if protocol not in PROTOCOLS:
        raise ValueError(f"protocol: {protocol!r} is unknown; allowed: {', '.join(PROTOCOLS)}")
    return PROTOCOLS[protocol]


def _means(errors: Float[Tensor, "G S"], weights: Float[Tensor, " S"] | None) -> Float[Tensor, " G"]:
    return torch.tensor([_weighted_mean(*checked_errors(row, weights)) for row in errors], dtype=torch.float64)


def _weighted_mean(errors: Float[Tensor, " S"], share: Float[Tensor, " S"]) -> float:
    used = share > 0  # 0 * inf would be NaN
    return float((errors[used] * share[used]).sum())
