"""Geodesic distances for evaluation: rows of some sources or single pairs, in chunks, kept on disk if asked.

Never more than a chunk of rows is alive beside the answer, so a V x V matrix does not occur.
"""

import hashlib
import warnings
import zipfile
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor

from torchqm.geometry.files import write_whole
from torchqm.geometry.mesh import Mesh

__all__ = ["distance_rows", "pair_distances", "solver_used"]

_CACHE_VERSION = 1
_CHUNK_BYTES = 2**28  # of the solver's float64 rows at a time


def solver_used(mesh: Mesh, method: str = "fast_marching") -> str:
    """The solver that :func:`torchqm.geometry.geodesic.distances` runs on a mesh when ``method`` is asked for.

    Fast marching needs an orientable manifold; on any other mesh it is ``heat`` that runs, and a result has to say so.

    Example:
        >>> corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]
        >>> fan = Mesh.from_arrays(corners, [[0, 1, 2], [0, 1, 3], [0, 1, 4]])  # three triangles at an edge
        >>> solver_used(fan), solver_used(fan, "dijkstra")
        ('heat', 'dijkstra')
    """
    from torchqm.geometry.geodesic_solver import GeodesicSolver

    return GeodesicSolver.kept(mesh, method).used


def distance_rows(
    mesh: Mesh, sources: Int[Tensor, " U"], method: str = "fast_marching", cache_dir: str | Path | None = None
) -> tuple[Shaped[Tensor, "U V"], str]:
    """Distances of all vertices from each source, in single precision, and the solver that ran.

    Args:
        mesh: the surface.
        sources: ``(U,)`` vertex ids.
        method: geodesic solver, see :func:`torchqm.geometry.geodesic.distances`.
        cache_dir: folder for ``.npz`` files keyed by the content of mesh, sources and method. Entries appear whole or
            not at all, so many processes may share it; a damaged entry is computed anew with a warning.

    Returns:
        ``(U, V)`` float32 (a relative error of 6e-8 is far below any solver's) in the unit of ``mesh.verts``, infinite
        between components; and the solver's name, see :func:`solver_used`.
    """
    arrays = {"sources": sources.numpy()}
    path = _entry(cache_dir, mesh, method, "distances", arrays)
    kept = _read(path, arrays, "rows", (len(sources), mesh.n_verts), np.float32)
    if kept is not None:
        return torch.from_numpy(kept[0]), kept[1] or solver_used(mesh, method)
    rows = torch.empty(len(sources), mesh.n_verts, dtype=torch.float32)
    step = _chunk_rows(mesh)
    for first in range(0, len(sources), step):
        rows[first : first + step] = _solve(mesh, sources[first : first + step], method)
    solver = solver_used(mesh, method)
    _write(path, arrays | {"rows": rows.numpy(), "solver": np.array(solver)})
    return rows, solver


def pair_distances(
    mesh: Mesh,
    sources: Int[Tensor, " N"],
    targets: Int[Tensor, " M"],  # as many
    method: str = "fast_marching",
    cache_dir: str | Path | None = None,
) -> Shaped[Tensor, " N"]:
    """Distances of N pairs of vertices; of the rows of their sources only a chunk is alive at any time.

    For errors at *all* vertices of a shape. Maps that are to be compared on one target go into one call, one after the
    other: each source is solved once for all pairs that start at it. Pairs of a vertex with itself cost nothing.

    Args:
        mesh: the surface.
        sources: ``(N,)`` vertex ids; solved for, so let this be the side with fewer different vertices (the truth).
        targets: ``(N,)`` vertex ids.
        method: geodesic solver.
        cache_dir: folder for the distances of each chunk of pairs, so that a long run that was stopped goes on where it
            was.

    Returns:
        ``(N,)`` float64, infinite between components.

    Raises:
        ValueError: the two have different lengths, or an id is out of range.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [3, 0, 0], [0, 4, 0]], [[0, 1, 2]])
        >>> pair_distances(mesh, torch.tensor([0, 1, 2]), torch.tensor([1, 2, 2])).tolist()
        [3.0, 5.0, 0.0]
    """
    if len(sources) != len(targets):
        raise ValueError(f"sources, targets: expected as many of each, got {len(sources)} and {len(targets)}")
    for name, ids in (("sources", sources), ("targets", targets)):
        if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) < mesh.n_verts:
            given = f"{int(ids.min())}..{int(ids.max())}"
            raise ValueError(f"{name}: vertices of {mesh.label} must lie in 0..{mesh.n_verts - 1}, got {given}")
    out = torch.zeros(len(sources), dtype=torch.float64)
    apart = (sources != targets).nonzero().flatten()
    apart = apart[sources[apart].argsort(stable=True)]
    ids, counts = sources[apart].unique_consecutive(return_counts=True)
    step, ends, first = _chunk_rows(mesh), counts.cumsum(0).tolist(), 0
    for start in range(0, len(ids), step):
        chunk, last = ids[start : start + step], ends[min(start + step, len(ids)) - 1]
        here = apart[first:last]
        arrays = {"sources": sources[here].numpy(), "targets": targets[here].numpy()}
        path = _entry(cache_dir, mesh, method, "pairs", arrays)
        kept = _read(path, arrays, "values", (len(here),), np.float64)
        if kept is None:
            row = torch.searchsorted(chunk, sources[here])
            out[here] = _solve(mesh, chunk, method)[row, targets[here]]
            _write(path, arrays | {"values": out[here].numpy()})
        else:
            out[here] = torch.from_numpy(kept[0])
        first = last
    return out


def _chunk_rows(mesh: Mesh) -> int:
    return max(1, _CHUNK_BYTES // (8 * max(1, mesh.n_verts)))


def _solve(mesh: Mesh, sources: Int[Tensor, " U"], method: str) -> Shaped[Tensor, "U V"]:
    from torchqm.geometry import geodesic  # on first use: it loads the solvers

    return geodesic.distances(mesh, sources, method=method)


def _entry(
    cache_dir: str | Path | None, mesh: Mesh, method: str, what: str, arrays: dict[str, np.ndarray]
) -> Path | None:
    """The cache file of a question: the mesh, the solver, and the ids that are asked about."""
    if cache_dir is None:
        return None
    digest = hashlib.sha256(f"torchqm truth {what} {_CACHE_VERSION} {method} {mesh.n_verts} {mesh.n_faces}".encode())
    for array in (*mesh.numpy(), *arrays.values()):
        digest.update(np.ascontiguousarray(array).data)
    return Path(cache_dir) / f"{digest.hexdigest()[:40]}.npz"


def _read(
    path: Path | None, arrays: dict[str, np.ndarray], name: str, shape: tuple[int, ...], dtype: type
) -> tuple[np.ndarray, str | None] | None:
    """The cached array and the solver it names, or None if there is no entry or it is not what was asked for."""
    if path is None or not path.exists():
        return None
    try:
        with np.load(path, allow_pickle=False) as entry:
            values = entry[name]
            same = all(np.array_equal(entry[key], ids) for key, ids in arrays.items())
            solver = str(entry["solver"]) if "solver" in entry else None
        if same and values.shape == shape and values.dtype == dtype:
            return values, solver
        reason = f"it holds {values.dtype} {values.shape}"
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zipfile.LargeZipFile) as error:
        reason = str(error)
    warnings.warn(f"{path}: damaged or foreign cache entry, computed anew ({reason})", stacklevel=3)
    return None


def _write(path: Path | None, arrays: dict[str, np.ndarray]) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda file: np.savez(file, **arrays))  # type: ignore[arg-type]
