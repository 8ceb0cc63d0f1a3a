"""The paper's Figures 6, 8 and 10 on TOSCA: semi-quotient matching, symmetry, quotient matching beside BIM.

    python benchmarks/tosca.py --scb ROOT [--cache DIR] [--classes cat,centaur,david,wolf] [--out FILE]
    python benchmarks/tosca.py --draw

ROOT holds TOSCA/Meshes, TOSCA/Corrs and Results/Results_Corr_TOSCA (the SCB benchmark of Kim et al. 2011). Writes
benchmarks/results/tosca.json (--out: classes run at the same time may write files of their own beside it); --draw makes
docs/tosca_figure{6,8,10}.png from all of them. Errors are geodesic / sqrt(area of the target).
"""

import argparse
import json
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from common import DOCS, RESULTS, write_json
from torch import Tensor
from tqdm import tqdm

from torchqm.data.published import load_published
from torchqm.data.scb import SCBenchmark
from torchqm.evaluate import (
    ErrorReport,
    TruthDistances,
    cumulative_curve,
    evaluate_errors,
    flip_rate,
    group_truth,
    make_report,
    mean_curve,
    spread_points,
    summarize,
)
from torchqm.fmap import fmap_to_p2p
from torchqm.geometry import load_mesh
from torchqm.matching import (
    MatchParameters,
    PreparedShape,
    SymmetryTransfer,
    match_prepared,
    match_semi_quotient,
    prepare,
)
from torchqm.matching.known import KnownSymmetry
from torchqm.matching.self_map import self_map_from_halves
from torchqm.matching.semi_quotient import sharpen_orbit_map
from torchqm.matching.transfer import transfer_symmetry
from torchqm.symmetry import SymmetryGroup, find_reflection

SEMI = "semi-quotient, k=30"
THRESHOLDS = torch.linspace(0, 0.25, 26, dtype=torch.float64)
N_POINTS = 50  # the paper: 50 uniformly distributed points a class
PAPER, OURS = MatchParameters.paper(), MatchParameters()


class Truth:
    """Ground truth of a class: vertex ids agree inside it; the reflection is that of the undeformed shape."""

    def __init__(self, benchmark: SCBenchmark, cls: str) -> None:
        self.undeformed = benchmark.undeformed(cls)
        mesh = load_mesh(benchmark.mesh_path(self.undeformed))
        self.reflection = find_reflection(mesh)
        self.side = self.reflection.side(mesh.verts)
        self.group = SymmetryGroup.from_reflection(self.reflection.map)
        self.points = spread_points(mesh, N_POINTS)
        self.landmarks = benchmark.landmarks(cls)
        swap = benchmark.symmetry_landmarks(cls).permutation()
        self.landmark_truth = torch.stack([self.landmarks, self.landmarks[swap]])
        self.truth = group_truth(self.points, self.group.maps)
        self.known = KnownSymmetry(self.group, torch.sign(self.side), "extrinsic")

    @property
    def sources(self) -> Tensor:
        """All vertices whose distances are needed."""
        return torch.cat([self.truth.flatten(), self.landmark_truth.flatten()]).unique()


class PlainTruth:
    """Points of a class and nothing else: for gorillas, which have no undeformed pose and so no known reflection.

    Or, of any class, without the landmarks: their true distances take as long as those of the points.
    """

    def __init__(self, benchmark: SCBenchmark, cls: str, reflected: Truth | None = None) -> None:
        first = load_mesh(benchmark.mesh_path(benchmark.shapes(cls)[0]))
        self.points = spread_points(first, N_POINTS) if reflected is None else reflected.points
        self.truth = self.points[None] if reflected is None else reflected.truth
        self.sources = self.truth.flatten().unique()


class Shapes:
    """Prepared shapes and distances of a class, each computed once (and kept in the cache folder)."""

    def __init__(
        self, benchmark: SCBenchmark, truth: "Truth | PlainTruth", cache: Path | None, k: int = PAPER.k_max
    ) -> None:
        self.benchmark, self.truth, self.cache, self.k = benchmark, truth, cache, k
        self._shapes: dict[str, PreparedShape] = {}
        self._distances: dict[str, TruthDistances] = {}

    def shape(self, name: str) -> PreparedShape:
        if name not in self._shapes:
            mesh = load_mesh(self.benchmark.mesh_path(name))
            folder = None if self.cache is None else self.cache / "spectral"  # where torchqm prepare may have put them
            self._shapes[name] = prepare(mesh, self.k, cache_dir=folder)
        return self._shapes[name]

    def distances(self, name: str) -> TruthDistances:
        if name not in self._distances:
            mesh = load_mesh(self.benchmark.mesh_path(name))
            self._distances[name] = TruthDistances.build(mesh, self.truth.sources, cache_dir=self.cache)
        return self._distances[name]

    def errors(self, p2p: Tensor, target: str, landmarks: bool = False) -> Tensor:
        """(2, S) errors of a point map against the plain and the mirrored truth."""
        truth = self.truth.truth
        if landmarks:
            assert isinstance(self.truth, Truth)
            truth = self.truth.landmark_truth
        return self.distances(target).errors(p2p[truth[0]], truth)


