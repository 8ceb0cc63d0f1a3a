"""One entry of the spectral cache: its name, its content, and what is checked when it is read.

An entry is a plain ``.npz`` that loads with ``numpy.load(allow_pickle=False)``. Its name says what it is of::

    <hash of verts and faces>-<asked>-k<K>-v<version>.npz       asked: the Laplacian, auto, cotan or robust

    format, version, content, asked     what the name says once more: a file under a wrong name is found out
    evals (K,), evecs (V, K), mass (V,) float64, in the units of the mesh's own vertices
    next_eval                           eigenvalue K+1 (inf: there is none; nan: not known), to see where a cluster ends
    kind, reason                        the Laplacian taken and why
    source, name                        what computed it, and what the shape was called
"""

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import torch

from torchqm.geometry.files import write_whole
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis

__all__ = ["KINDS", "Entry", "content_hash", "entry_files", "entry_path", "read_entry", "write_entry"]

KINDS = ("auto", "cotan", "robust")
"""Laplacians that can be asked for."""

_FORMAT, _VERSION = "torchqm spectral basis", 1
_NAME = re.compile(rf"(?P<content>[0-9a-f]{{32}})-(?P<asked>{'|'.join(KINDS)})-k(?P<k>[1-9]\d*)-v{_VERSION}\.npz")


@dataclass(frozen=True, eq=False)
class Entry:
    """The content of a file.

    Args:
        basis: eigenpairs in the units of the mesh.
        next_eval: the eigenvalue after the last one; infinite if there is none, NaN if it is not known.
        kind: ``cotan`` or ``robust``.
        reason: why that one.
        source: what computed it.
        path: the file; None if there is none.
    """

    basis: SpectralBasis
    next_eval: float
    kind: str
    reason: str
    source: str
    path: Path | None = None


def content_hash(mesh: Mesh) -> str:
    """32 hexadecimal digits that depend on every coordinate and every triangle, and on nothing else.

    Example:
        >>> content_hash(Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]))
        '39c3cd34dc9600caa998539b7a04d760'
    """
    digest = hashlib.blake2b(digest_size=16)
    for array, kind in zip(mesh.numpy(), ("<f8", "<i8"), strict=True):
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array, dtype=kind).data)
    return digest.hexdigest()


def entry_path(folder: Path, content: str, asked: str, k: int) -> Path:
    """Where the entry of a mesh, a Laplacian and a number of functions lies."""
    return folder / f"{content}-{asked}-k{k}-v{_VERSION}.npz"


def entry_files(folder: Path, content: str, asked: str, k: int = 1, below: int | None = None) -> list[Path]:
    """The entries of a mesh with at least ``k`` functions (and fewer than ``below``), smallest first."""
    found = []
    for path in folder.glob(f"{content}-{asked}-k*-v{_VERSION}.npz"):
        name = _NAME.fullmatch(path.name)
        if name is not None and 1 <= k <= int(name["k"]) and (below is None or int(name["k"]) < below):
            found.append((int(name["k"]), path))
    return [path for _, path in sorted(found)]


def write_entry(path: Path, entry: Entry, name: str) -> None:
    """Write an entry under a path of :func:`entry_path`, whole or not at all.

    Raises:
        OSError: the place cannot be written to.
    """
    content, asked = path.name.split("-")[:2]

    def write(file: IO[bytes]) -> None:
        np.savez(
            file,
            allow_pickle=False,
            format=_FORMAT,
            version=_VERSION,
            content=content,
            asked=asked,
            evals=entry.basis.evals.numpy(),
            evecs=entry.basis.evecs.numpy(),
            mass=entry.basis.mass.numpy(),
            next_eval=entry.next_eval,
            kind=entry.kind,
            reason=entry.reason,
            source=entry.source,
            name=name,
        )

    write_whole(path, write)


def read_entry(path: Path, n_verts: int) -> Entry:
    """Read an entry, with everything checked that can be checked in the time of reading it.

    Args:
        path: a path of :func:`entry_path`.
        n_verts: vertices of the mesh.

    Raises:
        FileNotFoundError: it is not there.
        Exception: it is damaged, or not what its name says; what is raised depends on where the damage is.
    """
    content, asked, size = path.name.split("-")[:3]
    k = int(size[1:])
    # Opened here: numpy.load leaves a file open that turns out to be no archive.
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        head = tuple(file[name].item() for name in ("format", "version", "content", "asked"))
        if head != (_FORMAT, _VERSION, content, asked):
            raise ValueError(f"it holds {head}")
        evals, evecs, mass = (file[name] for name in ("evals", "evecs", "mass"))
        kind, reason, source = (str(file[name]) for name in ("kind", "reason", "source"))
        next_eval = float(file["next_eval"])
    for name, array, shape in (("evals", evals, (k,)), ("evecs", evecs, (n_verts, k)), ("mass", mass, (n_verts,))):
        if array.shape != shape or array.dtype != np.float64:
            raise ValueError(f"{name} is {array.dtype} {array.shape}, not float64 {shape}")
    if not (np.isfinite(evals).all() and evals[0] >= 0 and (np.diff(evals) >= 0).all()):
        raise ValueError("evals are not in ascending order from 0")
    if not (np.isfinite(mass).all() and mass.min() >= 0):
        raise ValueError("mass is negative or not finite")
    # Orthonormality through two random combinations of the functions: all of it would take longer than the reading.
    probe = np.random.default_rng(0).standard_normal((k, 2)) / np.sqrt(k)
    image = evecs @ probe
    if not np.abs(image.T @ (mass[:, None] * image) - probe.T @ probe).max() < 1e-6:
        raise ValueError("evecs are not orthonormal in mass")
    basis = SpectralBasis(torch.from_numpy(evals), torch.from_numpy(evecs), torch.from_numpy(mass))
    return Entry(basis, next_eval, kind, reason, source, path)
