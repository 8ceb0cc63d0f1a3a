"""What all sets that lie in a folder share: shapes as files, vertex counts, the check of the files."""

import abc
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch

from torchqm.data.base import Problem, ShapeSet, Truth, TruthError
from torchqm.data.files import read_names
from torchqm.data.meshes import look_at_mesh, vertex_count
from torchqm.data.scb import shape_class
from torchqm.geometry import MeshError
from torchqm.symmetry import SymmetryGroup, extrinsic_group, find_reflections

__all__ = [
    "FolderShapes",
    "SameIdShapes",
    "base_name",
    "majority_count",
    "mesh_problem",
    "read_split",
    "undeformed_symmetry",
]


class FolderShapes(ShapeSet):
    """Shapes that are files of a folder.

    Args:
        root: the folder.
        layout: its short name.
        paths: mesh file of each shape, in the order of ``names``.
        recognised: how the layout was recognised, in a sentence.
    """

    def __init__(self, root: Path, layout: str, paths: Mapping[str, Path], recognised: str) -> None:
        self.root = root
        self.layout = layout
        self.recognised = [recognised]
        self._paths = dict(paths)
        self._counts: dict[str, int] = {}

    @property
    def names(self) -> list[str]:
        """All shapes, in natural order."""
        return list(self._paths)

    def shape_class(self, name: str) -> str:
        """The class of a shape: by default its name without the trailing number."""
        self.require(name)
        return base_name(name) or self.layout

    def path(self, name: str) -> Path:
        """The mesh file of a shape.

        Raises:
            ValueError: there is no such shape.
        """
        if name not in self._paths:
            self.require(name)
        return self._paths[name]

    def n_verts(self, name: str) -> int:
        """Number of vertices of a shape, from its file's header where it has one.

        Raises:
            MeshError: the file cannot be read.
        """
        if name not in self._counts:
            self._counts[name] = vertex_count(self.path(name))
        return self._counts[name]

    def problems(self, full: bool = False) -> list[Problem]:
        """Look at every file of the folder.

        Args:
            full: read every number of every mesh, too; without it an OFF file is believed that has as many lines as its
                header says and nothing but numbers in them.
        """
        out = [problem for name, path in self._all_files().items() if (problem := mesh_problem(name, path, full))]
        return out + self._other_problems()

    def _all_files(self) -> dict[str, Path]:
        """Every mesh file, also of shapes that are left out."""
        return self._paths

    @abc.abstractmethod
    def _other_problems(self) -> list[Problem]:
        """What there is to say beside the mesh files themselves."""

    def _itself(self, name: str) -> Truth:
        ids = torch.arange(self.n_verts(name))
        return Truth(ids, ids, "a shape and itself")