def figure6(shapes: Shapes, name: str) -> dict[str, ErrorReport]:
    """Semi-quotient matching of a pose to the undeformed shape, flips forgiven point by point."""
    x, y, group = shapes.shape(name), shapes.shape(shapes.truth.undeformed), shapes.truth.group
    semi = match_semi_quotient(x, y, group, PAPER)
    printed = match_semi_quotient(x, y, group, PAPER.changed(semi_width=None))
    maps = {
        SEMI: semi.orbit_map,
        "semi-quotient, k=30, ICP as printed": printed.orbit_map,
        "semi-quotient, upsampled to k=100": sharpen_orbit_map(semi, x, y, group, PAPER),
    }
    undeformed = shapes.truth.undeformed
    return {key: evaluate_errors(shapes.errors(p2p, undeformed), "orbit") for key, p2p in maps.items()}


def symmetries(shapes: Shapes, name: str) -> dict[str, tuple[SymmetryGroup, SymmetryTransfer | None]]:
    """A shape's symmetry by the three ways that Figure 8 compares."""
    x, y = shapes.shape(name), shapes.shape(shapes.truth.undeformed)
    truth = shapes.truth
    by_paper = transfer_symmetry(x, y, truth.group, truth.side, PAPER, "clustering")
    ours = transfer_symmetry(x, y, truth.group, truth.side, OURS, "full_map")
    exact = self_map_from_halves(x, torch.sign(truth.side), PAPER)
    basis = x.basis.truncate(exact.shape[0])
    return {
        "paper, estimated axis": (by_paper.group, by_paper),
        "torchqm, estimated axis": (ours.group, ours),
        "paper, exact axis": (SymmetryGroup.from_reflection(fmap_to_p2p(exact, basis, basis)), None),
    }


def figure8(shapes: Shapes, name: str) -> dict[str, ErrorReport]:
    """Error of the estimated reflection against the true one."""
    truth, store = shapes.truth, shapes.distances(name)
    reports = {}
    for key, (group, _) in symmetries_once(shapes, name).items():
        errors = store.errors(group.maps[1][truth.points], truth.truth[1])
        reports[key] = evaluate_errors(errors[None], "symmetry")
    return reports


_SYMMETRIES: dict[str, dict[str, tuple[SymmetryGroup, SymmetryTransfer | None]]] = {}


def symmetries_once(shapes: Shapes, name: str) -> dict[str, tuple[SymmetryGroup, SymmetryTransfer | None]]:
    if name not in _SYMMETRIES:
        _SYMMETRIES[name] = symmetries(shapes, name)
    return _SYMMETRIES[name]


def estimated(shapes: Shapes, name: str, key: str) -> KnownSymmetry:
    """What the collection pipeline knows of a pose: the true plane of the undeformed one, a transfer for the others."""
    if name == shapes.truth.undeformed:
        return shapes.truth.known
    group, transfer = symmetries_once(shapes, name)[key]
    assert transfer is not None
    return KnownSymmetry(group, transfer.sign, "transfer", transfer.warnings)


def figure10(shapes: Shapes, a: str, b: str) -> tuple[dict[str, ErrorReport], dict[str, dict]]:
    """Quotient matching of a published pair; a flip of the whole map is forgiven."""
    x, y, known = shapes.shape(a), shapes.shape(b), shapes.truth.known
    ours = "torchqm, estimated axis"
    paper = "paper, estimated axis"
    runs = {
        "paper, estimated axis": ("paper", PAPER, estimated(shapes, a, paper), estimated(shapes, b, paper)),
        "paper, exact axis": ("paper", PAPER, known, known),
        "torchqm, estimated axis": ("quotient", OURS, estimated(shapes, a, ours), estimated(shapes, b, ours)),
        "torchqm, exact axis": ("quotient", OURS, known, known),
    }
    reports, notes = {}, {}
    for key, (method, parameters, known_x, known_y) in runs.items():
        start = perf_counter()
        result = match_prepared(x, y, known_x, known_y, method, parameters)
        seconds = perf_counter() - start
        errors = shapes.errors(result.maps[0], b)
        reports[key] = evaluate_errors(errors, "map")
        reports[f"{key}, at landmarks"] = evaluate_errors(shapes.errors(result.maps[0], b, landmarks=True), "map")
        notes[key] = {
            "plain": float(errors[0].mean()),
            "label": result.labels[0],
            "element": reports[key].element,
            "patches": flip_rate(errors, margin=0.05).patches,
            "seconds": seconds,
            "warnings": result.warnings,
        }
    return reports, notes


def bim(root: Path, pairs: list[tuple[str, str]]) -> tuple[list[ErrorReport], list[ErrorReport]]:
    """BIM's published errors on the same pairs: at its 1024 samples (plain) and at the landmarks (flip forgiven)."""
    found = {(r.source, r.target): r for r in load_published(root, "BlendedMap")}
    chosen = [found[pair] for pair in pairs]
    samples = [make_report("map", torch.as_tensor(r.plain.errors, dtype=torch.float64)) for r in chosen]
    marks = [make_report("map", torch.as_tensor(r.landmarks.errors, dtype=torch.float64)) for r in chosen]
    return samples, marks


