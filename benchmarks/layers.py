"""Speed and memory of the differentiable layers, forward and backward, against the field's usual code.

    python benchmarks/layers.py [--parts solver,blocks,basis,soft_map] [--threads 2] [--repeats 5] [--out FILE]

solver: B = 8, K = 100, C = 256, float32. The twin takes the inverse of each row's matrix, as ULRSSM and its relatives
do; it is written from their description (``tests/references/fmap_layers.py``). Both take turns, medians are reported:
from the coefficients of the descriptors, and from features at 5000 vertices, where both spend the same time on the
projection. Memory is the growth of a process's peak while it takes one step, each in a process of its own. The second
part solves a block-diagonal map, 100 even and 100 odd functions, against one full map at K = 200. basis: see
layers_basis.py, soft_map: see layers_soft.py.
Writes benchmarks/results/layers.json.
"""

import argparse
import ctypes
import gc
import json
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from common import RESULTS, ROOT, write_json
from layers_basis import basis_part
from layers_soft import soft_map_part
from torch import Tensor

from torchqm.fmap.compiled import SPARE
from torchqm.fmap.regularized import regularized_blocks, regularized_fmap
from torchqm.nn.solver import FunctionalMapSolver

sys.path.insert(0, str(ROOT / "tests"))
from references.fmap_layers import fmap_by_inverses, regularized_fmap_net, resolvent_mask

B, K, C, V = 8, 100, 256, 5000
CHUNK = 10

Step = Callable[[], list[Tensor]]


def solver_inputs(k: int, features: bool) -> tuple[list[Tensor], list[Tensor]]:
    """Descriptors of both shapes (coefficients, or features at vertices) and their spectra by Weyl's law."""
    generator = torch.Generator().manual_seed(0)
    descriptors = [torch.randn(B, V if features else k, C, generator=generator).requires_grad_() for _ in range(2)]
    jitter = [torch.rand(B, k, generator=generator) for _ in range(2)]
    spectra = [(4 * torch.pi * (torch.arange(k) + j)).sort(-1).values for j in jitter]
    if features:
        spectra += [torch.randn(B, k, V, generator=generator) / V for _ in range(2)]
    return descriptors, spectra


def steps(k: int, features: bool) -> dict[str, Step]:
    """One forward and backward pass of each solver; they return the map and the gradients of both descriptors."""
    descriptors, given = solver_inputs(k, features)
    weight = torch.randn(B, k, k, generator=torch.Generator().manual_seed(1))

    def step(solve: Callable[[], Tensor]) -> list[Tensor]:
        fmap = solve()
        return [fmap.detach(), *torch.autograd.grad(fmap, descriptors, weight)]

    def twin() -> Tensor:
        if features:
            return regularized_fmap_net(*descriptors, *given)
        masks = torch.stack([resolvent_mask(x, y, 0.5) for x, y in zip(*given, strict=True)])
        return fmap_by_inverses(*descriptors, masks, 100.0)

    def ours(row_chunk: int | None) -> Callable[[], Tensor]:
        if features:
            layer = FunctionalMapSolver(row_chunk=row_chunk)
            return lambda: layer(*descriptors, *given)[0]
        return lambda: regularized_fmap(*descriptors, *given, row_chunk=row_chunk)

    return {
        "twin": lambda: step(twin),
        "kept": lambda: step(ours(None)),
        "chunked": lambda: step(ours(CHUNK)),
    }


def in_turns(candidates: dict[str, Step], repeats: int) -> dict[str, list[float]]:
    """Seconds of each, in turns, after a warm-up."""
    for step in candidates.values():
        step()
    seconds: dict[str, list[float]] = {name: [] for name in candidates}
    for _ in range(repeats):
        for name, step in candidates.items():
            start = perf_counter()
            step()
            seconds[name].append(perf_counter() - start)
    return seconds


