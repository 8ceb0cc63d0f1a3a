"""Seconds of reading all shapes of a set from the cache and evaluating a map on each; the bound for TOSCA's 80 is 90 s.

    python benchmarks/evaluate_speed.py --root ROOT --cache DIR [--jobs 2] [--out FILE]

Each shape is read from its file, prepared with its 200 eigenfunctions from the cache, and one map to it is measured
under the protocols plain, map and orbit at 100 points: as many maps as shapes, each from the pose before it in its
class. The maps are wrong on purpose (each vertex goes to the one with the next number), which costs the same as any
other. The cache must be full: ``torchqm prepare ROOT --cache DIR``; distances that are not in it are computed in a
first run that is not counted. Writes benchmarks/results/evaluate_speed.json.
"""

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from common import RESULTS, write_json

from torchqm.benchmark import Settings
from torchqm.benchmark.measure import measure_pair
from torchqm.cli.processes import Failure, in_processes
from torchqm.data import open_shapes
from torchqm.geometry import check_mesh
from torchqm.matching import prepare

BOUND_SECONDS = 90.0


def one(task: tuple[str, str, str, Path]) -> tuple[int, float]:
    """Vertices of a shape, and the mean error of the wrong map to it."""
    root, first, second, cache = task
    shapes = open_shapes(root)
    mesh = shapes.mesh(second)
    check_mesh(mesh)
    shape = prepare(mesh, 200, cache_dir=cache)
    n_verts = shapes.mesh(first).n_verts
    p2p = (torch.arange(n_verts) + 1) % shape.n_verts
    row = measure_pair(shapes, first, second, p2p, Settings(root, Path("unused"), cache=cache)).row
    return shape.n_verts, float(row["plain_mean"])


def run(tasks: list[tuple[str, str, str, Path]], jobs: int) -> tuple[float, list[tuple[int, float]]]:
    start = perf_counter()
    done: list[Any] = [result for _, result in in_processes(one, tasks, jobs)]
    seconds = perf_counter() - start
    failed = [result.reason for result in done if isinstance(result, Failure)]
    if failed:
        raise SystemExit(f"{len(failed)} of {len(tasks)} failed, such as: {failed[0]}")
    return seconds, done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", required=True)
    parser.add_argument("--cache", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "evaluate_speed.json")
    args = parser.parse_args()
    shapes = open_shapes(args.root)
    classes: dict[str, list[str]] = {}
    for name in shapes.names:
        classes.setdefault(shapes.shape_class(name), []).append(name)
    pairs = [(names[i - 1], names[i]) for names in classes.values() for i in range(len(names))]
    tasks = [(args.root, first, second, args.cache) for first, second in pairs]
    filling, _ = run(tasks, args.jobs)
    seconds, done = run(tasks, args.jobs)
    result = {
        "layout": shapes.layout,
        "shapes": len(tasks),
        "maps": len(done),
        "vertices": sum(n for n, _ in done),
        "jobs": args.jobs,
        "seconds_filling": filling,
        "seconds": seconds,
        "bound_seconds": BOUND_SECONDS,
    }
    print(result)
    write_json(args.out, result)


if __name__ == "__main__":
    main()
