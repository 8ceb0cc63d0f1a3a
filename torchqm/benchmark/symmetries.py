"""Symmetries found during a run, each once: kept in the output folder, read by every later pair, method and run."""

import hashlib
import json
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchqm.benchmark.ledger import file_name
from torchqm.geometry.files import write_whole
from torchqm.matching.baselines import BaselineResult, Given, Ours
from torchqm.matching.collection import Collection
from torchqm.matching.known import KnownSymmetry
from torchqm.matching.outside import Descriptors
from torchqm.matching.parameters import MatchParameters
from torchqm.matching.shape import PreparedShape
from torchqm.spectral.cache_file import content_hash
from torchqm.symmetry.group import SymmetryGroup
from torchqm.version import __version__

__all__ = ["KeptCollection", "load_known", "match_ours", "save_known"]


def save_known(path: Path, known: KnownSymmetry, seconds: float) -> None:
    """Write a symmetry and the seconds that it took to one ``.npz``, whole or not at all."""
    about = {"origin": known.origin, "warnings": known.warnings, "details": known.details, "seconds": seconds}
    arrays = {"maps": known.group.maps, "sign": known.sign, "table": known.table, "turned": known.turned}
    content: dict[str, Any] = {name: array.numpy() for name, array in arrays.items() if array is not None}
    content["about"] = np.array(json.dumps(about, default=str))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: np.savez_compressed(file, **content))


def load_known(path: Path, n_verts: int) -> tuple[KnownSymmetry, float] | None:
    """What :func:`save_known` wrote; None if there is no such file, or (with a warning) if it cannot be used."""
    if not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as kept:
            arrays = {name: torch.from_numpy(kept[name]) for name in kept.files if name != "about"}
            about = json.loads(str(kept["about"]))
        if arrays["maps"].shape[1] != n_verts or len(arrays["sign"]) != n_verts:
            raise ValueError(f"of {arrays['maps'].shape[1]} vertices instead of {n_verts}")
        known = KnownSymmetry(
            SymmetryGroup(arrays["maps"]),
            arrays["sign"],
            about["origin"],
            about["warnings"],
            about["details"],
            arrays.get("table"),
            arrays.get("turned"),
        )
        return known, float(about["seconds"])
    except (OSError, ValueError, KeyError, EOFError, IndexError, zipfile.BadZipFile) as error:
        warnings.warn(f"{path}: a kept symmetry that cannot be used, found anew ({error})", stacklevel=2)
        return None


class KeptCollection(Collection):
    """A :class:`Collection` whose symmetries are files: what another pair, process or run found is not found again.

    The seconds of a symmetry are kept with it and counted for every pair that uses it, so that the seconds of a pair do
    not depend on what ran before it.

    Args:
        folder: where the files are.
        method: one of :data:`torchqm.matching.collection.METHODS`.
        parameters: of the method.
        descriptors: see :func:`torchqm.matching.match`; symmetries do not depend on them.
    """

    def __init__(
        self, folder: Path, method: str, parameters: MatchParameters, descriptors: Descriptors | None = None
    ) -> None:
        super().__init__(None, method, parameters, descriptors=descriptors)
        self.folder = folder
        self.symmetry_seconds = 0.0
        self._read_seconds = 0.0
        self._kept: dict[str, KnownSymmetry] = {}
        self._hashes: dict[int, tuple[PreparedShape, str]] = {}

    @property
    def total_seconds(self) -> float:
        """Of all steps, those of symmetries that were read included."""
        return sum(self.steps.seconds.values()) + self._read_seconds

    def transfer(self, shape: PreparedShape, reference: PreparedShape, known: KnownSymmetry) -> KnownSymmetry:
        """See :meth:`Collection.transfer`."""
        given = hashlib.sha256(known.group.maps.numpy().tobytes()).hexdigest()[:16]
        key = [self._hash(reference), given, self.way]
        return self._once(shape, "transfer", key, lambda: super(KeptCollection, self).transfer(shape, reference, known))

    def own_symmetry(self, shape: PreparedShape, how: str) -> KnownSymmetry:
        """See :meth:`Collection.own_symmetry`."""
        return self._once(shape, how, [], lambda: super(KeptCollection, self).own_symmetry(shape, how))

    def _hash(self, shape: PreparedShape) -> str:
        if id(shape) not in self._hashes:
            self._hashes[id(shape)] = shape, f"{content_hash(shape.mesh)}-{shape.basis.k}-{len(shape.samples)}"
        return self._hashes[id(shape)][1]

    def _once(self, shape: PreparedShape, how: str, key: list[str], make: Callable[[], KnownSymmetry]) -> KnownSymmetry:
        from filelock import FileLock

        what = json.dumps([__version__, how, self._hash(shape), *key, self.parameters.as_dict()], sort_keys=True)
        name = f"{file_name(shape.mesh.name)}-{how}-{hashlib.sha256(what.encode()).hexdigest()[:12]}"
        if name in self._kept:
            return self._kept[name]
        path = self.folder / f"{name}.npz"
        self.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(self.folder / f".{name}.lock"):  # of processes that need it one finds it, the others wait
            outer = self.symmetry_seconds
            found = load_known(path, shape.n_verts)
            if found is None:
                before = self.total_seconds
                known = make()
                seconds = self.total_seconds - before
                save_known(path, known, seconds)
            else:
                known, seconds = found
                self._read_seconds += seconds
            self.symmetry_seconds = outer + seconds  # what it found on the way is part of it
        self._kept[name] = known
        return known


def match_ours(
    matcher: Ours, x: PreparedShape, y: PreparedShape, given: Given, collection: KeptCollection
) -> BaselineResult:
    """What ``matcher.match(x, y, given)`` gives, with symmetries that are found once for all pairs.

    Raises:
        MatchError: as there.
    """
    result = matcher.match(x, y, given, collection)
    matching = collection.total_seconds - collection.symmetry_seconds
    return replace(result, steps={"symmetries": collection.symmetry_seconds, "matching": matching})