def solver_part(threads: int, repeats: int) -> dict[str, Any]:
    """Time, memory and agreement: the solver that keeps its factor, the one that takes rows in chunks, the twin."""
    result: dict[str, Any] = {"batch": B, "k": K, "descriptors": C, "dtype": "float32", "row_chunk": CHUNK}
    for case, features in (("coefficients", False), (f"features at {V} vertices", True)):
        candidates = steps(K, features)
        seconds = in_turns(candidates, repeats)
        median = {name: statistics.median(values) for name, values in seconds.items()}
        peaks = {name: solver_memory(name, features, threads) for name in candidates}
        wanted = candidates["twin"]()
        result[case] = {
            "median_ms": {name: 1e3 * value for name, value in median.items()},
            "fastest_ms": {name: 1e3 * min(values) for name, values in seconds.items()},
            "times_as_fast": {name: median["twin"] / median[name] for name in ("kept", "chunked")},
            "peak_mib": peaks,
            "share_of_memory": {name: peaks[name] / peaks["twin"] for name in ("kept", "chunked")},
            "relative_difference": {
                name: max(float((a - b).norm() / b.norm()) for a, b in zip(candidates[name](), wanted, strict=True))
                for name in ("kept", "chunked")
            },
        }
    return result


def solver_memory(name: str, features: bool, threads: int) -> float:
    """MiB by which one step raises the memory of a fresh process at most."""
    command = [sys.executable, __file__, "--threads", str(threads), "--one", f"{name}:{int(features)}"]
    run = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return float(json.loads(run.stdout.splitlines()[-1]))


def one_peak(case: str) -> float:
    """In this process, after a step that loads all code and makes the libraries' own buffers."""
    name, features = case.split(":")
    step = steps(K, bool(int(features)))[name]
    step()
    SPARE.clear()  # what is kept for the next step counts, too
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)  # what the first step has freed goes back to the system
    before = _status_mib("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here (Linux)
    step()
    return _status_mib("VmHWM") - before


def _status_mib(field: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line.split()[1] for line in lines if line.startswith(field))) / 2**10


def blocks_part(threads: int, repeats: int) -> dict[str, Any]:
    """Even and odd blocks of 100 functions each against one map of 200 x 200, the same descriptors."""
    (a, b), (x, y) = solver_inputs(2 * K, False)
    # Coefficients in the even and in the odd basis are tensors of their own, as SymmetrizedBasis gives them.
    halves = [[side.detach()[:, start::2].contiguous() for start in (0, 1)] for side in (a, b, x, y)]
    leaves = [half.requires_grad_() for side in halves[:2] for half in side]

    def full() -> list[Tensor]:
        return list(torch.autograd.grad(regularized_fmap(a, b, x, y).square().sum(), [a, b]))

    def blocks() -> list[Tensor]:
        return list(torch.autograd.grad(sum(c.square().sum() for c in regularized_blocks(*halves)), leaves))

    seconds = in_turns({"full": full, "blocks": blocks}, repeats)
    median = {name: statistics.median(values) for name, values in seconds.items()}
    return {
        "batch": B,
        "k": 2 * K,
        "median_ms": {name: 1e3 * value for name, value in median.items()},
        "times_as_fast": median["full"] / median["blocks"],
    }


PARTS: dict[str, Callable[[int, int], dict[str, Any]]] = {
    "solver": solver_part,
    "blocks": blocks_part,
    "basis": basis_part,
    "soft_map": lambda threads, repeats: soft_map_part(threads=threads),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", default=",".join(PARTS))
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=RESULTS / "layers.json")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # measure the memory of this case in this process
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    if args.one:
        print(json.dumps(one_peak(args.one)))
        return
    results = {}
    for name in args.parts.split(","):
        results[name] = PARTS[name](args.threads, args.repeats)
        print(name, json.dumps(results[name], indent=1), flush=True)
    write_json(args.out, {"repeats": args.repeats, **results})


if __name__ == "__main__":
    main()
