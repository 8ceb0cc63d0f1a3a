"""The symmetry groups of the built-in creatures from their spectra: group, verdict, error and seconds.

    python benchmarks/detect.py [--n-verts 5000] [--poses 20] [--bodies 2] [--kinds biped,quadruped,...]
                                [--out FILE]

Each creature is in a random pose and has a triangulation of its own; nothing is known of it: no reference, no mirror
plane. Pose p is that of body p modulo --bodies. Right is a verdict of ``symmetric`` with the true group (``asymmetric``
for the crab, which has none). Errors are Euclidean / sqrt(area) at all vertices: of each element found, against the
nearest true one, the mean over the elements. Seconds are without eigenpairs. Writes benchmarks/results/detect.json.
TOSCA's shapes are in benchmarks/pairs.py.
"""

import argparse
from pathlib import Path
from time import perf_counter
from typing import Any

from common import RESULTS, write_json
from tqdm import tqdm

from torchqm.data.synthetic import CREATURES, creature, exact_maps
from torchqm.matching import MatchParameters, detect_group, prepare

GROUPS = {"biped": "C2", "quadruped": "C2", "octopus": "D8", "ellipsoid": "C2 x C2 x C2", "asymmetric": "trivial"}


def one(kind: str, n_verts: int, body: int, pose: int) -> dict[str, Any]:
    animal = creature(kind, n_verts, body, pose, retriangulate=1)
    shape = prepare(animal.mesh, MatchParameters().k_max)
    start = perf_counter()
    found = detect_group(shape)
    seconds = perf_counter() - start
    truth = exact_maps(animal, animal).points(shape.mesh)[1:]
    gaps = []
    for p2p in found.group.maps[1:]:
        gaps += [min(float((shape.mesh.verts[p2p] - t).norm(dim=1).mean()) for t in truth)] if len(truth) else []
    wanted = "asymmetric" if kind == "asymmetric" else "symmetric"
    right = found.name == GROUPS[kind] and found.verdict == wanted
    numbers = {key: found.parts[key] for key in ("score", "commutativity")}
    error = sum(gaps) / len(gaps) if gaps else None
    return {
        "group": found.name,
        "verdict": found.verdict,
        "right": right,
        "error": error,
        "seconds": seconds,
        **numbers,
    }


def summary(rows: dict[str, dict[str, Any]]) -> dict[str, Any]:
    errors = [row["error"] for row in rows.values() if row["right"] and row["error"] is not None]
    return {
        "shapes": len(rows),
        "right": sum(row["right"] for row in rows.values()),
        "mean_error": sum(errors) / len(errors) if errors else None,
        "worst_error": max(errors, default=None),
        "mean_seconds": sum(row["seconds"] for row in rows.values()) / len(rows),
        "each": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", default=",".join(CREATURES))
    parser.add_argument("--n-verts", type=int, default=5000)
    parser.add_argument("--poses", type=int, default=20)
    parser.add_argument("--bodies", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULTS / "detect.json")
    args = parser.parse_args()
    kinds: dict[str, Any] = {}
    for kind in args.kinds.split(","):
        poses = tqdm(range(1, args.poses + 1), desc=kind)
        rows = {f"body {p % args.bodies}, pose {p}": one(kind, args.n_verts, p % args.bodies, p) for p in poses}
        kinds[kind] = summary(rows)
        print(kind, {key: value for key, value in kinds[kind].items() if key != "each"}, flush=True)
        write_json(args.out, {"vertices": args.n_verts, "groups": GROUPS, "creatures": kinds})


if __name__ == "__main__":
    main()
