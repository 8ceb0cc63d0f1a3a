"""What every matcher of a comparison takes and gives: one small protocol, what it may be told, and its result."""

from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.matching.parameters import MatchError
from torchqm.matching.shape import PreparedShape
from torchqm.matching.steps import Steps

__all__ = ["NOTHING", "BaselineResult", "Given", "Matcher", "make_result", "shared_size"]


@dataclass(frozen=True, eq=False)
class Given:
    """What a matcher is told of a pair beside the two shapes; it uses what it can and says in its notes what it used.

    Args:
        symmetry_x: ``(Gx, Vx)`` the source's symmetry as vertex maps, row 0 the identity.
        symmetry_y: ``(Gy, Vy)`` that of the target.
        side_x: ``(Vx,)`` of a reflection: any function with one sign on the left and the other on the right, such as
            the distance from the mirror plane of the undeformed pose; without it the sides are read off the symmetry.
        side_y: ``(Vy,)`` that of the target; which side is positive need not agree with the source.
        segments_x: ``(Vx,)`` the number of the part that each source vertex belongs to; negative: none.
        segments_y: ``(Vy,)`` the same of the target; equal numbers are parts that correspond.
        reference: an undeformed pose of the same shape that has a mirror plane.
    """

    symmetry_x: Int[Tensor, "Gx Vx"] | None = None
    symmetry_y: Int[Tensor, "Gy Vy"] | None = None
    side_x: Float[Tensor, " Vx"] | None = None
    side_y: Float[Tensor, " Vy"] | None = None
    segments_x: Int[Tensor, " Vx"] | None = None
    segments_y: Int[Tensor, " Vy"] | None = None
    reference: PreparedShape | None = None

    def check(self, x: PreparedShape, y: PreparedShape) -> None:
        """Refuse what does not fit the two shapes.

        Raises:
            MatchError: lengths that differ from the vertex counts, segments of one shape only or without a common part.
        """
        for name, values, shape in (
            ("symmetry_x", self.symmetry_x, x),
            ("symmetry_y", self.symmetry_y, y),
            ("side_x", self.side_x, x),
            ("side_y", self.side_y, y),
            ("segments_x", self.segments_x, x),
            ("segments_y", self.segments_y, y),
        ):
            if values is not None and values.shape[-1] != shape.n_verts:
                raise MatchError(
                    f"{name}: has {values.shape[-1]} entries a row, but {shape.mesh.label} has {shape.n_verts} vertices"
                )
        if (self.segments_x is None) != (self.segments_y is None):
            raise MatchError("segments: given for one of the two shapes only; they are needed on both, or on none")
        if self.segments_x is not None and not self.common_segments():
            raise MatchError("segments: the two shapes have no part number in common")

    def common_segments(self) -> list[int]:
        """Numbers of the parts that both shapes have, ascending; empty where no segments are given."""
        if self.segments_x is None or self.segments_y is None:
            return []
        both = set(self.segments_x.unique().tolist()) & set(self.segments_y.unique().tolist())
        return sorted(number for number in both if number >= 0)

    def reflections(self, x: PreparedShape, y: PreparedShape, method: str) -> tuple[Tensor, Tensor]:
        """The two symmetry tables, for a method that cannot do without them.

        Raises:
            MatchError: one of them is missing or has other than two rows.
        """
        tables = []
        for name, table, shape in (("symmetry_x", self.symmetry_x, x), ("symmetry_y", self.symmetry_y, y)):
            if table is None or table.shape[0] != 2:
                found = "none is given" if table is None else f"{table.shape[0]} maps are given"
                raise MatchError(
                    f"{method}: needs {name}, the reflection of {shape.mesh.label} as 2 vertex maps (the identity "
                    f"first); {found}"
                )
            tables.append(table)
        return tables[0], tables[1]


NOTHING = Given()
"""Nothing but the two shapes."""


