"""Reading a shape's symmetry from a file that somebody hands in, and saying exactly what is wrong with it."""

import re
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchqm.geometry.check import orient_faces
from torchqm.geometry.mesh import Mesh
from torchqm.matching.quality import orientation_agreement
from torchqm.symmetry.group import GroupResiduals, SymmetryGroup

__all__ = [
    "MAX_RETURN_ERROR",
    "SymmetryFile",
    "SymmetryFileError",
    "closure_fault",
    "load_symmetry",
    "reflection_fault",
    "return_error",
]

MAX_RETURN_ERROR = 0.1
"""A reflection applied twice must bring points back to within this on average, in units of sqrt(area)."""

_TEXT = (".txt", ".vts", ".csv", ".map")
_ENDINGS = (".npz", ".npy", *_TEXT)


class SymmetryFileError(ValueError):
    """A symmetry file that cannot be used; the message names the file and the fault."""


@dataclass(frozen=True, eq=False)
class SymmetryFile:
    """A symmetry group read from a file.

    Args:
        maps: ``(G, V)`` int64, 0-based vertex maps, row 0 the identity.
        notes: how the file was read where that is not obvious (ids counted from 1, several vertices with one image).
    """

    maps: Int[Tensor, "G V"]
    notes: list[str] = field(default_factory=list)


def return_error(mesh: Mesh, reflection: Int[Tensor, " V"]) -> float:
    """Mean distance between x and S(S(x)) over the surface, divided by sqrt(area); 0 for an exact involution.

    Args:
        mesh: the shape, any scale.
        reflection: ``(V,)`` vertex map of it.
    """
    unit = mesh.normalized()  # area**1.5 of the file's units may be no double
    moved = (unit.verts - unit.verts[reflection[reflection]]).norm(dim=1)
    return float((moved * unit.vertex_areas).sum())


def reflection_fault(mesh: Mesh, reflection: Int[Tensor, " V"], half_turns: bool = False) -> str | None:
    """What speaks against a vertex map being the reflection of a shape, with the numbers; None if nothing does.

    Applied twice it must bring points back (:data:`MAX_RETURN_ERROR`), it must move a third of the area at least by
    more than 0.02 sqrt(area), and on an orientable surface it must turn the orientation over: what keeps it is a
    rotation, which has no left and right.

    Args:
        mesh: the shape, any scale.
        reflection: ``(V,)`` vertex map of it.
        half_turns: whether a rotation that undoes itself is as good.
    """
    error = return_error(mesh, reflection)
    if not error <= MAX_RETURN_ERROR:
        return (
            f"applied twice it moves points by {error:.3f} sqrt(area) on average "
            f"(0 is exact, {MAX_RETURN_ERROR:g} is allowed)"
        )
    unit = mesh.normalized()
    moved = float(unit.vertex_areas[(unit.verts - unit.verts[reflection]).norm(dim=1) > 0.02].sum())
    if moved < 1 / 3:
        return f"it moves only {moved:.1%} of the area (by more than 0.02 sqrt(area)); a reflection moves nearly all"
    faces = None if half_turns else orient_faces(unit)
    if faces is not None:
        oriented = replace(unit, faces=faces)
        agreement = orientation_agreement(oriented, oriented, reflection)
        if agreement > 0.3:
            return f"it keeps the orientation of the surface ({agreement:+.2f}, a reflection has -1): a rotation"
    return None


def closure_fault(mesh: Mesh, group: SymmetryGroup) -> tuple[str | None, GroupResiduals]:
    """What speaks against a table of vertex maps being a group, with the numbers; and its residuals.

    Args:
        mesh: the shape, any scale.
        group: the table.
    """
    unit = mesh.normalized()
    residuals = group.residuals(unit.verts, unit.vertex_areas)
    worst = max(residuals.closure, residuals.inverse)
    fault = residuals.fault
    if fault is None and worst > MAX_RETURN_ERROR:
        fault = (
            f"products of two maps are up to {worst:.3f} sqrt(area) from the nearest map on average "
            f"({MAX_RETURN_ERROR:g} is allowed)"
        )
    return fault, residuals


