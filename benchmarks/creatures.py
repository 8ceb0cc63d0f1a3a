"""Transferred symmetry and matching on the built-in creatures, each mesh with its own triangulation.

    python benchmarks/creatures.py [--n-verts 5000] [--poses 4] [--bodies 2]

A posed creature is matched to the undeformed one; the mirror plane of the latter is found, the symmetry of the former
transferred. Writes benchmarks/results/creatures.json. Errors are geodesic / sqrt(area), against the exact truth.
"""

import argparse
from pathlib import Path
from time import perf_counter

from common import RESULTS, write_json
from tqdm import tqdm

from torchqm.data.synthetic import Creature, creature, exact_maps
from torchqm.evaluate import SurfacePoints, TruthDistances, evaluate_errors, summarize
from torchqm.evaluate.protocol import ErrorReport
from torchqm.matching import (
    Collection,
    MatchParameters,
    extrinsic_symmetry,
    match_prepared,
    transferred_symmetry,
)

KINDS = ("biped", "quadruped")
N_POINTS = 50


class Case:
    """One posed, retriangulated creature against the undeformed one, with the true distances, each computed once."""

    def __init__(self, kind: str, body: int, pose: int, n_verts: int) -> None:
        self.source = creature(kind, n_verts, body, pose, retriangulate=1)
        self.target = creature(kind, round(1.1 * n_verts), body, 0, retriangulate=2)
        collection = Collection(parameters=MatchParameters.paper())  # 300 functions serve both methods
        self.x, self.y = collection.shape(self.source.mesh), collection.shape(self.target.mesh)
        self.points = self.x.samples[:N_POINTS]
        self.truth, self.store = self._distances(self.source, self.target)
        self.own_truth, self.own_store = self._distances(self.source, self.source)

    def _distances(self, source: Creature, target: Creature) -> tuple[SurfacePoints, TruthDistances]:
        exact = exact_maps(source, target)
        truth = SurfacePoints(exact.corners[:, self.points], exact.bary[:, self.points])
        return truth, TruthDistances.build(target.mesh, truth)

    def run(self, method: str) -> tuple[dict[str, ErrorReport], dict]:
        parameters = MatchParameters.of(method)
        way = "full_map" if method == "quotient" else "clustering"
        start = perf_counter()
        known_y = extrinsic_symmetry(self.y)
        known_x = transferred_symmetry(self.x, self.y, known_y, parameters, way)
        transferred = perf_counter()
        result = match_prepared(self.x, self.y, known_x, known_y, method, parameters)
        done = perf_counter()
        found = self.store.errors(result.maps[0][self.points], self.truth)
        own = self.own_store.errors(known_x.group.maps[1][self.points], self.own_truth)
        reports = {
            "symmetry": evaluate_errors(own[1:], "symmetry"),
            "better of the two maps": evaluate_errors(found, "map"),
            "first map, plain": evaluate_errors(found, "plain"),
        }
        note = {
            "labels": list(result.labels),
            "plane_residual": known_y.details["residual"],
            "vertices": [self.x.n_verts, self.y.n_verts],
            "seconds_symmetry": transferred - start,
            "seconds_match": done - transferred,
            "warnings": result.warnings,
        }
        return reports, note


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--n-verts", type=int, default=5000)
    parser.add_argument("--poses", type=int, default=4)
    parser.add_argument("--bodies", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "creatures.json")
    args = parser.parse_args()
    result: dict = {"kinds": {}}
    for kind in KINDS:
        result["kinds"][kind] = {}
        cases = [(body, pose) for body in range(args.bodies) for pose in range(1, args.poses + 1)]
        runs: dict[str, dict[str, tuple[dict[str, ErrorReport], dict]]] = {"quotient": {}, "paper": {}}
        for body, pose in tqdm(cases, desc=kind):
            case = Case(kind, body, pose, args.n_verts)
            for method, found in runs.items():
                found[f"body {body}, pose {pose}"] = case.run(method)
        for method, found in runs.items():
            rows = [reports for reports, _ in found.values()]
            notes = {name: note | {k: r.mean for k, r in reports.items()} for name, (reports, note) in found.items()}
            summary = {key: summarize([row[key] for row in rows]).to_dict() for key in rows[0]}
            labelled = sum(n["labels"][0] == "direct" for n in notes.values())
            result["kinds"][kind][method] = {"pairs": len(rows), "labelled": labelled, **summary, "cases": notes}
            print(
                kind,
                method,
                len(rows),
                {k: f"{v['mean']:.4f} (worst {v['worst']:.4f})" for k, v in summary.items()},
                flush=True,
            )
    write_json(args.out, result)


if __name__ == "__main__":
    main()
