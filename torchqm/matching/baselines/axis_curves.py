"""Matching from symmetry axis curves: align the axes of two shapes, and reach every other point from there.

References:
    Liu, Kim, Funkhouser. Finding surface correspondences using symmetry axis curves. SGP 2012: its second and third
    stage, "curve alignment" and "correspondence extrapolation". The first, finding the axis, is left out: the true axis
    is given, as in the comparison of the quotient paper (section 7.3, Figure 10).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.fmap.nearest import nearest_rows
from torchqm.geometry.geodesic import distances
from torchqm.matching.baselines.base import NOTHING, BaselineResult, Given, make_result, shared_size
from torchqm.matching.baselines.curve_alignment import SurfaceCurve, align_closed, axis_curve
from torchqm.matching.known import given_symmetry
from torchqm.matching.parameters import MatchError
from torchqm.matching.quality import orientation_agreement, orientation_label
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps
from torchqm.spectral.descriptors import wave_energies, wave_kernel_signature

__all__ = ["AxisCurves", "nearest_by_side"]


@dataclass(frozen=True)
class AxisCurves:
    """``axis-curves``: the axes aligned by dynamic programming, extended by geodesic distances to the axis.

    Features along the axis are wave kernel signatures. Every vertex is described by its geodesic distances to points
    spread over the axis, and goes to the vertex of the other shape, on one side of its axis, whose distances to the
    partners of these points are most alike. Left to left and left to right are both returned; the one that keeps
    orientation comes first.

    Args:
        n_points: along each axis.
        n_anchors: of these, evenly, to which distances are measured.
        stretch: penalty for unequal steps in the alignment.
        n_descriptors: energies of the wave kernel signature.
        k: eigenfunctions in it, at most.
        name: in tables.
        needs: ``symmetry``: the reflections of both shapes (and ``side_x``, ``side_y`` where they are known).
    """

    n_points: int = 128
    n_anchors: int = 32
    stretch: float = 0.1
    n_descriptors: int = 100
    k: int = 200
    name: str = "axis-curves"
    needs: tuple[str, ...] = ("symmetry",)

    def __post_init__(self) -> None:
        if not 3 <= self.n_anchors <= self.n_points:
            raise ValueError(f"n_anchors={self.n_anchors}: allowed are 3 to n_points={self.n_points}")

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """Two maps; see :class:`torchqm.matching.baselines.Matcher`.

        Raises:
            MatchError: a reflection is missing or is none.
        """
        given.check(x, y)
        tables = given.reflections(x, y, self.name)
        steps, notes = Steps(), []
        with steps("axes"):
            sides = [
                self._side(shape, table, side)
                for shape, table, side in zip((x, y), tables, (given.side_x, given.side_y), strict=True)
            ]
            curves = [axis_curve(shape.mesh, side, self.n_points) for shape, side in zip((x, y), sides, strict=True)]
        for shape, curve in zip((x, y), curves, strict=True):
            if curve.share < 0.9 or not curve.closed:
                how = "one closed curve" if curve.closed else "an open curve"
                notes.append(f"{shape.mesh.label}: {how} is used, {curve.share:.0%} of the length of the axis")
        with steps("alignment"):
            best, other = align_closed(*self._features(x, y, curves), self.stretch)
        with steps("distances to the axis"):
            at = torch.arange(self.n_anchors) * self.n_points // self.n_anchors
            far_x = distances(x.mesh, curves[0].vertices[at]).T
            far_y = distances(y.mesh, curves[1].vertices[best.partners[at]]).T
        with steps("point maps"):
            maps = [nearest_by_side(far_x, far_y, sides[0], turn * sides[1]) for turn in (1.0, -1.0)]
        labels = ["unknown", "unknown"]
        if x.oriented and y.oriented:
            with steps("orientation"):
                agreement = [orientation_agreement(x.mesh, y.mesh, p2p) for p2p in maps]
            order = sorted((0, 1), key=lambda i: -agreement[i])
            maps, labels = [maps[i] for i in order], [orientation_label(agreement[i]) for i in order]
        return make_result(
            self.name,
            x,
            y,
            torch.stack(maps),
            steps,
            tuple(labels),
            notes,
            cost=best.cost,
            cost_other_direction=other.cost,
            axis_lengths=[curve.length for curve in curves],
        )

    def _side(self, shape: PreparedShape, table: Tensor, side: Tensor | None) -> Tensor:
        """Left and right of a shape: what is given, else read off its reflection."""
        known = given_symmetry(shape, table)
        if not known.reflection:
            raise MatchError(f"{self.name}: the symmetry of {shape.mesh.label} is a rotation, which has no axis curve")
        return known.sign if side is None else _without_rounding(side)

    def _features(self, x: PreparedShape, y: PreparedShape, curves: list[SurfaceCurve]) -> tuple[Tensor, Tensor]:
        """Wave kernel signatures along both axes, each energy scaled to deviation 1 over the two."""
        k = shared_size(x, y, self.k)
        bases = [x.basis.truncate(k), y.basis.truncate(k)]
        energies = wave_energies(bases, self.n_descriptors)
        values = [c.values(wave_kernel_signature(b, energies)) for c, b in zip(curves, bases, strict=True)]
        scale = torch.cat(values).std(0).clamp_min(torch.finfo(values[0].dtype).tiny)
        return values[0] / scale, values[1] / scale


def _without_rounding(side: Float[Tensor, " V"]) -> Float[Tensor, " V"]:
    """0 on the axis itself, where the sign of a distance from the mirror plane is noise."""
    return torch.where(side.abs() > 1e-6 * side.abs().max(), side, 0.0)


def nearest_by_side(
    rows_x: Float[Tensor, "Vx D"],
    rows_y: Float[Tensor, "Vy D"],
    side_x: Float[Tensor, " Vx"],
    side_y: Float[Tensor, " Vy"],
) -> Int[Tensor, " Vx"]:
    """The nearest row on the same side; vertices on the axis (0), or of no side of y, are compared with all.

    Rows that are not finite (vertices that no path joins to the axis) are never chosen; such vertices of x go to the
    first vertex that can be chosen.
    """
    usable = torch.isfinite(rows_y).all(1)
    asks = torch.isfinite(rows_x).all(1)
    out = torch.full((len(rows_x),), int(usable.nonzero()[0]), dtype=torch.int64)
    for sign in (-1.0, 0.0, 1.0):
        mine = (asks & (torch.sign(side_x) == sign)).nonzero().flatten()
        there = (usable & (torch.sign(side_y) * sign >= 0)).nonzero().flatten()
        if len(mine):
            there = there if len(there) else usable.nonzero().flatten()
            out[mine] = there[nearest_rows(rows_x[mine], rows_y[there])]
    return out
