"""One map measured: its errors, every protocol's numbers, its flips, and the solver that stands behind them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float, Int
from torch import Tensor

from torchqm.evaluate.distances import solver_used
from torchqm.evaluate.metrics import SurfacePoints, TruthDistances, geodesic_errors, group_truth
from torchqm.evaluate.protocol import ErrorReport, FlipRate, Protocol, evaluate_errors, flip_rate
from torchqm.geometry.mesh import Mesh

__all__ = ["MapEvaluation", "evaluate_map"]


@dataclass(frozen=True, eq=False)
class MapEvaluation:
    """What the errors of one point map say.

    Args:
        errors: ``(G, S)`` float64 errors against the G true maps, row 0 the plain truth.
        reports: the numbers under each protocol, by its name.
        flips: how much of the map is mirrored; None where there is one true map alone.
        solver: the geodesic solver that ran.
    """

    errors: Float[Tensor, "G S"]
    reports: dict[str, ErrorReport]
    flips: FlipRate | None
    solver: str

    def to_row(self) -> dict[str, float | int | str | bool | None]:
        """The numbers as one flat row of a table of pairs, for :func:`torchqm.evaluate.report.write_report`."""
        row: dict[str, float | int | str | bool | None] = {
            "points": int(self.errors.shape[1]),
            "true_maps": int(self.errors.shape[0]),
            "solver": self.solver,
        }
        for report in self.reports.values():
            row |= report.to_row()
        if self.flips is not None:
            row |= {
                "flip_points": self.flips.points,
                "flip_map": self.flips.map,
                "flip_patches": self.flips.patches,
            }
        return row


def evaluate_map(
    target_mesh: Mesh,
    p2p: Int[Tensor, " Vs"],
    truth: Int[Tensor, "..."] | SurfacePoints,
    at: Int[Tensor, " S"] | None = None,
    group: Int[Tensor, "G Vt"] | None = None,
    protocols: Sequence[str | Protocol] = ("plain", "map", "orbit"),
    method: str = "fast_marching",
    distances: TruthDistances | None = None,
    cache_dir: str | Path | None = None,
    weights: Float[Tensor, " S"] | None = None,
    margin: float = 0.0,
) -> MapEvaluation:
    """Measure one point-to-point map under several protocols.

    Args:
        target_mesh: the target.
        p2p: ``(Vs,)`` target vertex of each source vertex (source to target).
        truth: ``(S,)`` true target vertices of the points ``at`` (or points inside faces); ``(G, S)`` where the images
            under the group are known already. For a self-map the true symmetry, with ``protocols=["symmetry"]``.
        at: ``(S,)`` source vertices at which to measure; all of them if left out.
        group: ``(G, Vt)`` vertex maps of the target's symmetries, identity first, for an ``(S,)`` truth.
        protocols: names of :data:`~torchqm.evaluate.protocol.PROTOCOLS`, or own ones.
        method: geodesic solver; ignored if ``distances`` is given.
        distances: rows built before for this target; they must contain all true points, images included.
        cache_dir: see :func:`~torchqm.evaluate.metrics.geodesic_errors`.
        weights: ``(S,)`` point weights, e.g. vertex areas of the source; equal if left out.
        margin: of the flip rate, see :func:`~torchqm.evaluate.protocol.flip_rate`.

    Raises:
        ValueError: naming the argument that does not fit.

    Example:
        >>> import torch
        >>> square = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]])
        >>> mirror = torch.tensor([[0, 1, 2, 3], [1, 0, 3, 2]])
        >>> result = evaluate_map(square, mirror[1], torch.arange(4), group=mirror)
        >>> {name: report.mean for name, report in result.reports.items()}, result.flips.map, result.solver
        ({'plain': 1.0, 'map': 0.0, 'orbit': 0.0}, True, 'fast_marching')
    """
    shape = truth.corners.shape[:-1] if isinstance(truth, SurfacePoints) else truth.shape
    if len(shape) not in (1, 2) or (group is not None and len(shape) == 2):
        wanted = "(S,), the group gives the images" if group is not None else "(S,) or (G, S)"
        raise ValueError(f"truth: expected shape {wanted}, got {tuple(shape)}")
    if group is not None:
        if group.shape[1] != target_mesh.n_verts:
            raise ValueError(
                f"group: its maps have {group.shape[1]} entries, {target_mesh.label} has {target_mesh.n_verts} vertices"
            )
        truth = group_truth(truth, group)
    if distances is None and TruthDistances.fits(target_mesh, truth):
        distances = TruthDistances.build(target_mesh, truth, method, cache_dir)
    errors = geodesic_errors(target_mesh, p2p, truth, at, method, distances, cache_dir)
    errors = errors if errors.ndim == 2 else errors[None]
    solver = distances.method if distances is not None else solver_used(target_mesh, method)
    reports = [evaluate_errors(errors, protocol, weights, solver) for protocol in protocols]
    flips = flip_rate(errors, margin, weights) if len(errors) > 1 else None
    return MapEvaluation(errors, {report.protocol: report for report in reports}, flips, solver)