@dataclass(frozen=True, eq=False)
class BaselineResult:
    """The maps of one matcher between two shapes, the one that it prefers first.

    Args:
        method: name of the matcher.
        maps: ``(G, Vx)`` int64: for each source vertex a target vertex; ranked, at least one row.
        labels: one a row: ``direct`` (keeps orientation), ``mirrored`` or ``unknown`` (the method does not say).
        steps: seconds of each step, in their order; eigenpairs and samples of the prepared shapes are not in it.
        notes: what was used, guessed or left out, in sentences.
        details: further numbers.
    """

    method: str
    maps: Int[Tensor, "G Vx"]
    labels: tuple[str, ...]
    steps: dict[str, float]
    notes: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)

    @property
    def best(self) -> Int[Tensor, " Vx"]:
        """The map that the method prefers."""
        return self.maps[0]

    @property
    def seconds(self) -> float:
        """Of all steps together."""
        return sum(self.steps.values())


@runtime_checkable
class Matcher(Protocol):
    """A way to match two shapes that a comparison can run by name.

    A matcher is a frozen dataclass of options: it may be pickled, sent to another process and run there. It keeps
    nothing between two calls, so that the seconds of a pair do not depend on what ran before it.
    """

    @property
    def name(self) -> str:
        """As on the command line and in tables."""
        ...

    @property
    def needs(self) -> tuple[str, ...]:
        """What it cannot do without: ``symmetry`` (both tables of :class:`Given`), ``reference``, ``self`` (x is y)."""
        ...

    def match(self, x: PreparedShape, y: PreparedShape, given: Given = NOTHING) -> BaselineResult:
        """Map the vertices of x to vertices of y.

        Args:
            x: source.
            y: target.
            given: what is known beside the shapes.

        Raises:
            MatchError: something that the method needs is missing, or does not fit the shapes.
            ImportError: the method runs through a package that is not installed.
        """
        ...


def make_result(
    method: str,
    x: PreparedShape,
    y: PreparedShape,
    maps: Tensor,
    steps: Steps,
    labels: tuple[str, ...] | None = None,
    notes: list[str] | None = None,
    **details: Any,
) -> BaselineResult:
    """A checked result.

    Args:
        method: name of the matcher.
        x: source.
        y: target.
        maps: ``(Vx,)`` or ``(G, Vx)`` target vertices.
        steps: the stopwatch that timed the method.
        labels: one a map; ``unknown`` if not given.
        notes: of the result.
        **details: of the result.

    Raises:
        ValueError: maps of a wrong length, type or number, or with ids that the target does not have: a fault of the
            matcher.
    """
    maps = maps.reshape(-1, maps.shape[-1])
    if maps.dtype != torch.int64 or maps.shape[0] < 1 or maps.shape[1] != x.n_verts:
        raise ValueError(f"{method}: gave {maps.dtype} maps of shape {tuple(maps.shape)} for {x.n_verts} vertices")
    if int(maps.min()) < 0 or int(maps.max()) >= y.n_verts:
        raise ValueError(f"{method}: gave ids {int(maps.min())}..{int(maps.max())}, the target has {y.n_verts}")
    labels = ("unknown",) * maps.shape[0] if labels is None else labels
    if len(labels) != maps.shape[0]:
        raise ValueError(f"{method}: gave {len(labels)} labels for {maps.shape[0]} maps")
    return BaselineResult(method, maps, labels, dict(steps.seconds), notes or [], details)


def shared_size(x: PreparedShape, y: PreparedShape, k: int, least: int = 4) -> int:
    """The largest basis size up to ``k`` that both shapes have.

    Raises:
        MatchError: it is below ``least``.
    """
    size = min(k, x.basis.k, y.basis.k)
    if size < least:
        raise MatchError(
            f"k={k}: the shapes have {x.basis.k} and {y.basis.k} eigenfunctions, at least {least} are needed"
        )
    return size
