"""Symmetrised basis of a 10k-vertex shape, K = 200: seconds of forward and backward pass, and what bounds them.

    python benchmarks/layers_basis.py [--threads 2] [--repeats 5]

The naive twin is the same computation with torch's own gradients: ``torch.linalg.eigh``, columns picked by a boolean
mask, one shape. Its gradient is finite only where the projection's eigenvalues happen to differ.
"""

import argparse
import statistics
from collections.abc import Callable
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

import torchqm
from torchqm import checks
from torchqm.spectral import mesh_basis
from torchqm.symmetry.split import symmetrized_bases

N_VERTS, K = 10_000, 200

Pass = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, ...]]


def naive(group: Tensor) -> Pass:
    def split(evals: Tensor, evecs: Tensor, mass: Tensor) -> tuple[Tensor, ...]:
        projection = (evecs * mass[:, None]).T @ evecs[group].mean(0)
        weights, vectors = torch.linalg.eigh((projection + projection.T) / 2)
        found: list[Tensor] = []
        for columns in (vectors[:, weights > 0.5], vectors[:, weights <= 0.5]):
            own, rotation = torch.linalg.eigh(columns.T @ (evals[:, None] * columns))
            found += [own, evecs @ (columns @ rotation)]
        return tuple(found)

    return split


def layer(group: Tensor) -> Pass:
    def split(evals: Tensor, evecs: Tensor, mass: Tensor) -> tuple[Tensor, ...]:
        found = symmetrized_bases(evals[None], evecs[None], mass[None], group=group[None])
        halves = (found.evals_even, found.evecs_even, found.evals_odd, found.evecs_odd)
        return tuple(value[0] for value in halves)

    return split


def step(split: Pass, inputs: list[Tensor], weight: Tensor) -> tuple[float, float, list[Tensor]]:
    """Seconds of both passes and the gradients of a loss without gauge: weighted kernels of the halves, heat traces."""
    start = perf_counter()
    outputs = split(*inputs)
    forward = perf_counter() - start
    even, odd = outputs[1].detach(), outputs[3].detach()
    grads = [
        *(-0.01 * torch.exp(-0.01 * outputs[0].detach()), 2 * weight[:, None] * even),
        *(-0.02 * torch.exp(-0.02 * outputs[2].detach()), -weight[:, None] * odd),
    ]
    start = perf_counter()
    gradients = torch.autograd.grad(outputs, inputs, grads)
    return forward, perf_counter() - start, list(gradients)


def seconds(function: Callable[[], Any], repeats: int) -> float:
    function()
    found = []
    for _ in range(repeats):
        start = perf_counter()
        function()
        found.append(perf_counter() - start)
    return statistics.median(found)


def bounds(inputs: list[Tensor], group: Tensor, repeats: int) -> dict[str, float]:
    """The pieces alone: the six products of forward and backward, each 2 V K^2 operations, one gather, two eigh."""
    _, evecs, _ = (value.detach() for value in inputs)
    square = torch.randn(K, K, dtype=evecs.dtype)
    square = square + square.T
    inner = seconds(lambda: evecs.T @ evecs, repeats)
    outer = seconds(lambda: evecs @ square, repeats)
    return {
        "products_ms": 1e3 * (2 * inner + 4 * outer),
        "products_gflop": 6 * 2 * evecs.shape[0] * K**2 / 1e9,
        "gather_ms": 1e3 * seconds(lambda: evecs.index_select(0, group[1]), repeats),
        "scatter_ms": 1e3 * seconds(lambda: torch.zeros_like(evecs).index_add_(0, group[1], evecs), repeats),
        "pass_over_evecs_ms": 1e3 * seconds(lambda: evecs + evecs, repeats),
        "eigh_ms": 2e3 * seconds(lambda: torch.linalg.eigh(square), repeats),
    }


def basis_part(threads: int = 2, repeats: int = 5) -> dict[str, Any]:
    """Median of ``repeats`` after a warm-up, layer and naive twin in turns, in both precisions."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        result: dict[str, Any] = {"vertices": N_VERTS, "k": K, "threads": threads, "repeats": repeats}
        for name, pose in (("at rest", 0), ("in a pose", 1)):
            shape = torchqm.creature("quadruped", N_VERTS, pose=pose)
            basis = mesh_basis(shape.mesh.normalized(), K)
            result[name] = {
                str(dtype).removeprefix("torch."): _compare(basis, shape.base_group, dtype, repeats)
                for dtype in (torch.float32, torch.float64)
            }
        return result
    finally:
        torch.set_num_threads(before)


def _compare(basis: torchqm.SpectralBasis, group: Tensor, dtype: torch.dtype, repeats: int) -> dict[str, Any]:
    inputs = [value.to(dtype).requires_grad_() for value in (basis.evals, basis.evecs, basis.mass)]
    weight = torch.rand(basis.n_verts, dtype=dtype, generator=torch.Generator().manual_seed(0)) / basis.n_verts
    ours, twin = layer(group), naive(group)
    passes: dict[str, list[tuple[float, float, list[Tensor]]]] = {"checked": [], "unchecked": [], "naive": []}
    for _ in range(repeats + 1):
        passes["checked"].append(step(ours, inputs, weight))
        with checks.disabled():
            passes["unchecked"].append(step(ours, inputs, weight))
        passes["naive"].append(step(twin, inputs, weight))
    row: dict[str, Any] = {"vertices": basis.n_verts}
    for name, found in passes.items():
        timed = found[1:]
        row[name] = {
            "forward_ms": 1e3 * statistics.median(one[0] for one in timed),
            "backward_ms": 1e3 * statistics.median(one[1] for one in timed),
            "total_ms": 1e3 * statistics.median(one[0] + one[1] for one in timed),
            "fastest_ms": 1e3 * min(one[0] + one[1] for one in timed),
        }
    got, want = passes["checked"][-1][2][1], passes["naive"][-1][2][1]
    row["finite"] = bool(torch.isfinite(got).all())
    row["naive_finite"] = bool(torch.isfinite(want).all())
    if row["naive_finite"]:
        row["relative_difference_of_gradients"] = float((got - want).norm() / got.norm())
    row["bounds"] = bounds(inputs, group, repeats)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    for name, row in basis_part(args.threads, args.repeats).items():
        print(name, row)


if __name__ == "__main__":
    main()
