"""Geodesics: what a set-up costs beside a row, calls that share one, farthest points with and without whole runs."""

import statistics
from collections.abc import Callable
from pathlib import Path
from time import process_time

import numpy as np
import scipy.sparse.csgraph as csgraph
import speed_eigen
import speed_growth
import torch
from common import RESULTS, write_json

from torchqm.geometry import GeodesicSolver, Mesh, distances, edge_graph, farthest_points

LARGEST = 60000  # a built-in creature that is made in its size, and whose solvers are timed
METHODS = {"fast_marching": 3, "heat": 10, "dijkstra": 10}  # and of how many rows the mean is taken
COUNTS = (50, 1000, 3000)
CALLS = 5  # of three rows each: so many maps on one target


def mesh_of(size: int, scb: Path | None) -> Mesh:
    """About ``size`` vertices, area 1; large ones by cutting triangles in four."""
    return speed_eigen.mesh_of(size, scb) if size <= LARGEST else speed_growth.mesh_of(size, 1)


def by_whole_runs(mesh: Mesh, n: int, start: int) -> torch.Tensor:
    """Farthest points with a run of Dijkstra's algorithm a point, up to the covering radius, as it was done before."""
    verts = mesh.verts - mesh.verts[:1]
    graph = edge_graph(mesh.moved(verts / float(verts.abs().max())))
    nearest = np.where(mesh.referenced.numpy(), np.inf, -1.0)
    out = [start]
    while True:
        limit = max(float(nearest.max()), 0.0)
        np.minimum(nearest, csgraph.dijkstra(graph, indices=out[-1:], limit=limit)[0], out=nearest)
        nearest[out[-1]] = -1.0
        if len(out) == n:
            return torch.tensor(out)
        out.append(int(nearest.argmax()))


def calls(mesh: Mesh, method: str, kept: bool) -> torch.Tensor:
    """Distances from three vertices in each of some calls."""
    sources = torch.arange(3 * CALLS).split(3)
    return torch.cat(
        [distances(mesh, some, method) if kept else GeodesicSolver(mesh, method).distances(some) for some in sources]
    )


def measure(sizes: list[int], repeats: int, scb: Path | None) -> None:
    """Every size in turn; the two ways of a comparison take turns."""
    farthest_points(mesh_of(1000, None), 20)  # imports and first calls
    calls(mesh_of(1000, None), "heat", True)
    cases = []
    for size in sizes:
        mesh = mesh_of(size, scb)
        case = {
            "mesh": mesh.name,
            "n_verts": mesh.n_verts,
            "solvers": {} if size > LARGEST else {name: one_solver(mesh, name, n) for name, n in METHODS.items()},
            "farthest_points": {n: both_ways(mesh, n, repeats) for n in COUNTS if n < mesh.n_verts},
        }
        cases.append(case)
        print(case, flush=True)
    result = {"threads": torch.get_num_threads(), "repeats": repeats, "calls": CALLS, "cases": cases}
    write_json(RESULTS / "speed_geodesics.json", result)


def one_solver(mesh: Mesh, method: str, rows: int) -> dict[str, float]:
    """CPU seconds of the set-up, of a row, and of some calls that set up anew or share one."""
    solver = GeodesicSolver(mesh, method)
    first, _ = timed(lambda: solver.distances([0]))
    several, _ = timed(lambda: solver.distances(torch.arange(rows)))
    anew, wanted = timed(lambda: calls(mesh, method, False))
    shared, found = timed(lambda: calls(mesh.moved(mesh.verts), method, True))
    if not torch.equal(found, wanted):
        raise RuntimeError(f"{mesh.name}, {method}: a solver that is kept gives other distances")
    return {
        "set_up": max(first - several / rows, 0.0),
        "row": several / rows,
        "calls_anew": anew,
        "calls_shared": shared,
    }


def both_ways(mesh: Mesh, n: int, repeats: int) -> dict[str, float]:
    """Median CPU seconds of farthest points by whole runs and by fronts that stop."""
    seconds: dict[str, list[float]] = {"whole_runs": [], "fronts": []}
    for _ in range(repeats):
        new, found = timed(lambda: farthest_points(mesh.moved(mesh.verts), n))
        old, wanted = timed(lambda start=int(found[0]): by_whole_runs(mesh.moved(mesh.verts), n, start))
        if not torch.equal(found, wanted):
            raise RuntimeError(f"{mesh.name}: other points among the first {n}")
        seconds["fronts"].append(new)
        seconds["whole_runs"].append(old)
    return {way: statistics.median(values) for way, values in seconds.items()}


def timed(call: Callable[[], torch.Tensor]) -> tuple[float, torch.Tensor]:
    """CPU seconds of a call (all of it runs in one thread, and the machine may be busy), and what it returned."""
    begin = process_time()
    found = call()
    return process_time() - begin, found
