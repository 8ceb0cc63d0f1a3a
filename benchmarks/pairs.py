"""TOSCA from start to end without any help: the symmetry of each shape from its spectrum, then the published pairs.

    python benchmarks/pairs.py --scb ROOT [--cache DIR] [--classes wolf,centaur,cat,david] [--paper 1] [--out FILE]
                               [--samples-only] [--functions 300]

Symmetries: no reference, no mirror plane, no landmark. Pairs: as ``torchqm match`` does it, which takes a mirror plane
where a shape has one; no flip forgiven. Errors are geodesic / sqrt(area of the target) at 50 spread points a class;
that of a symmetry is measured against the mirror plane of the undeformed shape (gorillas have none, and no row).
--paper N runs the paper's own pipeline (which is told the undeformed shape and its plane) on the first N pairs of each
class, for its time on the same machine. --samples-only: true distances are computed at these points alone, not at the
landmarks that other benchmarks keep in the same cache. --functions: eigenpairs (the paper's pipeline needs 300, torchqm
uses 200). Seconds are without eigenpairs; symmetries are found once a shape, and their time counts for the shape.
Writes benchmarks/results/pairs.json.
"""

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from common import RESULTS, write_json
from tosca import N_POINTS, OURS, PAPER, PlainTruth, Shapes, Truth, bim
from tqdm import tqdm

from torchqm.data.scb import SCBenchmark
from torchqm.matching import Collection, match_prepared, transferred_symmetry


def paper_seconds(shapes: Shapes, truth: Truth, a: str, b: str) -> float:
    """Of the paper's pipeline: both symmetries transferred from the undeformed shape, then Algorithm 1."""
    x, y, reference = (shapes.shape(name) for name in (a, b, truth.undeformed))
    start = perf_counter()
    knowns = [
        truth.known
        if name == truth.undeformed
        else transferred_symmetry(shape, reference, truth.known, PAPER, "clustering")
        for name, shape in ((a, x), (b, y))
    ]
    match_prepared(x, y, *knowns, "paper", PAPER)
    return perf_counter() - start


def symmetries(shapes: Shapes, names: list[str], collection: Collection) -> dict[str, dict[str, Any]]:
    rows = {}
    for name in tqdm(names, desc="symmetries"):
        shape = shapes.shape(name)
        shape.search  # noqa: B018  made once a shape, and not part of the detection
        start = perf_counter()
        known = collection.symmetry(shape, "detect")
        seconds = perf_counter() - start
        error = None
        if known.known and len(shapes.truth.truth) > 1:
            error = float(shapes.errors(known.group.maps[1], name)[1].mean())
        rows[name] = {"group": known.name, "verdict": known.details["verdict"], "error": error, "seconds": seconds}
        rows[name] |= {key: known.details[key] for key in ("score", "commutativity")}
    return rows


def matches(
    shapes: Shapes,
    pairs: list[tuple[str, str]],
    collection: Collection,
    n_paper: int,
    root: Path,
    reflected: Truth | None,
) -> dict[str, dict[str, Any]]:
    rows = {}
    for number, (a, b) in enumerate(tqdm(pairs, desc="pairs")):
        result = collection.match(shapes.shape(a), shapes.shape(b))
        seconds = {step: s for step, s in result.seconds.items() if "symmetry" not in step and "plane" not in step}
        errors = shapes.errors(result.maps[0], b)
        row: dict[str, Any] = {"plain": float(errors[0].mean()), "label": result.labels[0]}
        row["seconds"] = sum(seconds.values())
        row["symmetries"] = [result.details[side]["symmetry"] for side in ("source", "target")]
        row["share_below_0.05"] = float((errors[0] < 0.05).double().mean())
        if len(errors) > 1:
            row["as_mirrored"] = float(errors[1].mean())
            row["direct"] = row["label"] == "direct" and row["plain"] <= row["as_mirrored"]
        row |= {key: value for key, value in result.details.items() if key.startswith("residual")}
        row["bim_plain"] = bim(root, [(a, b)])[0][0].mean
        if number < n_paper and reflected is not None:
            row["seconds_paper"] = paper_seconds(shapes, reflected, a, b)
        row["warnings"] = result.warnings
        rows[f"{a} -> {b}"] = row
    return rows


def mean(rows: dict[str, dict[str, Any]], key: str) -> float | None:
    values = [row[key] for row in rows.values() if row.get(key) is not None]
    return sum(values) / len(values) if values else None


def summary(shapes: dict[str, dict[str, Any]], pairs: dict[str, dict[str, Any]]) -> dict[str, Any]:
    errors = [row["error"] for row in shapes.values() if row["error"] is not None]
    return {
        "shapes": len(shapes),
        "shapes_with_truth": len(errors),
        "symmetry_error": mean(shapes, "error"),
        "symmetry_worst": max(errors, default=None),
        "symmetry_share_below_0.03": sum(e < 0.03 for e in errors) / len(errors) if errors else None,
        "seconds_symmetry": mean(shapes, "seconds"),
        "pairs": len(pairs),
        "plain": mean(pairs, "plain"),
        "plain_worst": max((row["plain"] for row in pairs.values()), default=None),
        "bim_plain": mean(pairs, "bim_plain"),
        "direct": sum(bool(row.get("direct")) for row in pairs.values()),
        "pairs_with_labels_judged": sum("direct" in row for row in pairs.values()),
        "seconds_match": mean(pairs, "seconds"),
        "seconds_paper": mean(pairs, "seconds_paper"),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scb", type=Path, required=True, help="folder of the SCB benchmark")
    parser.add_argument("--cache", type=Path, help="folder for eigenbases and distances")
    parser.add_argument("--classes", default="wolf,centaur,cat,david")
    parser.add_argument("--paper", type=int, default=1, help="pairs a class that the paper's pipeline is timed on")
    parser.add_argument("--samples-only", action="store_true", help="no distances at landmarks")
    parser.add_argument("--functions", type=int, default=PAPER.k_max, help="eigenpairs of each shape")
    parser.add_argument("--out", type=Path, default=RESULTS / "pairs.json")
    args = parser.parse_args()
    benchmark = SCBenchmark(args.scb)
    classes: dict[str, Any] = {}
    every_shape: dict[str, dict[str, Any]] = {}
    every_pair: dict[str, dict[str, Any]] = {}
    for name in args.classes.split(","):
        reflected = Truth(benchmark, name) if benchmark.undeformed(name) else None
        truth = PlainTruth(benchmark, name, reflected) if reflected is None or args.samples_only else reflected
        group = Shapes(benchmark, truth, args.cache, args.functions)
        collection = Collection(parameters=OURS)  # remembers what it found of each shape
        shapes = symmetries(group, benchmark.shapes(name), collection)
        pairs = matches(group, benchmark.published_pairs(name), collection, args.paper, args.scb, reflected)
        classes[name] = {**summary(shapes, pairs), "each_shape": shapes, "each_pair": pairs}
        every_shape, every_pair = every_shape | shapes, every_pair | pairs
        print(name, {k: v for k, v in classes[name].items() if not k.startswith("each")}, flush=True)
        result = {"points_per_shape": N_POINTS, "all": summary(every_shape, every_pair), "classes": classes}
        write_json(args.out, result)
    print("all", summary(every_shape, every_pair))


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
