"""SHREC16: parts of deformed shapes (``cuts``, ``holes``) and the full shapes in a canonical pose (``null``).

As first published: ``null/cat.off``, ``cuts/cuts_cat_shape_1.off``, and beside each part ``.baryc_gt`` with a line
``triangle w1 w2 w3`` for each of its vertices, a point of the full shape, and ``.baryc_gt_sym`` with its mirror image.
As ULRSSM has it: ``null/off``, ``cuts/off``, ``cuts/corres`` with ``.vts`` files (a vertex of the full shape for each
vertex of the part). Ids count from 1 by custom; that is recognised from the numbers. A few lines of cats name triangles
that the full cat has lost; they are left out, which is said.

References:
    Cosmo, Rodola, Bronstein, Torsello, Cremers, Sahillioglu. SHREC'16: Partial Matching of Deformable Shapes. 3DOR
    2016.
"""

from pathlib import Path

import numpy as np
import torch

from torchqm.data.base import Problem, Truth, TruthError, TruthFileError
from torchqm.data.files import read_barycentric, read_ids, recognise_base
from torchqm.data.folder import FolderShapes, undeformed_symmetry
from torchqm.data.meshes import mesh_files
from torchqm.data.published import natural_key
from torchqm.evaluate.metrics import SurfacePoints
from torchqm.geometry import Mesh, MeshError
from torchqm.symmetry import SymmetryGroup

__all__ = ["Shrec16Shapes"]

PARTS = ("cuts", "holes", "cuts24")
MOST_LOST = 0.05
"""Largest share of lines that may name lost triangles; with more of them the file belongs to another mesh."""
_N_LOOKED_AT = 40


