"""A map of a pair against the truth of its set: at which points, against which images of the truth."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.benchmark.plan import Settings
from torchqm.data.base import ShapeSet, TruthError
from torchqm.data.folder import SameIdShapes
from torchqm.evaluate import MapEvaluation, SurfacePoints, evaluate_map
from torchqm.geometry import Mesh, farthest_points

__all__ = ["Measured", "measure_pair", "measure_symmetry", "undeformed"]

Points = Int[Tensor, "..."] | SurfacePoints


@dataclass(frozen=True, eq=False)
class Measured:
    """Errors of a map.

    Args:
        row: numbers for a table of pairs.
        errors: ``(S,)`` errors by protocol.
    """

    row: dict[str, Any]
    errors: dict[str, list[float]]

    @classmethod
    def of(cls, found: MapEvaluation) -> "Measured":
        """What an evaluation found."""
        return cls(found.to_row(), {name: report.errors.tolist() for name, report in found.reports.items()})


def undeformed(shapes: ShapeSet, cls: str) -> str | None:
    """The pose of a class that stands in its symmetric pose, if the set knows one."""
    if shapes.layout == "synthetic":  # pose 0 is at rest
        return next(name for name in shapes.names if shapes.shape_class(name) == cls)
    found = getattr(shapes, "undeformed", lambda _: None)(cls)
    return found if isinstance(found, str) else None


def measure_pair(shapes: ShapeSet, first: str, second: str, p2p: Int[Tensor, " V"], settings: Settings) -> Measured:
    """Errors of a map from ``first`` to ``second`` under the protocols ``plain``, ``map`` and ``orbit``.

    Where nothing is known of the symmetry of ``second`` it is ``plain`` alone. Where its reflection is known at a few
    points only (landmarks), ``map`` and ``orbit`` are measured at those and ``plain`` at the points of all pairs.

    Args:
        shapes: the set.
        first: source.
        second: target.
        p2p: ``(V,)`` target vertex of each source vertex.
        settings: points, solver and cache.

    Raises:
        TruthError: there is no truth, or none at the points.
    """
    truth, target = shapes.truth(first, second), shapes.mesh(second)
    rows = evaluation_rows(shapes, first, truth.at, settings)
    at, points = truth.at[rows], _take(truth.points, rows)

    def evaluate(points: Points, at: Tensor, group: Tensor | None, protocols: Sequence[str]) -> Measured:
        cache = None if settings.cache is None else settings.cache / "distances"
        return Measured.of(
            evaluate_map(
                target, p2p, points, at, group=group, protocols=protocols, method=settings.solver, cache_dir=cache
            )
        )

    group = shapes.symmetry(second)
    if group is not None and group.order != 2:
        return evaluate(points, at, group.maps, ("plain", "map", "orbit"))
    mirrored = shapes.mirrored_truth(first, second)
    if mirrored is None:
        return evaluate(points, at, None, ("plain",))
    place = torch.full((len(p2p),), -1)
    place[mirrored.at] = torch.arange(len(mirrored))
    if bool((place[at] >= 0).all()):
        return evaluate(_stack(points, _take(mirrored.points, place[at])), at, None, ("plain", "map", "orbit"))
    plain = evaluate(points, at, None, ("plain",))
    common = (place[truth.at] >= 0).nonzero().flatten()
    at = truth.at[common]
    both = _stack(_take(truth.points, common), _take(mirrored.points, place[at]))
    more = evaluate(both, at, None, ("map", "orbit"))
    row = {name: value for name, value in more.row.items() if name not in ("points", "solver")}
    return Measured({**plain.row, **row, "points_mirrored": len(at)}, plain.errors | more.errors)


def measure_symmetry(shapes: ShapeSet, name: str, p2p: Int[Tensor, " V"], settings: Settings) -> Measured | None:
    """Errors of a self-map against the true reflection; None where the set knows none (or several)."""
    truth = shapes.symmetry_truth(name)
    if truth is None:
        return None
    rows = evaluation_rows(shapes, name, truth.at, settings)
    cache = None if settings.cache is None else settings.cache / "distances"
    found = evaluate_map(
        shapes.mesh(name),
        p2p,
        _take(truth.points, rows),
        truth.at[rows],
        protocols=("symmetry",),
        method=settings.solver,
        cache_dir=cache,
    )
    return Measured.of(found)


def evaluation_rows(shapes: ShapeSet, name: str, at: Int[Tensor, " S"], settings: Settings) -> Int[Tensor, " R"]:
    """Which rows of a truth are measured.

    Where vertex ids agree in a class the points are spread over one pose and used on all, so that pairs can be compared
    (and distances from them are computed once); elsewhere they are spread over the source.

    Raises:
        TruthError: the truth is at none of the landmarks.
    """
    wanted = settings.points
    used = shapes.mesh(name).referenced[at].nonzero().flatten()  # no path leads to a vertex of no face
    if wanted < 0:
        benchmark = shapes.benchmark  # type: ignore[attr-defined]  # the plan has checked that it is there
        rows = torch.isin(at, benchmark.landmarks(shapes.shape_class(name))).nonzero().flatten()
        if not len(rows):
            raise TruthError(f"{name}: the truth is at none of the landmarks of its class")
        return rows
    if wanted == 0 or wanted >= len(used):
        return used
    cls = shapes.shape_class(name)
    pose = name
    if isinstance(shapes, SameIdShapes):
        pose = undeformed(shapes, cls) or next(other for other in shapes.names if shapes.shape_class(other) == cls)
    mesh = shapes.mesh(pose)
    usable = mesh.referenced
    if len(at) == mesh.n_verts and torch.equal(at, torch.arange(len(at))) and wanted <= int(usable.sum()):
        return _spread(_Pose(mesh), wanted)
    return used[_spread_among(shapes.mesh(name).verts[at[used]], wanted)]


class _Pose:
    """A mesh as a key: equal if it is the same file or the same object."""

    def __init__(self, mesh: Mesh) -> None:
        self.mesh = mesh
        self.key = (mesh.name, Path(mesh.path) if mesh.path else id(mesh), mesh.n_verts, float(mesh.verts.sum()))

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Pose) and self.key == other.key


@lru_cache(maxsize=32)
def _spread(pose: _Pose, n: int) -> Int[Tensor, " n"]:
    return farthest_points(pose.mesh, n).sort().values


def _spread_among(verts: Float[Tensor, "S 3"], n: int) -> Int[Tensor, " n"]:
    """Farthest points (in space) among some points, from the one that is farthest from their centre on."""
    nearest = torch.full((len(verts),), float("inf"), dtype=verts.dtype)
    chosen = [int((verts - verts.mean(0)).norm(dim=1).argmax())]
    while len(chosen) < n:
        nearest = torch.minimum(nearest, (verts - verts[chosen[-1]]).norm(dim=1))
        nearest[chosen] = -1.0
        chosen.append(int(nearest.argmax()))
    return torch.tensor(chosen).sort().values


def _take(points: Points, rows: Tensor) -> Points:
    return SurfacePoints(points.corners[rows], points.bary[rows]) if isinstance(points, SurfacePoints) else points[rows]


def _stack(direct: Points, mirrored: Points) -> Points:
    """The two true maps as ``(2, S)`` points; vertices become points in faces where one of the two is such."""
    if not isinstance(direct, SurfacePoints) and not isinstance(mirrored, SurfacePoints):
        return torch.stack([direct, mirrored])
    pair = [_in_face(points) for points in (direct, mirrored)]
    return SurfacePoints(torch.stack([p.corners for p in pair]), torch.stack([p.bary for p in pair]))


def _in_face(points: Points) -> SurfacePoints:
    if isinstance(points, SurfacePoints):
        return points
    corner = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    return SurfacePoints(points[:, None].expand(-1, 3), corner.expand(len(points), 3))