class SameIdShapes(FolderShapes):
    """Shapes whose vertex ids agree inside a class, so that the truth is the identity.

    A shape with another number of vertices than most of its class has no truth and is left out of ``names``; of two
    counts that are equally frequent the larger is the class's (holes only remove vertices).
    """

    def __init__(self, root: Path, layout: str, paths: Mapping[str, Path], recognised: str) -> None:
        super().__init__(root, layout, paths, recognised)
        self._files = dict(paths)
        self._symmetries: dict[str, SymmetryGroup | None] = {}
        self.unreadable: dict[str, str] = {}
        for name, path in paths.items():
            try:
                self._counts[name] = vertex_count(path)
            except MeshError as error:
                self.unreadable[name] = str(error).removeprefix(f"{path}: ")
        self._class_counts = majority_count((self.shape_class(name), count) for name, count in self._counts.items())
        self.excluded = self.unreadable | {
            name: f"{count} vertices where class {cls!r} has {self._class_counts[cls]}: no truth by vertex id, left out"
            for name, count in self._counts.items()
            if count != self._class_counts[cls := self.shape_class(name)]
        }
        for name in self.excluded:
            del self._paths[name]

    def truth(self, first: str, second: str) -> Truth:
        """The identity on vertex ids.

        Raises:
            TruthError: the shapes are of different classes.
        """
        for name in (first, second):
            if name in self.excluded:
                raise TruthError(f"{self._files[name]}: {self.excluded[name]}")
        self.require(first, second)
        cls, other = self.shape_class(first), self.shape_class(second)
        if cls != other:
            raise TruthError(
                f"{self.root}: no truth from {first} to {second}: vertex ids agree inside a class only, and these are "
                f"of {cls!r} and {other!r}"
            )
        ids = torch.arange(self._class_counts[cls])
        return Truth(ids, ids, f"vertex ids agree in class {cls}")

    def undeformed(self, cls: str) -> str | None:
        """The shape of a class that stands in a symmetric pose; None if the set has no rule for that."""
        return None

    def symmetry(self, name: str) -> SymmetryGroup | None:
        """The symmetry of the undeformed shape of the class, which holds for all its poses (their ids agree)."""
        self.require(name)
        cls = self.shape_class(name)
        if cls not in self._symmetries:
            pose = self.undeformed(cls)
            self._symmetries[cls] = None if pose is None else undeformed_symmetry(self, pose)
        return self._symmetries[cls]

    def symmetry_truth(self, name: str) -> Truth | None:
        """The true reflection at all vertices; None if the group of the class is another one."""
        group = self.symmetry(name)
        if group is None or group.order != 2:
            return None
        source = f"mirror plane of {self.undeformed(self.shape_class(name))}"
        return Truth(torch.arange(group.n_verts), group.maps[1], source)

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a class come from, in a few words."""
        pose = self.undeformed(cls)
        return "same vertex ids", "none" if pose is None else f"mirror plane of {pose}"

    def _all_files(self) -> dict[str, Path]:
        return self._files

    def _other_problems(self) -> list[Problem]:
        excluded = ((name, what) for name, what in self.excluded.items() if name not in self.unreadable)
        return [Problem(name, self._files[name], what, "malformed") for name, what in excluded]


def base_name(name: str) -> str:
    """A name without its trailing number and what separates the two.

    Example:
        >>> base_name("cat10"), base_name("tr_reg_012"), base_name("381")
        ('cat', 'tr_reg', '')
    """
    return shape_class(name).rstrip("_-. ")


def majority_count(counts: Iterable[tuple[str, int]]) -> dict[str, int]:
    """Of each class the count that most of its shapes have, of equally frequent ones the largest.

    Example:
        >>> majority_count([("cat", 5), ("cat", 5), ("cat", 4), ("dog", 7), ("dog", 8)])
        {'cat': 5, 'dog': 8}
    """
    votes: dict[str, Counter[int]] = {}
    for cls, count in counts:
        votes.setdefault(cls, Counter())[count] += 1
    return {cls: max(votes[cls], key=lambda count: (votes[cls][count], count)) for cls in votes}


def mesh_problem(name: str, path: Path, full: bool = False) -> Problem | None:
    """What is wrong with a mesh file, if anything."""
    what = look_at_mesh(path, full)
    if what is None:
        return None
    return Problem(name, path, what, "malformed" if path.exists() else "missing")


def undeformed_symmetry(shapes: ShapeSet, name: str) -> SymmetryGroup | None:
    """The symmetries that a pose shows by its mirror planes; None if it has no convincing one.

    Raises:
        MeshError: the pose cannot be read; its class would pass for one without symmetry.
    """
    mesh = shapes.mesh(name)
    planes = [plane for plane in find_reflections(mesh) if plane.convincing]
    if len(planes) > 1:
        return extrinsic_group(mesh, planes).group
    return SymmetryGroup.from_reflection(planes[0].map) if planes else None


def read_split(shapes: FolderShapes, files: Mapping[str, Path]) -> tuple[dict[str, list[str]], list[Problem]]:
    """Lists of names, one a file; names that are no shape here become problems.

    Args:
        shapes: the set.
        files: file of each part, such as ``train``.

    Returns:
        The parts whose file is there, and what is wrong with the files.
    """
    parts: dict[str, list[str]] = {}
    problems = []
    for part, path in files.items():
        if not path.is_file():
            continue
        try:
            lines = read_names(path)
        except ValueError as error:
            problems.append(Problem(path.name, path, str(error), "malformed"))
            continue
        known = set(shapes.names)
        parts[part] = [name for _, name in lines if name in known]
        problems += [
            Problem(name, path, f"{path}:{number}: there is no shape {name!r}", "missing")
            for number, name in lines
            if name not in known
        ]
    return parts, problems
