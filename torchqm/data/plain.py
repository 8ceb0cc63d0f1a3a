"""A plain folder of meshes, with an optional list of pairs.

``pairs.txt`` (or ``pairs.csv``, ``test_pairs.txt``) has two names a line, and perhaps a third word: a file with the
truth of that pair, beside the list. Such a file has either one number a line, the vertex of the second shape for each
vertex of the first, or two, a vertex of the first and its partner. ``#`` begins a comment; ids count from 0 by custom,
which is recognised from the numbers. Where there is no such file, two meshes with exactly the same triangles are taken
to be poses of one shape, whose vertex ids agree.
"""

from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from torchqm.data.base import Problem, Truth, TruthError, TruthFileError
from torchqm.data.files import PairLine, read_ids, read_pairs, read_table, recognise_base
from torchqm.data.folder import FolderShapes
from torchqm.data.meshes import mesh_files
from torchqm.geometry import MeshError

__all__ = ["PlainShapes"]

PAIR_FILES = ("pairs.txt", "pairs.csv", "pairs.tsv", "test_pairs.txt")


class PlainShapes(FolderShapes):
    """A folder of meshes.

    Args:
        root: the folder.
    """

    def __init__(self, root: Path) -> None:
        files = mesh_files(root)
        self.pairs_file = next((root / name for name in PAIR_FILES if (root / name).is_file()), None)
        listed = f", pairs from {self.pairs_file.name}" if self.pairs_file else ", no list of pairs (pairs.txt)"
        super().__init__(root, "plain", files, f"a plain folder of {len(files)} meshes{listed}")
        self._faces: dict[str, Tensor] = {}
        self._fault: str | None = None
        self._pairs: list[PairLine] = []
        if self.pairs_file is not None:
            try:
                self._pairs = read_pairs(self.pairs_file, files)
            except ValueError as error:
                self._fault = str(error)
        self._truth_files = {
            (pair.first, pair.second): self.pairs_file.parent / pair.extra
            for pair in self._pairs
            if self.pairs_file is not None and pair.extra is not None
        }
        self.base = 0
        self._recognise_numbers()

    @classmethod
    def recognise(cls, root: Path) -> "PlainShapes | None":
        """The set in a folder, if there is a mesh in it."""
        return cls(root) if mesh_files(root) else None

    def truth(self, first: str, second: str) -> Truth:
        """From the file that the list names for the pair (also backwards), else by vertex ids if the triangles agree.

        Raises:
            TruthError: there is neither, or the file is malformed.
            MeshError: one of the meshes cannot be read.
        """
        self.require(first, second)
        if (first, second) in self._truth_files:
            return self._read(first, second)
        if first == second:
            return self._itself(first)
        if (second, first) in self._truth_files:
            forth = self._read(second, first)
            return Truth(forth.vertices, forth.at, f"{forth.source}, backwards")
        one, two = self._triangles(first), self._triangles(second)
        if self.n_verts(first) == self.n_verts(second) and torch.equal(one, two):
            ids = torch.arange(self.n_verts(first))
            return Truth(ids, ids, "the same triangles: vertex ids agree")
        raise TruthError(
            f"{self.root}: no truth from {first} to {second}: their triangles differ, and no list of pairs names a file"
        )

    def published_pairs(self) -> list[tuple[str, str]]:
        """The pairs of the list.

        Raises:
            ValueError: naming file and line, if it is malformed or names a shape that is not here.
        """
        if self._fault is not None:
            raise ValueError(self._fault)
        for pair in self._pairs:
            self._check_names(pair)
        return [(pair.first, pair.second) for pair in self._pairs]

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a class come from."""
        if self._truth_files:
            return f"files of {len(self._truth_files)} pairs", "none"
        return "vertex ids, where triangles agree", "none"

    def _check_names(self, pair: PairLine) -> None:
        for name in (pair.first, pair.second):
            if name not in self._paths:
                raise ValueError(f"{self.pairs_file}:{pair.line}: there is no shape {name!r} in {self.root}")

    def _triangles(self, name: str) -> Tensor:
        if name not in self._faces:
            mesh = self.mesh(name)
            self._faces[name], self._counts[name] = mesh.faces.int(), mesh.n_verts
        return self._faces[name]

    def _recognise_numbers(self) -> None:
        usable = []
        for (first, second), path in self._truth_files.items():
            try:
                width = read_table(path, (1, 2)).shape[1]
                owners = (second,) if width == 1 else (first, second)
                usable += [(read_ids(path, column).values, self.n_verts(name)) for column, name in enumerate(owners)]
            except ValueError:  # `problems` says what is wrong with the file, or the mesh
                continue
        if usable:
            found = recognise_base("ids in files of the truth", usable, 0)
            self.base = found.base
            self.recognised.append(found.why)

    def _read(self, first: str, second: str) -> Truth:
        path, base = self._truth_files[first, second], self.base
        try:
            width = read_table(path, (1, 2)).shape[1]
            points = read_ids(path, width - 1)
            to = torch.from_numpy(points.checked(base, self.n_verts(second), second))
            if width == 2:
                at = torch.from_numpy(read_ids(path, 0).checked(base, self.n_verts(first), first))
            else:
                at = torch.arange(self.n_verts(first))
                if len(to) != len(at):
                    raise ValueError(f"{path}: {len(to)} lines, but {first} has {len(at)} vertices")
        except MeshError:
            raise
        except ValueError as error:
            raise TruthFileError(str(error)) from error
        return Truth(at, to, f"{path.name} ({base}-based)")

    def _other_problems(self) -> list[Problem]:
        out = []
        if self._fault is not None:
            out.append(Problem("pairs", self.pairs_file, self._fault, "malformed"))
        for pair in self._pairs:
            try:
                self._check_names(pair)
            except ValueError as error:
                out.append(Problem(f"{pair.first} {pair.second}", self.pairs_file, str(error), "missing"))
                continue
            path = self._truth_files.get((pair.first, pair.second))
            if path is None:
                continue
            try:
                self._read(pair.first, pair.second)
            except MeshError:
                continue  # the mesh has its own line
            except TruthError as error:
                severity: Literal["malformed", "missing"] = "malformed" if path.exists() else "missing"
                out.append(Problem(path.name, path, str(error), severity))
        return out
