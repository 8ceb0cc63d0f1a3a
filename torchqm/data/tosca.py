"""TOSCA as first published: ``cat0.mat`` with ``surface.X, Y, Z, TRIV``, or ``cat0.vert`` beside ``cat0.tri``.

The vertex ids of a class agree, so the truth inside a class is the identity. Triangles count vertices from 1; that is
recognised from the numbers. The symmetry of a class is the mirror plane of its pose 0, where that has one.

References:
    Bronstein, Bronstein, Kimmel. Numerical Geometry of Non-Rigid Shapes, 2008.
"""

import re
from pathlib import Path

from torchqm.data.base import Problem
from torchqm.data.files import IndexBase, recognise_base
from torchqm.data.folder import SameIdShapes
from torchqm.data.meshes import mesh_files, raw_faces
from torchqm.geometry import MeshError

__all__ = ["ToscaShapes"]


class ToscaShapes(SameIdShapes):
    """A folder of TOSCA, ``.mat`` or ``.vert`` + ``.tri`` files.

    Args:
        root: the folder.
        ending: ``.mat`` or ``.vert``.
    """

    def __init__(self, root: Path, ending: str) -> None:
        files = mesh_files(root, (ending,))
        what = "MATLAB files" if ending == ".mat" else ".vert files, each with a .tri beside it"
        sentence = f"TOSCA as first published: {len(files)} {what}, named by class and number"
        super().__init__(root, "tosca-mat" if ending == ".mat" else "tosca-vert", files, sentence)
        self.ending = ending
        self.recognised.append(self._base(next(iter(self._paths.values()), None)).why)

    @classmethod
    def recognise(cls, root: Path) -> "ToscaShapes | None":
        """The set in a folder, if it is one of this layout."""
        mats = [stem for stem in mesh_files(root, (".mat",)) if re.fullmatch(r"[A-Za-z]+\d+", stem)]
        verts = mesh_files(root, (".vert",))
        if max(len(mats), len(verts)) <= len(mesh_files(root)):  # meshes of other kinds, with something beside them
            return None
        return cls(root, ".mat" if len(mats) > len(verts) else ".vert")

    def undeformed(self, cls: str) -> str | None:
        """Pose 0 of the class, if it is here."""
        return f"{cls}0" if f"{cls}0" in self._paths else None

    def _base(self, path: Path | None) -> IndexBase:
        """From what number the triangles of a file count (of the first, which stands for all: reading takes long)."""
        default = 1
        if path is None:
            return IndexBase(default, "no readable shape says from what number triangles count")
        where = "surface.TRIV" if self.ending == ".mat" else path.with_suffix(".tri").name
        try:
            faces = raw_faces(path)
        except MeshError as error:
            return IndexBase(default, f"triangles are taken as 1-based ({error})")
        return recognise_base(f"triangles ({where} of {path.stem})", [(faces, self.n_verts(path.stem))], default)

    def _other_problems(self) -> list[Problem]:
        out = super()._other_problems()
        if self.ending == ".vert":
            alone = sorted(set(mesh_files(Path(self.root), (".tri",))) - set(self._files))
            root = Path(self.root)
            out += [
                Problem(stem, root / f"{stem}.vert", f"{root / stem}.tri has no .vert file beside it", "missing")
                for stem in alone
            ]
        return out
