"""The built-in creatures as a set of shapes like any folder, under a root such as ``synthetic:kinds=biped;poses=4``.

After the colon stand options ``key=value`` with semicolons between them (so the root is quoted in a shell)::

    kinds=biped,quadruped   which creatures: biped, quadruped, octopus, ellipsoid, asymmetric
    bodies=1                individuals of each kind, with proportions of their own (1 to 100)
    poses=3                 shapes of each body, the first in rest pose (1 to 100)
    verts=1000              vertices of a shape, reached within 5 percent (500 to 400000)
    seed=0                  draws the bodies and the poses
    triangulation=own       own: each shape has triangles of its own, truth lies inside faces;
                            shared: the poses of a body share their triangles, truth is the vertex id

What is given here are the defaults. A shape is called ``biped-0-pose2``, its class is its body, ``biped-0``: truth
exists between poses of one body. The same root gives the same shapes, bit for bit.
"""

from dataclasses import dataclass, fields, replace
from typing import Any

import torch

from torchqm.data.base import LayoutError, Problem, ShapeSet, Truth, TruthError
from torchqm.data.synthetic import CREATURES, Creature, ExactMaps, creature, exact_maps
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.geometry.check import MeshError
from torchqm.geometry.mesh import Mesh
from torchqm.symmetry.group import SymmetryGroup

__all__ = ["SyntheticOptions", "SyntheticShapes"]

_PREFIX = "synthetic:"
_RANGES = {"bodies": (1, 100), "poses": (1, 100), "verts": (500, 400_000), "seed": (0, 1_000_000)}
_TRIANGULATIONS = ("own", "shared")


@dataclass(frozen=True)
class SyntheticOptions:
    """What a ``synthetic:`` root says; the options are described in :mod:`torchqm.data.synthetic_set`.

    Example:
        >>> SyntheticOptions.parse("synthetic:kinds=octopus;poses=2")
        SyntheticOptions(kinds=('octopus',), bodies=1, poses=2, verts=1000, seed=0, triangulation='own')
    """

    kinds: tuple[str, ...] = ("biped", "quadruped")
    bodies: int = 1
    poses: int = 3
    verts: int = 1000
    seed: int = 0
    triangulation: str = "own"

    @classmethod
    def parse(cls, root: str) -> "SyntheticOptions":
        """Read a root.

        Raises:
            LayoutError: it does not start with ``synthetic:``, or an option is unknown, given twice or out of range.
        """
        if not root.startswith(_PREFIX):
            raise LayoutError(f"{root}: the root of the built-in creatures starts with {_PREFIX!r}")
        given: dict[str, str] = {}
        allowed = ", ".join(field.name for field in fields(cls))
        for part in filter(None, (part.strip() for part in root.removeprefix(_PREFIX).split(";"))):
            key, equals, value = (word.strip() for word in part.partition("="))
            if not equals:
                raise LayoutError(f"{root}: {part!r} is no 'key=value'; keys are {allowed}")
            if key not in {field.name for field in fields(cls)}:
                raise LayoutError(f"{root}: unknown key {key!r}; allowed are {allowed}")
            if key in given:
                raise LayoutError(f"{root}: {key!r} is given twice")
            given[key] = value
        options = cls(**{key: _convert(root, key, value) for key, value in given.items()})
        if options.triangulation not in _TRIANGULATIONS:
            raise LayoutError(f"{root}: triangulation is {options.triangulation!r}; allowed are own and shared")
        return options


def _convert(root: str, key: str, value: str) -> Any:
    """The value of one option in its type."""
    if key == "kinds":
        kinds = tuple(filter(None, (kind.strip() for kind in value.split(","))))
        wrong = [kind for kind in kinds if kind not in CREATURES]
        if wrong or not kinds or len(set(kinds)) < len(kinds):
            what = f"unknown {', '.join(map(repr, wrong))}" if wrong else "at least one, and each once"
            raise LayoutError(f"{root}: kinds is {value!r}: {what}; allowed are {', '.join(CREATURES)}")
        return kinds
    if key in _RANGES:
        low, high = _RANGES[key]
        if not (value.isascii() and value.isdecimal() and low <= int(value) <= high):
            raise LayoutError(f"{root}: {key} is {value!r}; allowed are whole numbers from {low} to {high}")
        return int(value)
    return value


@dataclass(frozen=True)
class _Place:
    """Which creature a name stands for."""

    kind: str
    body: int
    pose: int
    mesh: int


