"""Peak memory and time of evaluating a map on a shape of 52k vertices; the bound is 2 GiB.

    python benchmarks/evaluate_memory.py [--mesh FILE] [--cases points:fast_marching,all:dijkstra] [--out FILE]

``points``: 1,024 points and their images under a second true map, 2,048 rows, which are kept. ``all``: the truth is
every vertex, so that a matrix of all distances would take 10 GiB as float32 and 21 GiB as float64; no rows are kept.
Each case runs in a process of its own; its peak is that of the whole process (Python, torch and the mesh included), as
the system counts it. Without --mesh a torus of 52,900 vertices is measured. Writes
benchmarks/results/evaluate_memory.json.
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from common import RESULTS, write_json

from torchqm.evaluate import evaluate_map
from torchqm.geometry import Mesh, load_mesh

BOUND_GIB = 2.0
SIDE = 230


def torus() -> Mesh:
    """A bumpy torus with 230 x 230 vertices."""
    u, v = np.meshgrid(*2 * [np.arange(SIDE) * 2 * np.pi / SIDE], indexing="ij")
    r = 0.4 + 0.05 * np.cos(3 * u + 2 * v)
    verts = np.stack([(1 + r * np.cos(v)) * np.cos(u), (1 + r * np.cos(v)) * np.sin(u), r * np.sin(v)], -1)
    at = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    a, b, c, d = at, np.roll(at, -1, 0), np.roll(at, (-1, -1), (0, 1)), np.roll(at, -1, 1)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return Mesh.from_arrays(verts.reshape(-1, 3), faces, "torus")


def measure(case: str, path: Path | None) -> dict:
    """Evaluate the map that takes each vertex to the one with the next number."""
    case, method = case.split(":")
    mesh = torus() if path is None else load_mesh(path)
    every = torch.arange(mesh.n_verts)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    at, truth = every, every
    if case == "points":
        at = every[:: mesh.n_verts // 1024][:1024]  # which ones has no influence on the memory
        truth = torch.stack([at, (at + mesh.n_verts // 2) % mesh.n_verts])
    start = perf_counter()
    result = evaluate_map(mesh, (every + 1) % mesh.n_verts, truth, at, method=method)
    seconds = perf_counter() - start
    return {
        "shape": mesh.name,
        "vertices": mesh.n_verts,
        "true_vertices": len(truth.unique()),
        "solver": result.solver,
        "mean_error": result.reports["plain"].mean,
        "seconds": seconds,
        "peak_gib_before": before,
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,  # Linux counts in KiB
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--cases", default="points:fast_marching,all:dijkstra", help="CASE:SOLVER,...")
    parser.add_argument("--out", type=Path, default=RESULTS / "evaluate_memory.json")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # measure this case in this process
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(args.one, args.mesh)))
        return
    cases = {}
    for case in args.cases.split(","):
        command = [sys.executable, __file__, "--one", case]
        command += ["--mesh", str(args.mesh)] if args.mesh else []
        run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
        cases[case] = json.loads(run.stdout.splitlines()[-1])
        print(case, cases[case], flush=True)
    if (most := max(row["peak_gib"] for row in cases.values())) > BOUND_GIB:
        raise SystemExit(f"peak {most:.2f} GiB, allowed are {BOUND_GIB}")
    write_json(args.out, {"bound_gib": BOUND_GIB, "cases": cases})


if __name__ == "__main__":
    main()
