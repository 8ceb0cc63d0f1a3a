"""Reader of the surface-correspondence benchmark (SCB) of Kim, Lipman and Funkhouser, TOSCA part.

The folder, as unpacked::

    ROOT/TOSCA/Meshes/cat0.off ...           meshes; the vertex ids of a class agree
    ROOT/TOSCA/Corrs/cat.pid                 landmarks: vertex id and three zeros a line
    ROOT/TOSCA/Corrs/cat.sym.info            "2 3": landmarks 2 and 3 swap; "0": landmark 0 stays
    ROOT/TOSCA/Corrs/cat.info                "0: tip of head/mouth": what a landmark is
    ROOT/Results/Results_Corr_TOSCA/*.txt    published results, see :mod:`torchqm.data.published`

Inside a class the ground truth is the identity on vertex ids, so a shape with another vertex count than its class
(cat11, cat12 and centaur6 in the copies that circulate) has no truth. It is left out, and :attr:`SCBenchmark.excluded`
says why.

References:
    Kim, Lipman, Funkhouser. Blended Intrinsic Maps. SIGGRAPH 2011. Bronstein, Bronstein, Kimmel. Numerical Geometry of
    Non-Rigid Shapes, 2008 (TOSCA).
"""

import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Int
from torch import Tensor

from torchqm.data.published import RESULT_FOLDER, natural_key, published_names

__all__ = ["SCBenchmark", "SymmetryLandmarks", "shape_class"]

_WITHOUT_UNDEFORMED = frozenset({"gorilla"})  # paper, section 7: the one class without an undeformed pose


def shape_class(name: str) -> str:
    """The class of a shape: its name without the trailing number.

    Example:
        >>> shape_class("cat10"), shape_class("dog")
        ('cat', 'dog')
    """
    return re.sub(r"\d+$", "", name)


@dataclass(frozen=True, eq=False)
class SymmetryLandmarks:
    """How the reflection of a class acts on its landmarks.

    Args:
        pairs: ``(P, 2)`` landmark numbers (rows of ``landmarks``, not vertex ids) that swap.
        fixed: ``(Q,)`` landmark numbers that stay, i.e. lie on the symmetry axis.

    Example:
        >>> SymmetryLandmarks(torch.tensor([[1, 2]]), torch.tensor([0])).permutation().tolist()
        [0, 2, 1]
    """

    pairs: Int[Tensor, "P 2"]
    fixed: Int[Tensor, " Q"]

    def permutation(self) -> Int[Tensor, " L"]:
        """For each landmark the landmark it is mirrored to; the truth of Figure 8 at the landmarks."""
        out = torch.arange(2 * len(self.pairs) + len(self.fixed))
        out[self.pairs[:, 0]] = self.pairs[:, 1]
        out[self.pairs[:, 1]] = self.pairs[:, 0]
        return out