def table(reports: list[dict[str, ErrorReport]]) -> dict[str, dict]:
    return {key: summarize([r[key] for r in reports]).to_dict() for key in (reports[0] if reports else {})}


def draw() -> None:
    """Figures 6, 8 and 10 from the curves in all the result files: the mean over shapes, or pairs, of all classes."""
    from torchqm.viz import line_figure

    files = [json.loads(path.read_text()) for path in sorted(RESULTS.glob("tosca*.json"))]
    for number in (6, 8, 10):
        figure = f"figure{number}"
        count = [data["all"][figure]["paper, exact axis" if number > 6 else SEMI]["n_pairs"] for data in files]
        series = {}
        for key in [k for k in files[0]["curves"][figure] if "landmarks" not in k]:
            curves = [n * np.array(data["curves"][figure][key]) for n, data in zip(count, files, strict=True)]
            series[key] = (np.array(files[0]["curves"]["thresholds"]), sum(curves) / sum(count))
        title = f"TOSCA, Figure {number}: {sum(count)} {'pairs' if number == 10 else 'shapes'}"
        path = DOCS / f"tosca_figure{number}.png"
        line_figure(series, path, "geodesic error / sqrt(area)", "share of correspondences", title=title)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scb", type=Path, help="folder of the SCB benchmark")
    parser.add_argument("--cache", type=Path, help="folder for eigenbases and distances")
    parser.add_argument("--classes", default="wolf,centaur,cat,david")
    parser.add_argument("--out", type=Path, default=RESULTS / "tosca.json")
    parser.add_argument("--draw", action="store_true", help="draw the figures from the result files and stop")
    parser.add_argument("--prepare-only", action="store_true", help="fill the cache and stop")
    args = parser.parse_args()
    if args.draw:
        draw()
        return
    if args.scb is None:
        parser.error("--scb ROOT is needed")
    benchmark = SCBenchmark(args.scb)
    result: dict[str, dict] = {
        "points_per_shape": N_POINTS,
        "parameters": {"paper": PAPER.as_dict(), "torchqm": OURS.as_dict()},
    }
    all6: list[dict[str, ErrorReport]] = []
    all8: list[dict[str, ErrorReport]] = []
    all10: list[dict[str, ErrorReport]] = []
    result["classes"] = {}
    for cls in args.classes.split(","):
        truth = Truth(benchmark, cls)
        shapes = Shapes(benchmark, truth, args.cache)
        poses = [n for n in benchmark.shapes(cls) if n != truth.undeformed]
        pairs = benchmark.published_pairs(cls)
        if args.prepare_only:
            for name in tqdm([*poses, truth.undeformed], desc=f"{cls}: cache"):
                shapes.distances(name)
            continue
        start = perf_counter()
        six, eight, ten, notes = [], [], [], {}
        for name in tqdm(poses, desc=f"{cls}: poses"):
            six.append(figure6(shapes, name))
            eight.append(figure8(shapes, name))
        for a, b in tqdm(pairs, desc=f"{cls}: pairs"):
            reports, note = figure10(shapes, a, b)
            samples, marks = bim(args.scb, [(a, b)])
            ten.append(reports | {"BIM, published": samples[0], "BIM, published, at landmarks": marks[0]})
            notes[f"{a} -> {b}"] = note
        transfers = {n: {k: t.warnings for k, (_, t) in symmetries_once(shapes, n).items() if t} for n in poses}
        per_pose = {n: {k: round(r.mean, 4) for k, r in row.items()} for n, row in zip(poses, eight, strict=True)}
        result["classes"][cls] = {
            "undeformed": truth.undeformed,
            "reflection_residual": truth.reflection.residual,
            "poses": len(poses),
            "figure6": table(six),
            "figure8": table(eight),
            "figure8_means": per_pose,
            "figure8_warnings": transfers,
            "figure10": table(ten),
            "figure10_pairs": {
                f"{a} -> {b}": {k: round(r.mean, 4) for k, r in row.items()}
                for (a, b), row in zip(pairs, ten, strict=True)
            },
            "figure10_notes": notes,
            "seconds": perf_counter() - start,
        }
        for name, sub in (("figure6", six), ("figure8", eight), ("figure10", ten)):
            print(
                cls,
                name,
                {k: f"{v['mean']:.4f}/{v['share_below']['0.05']:.2f}" for k, v in table(sub).items()},
                flush=True,
            )
        all6, all8, all10 = all6 + six, all8 + eight, all10 + ten
        result["all"] = {"figure6": table(all6), "figure8": table(all8), "figure10": table(all10)}
        write_json(args.out, result)
    if args.prepare_only:
        return
    result["curves"] = {"thresholds": THRESHOLDS} | {
        f"figure{number}": {
            k: mean_curve([cumulative_curve(r[k].errors, THRESHOLDS) for r in reports]) for k in reports[0]
        }
        for number, reports in ((6, all6), (8, all8), (10, all10))
    }
    write_json(args.out, result)


if __name__ == "__main__":
    main()