def load_symmetry(path: str | Path, mesh: Mesh) -> SymmetryFile:
    """Read the symmetry of a mesh from a file.

    Three forms are read. ``.npz`` with the key ``maps``, as ``torchqm symmetry`` writes it: ``(G, V)``, row 0 the
    identity. ``.npy`` or text (``.txt``, ``.vts``, ``.csv``, ``.map``) with one reflection, V integers: for each vertex
    the vertex that it goes to. ``.npy`` or text with a ``(G, V)`` table whose first row is the identity; such
    a table of two maps may be a half turn.

    Ids count from 0. Where no id is 0 and one is V, they are taken to count from 1, as in the ``.vts`` files of
    correspondence benchmarks, and a note says so. A reflection need not be a permutation, since a real one sends a
    vertex to the vertex *nearest* its image, and two vertices may share that. But applied twice it must bring points
    back to within :data:`MAX_RETURN_ERROR` on average; if several vertices share images, a note gives both numbers.

    Args:
        path: the file.
        mesh: the shape whose symmetry it is.

    Returns:
        The maps and notes on how they were read.

    Raises:
        SymmetryFileError: missing, unreadable, of the wrong length, ids out of range, or no symmetry of the mesh.

    Example:
        >>> load_symmetry("nowhere.npz", Mesh.from_arrays(np.eye(3), [[0, 1, 2]]))
        Traceback (most recent call last):
        torchqm.matching.symmetry_file.SymmetryFileError: nowhere.npz: no such file
    """
    path = Path(path)
    table, notes = _from_one(path, _as_table(path, _read(path), mesh), mesh)
    alone = table.shape[0] == 1  # without the identity beside it, it is said to be a reflection
    if table.shape[0] == 1:
        table = np.concatenate([np.arange(mesh.n_verts)[None], table])
    elif (table[0] != np.arange(mesh.n_verts)).any():
        raise SymmetryFileError(
            f"{path}: row 0 of {len(table)} must be the identity, as in files of `torchqm symmetry`"
        )
    maps = torch.from_numpy(np.ascontiguousarray(table))
    for row in range(1, len(maps)):
        notes += _check_row(path, mesh, maps[row], row, len(maps), half_turns=not alone)
    if len(maps) > 2:
        fault, _ = closure_fault(mesh, SymmetryGroup(maps))
        if fault is not None:
            raise SymmetryFileError(f"{path}: the {len(maps)} maps are no group: {fault}")
    return SymmetryFile(maps, notes)


def _read(path: Path) -> np.ndarray:
    """The numbers in a file, of whatever shape and type."""
    if path.is_dir():
        raise SymmetryFileError(f"{path}: is a folder, not a symmetry file")
    if not path.exists():
        raise SymmetryFileError(f"{path}: no such file")
    ending = path.suffix.lower()
    if ending not in _ENDINGS:
        given = f"unknown ending {path.suffix!r}" if path.suffix else "no file ending"
        raise SymmetryFileError(f"{path}: {given} for a symmetry; supported are {', '.join(_ENDINGS)}")
    try:
        if path.stat().st_size == 0:
            raise SymmetryFileError(f"{path}: the file is empty")
        return _read_text(path) if ending in _TEXT else _read_numpy(path)
    except SymmetryFileError:
        raise
    except OSError as error:
        raise SymmetryFileError(f"{path}: cannot be read ({error.strerror or error})") from error


def _read_numpy(path: Path) -> np.ndarray:
    """An array file, or the key ``maps`` of an archive."""
    try:
        loaded = np.load(path, allow_pickle=False)
        if isinstance(loaded, np.ndarray):
            return loaded
        with loaded:
            if "maps" not in loaded:
                raise SymmetryFileError(
                    f"{path}: no key 'maps' in it, only {', '.join(sorted(loaded)) or 'nothing'}; a symmetry file has "
                    "'maps' of shape (G, V)"
                )
            if "orbits" in loaded:
                raise SymmetryFileError(
                    f"{path}: the result of a match, not a symmetry; a symmetry.npz comes from `torchqm symmetry`"
                )
            return loaded["maps"]
    except SymmetryFileError:
        raise
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise SymmetryFileError(f"{path}: damaged, or no NumPy file without pickled objects") from error


