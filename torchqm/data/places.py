"""Where the meshes and the truth of a set lie: the folder names that the field uses."""

from dataclasses import dataclass
from pathlib import Path

from torchqm.data.meshes import MESH_ENDINGS, mesh_files

__all__ = ["Place", "find_place"]

MESH_FOLDERS = ("off", "shapes", "off_2", "meshes", "Meshes")
TRUTH_FOLDERS = ("corres", "correspondences", "corrs", "Corrs", "groundtruth", "landmarks", "vts")


@dataclass(frozen=True)
class Place:
    """A folder of meshes and the folder of their truth.

    Args:
        root: what the user gave.
        meshes: where the meshes lie, perhaps in folders of their own.
        truth: where the files of the truth lie; None if there is no such folder.
    """

    root: Path
    meshes: Path
    truth: Path | None

    def name(self, folder: Path | None) -> str:
        """A folder as it is called in sentences: relative to the root."""
        if folder is None:
            return "corres/"
        return "the folder" if folder == self.root else f"{folder.relative_to(self.root)}/"

    def truth_files(self, ending: str) -> list[Path]:
        """Files of the truth with an ending, also one folder deeper."""
        if self.truth is None:
            return []
        return sorted([*self.truth.glob(f"*{ending}"), *self.truth.glob(f"*/*{ending}")])


def find_place(root: Path) -> Place | None:
    """The folders of a set that keeps meshes and truth apart, or side by side with the same stems; None if it is none.

    ``root/off`` + ``root/corres`` and the like; ``root/*.off`` + ``root/corres``; ``root/*.off`` + ``root/*.vts``.
    ``root`` may also hold ``vtx_5k`` (Ren et al. 2018) with these in it. Meshes in a folder of the first kind make a
    set of this kind even where the truth is missing.
    """
    for base in (root, root / "vtx_5k"):
        truth = next((base / name for name in TRUTH_FOLDERS if (base / name).is_dir()), None)
        for name in MESH_FOLDERS:
            if _holds_meshes(base / name):
                return Place(root, base / name, truth)
        files = mesh_files(base)
        if files and truth is not None:
            return Place(root, base, truth)
        if any(path.stem in files for path in base.glob("*.vts")):
            return Place(root, base, base)
    return None


def _holds_meshes(folder: Path) -> bool:
    if not folder.is_dir():
        return False
    if mesh_files(folder):
        return True
    return any(child.suffix.lower() in MESH_ENDINGS for child in folder.glob("*/*"))
