"""Work that many tests ask for again with equal input is done once in a run."""

import functools
import hashlib
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from torch import Tensor

from torchqm.data import synthetic
from torchqm.geometry.files import write_whole
from torchqm.matching import known, shape


def share(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Meshes of creatures (one to three seconds each), mirror planes (half a second) and eigenpairs (a tenth).

    That equal input gives equal output is tested where the work is done: in ``tests/data/test_synthetic.py``,
    ``tests/symmetry/test_extrinsic.py`` and ``tests/spectral/test_eigen.py``, which are not touched by this.

    Args:
        patch: of the run.
        folder: where the processes of the run find each other's meshes.
    """
    folder.mkdir(exist_ok=True)
    for name in ("_body", "_retriangulated"):
        patch.setattr(synthetic, name, _in_files(getattr(synthetic, name).__wrapped__, folder))
    patch.setattr(known, "find_reflections", _kept(known.find_reflections, _mesh))
    patch.setattr(shape, "eigenbasis_and_note", _kept(shape.eigenbasis_and_note, _operator))


def _in_files(plain: Callable[..., Any], folder: Path) -> Callable[..., Any]:
    @functools.lru_cache(None)
    @functools.wraps(plain)
    def made(*place):
        path = folder / "-".join(map(str, (plain.__name__, *place)))
        if path.exists():
            return pickle.loads(path.read_bytes())
        value = plain(*place)
        write_whole(path, lambda file: pickle.dump(value, file))
        return value

    return made


def _kept(plain: Callable[..., Any], content: Callable[..., tuple], most: int = 60) -> Callable[..., Any]:
    kept: dict[tuple, Any] = {}

    @functools.wraps(plain)
    def call(*arguments):
        key = content(*arguments)
        if key not in kept:
            if len(kept) == most:
                kept.pop(next(iter(kept)))
            kept[key] = plain(*arguments)
        return kept[key]

    return call


def _mesh(mesh):
    return _hash(mesh.verts), _hash(mesh.faces)


def _operator(operator, k, name="mesh"):
    stiffness = operator.stiffness.coalesce()
    return k, _hash(stiffness.indices()), _hash(stiffness.values()), _hash(operator.mass)


def _hash(values: Tensor) -> tuple[bytes, tuple[int, ...]]:
    return hashlib.sha256(values.contiguous().numpy().tobytes()).digest(), tuple(values.shape)
