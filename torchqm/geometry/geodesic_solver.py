"""Geodesic distances of one mesh by one method: set up once, asked many times."""

from collections.abc import Callable
from functools import cached_property
from threading import Lock
from weakref import WeakKeyDictionary

import numpy as np
import scipy
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchqm.geometry.check import inspect_mesh
from torchqm.geometry.geodesic_surface import Surface, vertex_ids
from torchqm.geometry.mesh import Mesh

__all__ = ["METHODS", "GeodesicSolver"]

METHODS = ("fast_marching", "heat", "dijkstra", "exact")


class GeodesicSolver:
    """Distances from vertices of a mesh, with everything that does not depend on the vertex done once.

    The factorisation of the heat method takes as long as 20 to 40 of its solves, the set-up of fast marching as 4 or 5,
    so a solver that is thrown away after a few rows costs more than they do. :meth:`kept` gives the one of the last
    call.

    Args:
        mesh: the surface.
        method: as in :func:`torchqm.geometry.geodesic.distances`.

    Raises:
        ValueError: unknown ``method``.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, 1, 0]], [[0, 1, 2], [1, 3, 2]])
        >>> solver = GeodesicSolver(mesh, "dijkstra")
        >>> [solver.distances([source])[0, 3].item() for source in (0, 1)], solver.used
        ([3.0, 1.0], 'dijkstra')
    """

    def __init__(self, mesh: Mesh, method: str = "fast_marching") -> None:
        if method not in METHODS:
            raise ValueError(f"method is {method!r}; allowed are {', '.join(map(repr, METHODS))}")
        self.method, self.n_verts, self.label = method, mesh.n_verts, mesh.label
        self.state = _state(mesh)
        self._surface = Surface(mesh)

    @classmethod
    def kept(cls, mesh: Mesh, method: str = "fast_marching") -> "GeodesicSolver":
        """The solver that an earlier call made for this very mesh as it is, else a new one.

        Those of the last :data:`KEEP` meshes are kept, as long as the mesh itself is there; of each the method that was
        asked for last (a heat solver of 52k vertices holds 170 MB).
        """
        with _LOCK:
            solver = _KEPT.pop(mesh, None)
        if solver is None or solver.method != method or solver.state != _state(mesh):
            solver = cls(mesh, method)
        with _LOCK:
            _KEPT[mesh] = solver
            while len(_KEPT) > KEEP:
                _KEPT.pop(next(iter(_KEPT)))  # the one that was asked for longest ago
        return solver

    @property
    def note(self) -> str:
        """Why another method runs than was asked for; empty if it does not."""
        why = self._surface.why_not_marching if self.method == "fast_marching" else None
        return "" if why is None else f"{self.label}: {why}; the heat method is used instead"

    @property
    def used(self) -> str:
        """The method that runs: ``heat`` where fast marching was asked for and cannot run."""
        return "heat" if self.note else self.method

    def distances(
        self, sources: Int[Tensor, " S"] | np.ndarray | list[int], targets: Int[Tensor, " T"] | None = None
    ) -> Float[Tensor, "S T"]:
        """As :func:`torchqm.geometry.geodesic.distances`, without its warning.

        Args:
            sources: ``(S,)`` vertex ids.
            targets: ``(T,)`` vertex ids to keep, all if not given.

        Raises:
            ValueError: an id out of range, or ``exact`` on a non-manifold mesh.
            ImportError: ``exact`` without pygeodesic.
        """
        surface = self._surface
        ids = vertex_ids(self.label, self.n_verts, "sources", sources)
        keep = None if targets is None else vertex_ids(self.label, self.n_verts, "targets", targets)
        out = np.full((len(ids), self.n_verts if keep is None else len(keep)), np.inf)
        row = np.full(self.n_verts, np.inf)
        for k, (source, vertex) in enumerate(zip(surface.local[ids].tolist(), ids.tolist(), strict=True)):
            row.fill(np.inf)
            if source >= 0:
                row[surface.ids] = self._from_source(source) * surface.scale
            row[vertex] = 0.0
            out[k] = row if keep is None else row[keep]
        return torch.from_numpy(out)

    @cached_property
    def _from_source(self) -> "_FromSource":
        return _SET_UP[self.used](self._surface)


def _state(mesh: Mesh) -> tuple[int, ...]:
    """Counts what was written into the tensors of a mesh; of inference tensors nobody keeps count."""
    return tuple(-1 if tensor.is_inference() else tensor._version for tensor in (mesh.verts, mesh.faces))


KEEP = 2
"""Meshes whose solvers :meth:`GeodesicSolver.kept` keeps: the two shapes of a pair."""

_KEPT: WeakKeyDictionary[Mesh, GeodesicSolver] = WeakKeyDictionary()
_LOCK = Lock()

_FromSource = Callable[[int], np.ndarray]


def _fast_marching(surface: Surface) -> _FromSource:
    solver, n = surface.marching_solver()
    return lambda source: np.asarray(solver.compute_distance([[(source, [])]], [], False)).reshape(-1)[:n]


def _heat(surface: Surface) -> _FromSource:
    import potpourri3d

    solver = potpourri3d.MeshHeatMethodDistanceSolver(surface.verts, surface.faces)
    _, piece = scipy.sparse.csgraph.connected_components(surface.graph(), directed=False)

    def from_source(source: int) -> np.ndarray:
        out = np.asarray(solver.compute_distance(source)).reshape(-1)
        return np.where(piece == piece[source], out, np.inf)

    return from_source


def _dijkstra(surface: Surface) -> _FromSource:
    graph = surface.graph()
    return lambda source: scipy.sparse.csgraph.dijkstra(graph, indices=np.array([source]))[0]


def _exact(surface: Surface) -> _FromSource:
    try:
        from pygeodesic.geodesic import PyGeodesicAlgorithmExact
    except ImportError as error:
        raise ImportError(
            "method='exact' needs the package pygeodesic (pip install pygeodesic); 'fast_marching' is within about 1%"
        ) from error
    report = inspect_mesh(surface.compact)
    if not report.manifold:
        raise ValueError(
            f"{surface.label}: method='exact' needs a manifold ({report.n_nonmanifold_edges} non-manifold edges, "
            f"{report.n_nonmanifold_verts} non-manifold vertices); 'heat' and 'dijkstra' do not"
        )
    solver = PyGeodesicAlgorithmExact(surface.verts, surface.faces)
    return lambda source: np.asarray(solver.geodesicDistances(np.array([source]))[0])


_SET_UP: dict[str, Callable[[Surface], _FromSource]] = {
    "fast_marching": _fast_marching,
    "heat": _heat,
    "dijkstra": _dijkstra,
    "exact": _exact,
}
