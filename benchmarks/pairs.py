"""TOSCA from start to end without any help: the symmetry of each shape from its spectrum, then the published pairs.

    python benchmarks/pairs.py --scb ROOT [--cache DIR] [--classes wolf,centaur,cat,david] [--paper 1] [--out FILE]
                               [--samples-only CLASSES] [--functions 300]

No reference, no mirror plane, no landmark, no flip forgiven. Errors are geodesic / sqrt(area of the target) at 50
spread points a class; that of a symmetry is measured against the mirror plane of the undeformed shape (gorillas have
none, and no row). --paper N runs the paper's own pipeline (which needs the undeformed shape and its plane) on the first
N pairs of each class, for its time on the same machine. --samples-only names classes whose true distances are computed
at these points alone, not at the landmarks that other benchmarks keep in the same cache; --functions: eigenpairs (the
paper's pipeline needs 300, torchqm uses 200). Seconds are without eigenpairs. Writes benchmarks/results/pairs.json.
"""

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from common import RESULTS, cached_basis, write_json
from torch import Tensor
from tosca import N_POINTS, PAPER, Truth, bim
from tqdm import tqdm

from torchqm.data.scb import SCBenchmark
from torchqm.evaluate import TruthDistances, spread_points
from torchqm.geometry import load_mesh
from torchqm.matching import MatchParameters, PreparedShape, match_prepared, prepare, transferred_symmetry
from torchqm.matching.known import KnownSymmetry, detected_symmetry

OURS = MatchParameters()


class Class:
    """Truth, prepared shapes, distances and symmetries of a class, each computed once."""

    def __init__(self, benchmark: SCBenchmark, name: str, cache: Path | None, samples_only: bool, k: int) -> None:
        self.benchmark, self.cache, self.k = benchmark, cache, k
        self.truth = Truth(benchmark, name) if benchmark.undeformed(name) else None
        if self.truth is not None:
            self.points, self.mirrored = self.truth.points, self.truth.truth[1]
            self.sources = self.truth.truth.flatten().unique() if samples_only else self.truth.sources
        else:
            self.points = spread_points(load_mesh(benchmark.mesh_path(benchmark.shapes(name)[0])), N_POINTS)
            self.sources = self.points
        self._shapes: dict[str, PreparedShape] = {}
        self._known: dict[str, tuple[KnownSymmetry, float]] = {}

    def shape(self, name: str) -> PreparedShape:
        if name not in self._shapes:
            mesh = load_mesh(self.benchmark.mesh_path(name))
            basis = cached_basis(mesh.normalized(), self.k, self.cache)
            self._shapes[name] = prepare(mesh, self.k, basis=basis)
        return self._shapes[name]

    def errors(self, p2p: Tensor, target: str, truth: Tensor) -> Tensor:
        mesh = load_mesh(self.benchmark.mesh_path(target))
        return TruthDistances.build(mesh, self.sources, cache_dir=self.cache).errors(p2p[self.points], truth[None])[0]

    def known(self, name: str) -> tuple[KnownSymmetry, float]:
        if name not in self._known:
            shape = self.shape(name)
            shape.search  # noqa: B018  made once a shape, and not part of the detection
            start = perf_counter()
            self._known[name] = (detected_symmetry(shape, OURS), 0.0)
            self._known[name] = (self._known[name][0], perf_counter() - start)
        return self._known[name]

    def paper(self, a: str, b: str) -> float:
        """Seconds of the paper's pipeline: both symmetries transferred from the undeformed shape, then Algorithm 1."""
        assert self.truth is not None
        start = perf_counter()
        reference = self.shape(self.truth.undeformed)
        knowns = [
            self.truth.known
            if name == self.truth.undeformed
            else transferred_symmetry(self.shape(name), reference, self.truth.known, PAPER, "clustering")
            for name in (a, b)
        ]
        match_prepared(self.shape(a), self.shape(b), *knowns, "paper", PAPER)
        return perf_counter() - start


def symmetries(group: Class, names: list[str]) -> dict[str, dict[str, Any]]:
    rows = {}
    for name in tqdm(names, desc="symmetries"):
        known, seconds = group.known(name)
        error = None
        if known.known and group.truth is not None:
            error = float(group.errors(known.group.maps[1], name, group.mirrored).mean())
        rows[name] = {"group": known.name, "verdict": known.details["verdict"], "error": error, "seconds": seconds}
        rows[name] |= {key: known.details[key] for key in ("score", "commutativity")}
    return rows


def matches(group: Class, pairs: list[tuple[str, str]], n_paper: int, root: Path) -> dict[str, dict[str, Any]]:
    rows = {}
    for number, (a, b) in enumerate(tqdm(pairs, desc="pairs")):
        x, y = group.shape(a), group.shape(b)
        (known_x, _), (known_y, _) = group.known(a), group.known(b)
        start = perf_counter()
        result = match_prepared(x, y, known_x, known_y, "quotient", OURS)
        seconds = perf_counter() - start
        errors = group.errors(result.maps[0], b, group.points)
        row: dict[str, Any] = {"plain": float(errors.mean()), "label": result.labels[0], "seconds": seconds}
        row["share_below_0.05"] = float((errors < 0.05).double().mean())
        if group.truth is not None:
            mirrored = group.errors(result.maps[0], b, group.mirrored)
            row["as_mirrored"] = float(mirrored.mean())
            row["direct"] = row["label"] == "direct" and row["plain"] <= row["as_mirrored"]
        row |= {key: value for key, value in result.details.items() if key.startswith("residual")}
        row["bim_plain"] = bim(root, [(a, b)])[0][0].mean
        if number < n_paper and group.truth is not None:
            row["seconds_paper"] = group.paper(a, b)
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
    parser.add_argument("--samples-only", default="", help="classes without distances at landmarks")
    parser.add_argument("--functions", type=int, default=PAPER.k_max, help="eigenpairs of each shape")
    parser.add_argument("--out", type=Path, default=RESULTS / "pairs.json")
    args = parser.parse_args()
    benchmark = SCBenchmark(args.scb)
    classes: dict[str, Any] = {}
    every_shape: dict[str, dict[str, Any]] = {}
    every_pair: dict[str, dict[str, Any]] = {}
    for name in args.classes.split(","):
        group = Class(benchmark, name, args.cache, name in args.samples_only.split(","), args.functions)
        shapes = symmetries(group, benchmark.shapes(name))
        pairs = matches(group, benchmark.published_pairs(name), args.paper, args.scb)
        classes[name] = {**summary(shapes, pairs), "each_shape": shapes, "each_pair": pairs}
        every_shape, every_pair = every_shape | shapes, every_pair | pairs
        print(name, {k: v for k, v in classes[name].items() if not k.startswith("each")}, flush=True)
        result = {"points_per_shape": N_POINTS, "all": summary(every_shape, every_pair), "classes": classes}
        write_json(args.out, result)
    print("all", summary(every_shape, every_pair))


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    main()
