"""Choosing vertices: at random in proportion to area, or spread out so that each is far from all before it."""

import numpy as np
import scipy
import torch
from jaxtyping import Int
from torch import Tensor

from torchqm.geometry.geodesic import edge_graph
from torchqm.geometry.mesh import Mesh

__all__ = ["area_samples", "farthest_points"]

_WHOLE = 10
"""Points whose distances a run of Dijkstra's algorithm gives. Later ones change a part of the surface only: a front
that stops where it is not nearer costs less than a run, which has to set up all vertices."""


def area_samples(mesh: Mesh, n: int, generator: torch.Generator | int = 0) -> Int[Tensor, " n"]:
    """Draw different vertices, each time with probabilities in proportion to the areas of those left.

    Args:
        mesh: the surface; vertices without area (unreferenced ones) are never drawn.
        n: how many.
        generator: a CPU ``torch.Generator``, which is advanced, or a seed.

    Returns:
        ``(n,)`` vertex ids in the order they were drawn, so that the first ``m`` of them are a sample of size ``m``.

    Raises:
        ValueError: ``n`` is negative or larger than the number of vertices with area.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [1, 0, 0], [0, 1, 0], [9, 9, 9]], [[0, 1, 2]])
        >>> sorted(area_samples(mesh, 3, generator=1).tolist())
        [0, 1, 2]
    """
    weights = _unit_size(mesh).vertex_areas
    _check_count(n, int((weights > 0).sum()), mesh, "with an area")
    if n == 0:
        return torch.zeros(0, dtype=torch.int64)
    if not isinstance(generator, torch.Generator):
        generator = torch.Generator().manual_seed(generator)
    return torch.multinomial(weights / weights.max(), n, replacement=False, generator=generator)


def farthest_points(mesh: Mesh, n: int, start: int | None = None, method: str = "dijkstra") -> Int[Tensor, " n"]:
    """Farthest point sampling: every next vertex is the one farthest from all before it.

    Deterministic: of equally far vertices the smallest id is taken. Of a new point only the distances are computed that
    are shorter than those to the points before it, so the steps get cheaper as the points get denser.

    Args:
        mesh: the surface; unreferenced vertices are never taken, and every component gets a point before any gets two.
        n: how many.
        start: the first vertex; if not given, the one farthest (in space) from the centroid of the area.
        method: ``"dijkstra"`` (distance along edges) or ``"euclidean"`` (distance in space, faster).

    Returns:
        ``(n,)`` vertex ids, ``start`` first; the first ``m`` of them are the sample of size ``m``.

    Raises:
        ValueError: ``n`` is negative or larger than the number of referenced vertices, ``start`` is not one of them, or
            the ``method`` is unknown.

    Example:
        >>> mesh = Mesh.from_arrays([[0, 0, 0], [3, 0, 0], [0, 1, 0], [9, 9, 9]], [[0, 1, 2]])
        >>> farthest_points(mesh, 3).tolist()
        [1, 2, 0]

    References:
        Y. Eldar et al., "The farthest point strategy for progressive image sampling", 1997.
    """
    if method not in ("dijkstra", "euclidean"):
        raise ValueError(f"method is {method!r}; allowed are 'dijkstra' and 'euclidean'")
    usable = mesh.referenced.numpy()
    _check_count(n, int(usable.sum()), mesh, "of a triangle")
    unit = _unit_size(mesh)
    verts = unit.numpy()[0]
    if start is None:
        centre = (unit.verts * unit.vertex_areas[:, None]).sum(0) / unit.area if unit.area > 0 else unit.verts.mean(0)
        start = int(np.where(usable, np.linalg.norm(verts - centre.numpy(), axis=1), -1.0).argmax())
    elif not (0 <= start < mesh.n_verts and usable[start]):
        raise ValueError(
            f"start is {start}, which is no vertex of a triangle of {mesh.label} (0 to {mesh.n_verts - 1})"
        )
    graph = edge_graph(unit) if method == "dijkstra" else None
    nearest = np.where(usable, np.inf, -1.0)  # distance to the points so far; -1 for what cannot be taken
    out = np.empty(n, dtype=np.int64)
    point = start
    for k in range(n):
        out[k] = point
        if graph is None:
            offsets = verts - verts[point]
            distance = np.einsum("vi,vi->v", offsets, offsets)  # squared: the order is the same
            np.minimum(nearest, distance, out=nearest)
            nearest[point] = -1.0
        elif k < _WHOLE:
            limit = max(float(nearest.max()), 0.0)
            np.minimum(nearest, scipy.sparse.csgraph.dijkstra(graph, indices=[point], limit=limit)[0], out=nearest)
            nearest[point] = -1.0
        else:
            _lower(nearest, graph, point)
        point = int(nearest.argmax())
    return torch.from_numpy(out)


def _lower(nearest: np.ndarray, graph: "scipy.sparse.csr_array", point: int) -> None:
    """``nearest = min(nearest, distance to the point)`` along edges, by a front that stops where it is not nearer.

    The result is that of Dijkstra's algorithm bit for bit: ``nearest`` of a neighbour is at most ``nearest`` here plus
    the edge, and rounded sums keep that order, so nothing behind a vertex where the front stops could be shortened.
    The point itself, and what is taken already, is at -1.
    """
    nearest[point] = -1.0
    front, distance = np.array([point]), np.zeros(1)
    number = np.empty(len(nearest), dtype=np.int64)
    while front.size:
        starts = graph.indptr[front]
        counts = graph.indptr[front + 1] - starts
        ends = counts.cumsum()
        entries = np.arange(ends[-1]) + np.repeat(starts - ends + counts, counts)
        to, reached = graph.indices[entries], np.repeat(distance, counts) + graph.data[entries]
        closer = reached < nearest[to]
        to, reached = to[closer], reached[closer]
        np.minimum.at(nearest, to, reached)
        number[to] = np.arange(len(to))  # of entries of one vertex the last one stays
        front = to[number[to] == np.arange(len(to))]
        distance = nearest[front]


def _unit_size(mesh: Mesh) -> Mesh:
    """The mesh at size one, so that no scale of the coordinates over- or underflows when squared."""
    verts = mesh.verts - mesh.verts[:1]
    return mesh.moved(verts / (float(verts.abs().max()) or 1.0))


def _check_count(n: int, most: int, mesh: Mesh, which: str) -> None:
    if not 0 <= n <= most:
        raise ValueError(f"n is {n}; {mesh.label} has {most} vertices {which}, so allowed are 0 to {most}")
