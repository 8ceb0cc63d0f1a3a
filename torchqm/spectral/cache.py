"""The spectral cache: the eigenpairs of a shape in one file, computed once and read by every later run."""

import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from torchqm.geometry.laplacian import laplacian
from torchqm.geometry.mesh import Mesh
from torchqm.spectral.basis import SpectralBasis, cluster_end
from torchqm.spectral.cache_file import KINDS, Entry, content_hash, entry_files, entry_path, read_entry, write_entry
from torchqm.spectral.diffusion_net import DiffusionNetError, diffusion_net_files, read_diffusion_net
from torchqm.spectral.eigen import SpectrumWarning, eigenbasis_and_note
from torchqm.version import __version__

__all__ = [
    "CACHE_VARIABLE",
    "CLUSTER_RTOL",
    "CacheReport",
    "CacheWarning",
    "CachedBasis",
    "cache_folder",
    "cached_basis",
    "is_cached",
    "read_basis",
]

CACHE_VARIABLE = "TORCHQM_CACHE"
"""Environment variable that names the cache where no folder is given."""

CLUSTER_RTOL = 1e-6
"""Eigenvalues closer than this (relative) are one cluster for the cache.

Only where they are equal up to the solver's accuracy does a cut between them return arbitrary functions; the wider
clusters of nearly symmetric shapes (1e-3, see :func:`torchqm.spectral.basis.cluster_end`) matter to a matcher, which
looks for them itself."""

LOCK_SECONDS = 900.0
"""How long to wait for another process that computes the same entry, before computing it twice."""


class CacheWarning(UserWarning):
    """A file of the cache that could not be used or written; the message names it and says why."""


@dataclass(frozen=True)
class CacheReport:
    """Where a basis came from.

    Args:
        outcome: ``read`` (from the cache), ``computed``, ``rebuilt`` (computed in place of a damaged entry) or
            ``diffusion-net`` (taken over from a file of diffusion-net).
        path: the entry; None without a cache, or where it could not be written.
        kind: the Laplacian taken, ``cotan`` or ``robust``.
        reason: why that one.
        source: what computed the eigenpairs: a version of torchqm, or diffusion-net and its file.
        problems: files that could not be used or written, each with its path and why.
        notes: what else was looked at, e.g. a diffusion-net file with too few functions.
        seconds: time of the whole call.
    """

    outcome: str
    path: Path | None
    kind: str
    reason: str
    source: str
    problems: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class CachedBasis(SpectralBasis):
    """A :class:`SpectralBasis` that says where it came from.

    Args:
        evals: ``(K,)`` eigenvalues (1 / area, in the units of the mesh).
        evecs: ``(V, K)`` eigenfunctions.
        mass: ``(V,)`` lumped vertex areas.
        report: where it came from.
    """

    report: CacheReport


@dataclass
class _Looked:
    """What was met on the way to an entry."""

    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    unusable: list[Path] = field(default_factory=list)


def cache_folder(given: str | Path | None = None, default: str | Path | None = None) -> Path | None:
    """The folder of the cache: the one given, else that of the variable ``TORCHQM_CACHE``, else the default.

    Example:
        >>> cache_folder("here").as_posix()
        'here'
    """
    place = given if given is not None else os.environ.get(CACHE_VARIABLE) or default
    return None if place is None else Path(place)


