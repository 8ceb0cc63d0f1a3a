"""What every set of shapes offers, whatever its folder looks like: meshes, truth, symmetries, and what is wrong.

The readers of :mod:`torchqm.data` are subclasses of :class:`ShapeSet`; :func:`torchqm.data.open_shapes` chooses one.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from torchqm.data.published import natural_key
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.geometry import Mesh, load_mesh
from torchqm.symmetry import SymmetryGroup

__all__ = ["LayoutError", "Problem", "ShapeSet", "Truth", "TruthError"]


class TruthError(ValueError):
    """There is no truth for a pair, or its file cannot be used; the message says which and why."""


class TruthFileError(TruthError):
    """The file of a truth cannot be used; the message names it and says why."""


class LayoutError(ValueError):
    """A root that is no set of shapes which torchqm knows; the message names it and what was looked for."""


@dataclass(frozen=True, eq=False)
class Truth:
    """True correspondences from the first shape of a pair to the second, at some points or at all vertices.

    Args:
        at: ``(S,)`` vertices of the first shape.
        points: where they truly go on the second: ``(S,)`` vertices of it, or S points inside its faces.
        source: where this was read, in a phrase ("vertex ids agree in class cat", "corres/x.vts (1-based)").

    Raises:
        ValueError: the two have different lengths.

    Example:
        >>> truth = Truth(torch.tensor([4, 7]), torch.tensor([1, 0]), "two landmarks")
        >>> len(truth), truth.vertices.tolist()
        (2, [1, 0])
    """

    at: Int[Tensor, " S"]
    points: Int[Tensor, " S2"] | SurfacePoints
    source: str

    def __post_init__(self) -> None:
        points = self.points.corners if isinstance(self.points, SurfacePoints) else self.points
        if len(points) != len(self.at):
            raise ValueError(f"points: {len(points)} given for {len(self.at)} vertices in 'at'")

    def __len__(self) -> int:
        return len(self.at)

    @property
    def vertices(self) -> Int[Tensor, " S"]:
        """The true points as vertices: of a point inside a face the corner with the largest weight."""
        if isinstance(self.points, SurfacePoints):
            best = self.points.bary.argmax(-1, keepdim=True)
            return self.points.corners.gather(-1, best)[..., 0]
        return self.points


@dataclass(frozen=True)
class Problem:
    """One thing that the check of a folder found.

    Args:
        name: the shape, or the file where it belongs to none.
        path: the file.
        what: what is wrong, in a sentence.
        severity: ``missing`` (a file that the layout needs), ``malformed`` (a file that cannot be used), or ``note``
            (nothing is wrong, but it should be known).
    """

    name: str
    path: Path | None
    what: str
    severity: Literal["missing", "malformed", "note"]


class ShapeSet(abc.ABC):
    """A set of shapes with whatever truth it ships.

    Attributes:
        root: the folder, or a word such as ``synthetic:``.
        layout: short name of the layout (``scb``, ``vts``, ``plain``, ...).
        recognised: what was recognised and why, in sentences: layout, index base, counts.
    """

    root: Path | str
    layout: str
    recognised: list[str]

    @property
    @abc.abstractmethod
    def names(self) -> list[str]:
        """All usable shapes, in natural order."""

    @abc.abstractmethod
    def shape_class(self, name: str) -> str:
        """The class of a shape; truth is only ever expected inside a class, unless the set says otherwise."""

    @abc.abstractmethod
    def path(self, name: str) -> Path | None:
        """The mesh file of a shape; None where shapes are made, not read.

        Raises:
            ValueError: there is no such shape.
        """

    @abc.abstractmethod
    def truth(self, first: str, second: str) -> Truth:
        """True correspondences from ``first`` to ``second``.

        Raises:
            TruthError: there are none, and why.
            ValueError: there is no such shape.
        """

    @abc.abstractmethod
    def problems(self) -> list[Problem]:
        """Every file looked at: what is missing, malformed, or worth knowing."""

    @property
    def classes(self) -> list[str]:
        """The classes that occur, in natural order."""
        return sorted({self.shape_class(name) for name in self.names}, key=natural_key)

    def mesh(self, name: str) -> Mesh:
        """The mesh of a shape, named ``name``.

        Raises:
            MeshError: its file cannot be read.
            ValueError: there is no such shape.
        """
        path = self.path(name)
        if path is None:
            raise NotImplementedError(f"{type(self).__name__}.mesh")
        mesh = load_mesh(path)
        return Mesh(mesh.verts, mesh.faces, name, path)

    def n_verts(self, name: str) -> int:
        """Number of vertices of a shape.

        Raises:
            MeshError: its file cannot be read.
            ValueError: there is no such shape.
        """
        return self.mesh(name).n_verts

    def about(self, cls: str) -> tuple[str, str]:
        """What the truth and the symmetry of a class come from, in a few words; nothing large is read for it."""
        return "", ""

    def symmetry(self, name: str) -> SymmetryGroup | None:
        """The true symmetry of a shape as vertex maps, identity first.

        From the set's own files, else from the undeformed shape of its class; None where there is neither.
        """
        return None

    def symmetry_truth(self, name: str) -> Truth | None:
        """The true reflection of a shape at those of its vertices where it is known (all, or landmarks), or None."""
        group = self.symmetry(name)
        if group is None or group.order != 2:
            return None
        return Truth(torch.arange(group.n_verts), group.maps[1], "symmetry of the whole shape")

    def mirrored_truth(self, first: str, second: str) -> Truth | None:
        """The truth followed by the reflection of ``second``: where a map that is flipped as a whole sends the points.

        Returns:
            It at those points of the truth where the reflection is known; None where it is known nowhere.

        Raises:
            TruthError: there is no truth for the pair.
        """
        truth, mirror = self.truth(first, second), self.symmetry_truth(second)
        if mirror is None or isinstance(mirror.points, SurfacePoints):
            return None
        image = torch.full((self.n_verts(second),), -1)
        image[mirror.at] = mirror.points
        source = f"{truth.source}, then {mirror.source}"
        if isinstance(truth.points, SurfacePoints):
            corners = image[truth.points.corners]
            known = (corners >= 0).all(1)
            points: Tensor | SurfacePoints = SurfacePoints(corners[known], truth.points.bary[known])
        else:
            known = image[truth.points] >= 0
            points = image[truth.points[known]]
        return Truth(truth.at[known], points, source) if known.any() else None

    def published_pairs(self) -> list[tuple[str, str]]:
        """The pairs ``(first, second)`` that results were published for; empty if there are none."""
        return []

    def split(self) -> dict[str, list[str]] | None:
        """The set's own division into ``train`` and ``test``, names in its order; None if it has none."""
        return None

    def require(self, *names: str) -> None:
        """Check that shapes are here.

        Raises:
            ValueError: naming the first that is not, with those of its class that are.
        """
        known = set(self.names)
        for name in names:
            if name not in known:
                raise ValueError(f"{self.root}: no shape {name!r}; {_listed(self.names)}")

    def __len__(self) -> int:
        return len(self.names)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}: {self.layout}, {len(self.names)} shapes)"


def _listed(names: Sequence[str], most: int = 12) -> str:
    shown = ", ".join(names[:most]) + (f", ... ({len(names)} in all)" if len(names) > most else "")
    return f"shapes here: {shown or 'none'}"
