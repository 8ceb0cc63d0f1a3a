"""FAUST as first published: ``training/registrations/tr_reg_000.ply`` to ``tr_reg_099.ply``, vertex ids agree.

Ten people in ten poses each. The set itself has no truth for its test scans; the field trains on the first 80
registrations and tests on the last 20, and so does :meth:`FaustRegistrations.split`.

References:
    Bogo, Romero, Loper, Black. FAUST: Dataset and Evaluation for 3D Mesh Registration. CVPR 2014.
"""

import re
from pathlib import Path

from torchqm.data.base import Problem
from torchqm.data.folder import SameIdShapes
from torchqm.data.meshes import mesh_files

__all__ = ["FaustRegistrations"]

N_SHAPES, FIRST_TEST = 100, 80
_PLACES = (".", "registrations", "training/registrations", "MPI-FAUST/training/registrations")


class FaustRegistrations(SameIdShapes):
    """The registrations of FAUST.

    Args:
        root: what the user gave.
        folder: where the registrations lie.
    """

    def __init__(self, root: Path, folder: Path) -> None:
        files = _registrations(folder)
        where = "" if folder == root else f" in {folder.relative_to(root)}/"
        sentence = f"FAUST registrations as first published: {len(files)} files tr_reg_*{where}; all vertex ids agree"
        super().__init__(root, "faust-registrations", files, sentence)
        self.folder = folder

    @classmethod
    def recognise(cls, root: Path) -> "FaustRegistrations | None":
        """The set in a folder, or in its ``training/registrations``, if there are ``tr_reg_*`` meshes without truth."""
        for place in _PLACES:
            folder = root if place == "." else root / place
            if _registrations(folder) and not (folder / "corres").is_dir() and not any(folder.glob("*.vts")):
                return cls(root, folder)
        return None

    def shape_class(self, name: str) -> str:
        """``faust``: all vertex ids agree, across people."""
        self.require(name)
        return "faust"

    def split(self) -> dict[str, list[str]] | None:
        """The first 80 registrations for training, the last 20 for tests."""
        test = [name for name in self.names if int(name.removeprefix("tr_reg_")) >= FIRST_TEST]
        return {"train": [name for name in self.names if name not in test], "test": test}

    def _other_problems(self) -> list[Problem]:
        out = super()._other_problems()
        if len(self._files) != N_SHAPES:
            what = f"{len(self._files)} registrations; FAUST has {N_SHAPES}"
            out.append(Problem("FAUST", self.folder, what, "note"))
        return out


def _registrations(folder: Path) -> dict[str, Path]:
    found = mesh_files(folder, (".ply", ".off", ".obj"))
    return {stem: path for stem, path in found.items() if re.fullmatch(r"tr_reg_\d{3}", stem)}