def cached_basis(
    mesh: Mesh,
    k: int,
    kind: str = "auto",
    cache_dir: str | Path | None = None,
    whole_clusters: bool = True,
    warn: bool = True,
) -> CachedBasis:
    """The first ``k`` eigenpairs of a mesh, read from the cache if they are there, else computed and kept.

    An entry with more functions serves a smaller ``k``. Files that diffusion-net left in the folder
    (``<sha1>_<i>.npz``) are used where the mesh has no entry yet, see :mod:`torchqm.spectral.diffusion_net`. A damaged
    or foreign entry is replaced. Many processes may share a folder: files appear whole, and of processes that ask for
    the same missing entry one computes it while the others wait.

    Args:
        mesh: the shape; the basis is in the units of its vertices (see :meth:`SpectralBasis.scaled`).
        k: number of eigenpairs.
        kind: which Laplacian; see :func:`torchqm.geometry.laplacian.laplacian`.
        cache_dir: the folder, made if need be; by default that of the environment variable ``TORCHQM_CACHE``. Without
            either nothing is kept.
        whole_clusters: return fewer than ``k`` functions where a cut at ``k`` would go through a cluster of equal
            eigenvalues (:data:`CLUSTER_RTOL`), so that the answer does not depend on the entry that served it; False:
            exactly ``k``.
        warn: False: problems are told in the report alone.

    Returns:
        The basis, with a report of where it came from.

    Raises:
        ValueError: an unknown ``kind``.
        SpectrumError: fewer than ``k`` vertices with area, or no convergence.

    Warns:
        CacheWarning: a file that could not be used or written; the basis is right all the same.

    Example:
        >>> import tempfile
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.5]], [[0, 1, 2], [1, 3, 2]])
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     [cached_basis(mesh, k, cache_dir=folder).report.outcome for k in (3, 2)]
        ['computed', 'read']
    """
    begin = perf_counter()
    folder = cache_folder(cache_dir)
    looked = _Looked()
    if folder is None or kind not in KINDS:  # an unknown kind has its error from the Laplacian
        return _served(_compute(mesh, k, kind), "computed", k, whole_clusters, looked, begin)
    content = content_hash(mesh)
    entry, outcome = _find(folder, content, mesh, k, kind, looked), "read"
    if entry is None:
        with _lock(folder, f"{content}-{kind}") as locked:
            looked = _Looked()  # whatever is wrong is still there, or was mended by the process before
            entry = _find(folder, content, mesh, k, kind, looked)
            if entry is None:
                entry, outcome = _make(folder, mesh, k, kind, looked)
                entry = _keep(folder, content, kind, entry, mesh.name, looked, locked)
    _remove(looked.unusable)
    if warn:
        for text in looked.problems:
            warnings.warn(text, CacheWarning, stacklevel=2)
    return _served(entry, outcome, k, whole_clusters, looked, begin)


def read_basis(
    mesh: Mesh, k: int, kind: str = "auto", cache_dir: str | Path | None = None, whole_clusters: bool = True
) -> CachedBasis | None:
    """What :func:`cached_basis` would read from an entry of its own, or None; nothing is computed or written."""
    begin = perf_counter()
    folder, looked = cache_folder(cache_dir), _Looked()
    entry = None if folder is None else _find(folder, content_hash(mesh), mesh, k, kind, looked)
    return None if entry is None else _served(entry, "read", k, whole_clusters, looked, begin)


def is_cached(mesh: Mesh, k: int, kind: str = "auto", cache_dir: str | Path | None = None) -> bool:
    """Whether the cache has a file that should serve ``k`` functions of a mesh; it is not opened."""
    folder = cache_folder(cache_dir)
    return folder is not None and kind in KINDS and bool(entry_files(folder, content_hash(mesh), kind, k))


def _served(entry: Entry, outcome: str, k: int, whole_clusters: bool, looked: _Looked, begin: float) -> CachedBasis:
    """The first ``k`` functions of an entry, or as many as end with a whole cluster."""
    evals, evecs, cut = entry.basis.evals, entry.basis.evecs, k
    if whole_clusters:
        known = torch.cat([evals, evals.new_tensor([entry.next_eval])]) if np.isfinite(entry.next_eval) else evals
        cut = cluster_end(known, k, CLUSTER_RTOL)
    if cut < k:
        looked.notes.append(f"{cut} functions instead of {k}: the next eigenvalues equal the one before them")
    report = CacheReport(
        outcome,
        entry.path,
        entry.kind,
        entry.reason,
        entry.source,
        tuple(looked.problems),
        tuple(looked.notes),
        perf_counter() - begin,
    )
    # A copy of what is used: the rest of the file need not stay in memory.
    return CachedBasis(evals[:cut].clone(), evecs[:, :cut].contiguous(), entry.basis.mass, report)