class SCBenchmark:
    """The TOSCA part of an SCB folder: shapes by class, landmarks, and the pairs with published results.

    Args:
        root: the folder that holds ``TOSCA/Meshes``.

    Raises:
        FileNotFoundError: if ``root/TOSCA/Meshes`` is not a folder with ``.off`` files.
        ValueError: if a mesh file has no OFF header.
    """

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root)
        self.mesh_folder = self.root / "TOSCA" / "Meshes"
        self.corr_folder = self.root / "TOSCA" / "Corrs"
        files = sorted(self.mesh_folder.glob("*.off")) if self.mesh_folder.is_dir() else []
        if not files:
            what = "has no .off files" if self.mesh_folder.is_dir() else "is not a folder"
            raise FileNotFoundError(
                f"{self.mesh_folder} {what}; an SCB folder ROOT with ROOT/TOSCA/Meshes/*.off was expected"
            )
        self._paths = {path.stem: path for path in sorted(files, key=lambda path: natural_key(path.stem))}

    @cached_property
    def _vertex_counts(self) -> dict[str, int]:
        return {name: _off_vertex_count(path) for name, path in self._paths.items()}

    @cached_property
    def _class_counts(self) -> dict[str, int]:
        """Vertex count of each class: that of most of its meshes, of two the larger (holes only remove vertices)."""
        votes: dict[str, Counter[int]] = {}
        for name, count in self._vertex_counts.items():
            votes.setdefault(shape_class(name), Counter())[count] += 1
        return {cls: max(votes[cls], key=lambda count: (votes[cls][count], count)) for cls in votes}

    @cached_property
    def excluded(self) -> dict[str, str]:
        """Meshes in the folder that are no part of the benchmark, each with the reason."""
        out = {}
        for name, count in self._vertex_counts.items():
            cls = shape_class(name)
            if count != self._class_counts[cls]:
                out[name] = (
                    f"{count} vertices where class {cls!r} has {self._class_counts[cls]}: no ground truth by vertex id"
                )
        return out

    @property
    def classes(self) -> list[str]:
        """Names of the classes that have a mesh here, sorted."""
        return sorted(self._class_counts)

    def shapes(self, cls: str | None = None) -> list[str]:
        """Shapes of a class (or all) in natural order, without the :attr:`excluded` ones.

        Raises:
            ValueError: if there is no such class.
        """
        if cls is not None:
            self._check_class(cls)
        return [name for name in self._paths if name not in self.excluded and cls in (None, shape_class(name))]

    def n_verts(self, cls: str) -> int:
        """Number of vertices that all shapes of the class share."""
        self._check_class(cls)
        return self._class_counts[cls]

    def mesh_path(self, name: str) -> Path:
        """The ``.off`` file of a shape (also of an excluded one, so that it can be looked at).

        Raises:
            FileNotFoundError: if there is none.
        """
        if name not in self._paths:
            raise FileNotFoundError(
                f"{self.mesh_folder / (name + '.off')} does not exist; shapes here: {', '.join(self._paths)}"
            )
        return self._paths[name]

    def undeformed(self, cls: str) -> str | None:
        """The pose X0 with an (almost) exact extrinsic reflection; None for gorilla, and if its mesh is not here."""
        name = f"{cls}0"
        return name if cls not in _WITHOUT_UNDEFORMED and name in self.shapes(cls) else None

    def landmarks(self, cls: str) -> Int[Tensor, " L"]:
        """Vertex ids of the landmarks of a class, the same on each of its shapes, in the benchmark's order.

        Raises:
            FileNotFoundError: if the ``.pid`` file is missing.
            ValueError: naming file and line, if a line is malformed or an id out of range.
        """
        path = self._corr_path(cls, "pid")
        ids = []
        for number, line in _lines(path):
            words = line.split()
            try:
                vertex, corners = int(words[0]), [float(word) for word in words[1:]]
            except ValueError:
                raise ValueError(f"{path}:{number}: expected a vertex id and three numbers, got {line!r}") from None
            if len(corners) not in (0, 3) or any(corners):
                raise ValueError(f"{path}:{number}: expected a vertex id and three zeros, got {line!r}")
            if not 0 <= vertex < self._class_counts[cls]:
                raise ValueError(
                    f"{path}:{number}: vertex {vertex}, but class {cls!r} has {self._class_counts[cls]} vertices"
                )
            ids.append(vertex)
        if not ids:
            raise ValueError(f"{path}: no landmarks")
        return torch.tensor(ids)

    def symmetry_landmarks(self, cls: str) -> SymmetryLandmarks:
        """Which landmarks of a class the reflection swaps and which it keeps.

        Raises:
            FileNotFoundError: if the ``.sym.info`` or ``.pid`` file is missing.
            ValueError: naming the file, if a line is malformed or the landmarks are not each named once.
        """
        path, count = self._corr_path(cls, "sym.info"), len(self.landmarks(cls))
        pairs: list[list[int]] = []
        fixed: list[list[int]] = []
        for number, line in _lines(path):
            words = line.split()
            if len(words) > 2 or not all(word.isdecimal() for word in words):
                raise ValueError(f"{path}:{number}: expected one or two landmark numbers, got {line!r}")
            (pairs if len(words) == 2 else fixed).append([int(word) for word in words])
        named = sorted(number for row in pairs + fixed for number in row)
        if named != list(range(count)):
            wrong = sorted(set(range(count)).symmetric_difference(named)) or sorted(
                n for n, c in Counter(named).items() if c > 1
            )
            raise ValueError(f"{path}: each of the {count} landmarks must be named once, these are not: {wrong}")
        return SymmetryLandmarks(
            torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2), torch.tensor(fixed, dtype=torch.int64).reshape(-1)
        )

    def landmark_names(self, cls: str) -> dict[int, str]:
        """What the landmarks of a class are, as far as its ``.info`` file says (some of its lines may be damaged)."""
        found = (re.match(r"(\d+)\s*:\s*(.+)", line) for _, line in _lines(self._corr_path(cls, "info")))
        return {int(match[1]): match[2].strip() for match in found if match}

    def published_pairs(
        self, cls: str | None = None, method: str = "BlendedMap", by_name: bool = True
    ) -> list[tuple[str, str]]:
        """Pairs ``(source, target)`` that have a published result and can be run and compared with it here.

        Args:
            cls: only this class.
            method: whose result files name the pairs.
            by_name: also leave out classes whose published names are not our mesh names (the dogs); with ``False`` only
                pairs with a missing or excluded mesh are left out, and dog rows must not be set beside published ones.

        Returns:
            The pairs in natural order; :meth:`skipped_pairs` has the others.
        """
        skipped = self.skipped_pairs(cls, method, by_name)
        return [pair for pair in self._published(cls, method) if pair not in skipped]

    def skipped_pairs(
        self, cls: str | None = None, method: str = "BlendedMap", by_name: bool = True
    ) -> dict[tuple[str, str], str]:
        """The published pairs that :meth:`published_pairs` leaves out, each with the reason."""
        pairs = self._published(cls, method)
        renamed = self._renamed(pairs) if by_name else {}
        out = {}
        for pair in pairs:
            bad = [f"{name}: {self.excluded[name]}" for name in pair if name in self.excluded]
            bad += [f"{name}: no mesh {self.mesh_folder / (name + '.off')}" for name in pair if name not in self._paths]
            reason = renamed.get(shape_class(pair[0]), "; ".join(bad))
            if reason:
                out[pair] = reason
        return out

    def _renamed(self, pairs: list[tuple[str, str]]) -> dict[str, str]:
        """Classes whose published names cannot be trusted to mean the meshes of that name, with the reason.

        Published names without a mesh *and* meshes that no result names: the poses were numbered anew, and even a name
        that occurs on both sides may be another pose. Meshes that are simply missing do not raise this alarm.
        """
        out = {}
        names = {name for pair in pairs for name in pair}
        for cls in sorted({shape_class(name) for name in names} & set(self.classes)):
            meshes = set(self.shapes(cls))
            no_mesh = sorted({name for name in names if shape_class(name) == cls} - meshes, key=natural_key)
            no_result = sorted(meshes - names, key=natural_key)
            if no_mesh and no_result:
                out[cls] = (
                    f"class {cls!r} is numbered differently in the published results (no mesh for "
                    f"{', '.join(no_mesh)}; no result for {', '.join(no_result)}): equal names may be other poses"
                )
        return out

    def _published(self, cls: str | None, method: str) -> list[tuple[str, str]]:
        if cls is not None:
            self._check_class(cls)
        pairs = published_names(self.root / RESULT_FOLDER, method)
        return [pair for pair in pairs if cls in (None, shape_class(pair[0]))]

    def _check_class(self, cls: str) -> None:
        if cls not in self._class_counts:
            raise ValueError(f"cls: {cls!r} has no mesh in {self.mesh_folder}; classes here: {', '.join(self.classes)}")

    def _corr_path(self, cls: str, suffix: str) -> Path:
        self._check_class(cls)
        path = self.corr_folder / f"{cls}.{suffix}"
        if not path.is_file():
            raise FileNotFoundError(
                f"{path} does not exist; the landmarks of class {cls!r} were expected there (.pid, .sym.info)"
            )
        return path


def _lines(path: Path) -> list[tuple[int, str]]:
    """Non-blank lines of a text file with their 1-based numbers."""
    text = path.read_text(encoding="utf-8", errors="replace")
    return [(number, line.strip()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]


def _off_vertex_count(path: Path) -> int:
    """The vertex count in an OFF header, read without reading the mesh."""
    words: list[str] = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            words += line.split("#")[0].split()
            if len(words) >= 2 or (words and not words[0].endswith("OFF")):
                break
    if len(words) < 2 or not words[0].endswith("OFF") or not words[1].isdecimal():
        raise ValueError(f"{path}: not an OFF file: expected 'OFF' and a vertex count, got {' '.join(words[:2])!r}")
    return int(words[1])
