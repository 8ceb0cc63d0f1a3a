"""SHREC19 remeshed: people in one pose each, with vertex maps between pairs.

``off/1.off`` ... ``44.off`` (or ``shapes``) and ``corres/i_j.map`` (or ``correspondences``, ``groundtruth``): line k is
the vertex of shape j that vertex k of shape i goes to, ids from 1 by custom. Shape 40 is a part of a body only;
everyone leaves it out, and so do we.

References:
    Melzi, Marin, Rodola, Castellani, Ren, Poulenard, Wonka, Ovsjanikov. SHREC 2019: Matching Humans with Different
    Connectivity. 3DOR 2019.
"""

import re
from pathlib import Path

import torch
from torch import Tensor

from torchqm.data.base import Problem, Truth, TruthError, TruthFileError
from torchqm.data.files import read_ids, recognise_base
from torchqm.data.folder import FolderShapes
from torchqm.data.meshes import mesh_files
from torchqm.data.places import Place
from torchqm.data.published import natural_key
from torchqm.geometry import MeshError

__all__ = ["Shrec19Shapes"]

PARTIAL = "40"
_N_LOOKED_AT = 40  # maps that vote on the index base; each is a file of 5,000 lines or more


class Shrec19Shapes(FolderShapes):
    """A folder of SHREC19.

    Args:
        place: where meshes and truth lie.
    """

    def __init__(self, place: Place) -> None:
        files = mesh_files(place.meshes)
        self.place = place
        self._partial = files.pop(PARTIAL, None)
        maps: dict[tuple[str, str], Path] = {}
        for path in place.truth_files(".map"):
            match = re.fullmatch(r"([^_]+)_([^_]+)", path.stem)
            if match:
                maps[match[1], match[2]] = path
        self._all_maps = dict(sorted(maps.items(), key=lambda item: tuple(map(natural_key, item[0]))))
        self._maps = {pair: path for pair, path in self._all_maps.items() if pair[0] in files and pair[1] in files}
        sentence = (
            f"SHREC19: {place.name(place.meshes)} with {len(files)} meshes, {place.name(place.truth)} with {len(maps)} "
            "files i_j.map; line k is the vertex of j for vertex k of i"
        )
        super().__init__(place.root, "shrec19", files, sentence)
        usable = []
        for (_, second), path in list(self._maps.items())[:_N_LOOKED_AT]:
            try:
                usable.append((read_ids(path).values, self.n_verts(second)))
            except ValueError:  # `problems` says what is wrong with the map, or the mesh
                continue
        found = recognise_base("ids in *.map", usable, 1)
        self.base = found.base
        self.recognised.append(found.why)
        dropped = len(self._all_maps) - len(self._maps)
        if self._partial is not None or any(PARTIAL in pair for pair in self._all_maps):
            maps_ = f"and {dropped} maps of it or of absent shapes " if dropped else ""
            self.recognised.append(f"shape {PARTIAL} {maps_}left out: it is a part of a body (nobody counts it)")

    @classmethod
    def recognise(cls, place: Place) -> "Shrec19Shapes | None":
        """The set at a place, if there are ``i_j.map`` files."""
        return cls(place) if any("_" in path.stem for path in place.truth_files(".map")) else None

    def shape_class(self, name: str) -> str:
        """``human``: there is but one class."""
        self.require(name)
        return "human"

    def truth(self, first: str, second: str) -> Truth:
        """The map of the pair; where there is only the one of the opposite direction, that read backwards.

        Read backwards, a vertex of ``first`` may occur several times in ``at``, and some do not occur.

        Raises:
            TruthError: the pair has no map, or it is malformed.
        """
        self.require(first, second)
        if first == second:
            return self._itself(first)
        if (first, second) in self._maps:
            points = self._map(first, second)
            return Truth(torch.arange(len(points)), points, self._source(first, second))
        if (second, first) in self._maps:
            at = self._map(second, first)
            return Truth(at, torch.arange(len(at)), f"{self._source(second, first)}, backwards")
        place = self.place.truth or self.place.root
        raise TruthError(f"{place}: no truth from {first} to {second}: there is no {first}_{second}.map, nor backwards")

    def published_pairs(self) -> list[tuple[str, str]]:
        """The pairs that have a map, without those of shape 40 (430 of the 44 shapes)."""
        return list(self._maps)

    def about(self, cls: str) -> tuple[str, str]:
        """What truth and symmetry come from."""
        return f"maps of {len(self._maps)} pairs", "none"

    def _source(self, first: str, second: str) -> str:
        path = self._maps[first, second]
        return f"{path.relative_to(self.place.root)} ({self.base}-based)"

    def _map(self, first: str, second: str) -> Tensor:
        path = self._maps[first, second]
        try:
            ids = read_ids(path)
            if len(ids.values) != self.n_verts(first):
                raise ValueError(
                    f"{path}: {len(ids.values)} lines, but shape {first} has {self.n_verts(first)} vertices"
                )
            return torch.from_numpy(ids.checked(self.base, self.n_verts(second), f"shape {second}"))
        except MeshError:
            raise
        except ValueError as error:
            raise TruthFileError(str(error)) from error

    def _other_problems(self) -> list[Problem]:
        out = []
        if self._partial is not None:
            out.append(Problem(PARTIAL, self._partial, f"{self._partial}: a part of a body, left out", "note"))
        absent: dict[str, int] = {}
        for pair in self._all_maps:
            for name in pair:
                if name not in self._paths and name != PARTIAL:
                    absent[name] = absent.get(name, 0) + 1
        for name, count in absent.items():
            path = self.place.meshes / f"{name}.off"
            out.append(Problem(name, path, f"{path}: no such mesh, but {count} maps name it", "missing"))
        for first, second in self._maps:
            try:
                self._map(first, second)
            except MeshError:
                continue  # the mesh has its own line
            except TruthError as error:
                out.append(Problem(f"{first}_{second}", self._maps[first, second], str(error), "malformed"))
        lonely = [name for name in self._paths if not any(name in pair for pair in self._maps)]
        out += [Problem(name, self._paths[name], f"no map names shape {name}", "missing") for name in lonely]
        return out
