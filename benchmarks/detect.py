"""The reflection of single shapes from their own spectrum: error, verdict and seconds, on TOSCA and the creatures.

    python benchmarks/detect.py [--scb ROOT] [--cache DIR] [--classes wolf,centaur,cat,david] [--n-verts 5000]
                                [--kinds biped,quadruped,asymmetric] [--poses 3] [--bodies 2]

Nothing is known of a shape: no reference, no mirror plane. Creatures are posed and have triangulations of their own.
Errors are geodesic / sqrt(area) at 50 spread points a class (TOSCA), and Euclidean / sqrt(area) at all vertices against
the exact truth (creatures). Seconds are without eigenpairs. Writes benchmarks/results/detect.json.
"""

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any

from common import RESULTS, write_json
from tosca import Shapes, Truth
from tqdm import tqdm

from torchqm.data.scb import SCBenchmark
from torchqm.data.synthetic import creature, exact_maps
from torchqm.matching import Detection, MatchParameters, PreparedShape, detect_group, prepare


def timed(shape: PreparedShape) -> tuple[Detection, float]:
    start = perf_counter()
    found = detect_group(shape)
    return found, perf_counter() - start


def row(found: Detection, seconds: float, error: float | None) -> dict[str, Any]:
    parts = {k: v if v < float("inf") else None for k, v in found.parts.items()}
    return {"verdict": found.verdict, "error": error, "seconds": seconds, **parts}


def summary(rows: dict[str, dict]) -> dict[str, Any]:
    errors = [r["error"] for r in rows.values() if r["error"] is not None]
    verdicts = [r["verdict"] for r in rows.values()]
    return {
        "shapes": len(rows),
        "verdicts": {name: verdicts.count(name) for name in ("symmetric", "ambiguous", "asymmetric")},
        "mean_error": sum(errors) / len(errors) if errors else None,
        "worst_error": max(errors) if errors else None,
        "share_below_0.03": sum(e < 0.03 for e in errors) / len(errors) if errors else None,
        "mean_seconds": sum(r["seconds"] for r in rows.values()) / len(rows),
        "each": rows,
    }


def on_tosca(args: argparse.Namespace) -> dict[str, Any]:
    benchmark, classes = SCBenchmark(args.scb), {}
    for cls in args.classes.split(","):
        truth = Truth(benchmark, cls)
        shapes = Shapes(benchmark, truth, args.cache)
        rows = {}
        for name in tqdm(benchmark.shapes(cls), desc=cls):
            found, seconds = timed(shapes.shape(name))
            errors = shapes.distances(name).errors(found.reflection[truth.points], truth.truth[1])
            rows[name] = row(found, seconds, float(errors.mean()))
        classes[cls] = summary(rows)
        print(cls, {k: v for k, v in classes[cls].items() if k != "each"}, flush=True)
    return classes


def on_creatures(args: argparse.Namespace) -> dict[str, Any]:
    kinds = {}
    for kind in args.kinds.split(","):
        rows = {}
        cases = [(body, pose) for body in range(args.bodies) for pose in range(1, args.poses + 1)]
        for body, pose in tqdm(cases, desc=kind):
            animal = creature(kind, args.n_verts, body, pose, retriangulate=1)
            shape = prepare(animal.mesh, MatchParameters().k_max)
            found, seconds = timed(shape)
            truth = exact_maps(animal, animal).points(shape.mesh)[1:]
            gaps = [float((shape.mesh.verts[found.reflection] - t).norm(dim=1).mean()) for t in truth]
            rows[f"body {body}, pose {pose}"] = row(found, seconds, min(gaps) if gaps else None)
        kinds[kind] = summary(rows)
        print(kind, {k: v for k, v in kinds[kind].items() if k != "each"}, flush=True)
    return kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scb", type=Path, help="folder of the SCB benchmark")
    parser.add_argument("--cache", type=Path, help="folder for eigenbases and distances")
    parser.add_argument("--classes", default="wolf,centaur,cat,david")
    parser.add_argument("--kinds", default="biped,quadruped,asymmetric")
    parser.add_argument("--n-verts", type=int, default=5000)
    parser.add_argument("--poses", type=int, default=3)
    parser.add_argument("--bodies", type=int, default=2)
    args = parser.parse_args()
    result: dict[str, Any] = {"vertices": args.n_verts}
    if args.scb:
        result["tosca"] = on_tosca(args)
    result["creatures"] = on_creatures(args)
    write_json(RESULTS / "detect.json", result)


if __name__ == "__main__":
    main()
