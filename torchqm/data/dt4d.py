"""DT4D-H: humanoid characters in many poses, a folder for each character.

As ULRSSM has it (``off/crypto/Pose12.off``, ``corres/crypto/Pose12.vts``) or AttentiveFMaps (``shapes``,
``correspondences``, ``.obj``), with ``train.txt`` and ``test.txt`` of names ``crypto/Pose12``. The ``.vts`` files of
a character speak of one template; ``corres/cross_category_corres/crypto_drake.vts`` gives for each point of crypto's
template one of drake's. Everyone leaves ``pumpkinhulk`` out, and so do we.

References:
    Magnet, Ren, Sorkine-Hornung, Ovsjanikov. Smooth Non-Rigid Shape Matching via Effective Dirichlet Energy
    Optimization. 3DV 2022 (DT4D-H, from DeformingThings4D of Li et al. 2021).
"""

from functools import cached_property
from pathlib import Path

import torch
from torch import Tensor

from torchqm.data.base import Problem, ShapeSet, Truth, TruthError, TruthFileError
from torchqm.data.files import read_ids
from torchqm.data.folder import read_split
from torchqm.data.meshes import mesh_files
from torchqm.data.places import Place
from torchqm.data.vts import VtsShapes

__all__ = ["Dt4dShapes"]

IGNORED = "pumpkinhulk"
CROSS = "cross_category_corres"


class Dt4dShapes(VtsShapes):
    """A folder of DT4D; a shape is called ``character/pose``.

    Args:
        place: where meshes and truth lie.
    """

    shares_template = False

    def __init__(self, place: Place) -> None:
        folders = sorted(path for path in place.meshes.iterdir() if path.is_dir() and path.name != IGNORED)
        paths = {f"{folder.name}/{stem}": path for folder in folders for stem, path in mesh_files(folder).items()}
        super().__init__(place, "dt4d", paths, "DT4D (a folder for each character)")
        self.recognised.append(
            f"truth between {len(self._cross)} pairs of characters in {CROSS}, in either direction"
            if self._cross
            else f"no folder {CROSS}: truth inside a character only"
        )
        if (place.meshes / IGNORED).is_dir():
            self.recognised.append(f"{IGNORED} is left out, as everyone does")

    @classmethod
    def recognise(cls, place: Place) -> "Dt4dShapes | None":
        """The set at a place, if its meshes lie in folders of their own and none outside."""
        return None if mesh_files(place.meshes) else cls(place)

    def shape_class(self, name: str) -> str:
        """The character of a shape."""
        self.require(name)
        return name.partition("/")[0]

    def truth(self, first: str, second: str) -> Truth:
        """Points of the character's template, or those that ``cross_category_corres`` pairs between two characters.

        Raises:
            TruthError: a file is missing or malformed, or nothing is said about the two characters.
        """
        a, b = self.shape_class(first), self.shape_class(second)
        if a == b:
            return super().truth(first, second)
        at, points = self._ids(first, self._raw, ".vts"), self._ids(second, self._raw, ".vts")
        if (a, b) in self._cross:
            where = self._across(a, b, len(points), len(at))
            points = points[where]
        elif (b, a) in self._cross:
            where = self._across(b, a, len(at), len(points))
            at = at[where]
        else:
            raise TruthError(f"{self.root}: no truth from {first} to {second}: there is no {CROSS}/{a}_{b}.vts")
        name = self._cross.get((a, b), self._cross.get((b, a)))
        return Truth(at, points, f"{self._called('.vts')} through {name and name.name} ({self.base}-based)")

    def split(self) -> dict[str, list[str]] | None:
        """The parts of ``train.txt`` and ``test.txt``; None without these files."""
        return self._parts[0] or None

    @cached_property
    def _cross(self) -> dict[tuple[str, str], Path]:
        """The files between characters; a name may have an underscore, so both halves must be characters."""
        characters = {name.partition("/")[0] for name in self._paths}
        found = {}
        for path in self.place.truth_files(".vts"):
            words = path.stem.split("_")
            for k in range(1, len(words)):
                pair = "_".join(words[:k]), "_".join(words[k:])
                if path.parent.name == CROSS and set(pair) <= characters:
                    found[pair] = path
        return found

    def mirrored_truth(self, first: str, second: str) -> Truth | None:
        """Inside a character line by line; between two by the reflection of the second, whose template is another."""
        same = self.shape_class(first) == self.shape_class(second)
        return super().mirrored_truth(first, second) if same else ShapeSet.mirrored_truth(self, first, second)

    def _across(self, a: str, b: str, n_points: int, n_lines: int) -> Tensor:
        """For each point of a's template one of b's."""
        path = self._cross[a, b]
        try:
            ids = read_ids(path)
            if len(ids.values) != n_lines:
                raise ValueError(f"{path}: {len(ids.values)} lines, but the template of {a} has {n_lines} points")
            return torch.from_numpy(ids.checked(self.base, n_points, f"the template of {b}", "point"))
        except ValueError as error:
            raise TruthFileError(str(error)) from error

    @cached_property
    def _parts(self) -> tuple[dict[str, list[str]], list[Problem]]:
        parts, problems = read_split(self, {part: self.place.root / f"{part}.txt" for part in ("train", "test")})
        return parts, [problem for problem in problems if not problem.name.startswith(f"{IGNORED}/")]

    def _belongs(self, path: Path) -> bool:
        return path.parent.name not in (CROSS, IGNORED)

    def _other_problems(self) -> list[Problem]:
        out = [*super()._other_problems(), *self._parts[1]]
        sizes: dict[str, int] = {}
        for name, ids in self._raw.items():
            sizes.setdefault(self.shape_class(name), len(ids.values))
        for (a, b), path in self._cross.items():
            if a in sizes and b in sizes:
                try:
                    self._across(a, b, sizes[b], sizes[a])
                except TruthError as error:
                    out.append(Problem(path.name, path, str(error), "malformed"))
        return out
