"""Remeshed sets with ``.vts`` files: FAUST_r, SCAPE_r and others of their kind.

Line k of ``x.vts`` is the vertex of shape x that stands for point k of a template, so line k of two files name
corresponding vertices; line k of ``x.sym.vts`` is the vertex for the mirror image of point k. Ids count from 1 by
custom; that is recognised from the numbers. The folders are those of ULRSSM (``off``, ``corres``), AttentiveFMaps
(``shapes``, ``correspondences``), diffusion-net (``off_2``, ``corres``) and Ren et al. (``vtx_5k/*.off``,
``vtx_5k/corres``, ``test_pairs.txt``).

References:
    Ren, Poulenard, Wonka, Ovsjanikov. Continuous and Orientation-preserving Correspondences via Functional Maps.
    SIGGRAPH Asia 2018 (the remeshing). Bogo et al. 2014 (FAUST). Anguelov et al. 2005 (SCAPE).
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchqm.data.base import Problem, Truth, TruthError, TruthFileError
from torchqm.data.files import Ids, read_ids, read_pairs, recognise_base
from torchqm.data.folder import FolderShapes, majority_count
from torchqm.data.meshes import mesh_files
from torchqm.data.places import Place
from torchqm.geometry import Mesh, MeshError, edge_graph
from torchqm.symmetry import SymmetryGroup

__all__ = ["VtsShapes"]

_FAMILIES = {  # names, the root's name, shapes in all, the first number of the test part
    "faust": (r"tr_reg_\d{3}", r"faust", 100, 80),
    "scape": (r"mesh\d{3}", r"scape", 71, 51),
}


class VtsShapes(FolderShapes):
    """Shapes with ``.vts`` files.

    Args:
        place: where meshes and truth lie.
        layout: short name of the layout; subclasses have their own.
        paths: mesh files by name; by default those in the folder of the meshes.
        title: what the set is called in ``recognised``.
    """

    default_base = 1
    shares_template = True  # whether classes whose files have equally many lines are taken to share a template

    def __init__(
        self, place: Place, layout: str = "vts", paths: Mapping[str, Path] | None = None, title: str | None = None
    ) -> None:
        paths = mesh_files(place.meshes) if paths is None else paths
        self.place = place
        self.family = _family(place.root, paths)
        title = title or (f"{self.family.upper()} remeshed" if self.family else "shapes with .vts files")
        n_vts = sum(not path.name.endswith(".sym.vts") for path in place.truth_files(".vts"))
        files = (
            f"{place.name(place.meshes)} with {len(paths)} meshes, {place.name(place.truth)} with {n_vts} .vts files"
            if place.meshes != place.truth
            else f"{len(paths)} meshes and {n_vts} .vts files side by side"
        )
        sentence = f"{title}: {files}; line k of each is the vertex for point k of a template"
        super().__init__(place.root, layout, paths, sentence)
        self._faults: dict[str, Problem] = {}
        self._raw = {name: ids for name in paths if (ids := self._read(name, ".vts")) is not None}
        self._raw_sym = {name: ids for name in paths if (ids := self._read(name, ".sym.vts")) is not None}
        self._recognise_numbers()

    def shape_class(self, name: str) -> str:
        """``faust`` or ``scape``; elsewhere the name without its number."""
        by_name = super().shape_class(name)
        return self.family or by_name

    def truth(self, first: str, second: str) -> Truth:
        """The vertices that stand for the same points of the template.

        Raises:
            TruthError: a file is missing or malformed, or the two are of different templates.
        """
        at, points = self._ids(first, self._raw, ".vts"), self._ids(second, self._raw, ".vts")
        self._check_template(first, second)
        return Truth(at, points, f"{self._called('.vts')} ({self.base}-based)")

    def symmetry_truth(self, name: str) -> Truth | None:
        """The reflection at the vertices that stand for points of the template; None without a ``.sym.vts`` file.

        Raises:
            TruthError: a file is malformed.
        """
        self.require(name)
        if self._file(name, ".sym.vts") is None:
            return None
        at, points = self._ids(name, self._raw, ".vts"), self._ids(name, self._raw_sym, ".sym.vts")
        if len(at) != len(points):
            raise TruthFileError(
                f"{self._file(name, '.sym.vts')}: {len(points)} lines, but {self._file(name, '.vts')} has {len(at)}"
            )
        return Truth(at, points, f"{self._called('.sym.vts')} ({self.base}-based)")

    def mirrored_truth(self, first: str, second: str) -> Truth | None:
        """``.vts`` of the first with ``.sym.vts`` of the second; None where that has none."""
        truth, mirror = self.truth(first, second), self.symmetry_truth(second)
        return None if mirror is None else Truth(truth.at, mirror.points, mirror.source)

    def symmetry(self, name: str) -> SymmetryGroup | None:
        """The reflection as a map of all vertices, from ``.sym.vts``.

        Vertices that stand for no point of the template (a few of a remeshed shape) take the image of the nearest one
        along the edges that does. None without a ``.sym.vts`` file, or where it names less than half of the vertices.
        """
        known = self.symmetry_truth(name)
        if known is None:
            return None
        mesh = self.mesh(name)
        image = torch.full((mesh.n_verts,), -1)
        image[known.at.flip(0)] = known.vertices.flip(0)  # of points at the same vertex the first one counts
        if 2 * int((image >= 0).sum()) < mesh.n_verts:
            return None
        image = image[_nearest_known(mesh, image >= 0)]
        return None if bool((image < 0).any()) else SymmetryGroup.from_reflection(image)

    def split(self) -> dict[str, list[str]] | None:
        """FAUST: the first 80 for training, the last 20 for tests; SCAPE: the first 51 and the last 20."""
        if self.family is None:
            return None
        first_test = _FAMILIES[self.family][3]
        numbers = {name: int(re.findall(r"\d+", name)[-1]) for name in self.names}
        return {
            "train": [name for name in self.names if numbers[name] < first_test],
            "test": [name for name in self.names if numbers[name] >= first_test],
        }

    def published_pairs(self) -> list[tuple[str, str]]:
        """The pairs of ``test_pairs.txt``, where the folder (or the one around it) has it.

        Raises:
            ValueError: naming file and line, if it is malformed or names a shape that is not here.
        """
        path = self._pairs_file()
        if path is None:
            return []
        pairs = read_pairs(path, self._paths)
        for pair in pairs:
            for name in (pair.first, pair.second):
                if name not in self._paths:
                    raise ValueError(f"{path}:{pair.line}: there is no shape {name!r} in {self.place.meshes}")
        return [(pair.first, pair.second) for pair in pairs]

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a class come from."""
        names = [name for name in self.names if self.shape_class(name) == cls]
        truth, mirror = (sum(name in raw for name in names) for raw in (self._raw, self._raw_sym))
        return (
            f"points of a template ({truth} .vts)" if truth else "none",
            f"{mirror} .sym.vts" if mirror else "none",
        )

    def _file(self, name: str, ending: str) -> Path | None:
        path = None if self.place.truth is None else self.place.truth / f"{name}{ending}"
        return path if path is not None and path.is_file() else None

    def _called(self, ending: str) -> str:
        return f"{self.place.name(self.place.truth)}*{ending}".replace("the folder*", "*")

    def _read(self, name: str, ending: str) -> Ids | None:
        path = self._file(name, ending)
        if path is None:
            return None
        try:
            return read_ids(path)
        except ValueError as error:
            self._faults[name + ending] = Problem(name, path, str(error), "malformed")
            return None

    def _recognise_numbers(self) -> None:
        """The index base, the templates, and which files contradict them."""
        usable = []
        for name, ids in [*self._raw.items(), *self._raw_sym.items()]:
            try:
                usable.append((ids.values, self.n_verts(name)))
            except MeshError:
                continue  # `problems` says what is wrong with the mesh
        found = recognise_base(f"ids in {self._called('.vts')}", usable, self.default_base)
        self.base = found.base
        counts = majority_count((self.shape_class(name), len(ids.values)) for name, ids in self._raw.items())
        self.one_template = len(counts) == 1 or (self.shares_template and len(set(counts.values())) == 1)
        if self._raw:
            self.recognised.append(found.why)
        if self.one_template:
            self.recognised.append(f"one template of {next(iter(counts.values()))} points for all shapes")
        elif counts:
            sizes = ", ".join(f"{cls} {count}" for cls, count in counts.items())
            self.recognised.append(f"a template for each class (points: {sizes}): truth inside a class only")
        if self._raw_sym:
            sentence = (
                f"{self._called('.sym.vts')} for {len(self._raw_sym)} of {len(self._paths)} shapes: mirror images"
            )
            self.recognised.append(sentence)
        for raw, ending in ((self._raw, ".vts"), (self._raw_sym, ".sym.vts")):
            for name, ids in raw.items():
                self._check_numbers(name, ids, ending, counts.get(self.shape_class(name), len(ids.values)))

    def _check_numbers(self, name: str, ids: Ids, ending: str, lines: int) -> None:
        try:
            ids.checked(self.base, self.n_verts(name), f"{name} ({self.path(name).name})")
        except MeshError:
            return
        except ValueError as error:
            self._faults[name + ending] = Problem(name, ids.path, str(error), "malformed")
            return
        if len(ids.values) != lines:
            what = f"{ids.path}: {len(ids.values)} lines where the template of its class has {lines} points"
            self._faults[name + ending] = Problem(name, ids.path, what, "malformed")

    def _ids(self, name: str, raw: Mapping[str, Ids], ending: str) -> Tensor:
        self.require(name)
        if name + ending in self._faults:
            raise TruthFileError(self._faults[name + ending].what)
        if name not in raw:
            place = self.place.truth or self.place.root / "corres"
            raise TruthError(f"{place / (name + ending)}: no such file, so there is no truth for {name}")
        return torch.from_numpy(raw[name].checked(self.base, self.n_verts(name), name))

    def _check_template(self, first: str, second: str) -> None:
        """Refuse a pair whose files speak of different templates."""
        if not self.one_template and self.shape_class(first) != self.shape_class(second):
            raise TruthError(
                f"{self.root}: no truth from {first} to {second}: the classes {self.shape_class(first)!r} and "
                f"{self.shape_class(second)!r} have templates of their own"
            )

    def _pairs_file(self) -> Path | None:
        root = self.place.root.resolve()
        places = [self.place.root, self.place.meshes] + ([root.parent] if root.name == "vtx_5k" else [])
        found = (place / "test_pairs.txt" for place in places)
        return next((path for path in found if path.is_file()), None)

    def _expected(self) -> Iterable[Problem]:
        """A known set should be complete."""
        if self.family and len(self._paths) != _FAMILIES[self.family][2]:
            what = f"{len(self._paths)} shapes; {self.family.upper()} has {_FAMILIES[self.family][2]}"
            yield Problem(self.family.upper(), self.place.meshes, what, "note")

    def _other_problems(self) -> list[Problem]:
        out = list(self._faults.values())
        if self.place.truth is None:
            what = f"{self.place.root}: no folder with the truth (corres or correspondences, *.vts)"
            return [*out, Problem("corres", self.place.root / "corres", what, "missing")]
        for name in self._paths:
            if self._file(name, ".vts") is None:
                path = self.place.truth / f"{name}.vts"
                out.append(Problem(name, path, f"{path}: no such file, so there is no truth for {name}", "missing"))
            elif self._raw_sym and self._file(name, ".sym.vts") is None:
                path = self.place.truth / f"{name}.sym.vts"
                out.append(Problem(name, path, f"{path}: no such file, though other shapes have one", "missing"))
        for path in self.place.truth_files(".vts"):
            name = str(path.relative_to(self.place.truth).with_suffix("")).removesuffix(".sym")
            if self._belongs(path) and name not in self._paths:
                what = f"{path}: its mesh is missing ({self.place.meshes / name}.off)"
                out.append(Problem(name, self.place.meshes / f"{name}.off", what, "missing"))
        try:
            self.published_pairs()
        except ValueError as error:
            out.append(Problem("test_pairs.txt", self._pairs_file(), str(error), "malformed"))
        return [*out, *self._expected()]

    def _belongs(self, path: Path) -> bool:
        """Whether a ``.vts`` file should have a mesh."""
        return True


def _family(root: Path, names: Iterable[str]) -> str | None:
    """The known set that all names are of, by themselves or (plain numbers) by the folder's name."""
    names = list(names)
    for family, (pattern, folder, _, _) in _FAMILIES.items():
        plain = re.search(folder, root.resolve().name, re.IGNORECASE) is not None
        if names and all(re.fullmatch(rf"{pattern}|\d{{2,3}}" if plain else pattern, name) for name in names):
            return family
    return None


def _nearest_known(mesh: Mesh, known: Tensor) -> Tensor:
    """For each vertex the nearest one, along the edges, of those in ``known`` (an unreachable one stays itself)."""
    from scipy.sparse.csgraph import dijkstra

    sources = np.flatnonzero(known.numpy())
    _, _, nearest = dijkstra(edge_graph(mesh), directed=False, indices=sources, min_only=True, return_predecessors=True)
    reached = nearest >= 0
    return torch.from_numpy(np.where(reached, nearest, np.arange(mesh.n_verts)).astype(np.int64))