def _compute(mesh: Mesh, k: int, kind: str) -> Entry:
    """Eigenpairs, and one eigenvalue more."""
    operator = laplacian(mesh, kind)
    more = 1 if 1 <= k < int((operator.mass > 0).sum()) else 0
    basis, note = eigenbasis_and_note(operator, k + more, mesh.label)
    if note:
        warnings.warn(note, SpectrumWarning, stacklevel=4)
    next_eval = float(basis.evals[k]) if more else np.inf
    reason = f"{operator.reason}; {note}" if note else operator.reason
    return Entry(basis.truncate(k), next_eval, operator.kind, reason, f"torchqm {__version__}")


def _make(folder: Path, mesh: Mesh, k: int, kind: str, looked: _Looked) -> tuple[Entry, str]:
    """An entry from a file of diffusion-net, else computed."""
    for path in diffusion_net_files(folder, mesh):
        try:
            taken = read_diffusion_net(path, mesh, kind)
        except DiffusionNetError as error:
            looked.problems.append(f"{error}; the file is not used")
            continue
        if taken.basis.k >= k:
            source = f"diffusion-net, {path.name}"
            return Entry(taken.basis, np.nan, taken.kind, taken.reason, source), "diffusion-net"
        looked.notes.append(f"{path}: has {taken.basis.k} functions, {k} were asked for")
    return _compute(mesh, k, kind), "rebuilt" if looked.unusable else "computed"


def _find(folder: Path, content: str, mesh: Mesh, k: int, kind: str, looked: _Looked) -> Entry | None:
    """The smallest entry that can serve ``k`` functions."""
    for asked in dict.fromkeys((kind, "auto")):
        for path in entry_files(folder, content, asked, k):
            try:
                entry = read_entry(path, mesh.n_verts)
            except FileNotFoundError:  # replaced by a larger one in the meantime
                continue
            except OSError as error:  # nothing is said about its content, so it stays
                looked.problems.append(f"{path}: cannot be read ({error.strerror or error})")
                continue
            except Exception as error:  # a damaged file can raise anything, MemoryError and zlib's own included
                reason = " ".join(str(error).split()) or type(error).__name__
                looked.problems.append(f"{path}: damaged or foreign cache entry, not used ({reason})")
                looked.unusable.append(path)
                continue
            if kind in ("auto", entry.kind):  # what "auto" chose may be another kind than the one asked for
                return entry
    return None


def _keep(folder: Path, content: str, asked: str, entry: Entry, name: str, looked: _Looked, locked: bool) -> Entry:
    """Write an entry and remove those it replaces; a folder that cannot be written to is a problem, not the end."""
    path = entry_path(folder, content, asked, entry.basis.k)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if locked:  # then nobody else writes this entry, and halves are those of processes that were killed
            _remove(folder.glob(f".{content}-{asked}-k*.part"))
        write_entry(path, entry, name)
    except OSError as error:
        looked.problems.append(f"{path}: the entry cannot be written ({error.strerror or error})")
        return entry
    _remove(old for old in entry_files(folder, content, asked, below=entry.basis.k))
    looked.unusable = [old for old in looked.unusable if old != path]
    return replace(entry, path=path)


def _remove(paths: Iterable[Path]) -> None:
    """Delete files that nobody needs, where that is allowed."""
    for path in paths:
        with suppress(OSError):
            path.unlink()


@contextmanager
def _lock(folder: Path, name: str) -> Iterator[bool]:
    """Hold the lock of an entry; False where there are no locks, or the holder takes too long: work is done twice."""
    from filelock import FileLock, Timeout

    try:
        (folder / "locks").mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / "locks" / f"{name}.lock", timeout=LOCK_SECONDS)
        lock.acquire()
    except (OSError, Timeout, NotImplementedError):
        yield False
        return
    try:
        yield True
    finally:
        lock.release()