def _read_text(path: Path) -> np.ndarray:
    """Integers, separated by blanks or commas; rows of equal length make a table."""
    try:
        rows = [
            re.split(r"[\s,]+", line.strip(" \t\r\n,")) for line in path.read_text("utf-8").splitlines() if line.strip()
        ]
    except UnicodeDecodeError as error:
        raise SymmetryFileError(f"{path}: not a text file (byte {error.start} is no UTF-8)") from error
    numbers = []
    for count, row in enumerate(rows, 1):
        try:
            numbers.append([int(word) for word in row])
        except ValueError:
            word = next(w for w in row if not re.fullmatch(r"[+-]?\d+", w))
            raise SymmetryFileError(f"{path}: {word[:20]!r} in row {count} is no vertex id") from None
    lengths = {len(row) for row in numbers}
    if len(lengths) > 1:
        raise SymmetryFileError(f"{path}: rows of different length, from {min(lengths)} to {max(lengths)} entries")
    try:
        return np.array(numbers, dtype=np.int64)
    except OverflowError as error:
        raise SymmetryFileError(f"{path}: a number too large for a vertex id") from error


def _as_table(path: Path, values: np.ndarray, mesh: Mesh) -> np.ndarray:
    """The numbers as ``(G, V)`` int64, or the fault that they have."""
    if values.dtype.kind == "f" and values.size and np.isfinite(values).all() and (values == np.round(values)).all():
        values = values.astype(np.int64)  # what numpy.savetxt and MATLAB make of ids
    if values.dtype.kind not in "iu":
        raise SymmetryFileError(f"{path}: holds {values.dtype} values, but vertex ids are integers")
    if values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim == 1:
        values = values[None]
    if values.ndim != 2 or values.shape[0] == 0:
        raise SymmetryFileError(f"{path}: an array of shape {values.shape}; allowed are (V,) and (G, V)")
    if values.shape[1] != mesh.n_verts:
        raise SymmetryFileError(
            f"{path}: {values.shape[1]} entries a map, but {mesh.label} has {mesh.n_verts} vertices"
        )
    return values.astype(np.int64)


def _from_one(path: Path, table: np.ndarray, mesh: Mesh) -> tuple[np.ndarray, list[str]]:
    """Ids counted from 0, and a note if the file counted from 1."""
    n = mesh.n_verts
    low, high = int(table.min()), int(table.max())
    if low >= 1 and high == n:
        return table - 1, [f"{path}: ids from {low} to {n} for {n} vertices: taken to count from 1"]
    if low < 0 or high >= n:
        outside = int(((table < 0) | (table >= n)).sum())
        raise SymmetryFileError(
            f"{path}: {outside} ids out of range (they run from {low} to {high}), but {mesh.label} has vertices "
            f"0 to {n - 1}"
        )
    return table, []


def _check_row(path: Path, mesh: Mesh, row: Int[Tensor, " V"], number: int, order: int, half_turns: bool) -> list[str]:
    """Refuse what is no symmetry: the identity again, or (of a pair) a map that does not undo itself."""
    where = f"{path}: " + (f"row {number} " if order > 2 else "the map ")
    n = mesh.n_verts
    if torch.equal(row, torch.arange(n)):
        raise SymmetryFileError(f"{where}is the identity: no vertex moves, so it is no reflection")
    repeated = n - int(row.unique().numel())
    if order > 2:  # a rotation need not undo itself; the group's own residuals judge it
        return []
    fault = reflection_fault(mesh, row, half_turns)
    if fault is not None:
        kind = f"no permutation ({repeated} of {n} ids repeat) and " if repeated else "a permutation, but "
        raise SymmetryFileError(f"{where}is {kind}no reflection: {fault}")
    error = return_error(mesh, row)
    if repeated:
        return [
            f"{where}is no permutation ({repeated} of {n} ids repeat): taken as a nearest-vertex map; applied twice it "
            f"moves points by {error:.3f} sqrt(area) on average"
        ]
    return []
