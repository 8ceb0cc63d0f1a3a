"""Figures 3 and 4 of the paper: how many functions do intrinsic descriptors determine, how much does splitting help?

    python benchmarks/descriptor_rank.py                        # the built-in creatures
    python benchmarks/descriptor_rank.py --scb ROOT             # TOSCA cat, centaur, david, wolf of an SCB folder
    python benchmarks/descriptor_rank.py --scb ROOT --shapes wolf0 wolf1 centaur0

Figure 3: ``|| f - P f ||^2 / || f ||^2``, averaged over the descriptors f (WKS at 10, 100 and 200 energies, from all
the eigenpairs) and over the shapes, where P projects on the first k eigenfunctions (solid), or on the symmetric part of
their span (dashed). The two lines coincide as far as the descriptors are symmetric.

Figure 4: singular values of the constraint matrix: coefficients of the descriptors in the first k functions, each
column (descriptor) scaled to norm 1 and the matrix divided by the root of their number, so that the squares of the
singular values sum to 1 whatever the number of descriptors. Numerical rank: how many exceed a share of the largest,
in all k functions and in the symmetric ones alone.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parent))

from common import DOCS, RESULTS, cached_basis, write_json

from torchqm.data.scb import SCBenchmark, shape_class
from torchqm.data.synthetic import creature, symmetry_truth
from torchqm.geometry import Mesh, load_mesh
from torchqm.spectral import (
    SpectralBasis,
    split_descriptors,
    unit_columns,
    wave_energies,
    wave_kernel_signature,
)
from torchqm.symmetry import SymmetryGroup, find_reflection, projection_matrix, split_by_projector
from torchqm.viz import line_figure

ENERGIES = (10, 100, 200)
RANK_SHARES = (1e-1, 1e-2, 1e-3, 1e-4)
SCB_CLASSES = ("cat", "centaur", "david", "wolf")
CREATURES = ("biped", "quadruped")
FLOOR = 1e-6  # singular values below are not drawn
COLORS = {10: "#0072B2", 100: "#D55E00", 200: "#009E73"}


def built_in(kinds: list[str], n_verts: int, poses: int) -> Iterator[tuple[Mesh, SymmetryGroup]]:
    """Creatures in several poses, each with its own triangulation, and their symmetries (to the nearest vertex)."""
    for kind in kinds:
        for pose in range(1, poses + 1):
            one = creature(kind, n_verts, pose=pose, retriangulate=pose)
            maps = symmetry_truth(one).nearest_vertices()
            maps[0] = torch.arange(one.mesh.n_verts)
            yield one.mesh, SymmetryGroup(maps)


def tosca(root: Path, names: list[str]) -> Iterator[tuple[Mesh, SymmetryGroup]]:
    """Poses of TOSCA; vertex ids agree inside a class, so the mirror map of the undeformed pose serves them all."""
    benchmark = SCBenchmark(root)
    names = names or [name for cls in SCB_CLASSES for name in benchmark.shapes(cls)]
    groups: dict[str, SymmetryGroup] = {}
    for name in names:
        cls = shape_class(name)
        if cls not in groups:
            undeformed = benchmark.undeformed(cls)
            if undeformed is None:
                raise SystemExit(f"{name}: class {cls} has no undeformed pose to take the reflection from")
            groups[cls] = SymmetryGroup.from_reflection(find_reflection(load_mesh(benchmark.mesh_path(undeformed))).map)
        yield load_mesh(benchmark.mesh_path(name)), groups[cls]


def projection_errors(basis: SpectralBasis, group: SymmetryGroup, values: Tensor, k: int) -> tuple[Tensor, Tensor]:
    """Mean relative quadratic error for 1..k functions: on their span, and on its symmetric part."""
    norms = basis.mass @ values.square()
    small = basis.truncate(k)
    coefficients = small.coefficients(values)
    projector = projection_matrix(small, group)
    full, even = [], []
    for size in range(1, k + 1):
        split = split_by_projector(small.truncate(size), projector[:size, :size])
        kept = coefficients[:size]
        full.append(1 - (kept.square().sum(0) / norms).mean())
        even.append(1 - ((split.even_coeffs.T @ kept).square().sum(0) / norms).mean())
    return torch.stack(full), torch.stack(even)


def singular_values(basis: SpectralBasis, values: Tensor) -> Tensor:
    """Of the matrix of unit descriptor columns over the root of their number."""
    (columns,) = unit_columns([basis.coefficients(values)])
    return torch.linalg.svdvals(columns / columns.shape[1] ** 0.5)


def measure(mesh: Mesh, group: SymmetryGroup, options: argparse.Namespace) -> dict[str, Tensor]:
    basis = cached_basis(mesh.normalized(), options.pairs, options.cache)
    small = basis.truncate(options.k)
    split = split_by_projector(small, projection_matrix(small, group))
    out = {"k_even": torch.tensor(float(split.even.k))}
    for n in ENERGIES:
        values = wave_kernel_signature(basis, wave_energies([basis], n))
        out[f"error {n}"], out[f"error {n} even"] = projection_errors(basis, group, values, options.k)
        if n >= options.k:
            split_values = split_descriptors([values], options.splits)[0]
            for part, one in (("", values), (" split", split_values)):
                out[f"singular {n}{part}"] = singular_values(small, one)
                even = singular_values(split.even, one)  # as many as symmetric functions: filled up to average shapes
                out[f"singular {n}{part}, symmetric part"] = torch.cat([even, even.new_zeros(options.k - len(even))])
    return out


def draw(mean: dict[str, Tensor], options: argparse.Namespace, shapes: str) -> None:
    k, s = options.k, options.splits
    x = torch.arange(1, k + 1)
    series, styles = {}, {}
    for n in ENERGIES:
        for part, dash in (("", "-"), (" even", "--")):
            name = f"WKS, n={n}" + (", symmetric part" if part else "")
            series[name] = (x, mean[f"error {n}{part}"])
            styles[name] = {"color": COLORS[n], "linestyle": dash}
            styles[name] |= {"linewidth": 1.3} if part else {"linewidth": 3.5, "alpha": 0.4}
    line_figure(
        series,
        options.docs / "figure3.png",
        "number of basis functions",
        "mean projection error",
        styles,
        f"Projection of the descriptors ({shapes})",
    )
    series, styles = {}, {}
    shown = min(40, k)
    for n in ENERGIES:
        for part in ("", " split"):
            if (values := mean.get(f"singular {n}{part}")) is None:
                continue
            name = f"WKS, n={n}" + (f", split {s}" if part else "")
            series[name] = (x[:shown], torch.where(values > FLOOR, values, torch.nan)[:shown])
            styles[name] = {"color": COLORS[n], "linestyle": "none" if part else "-"}
            styles[name] |= {"marker": {100: "o", 200: "x"}.get(n), "markersize": 3.5} if part else {}
    line_figure(
        series,
        options.docs / "figure4.png",
        "index of the singular value",
        "singular value of the constraint matrix",
        styles,
        f"Rank of the descriptors ({shapes})",
        yscale="log",
    )


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scb", type=Path, help="SCB folder: use TOSCA instead of the built-in creatures")
    parser.add_argument(
        "--shapes", nargs="*", default=[], help="names of TOSCA shapes (default: cat, centaur, david, wolf)"
    )
    parser.add_argument("--creatures", nargs="*", default=list(CREATURES), help="kinds of built-in creatures")
    parser.add_argument("--n-verts", type=int, default=5000, help="vertices of a creature")
    parser.add_argument("--poses", type=int, default=3, help="poses of a creature")
    parser.add_argument("--k", type=int, default=60, help="basis functions")
    parser.add_argument("--pairs", type=int, default=300, help="eigenpairs that the descriptors are computed from")
    parser.add_argument("--splits", type=int, default=5, help="intervals s of the splitting")
    parser.add_argument("--cache", type=Path, help="folder that keeps eigenbases between runs")
    parser.add_argument("--out", type=Path, default=RESULTS / "descriptor_rank.json", help="where the numbers go")
    parser.add_argument("--docs", type=Path, default=DOCS, help="folder of the two pictures")
    return parser.parse_args(arguments)


def main() -> None:
    options = parse()
    if options.scb is None:
        source = built_in(options.creatures, options.n_verts, options.poses)
    else:
        source = tosca(options.scb, options.shapes)
    found: dict[str, dict[str, Tensor]] = {}
    for mesh, group in source:
        found[mesh.name] = measure(mesh, group, options)
        print(
            f"{mesh.name}: {mesh.n_verts} vertices, {int(found[mesh.name]['k_even'])} of {options.k} symmetric",
            flush=True,
        )
    if not found:
        raise SystemExit("no shapes")
    keys = next(iter(found.values()))
    mean = {key: torch.stack([one[key] for one in found.values()]).mean(0) for key in keys}
    curves = {key: mean[key] for key in keys if key != "k_even" and "symmetric part" not in key}
    ranks = {
        key.removeprefix("singular "): {
            f"{share:g}": sum(int((one[key] > share * one[key][0]).sum()) for one in found.values()) / len(found)
            for share in RANK_SHARES
        }
        for key in keys
        if key.startswith("singular")
    }
    result = {
        "data": "TOSCA (SCB)" if options.scb else "built-in creatures, retriangulated",
        "shapes": list(found),
        "number_of_shapes": len(found),
        "k": options.k,
        "eigenpairs": options.pairs,
        "splits": options.splits,
        "symmetric_functions": {"mean": mean["k_even"], "of": options.k},
        "numerical_rank": ranks,
        "curves": curves,
    }
    draw(mean, options, f"{len(found)} shapes")
    print(write_json(options.out, result))
    for name, row in ranks.items():
        print(f"rank, WKS {name:26s}", "  ".join(f"> {share} s1: {rank:.1f}" for share, rank in row.items()))
    for k in (10, 20, 30, options.k):
        print(
            f"error, k={k}",
            *(f"n={n}: {mean[f'error {n}'][k - 1]:.4f} / {mean[f'error {n} even'][k - 1]:.4f}" for n in ENERGIES),
        )


if __name__ == "__main__":
    main()
