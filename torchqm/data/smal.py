"""SMAL remeshed: animals of eight kinds, all in correspondence with one template.

As ULRSSM has it (``off/cow_alph4.off``, ``corres/cow_alph4.vts``, ``train.txt``, ``test.txt`` and, divided by kinds,
``train_cat.txt``, ``test_cat.txt``) or AttentiveFMaps (``shapes/*.obj``, ``correspondences/*.vts``, no lists: its
kinds for training and for tests are those of :data:`TEST_KINDS`).

References:
    Zuffi, Kanazawa, Jacobs, Black. 3D Menagerie. CVPR 2017.
"""

from functools import cached_property
from pathlib import Path

from torchqm.data.base import Problem
from torchqm.data.folder import read_split
from torchqm.data.meshes import mesh_files
from torchqm.data.places import Place
from torchqm.data.vts import VtsShapes

__all__ = ["SmalShapes"]

KINDS = frozenset({"cougar", "cow", "dog", "fox", "hippo", "horse", "lion", "wolf"})
TEST_KINDS = frozenset({"cougar", "hippo", "horse"})
"""The kinds that no shape of the training part is of, in the division by kinds."""


class SmalShapes(VtsShapes):
    """A folder of SMAL.

    Args:
        place: where meshes and truth lie.
    """

    def __init__(self, place: Place) -> None:
        super().__init__(place, "smal", title="SMAL (animals)")
        lists = sorted(path.name for path in self._lists.values() if path.is_file())
        how = f"parts for training and tests from {', '.join(lists)}" if lists else "parts by kind, as it has no lists"
        self.recognised.append(how)

    @classmethod
    def recognise(cls, place: Place) -> "SmalShapes | None":
        """The set at a place, if the folder is called SMAL, or all names are of its kinds and two of them occur."""
        kinds = {_kind(name) for name in mesh_files(place.meshes)}
        named = place.root.resolve().name.lower().startswith("smal")
        return cls(place) if kinds and (named or (kinds <= KINDS and len(kinds) > 1 and _underscored(place))) else None

    def shape_class(self, name: str) -> str:
        """The kind of an animal: its name up to the first underscore."""
        self.require(name)
        return _kind(name)

    def split(self) -> dict[str, list[str]] | None:
        """``train`` and ``test``, also ``train_cat`` and ``test_cat`` (by kinds) where the folder has these lists."""
        parts, _ = self._parts
        if parts:
            return parts
        test = {name for name in self.names if self.shape_class(name) in TEST_KINDS}
        return {"train": [n for n in self.names if n not in test], "test": [n for n in self.names if n in test]}

    @property
    def _lists(self) -> dict[str, Path]:
        return {part: self.place.root / f"{part}.txt" for part in ("train", "test", "train_cat", "test_cat")}

    @cached_property
    def _parts(self) -> tuple[dict[str, list[str]], list[Problem]]:
        return read_split(self, self._lists)

    def _other_problems(self) -> list[Problem]:
        return [*super()._other_problems(), *self._parts[1]]


def _kind(name: str) -> str:
    return name.partition("_")[0]


def _underscored(place: Place) -> bool:
    """TOSCA has dogs, horses and wolves, too, but writes ``dog1``."""
    return all("_" in name for name in mesh_files(place.meshes))