class Shrec16Shapes(FolderShapes):
    """A folder of SHREC16.

    Args:
        root: the folder that holds ``null`` and ``cuts`` or ``holes``.
    """

    def __init__(self, root: Path) -> None:
        self._full = mesh_files(_meshes(root / "null"))
        found = {part: mesh_files(_meshes(root / part)) for part in PARTS if (root / part).is_dir()}
        stems = [stem for files in found.values() for stem in files]
        self._parts: dict[str, tuple[str, str]] = {}  # name -> (cuts or holes, stem)
        paths = dict(self._full)
        for part, files in found.items():
            for stem, path in files.items():
                name = stem if stems.count(stem) == 1 and stem not in self._full else f"{part}/{stem}"
                paths[name], self._parts[name] = path, (part, stem)
        counts = ", ".join(f"{len(files)} in {part}/" for part, files in found.items())
        sentence = f"SHREC16: {len(self._full)} full shapes in null/, parts: {counts}"
        super().__init__(root, "shrec16", paths, sentence)
        self._meshes: dict[str, Mesh] = {}
        self._symmetries: dict[str, SymmetryGroup | None] = {}
        self._recognise_numbers()

    @classmethod
    def recognise(cls, root: Path) -> "Shrec16Shapes | None":
        """The set in a folder, if it has ``null`` and one of ``cuts``, ``holes``, ``cuts24``."""
        return cls(root) if (root / "null").is_dir() and any((root / part).is_dir() for part in PARTS) else None

    def shape_class(self, name: str) -> str:
        """The full shape that a part is of: ``cat`` of ``cuts_cat_shape_1``."""
        self.require(name)
        if name in self._full:
            return name
        words = self._parts[name][1].split("_")
        return next((word for word in words if word in self._full), words[1] if len(words) > 1 else words[0])

    def truth(self, first: str, second: str) -> Truth:
        """The point of the full shape for each vertex of a part.

        From the full shape to a part (the order of ULRSSM) the truth is read backwards: a point inside a triangle is
        taken at its nearest corner, and vertices of the full shape that the part lacks do not occur.

        Raises:
            TruthError: the two are no part and its full shape, or the file is missing or malformed.
        """
        self.require(first, second)
        if first == second:
            return self._itself(first)
        if first in self._parts and second == self.shape_class(first):
            return self._read(first, symmetric=False)
        if second in self._parts and first == self.shape_class(second):
            forth = self._read(second, symmetric=False)
            return Truth(forth.vertices, forth.at, f"{forth.source}, backwards")
        raise TruthError(
            f"{self.root}: no truth from {first} to {second}: it leads from a part to its full shape in null/"
        )

    def mirrored_truth(self, first: str, second: str) -> Truth | None:
        """From a part to its full shape: ``.baryc_gt_sym`` or ``.sym.vts``, else by the full shape's mirror plane."""
        self.truth(first, second)  # raises if there is none
        if first in self._parts and first != second and self._file(first, symmetric=True) is not None:
            return self._read(first, symmetric=True)
        return super().mirrored_truth(first, second)

    def symmetry(self, name: str) -> SymmetryGroup | None:
        """Of a full shape: that of its canonical pose, where it has a mirror plane; None for parts."""
        self.require(name)
        if name in self._parts:
            return None
        if name not in self._symmetries:
            self._symmetries[name] = undeformed_symmetry(self, name)
        return self._symmetries[name]

    def published_pairs(self) -> list[tuple[str, str]]:
        """Each part that has a truth with its full shape."""
        return [(name, self.shape_class(name)) for name in self._parts if self._file(name, symmetric=False) is not None]

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry of a class come from."""
        files = [self._file(name, symmetric=False) for name in self._parts if self.shape_class(name) == cls]
        endings = sorted({path.suffix for path in files if path is not None})
        return ", ".join(endings) or "none", f"mirror plane of {cls}" if cls in self._full else "none"

    def _file(self, name: str, symmetric: bool) -> Path | None:
        part, stem = self._parts[name]
        folder = Path(self.root) / part
        for place in (folder, folder / "corres", folder / "off"):
            for ending in (".baryc_gt_sym", ".sym.vts") if symmetric else (".baryc_gt", ".vts"):
                if (place / f"{stem}{ending}").is_file():
                    return place / f"{stem}{ending}"
        return None

    def _full_mesh(self, name: str) -> Mesh:
        if name not in self._meshes:
            self._meshes[name] = self.mesh(name)
        return self._meshes[name]

    def _recognise_numbers(self) -> None:
        """The index bases: triangles of ``.baryc_gt`` and vertices of ``.vts``."""
        seen: dict[str, list[tuple[np.ndarray, int]]] = {}
        for name in list(self._parts)[:_N_LOOKED_AT]:
            path, full = self._file(name, symmetric=False), self.shape_class(name)
            if path is None or full not in self._full:
                continue
            try:
                mesh = self._full_mesh(full)
                count = mesh.n_verts if path.suffix == ".vts" else mesh.n_faces
                seen.setdefault(path.suffix, []).append((read_ids(path).values, count))
            except ValueError:  # `problems` says what is wrong
                continue
        bases = {
            ending: recognise_base(f"{'vertices' if ending == '.vts' else 'triangles'} in *{ending}", files, 1)
            for ending, files in sorted(seen.items())
        }
        self._bases = {ending: found.base for ending, found in bases.items()}
        self.recognised += [found.why for found in bases.values()]

    def _read(self, name: str, symmetric: bool) -> Truth:
        path, full = self._file(name, symmetric), self.shape_class(name)
        if path is None:
            raise TruthError(f"{self.path(name)}: no .baryc_gt or .vts file for this part, so there is no truth for it")
        if full not in self._full:
            raise TruthError(f"{Path(self.root) / 'null'}: there is no full shape {full!r} for {name}")
        try:
            return (
                self._read_vertices(name, path, full) if path.suffix == ".vts" else self._read_points(name, path, full)
            )
        except MeshError:
            raise
        except ValueError as error:
            raise TruthFileError(str(error)) from error

    def _read_vertices(self, name: str, path: Path, full: str) -> Truth:
        base, ids = self._bases.get(".vts", 1), read_ids(path)
        self._check_length(name, path, len(ids.values))
        points = torch.from_numpy(ids.checked(base, self.n_verts(full), f"null/{full}"))
        return Truth(torch.arange(len(points)), points, f"{self._called(path)} ({base}-based)")

    def _read_points(self, name: str, path: Path, full: str) -> Truth:
        mesh, base = self._full_mesh(full), self._bases.get(".baryc_gt", 1)
        faces, weights = read_barycentric(path)
        self._check_length(name, path, len(weights))
        keep = np.ones(len(weights), dtype=bool)
        beyond = faces.values - base >= mesh.n_faces
        note = ""
        if 0 < beyond.mean() <= MOST_LOST:
            keep = ~beyond
            note = f", without {int(beyond.sum())} lines with triangles that null/{full} has lost"
            faces.values[beyond] = base
        ids = torch.from_numpy(faces.checked(base, mesh.n_faces, f"null/{full}", "triangle"))
        chosen = torch.from_numpy(keep)
        points = SurfacePoints.from_faces(mesh, ids[chosen], torch.from_numpy(weights)[chosen])
        return Truth(torch.arange(len(keep))[chosen], points, f"{self._called(path)} (triangles {base}-based){note}")

    def _check_length(self, name: str, path: Path, lines: int) -> None:
        if lines != self.n_verts(name):
            raise ValueError(f"{path}: {lines} lines, but {self.path(name).name} has {self.n_verts(name)} vertices")

    def _called(self, path: Path) -> str:
        return str(path.relative_to(self.root))

    def _other_problems(self) -> list[Problem]:
        out = []
        for full in sorted({self.shape_class(name) for name in self._parts} - set(self._full), key=natural_key):
            path = Path(self.root) / "null" / f"{full}.off"
            out.append(Problem(full, path, f"{path}: the full shape of some parts is missing", "missing"))
        without = [name for name in self._parts if self._file(name, symmetric=False) is None]
        if without and len(without) == len(self._parts):  # the test set was published without truth
            out.append(Problem("*.baryc_gt", Path(self.root), "no part has a truth (.baryc_gt, .vts)", "missing"))
        else:
            out += [
                Problem(n, self.path(n), f"{self.path(n)}: no .baryc_gt or .vts for it", "missing") for n in without
            ]
        for name in self._parts:
            for symmetric in (False, True):
                file = self._file(name, symmetric)
                if file is None or self.shape_class(name) not in self._full:
                    continue
                try:
                    truth = self._read(name, symmetric)
                except MeshError:
                    continue  # the mesh has its own line
                except TruthError as error:
                    out.append(Problem(name, file, str(error), "malformed"))
                    continue
                if "without" in truth.source:
                    out.append(Problem(name, file, truth.source, "note"))
        return out


def _meshes(folder: Path) -> Path:
    return folder / "off" if (folder / "off").is_dir() else folder
