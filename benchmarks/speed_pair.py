"""Seconds and memory for two meshes of 28k vertices, everything after the eigenpairs, and what the fast search misses.

    python benchmarks/speed_pair.py [--scb ROOT] [--cache DIR] [--n-verts 28000] [--repeats 3]

With --scb the pair is cat1 -> cat0 of TOSCA (27,894 vertices each), else two built-in quadrupeds. The source's symmetry
is not known: it is transferred from the target, whose mirror plane is found. The peer is the same match with exhaustive
searches over all vertices of the target, in the same run. Writes benchmarks/results/speed_pair.json.
"""

import argparse
import resource
import statistics
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import torch
from common import RESULTS, cached_basis, write_json

from torchqm.data.synthetic import creature
from torchqm.fmap import nearest_rows
from torchqm.geometry import Mesh, load_mesh
from torchqm.matching import MatchParameters, PreparedShape, extrinsic_symmetry, match_prepared, prepare
from torchqm.matching.known import transferred_symmetry
from torchqm.matching.steps import Steps


def after_eigenpairs(x: PreparedShape, y: PreparedShape, method: str) -> tuple[dict[str, float], torch.Tensor]:
    parameters = MatchParameters() if method == "quotient" else MatchParameters.paper()
    steps = Steps()
    with steps("mirror plane of the target"):
        known_y = extrinsic_symmetry(y)
    with steps("symmetry transfer to the source"):
        way = "full_map" if method == "quotient" else "clustering"
        known_x = transferred_symmetry(x, y, known_y, parameters, way)
    result = match_prepared(x, y, known_x, known_y, method, parameters, steps)
    return dict(steps.seconds), result.fmaps[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scb", type=Path)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--n-verts", type=int, default=28000)
    parser.add_argument("--repeats", type=int, default=3)
    args = parser.parse_args()
    meshes: list[Mesh]
    if args.scb:
        meshes = [load_mesh(args.scb / "TOSCA" / "Meshes" / f"{name}.off") for name in ("cat1", "cat0")]
    else:
        meshes = [
            creature("quadruped", args.n_verts, 0, 1, retriangulate=1).mesh,
            creature("quadruped", args.n_verts, 0, 0).mesh,
        ]
    x, y = (prepare(m, 300, basis=cached_basis(m.normalized(), 300, args.cache)) for m in meshes)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result: dict = {"vertices": [x.n_verts, y.n_verts], "repeats": args.repeats, "methods": {}}
    for method in ("quotient", "paper"):
        fast, slow = [], []
        for _ in range(args.repeats):
            start = perf_counter()
            steps, fmap = after_eigenpairs(x, y, method)
            fast.append((perf_counter() - start, steps))
            if method == "quotient":
                exhaustive = [replace(s, samples=s.samples) for s in (x, y)]
                for shape in exhaustive:
                    shape.__dict__["search"] = None  # a cached property: all vertices are compared
                start = perf_counter()
                after_eigenpairs(*exhaustive, method)
                slow.append(perf_counter() - start)
        total = statistics.median(seconds for seconds, _ in fast)
        row = {"seconds": total, "all_seconds": [s for s, _ in fast], "steps": fast[0][1]}
        if slow:
            row |= {"exhaustive_seconds": statistics.median(slow), "ratio": statistics.median(slow) / total}
            k = fmap.shape[0]
            images, points = x.basis.evecs[:, :k] @ fmap.T, y.basis.evecs[:, :k]
            exact, found = nearest_rows(images, points), y.search.nearest(images, points)
            gap = (y.mesh.verts[exact] - y.mesh.verts[found]).norm(dim=1)
            row["search"] = {
                "same_vertex": (exact == found).double().mean().item(),
                "mean_gap": gap.mean().item(),
                "share_gap_above_0.02": (gap > 0.02).double().mean().item(),
            }
        result["methods"][method] = row
        print(method, row, flush=True)
    result["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    result["mib_before_matching"] = before / 1024
    print({k: v for k, v in result.items() if k != "methods"})
    write_json(RESULTS / "speed_pair.json", result)


if __name__ == "__main__":
    main()