class SyntheticShapes(ShapeSet):
    """Built-in creatures with exact truth and exact symmetries; made on first use and kept in memory.

    Args:
        root: ``synthetic:`` and options, see :mod:`torchqm.data.synthetic_set`.

    Raises:
        LayoutError: an option that is unknown or out of range.

    Example:
        >>> shapes = SyntheticShapes("synthetic:kinds=ellipsoid;poses=2;verts=500;triangulation=shared")
        >>> shapes.names, shapes.classes
        (['ellipsoid-0-pose0', 'ellipsoid-0-pose1'], ['ellipsoid-0'])
        >>> shapes.symmetry("ellipsoid-0-pose1").order
        8
    """

    layout = "synthetic"

    def __init__(self, root: str = _PREFIX) -> None:
        self.root = root
        self.options = options = SyntheticOptions.parse(root)
        # Numbers of different seeds never meet, and pose 0 is the rest pose whatever the seed.
        first = 100 * options.seed
        self._places: dict[str, _Place] = {}
        for kind in options.kinds:
            for body in range(first, first + options.bodies):
                for number in range(options.poses):
                    pose = first + number if number else 0
                    own = number + 1 if options.triangulation == "own" else 0
                    self._places[f"{kind}-{body}-pose{pose}"] = _Place(kind, body, pose, own)
        self._creatures: dict[str, Creature] = {}
        self._groups: dict[str, SymmetryGroup] = {}
        own = options.triangulation == "own"
        self.recognised = [
            f"built-in creatures: {', '.join(options.kinds)}; bodies of each: {options.bodies}, poses of a body: "
            f"{options.poses} (the first at rest), about {options.verts} vertices, seed {options.seed}",
            "each shape has triangles of its own: truth is exact and lies inside faces"
            if own
            else "the poses of a body share their triangles: truth is the vertex id (0-based)",
            "classes are bodies: truth exists between the poses of one body",
        ]

    @property
    def names(self) -> list[str]:
        """All shapes, kind by kind and body by body."""
        return list(self._places)

    def shape_class(self, name: str) -> str:
        """The body of a shape, e.g. ``biped-0``."""
        place = self._place(name)
        return f"{place.kind}-{place.body}"

    def path(self, name: str) -> None:
        """None: creatures are made, not read."""
        self._place(name)

    def creature(self, name: str) -> Creature:
        """The creature itself: its rest pose, its place on the base mesh, the base's permutations."""
        place = self._place(name)
        if name not in self._creatures:
            try:
                made = creature(place.kind, self.options.verts, place.body, place.pose, place.mesh)
            except RuntimeError as error:  # thin limbs, few vertices: no sound triangulation was found
                raise MeshError(f"{self.root}: {name}: {error}; try more verts, or triangulation=shared") from error
            self._creatures[name] = replace(made, mesh=replace(made.mesh, name=name))
        return self._creatures[name]

    def mesh(self, name: str) -> Mesh:
        """The mesh of a shape; the same object each time.

        Raises:
            MeshError: the creature cannot be given triangles of its own with so few vertices.
            ValueError: there is no such shape.
        """
        return self.creature(name).mesh

    def exact(self, first: str, second: str) -> ExactMaps:
        """For every symmetry the exact image of each vertex of ``first`` on ``second``, the direct one first.

        Raises:
            TruthError: they are different bodies.
        """
        self._require_one_body(first, second)
        return exact_maps(self.creature(first), self.creature(second))

    def truth(self, first: str, second: str) -> Truth:
        """The direct map at every vertex of ``first``: vertex ids where triangles are shared, else points in faces."""
        self._require_one_body(first, second)
        if first == second or self.options.triangulation == "shared":
            ids = torch.arange(self.mesh(first).n_verts)
            return Truth(ids, ids, f"vertex ids agree on the body {self.shape_class(first)}")
        return _element(self.exact(first, second), 0, f"exact places on the body {self.shape_class(first)}")

    def mirrored_truth(self, first: str, second: str) -> Truth | None:
        """Where a map that is flipped as a whole sends the vertices; None unless there is exactly one reflection."""
        maps = self.exact(first, second)
        if len(maps.faces) != 2:
            return None
        return _element(maps, 1, f"exact mirrored places on the body {self.shape_class(first)}")

    def symmetry(self, name: str) -> SymmetryGroup:
        """The whole group; each element sends a vertex to the one nearest its exact image (at rest)."""
        if name not in self._groups:
            self._groups[name] = SymmetryGroup(self.exact(name, name).nearest_vertices())
        return self._groups[name]

    def symmetry_truth(self, name: str) -> Truth | None:
        """The exact reflection; None unless there is exactly one."""
        truth = self.mirrored_truth(name, name)
        return (
            None if truth is None else replace(truth, source=f"exact reflection of the body {self.shape_class(name)}")
        )

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a body come from, in a few words."""
        members = [name for name in self._places if self.shape_class(name) == cls]
        order = len(self.creature(members[0]).base_group) if members else 0
        truth = "exact points in faces" if self.options.triangulation == "own" else "same vertex ids"
        return truth, "none" if order == 1 else f"exact group of {order}"

    def problems(self) -> list[Problem]:
        """None: there are no files."""
        return []

    def _require_one_body(self, first: str, second: str) -> None:
        if self.shape_class(first) != self.shape_class(second):
            raise TruthError(
                f"{self.root}: no truth from {first} to {second}: bodies {self.shape_class(first)} and "
                f"{self.shape_class(second)} differ"
            )

    def _place(self, name: str) -> _Place:
        self.require(name)
        return self._places[name]


def _element(maps: ExactMaps, number: int, source: str) -> Truth:
    points = SurfacePoints(maps.corners[number], maps.bary[number])
    return Truth(torch.arange(maps.faces.shape[1]), points, source)
