"""Seconds and memory for two meshes of 28k vertices, everything after the eigenpairs, and what the fast search misses.

    python benchmarks/speed_pair.py [--scb ROOT] [--cache DIR] [--n-verts 28000] [--repeats 3]

With --scb the pair is cat1 -> cat0 of TOSCA (27,894 vertices each), else two built-in quadrupeds. Their symmetry
is not known: a mirror plane is looked for in both, and the source's symmetry is transferred. The peer is
the same match with exhaustive searches over all vertices of the target, in the same run. Writes
benchmarks/results/speed_pair.json.
"""

import argparse
import resource
import statistics
from pathlib import Path
from time import perf_counter

from common import RESULTS, cached_basis, write_json

from torchqm.data.synthetic import creature
from torchqm.fmap import nearest_rows
from torchqm.geometry import Mesh, load_mesh
from torchqm.matching import Collection, MatchResult, PreparedShape, prepare
from torchqm.spectral import SpectralBasis


def after_eigenpairs(
    meshes: list[Mesh], bases: list[SpectralBasis], method: str, exhaustive: bool = False
) -> tuple[float, dict[str, float], MatchResult, PreparedShape, PreparedShape]:
    """What ``torchqm.match`` does with two meshes in memory, except the eigenpairs; nothing is kept between calls."""
    start = perf_counter()
    collection = Collection(method=method)
    x, y = (prepare(m, collection.parameters.k_max, basis=b) for m, b in zip(meshes, bases, strict=True))
    if exhaustive:
        for shape in (x, y):
            shape.__dict__["search"] = None  # a cached property: all vertices are compared
    result = collection.match(x, y)
    return perf_counter() - start, dict(collection.steps.seconds), result, x, y


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
    bases = [cached_basis(m.normalized(), 300, args.cache) for m in meshes]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    result: dict = {"vertices": [m.n_verts for m in meshes], "repeats": args.repeats, "methods": {}}
    for method in ("quotient", "paper"):
        fast, slow = [], []
        for _ in range(args.repeats):
            fast.append(after_eigenpairs(meshes, bases, method))
            if method == "quotient":
                slow.append(after_eigenpairs(meshes, bases, method, exhaustive=True)[0])
        _, steps, found, x, y = fast[0]
        total = statistics.median(row[0] for row in fast)
        row = {"seconds": total, "all_seconds": [row[0] for row in fast], "steps": steps, "warnings": found.warnings}
        if slow:
            row |= {"exhaustive_seconds": statistics.median(slow), "ratio": statistics.median(slow) / total}
            fmap = found.fmaps[0]
            k = fmap.shape[0]
            images, points = x.basis.evecs[:, :k] @ fmap.T, y.basis.evecs[:, :k]
            exact, near = nearest_rows(images, points), y.search.nearest(images, points)
            gap = (y.mesh.verts[exact] - y.mesh.verts[near]).norm(dim=1)
            row["search"] = {
                "same_vertex": (exact == near).double().mean().item(),
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
