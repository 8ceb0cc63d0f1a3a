"""Memory and time of the soft point map at 10,000 x 10,000 vertices, C = 256, float32, forward and backward.

    python benchmarks/layers_soft.py

The bound for the sparse map is 2 GiB beside the features. Each run is a process of its own; counted is its peak
(``VmHWM``: unlike ``ru_maxrss`` it does not begin with that of the parent) less what it held before the call.
"""

import json
import os
import subprocess
import sys
from typing import Any

from common import ROOT

N, C, K = 10_000, 256, 30
LIMIT_GIB = 2.0

_CHILD = """
import json, sys, time
import torch
from torchqm.fmap.soft import soft_map

def held(key):
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith(key)) / 2**20

n, c, k, kind, threads = json.loads(sys.argv[1])
torch.set_num_threads(threads)
make = torch.Generator().manual_seed(0)
x, y = (torch.randn(n, c, generator=make).requires_grad_() for _ in range(2))

def run(x, y):
    start = time.perf_counter()
    soft = soft_map(x, y, 0.5, k, kind=kind, normalize=kind == "dot")
    middle = time.perf_counter()
    (soft.weights if k else soft).square().sum().backward()
    return middle - start, time.perf_counter() - middle

run(x[:64], y[:64])  # what is loaded at the first call
x.grad = y.grad = None
before = held("VmRSS")
forward, backward = run(x, y)
print(json.dumps({
    "extra_gib": held("VmHWM") - before,
    "forward_s": forward,
    "backward_s": backward,
    "finite": bool(torch.isfinite(x.grad).all() & torch.isfinite(y.grad).all()),
}))
"""


def soft_map_part(n: int = N, c: int = C, k: int = K, threads: int = 2) -> dict[str, Any]:
    """Extra memory (GiB) and seconds of sparse maps of both kinds (within the limit?) and of a dense one."""
    sparse = {kind: _measured(n, c, k, kind, threads) for kind in ("dot", "distance")}
    worst = max(run["extra_gib"] for run in sparse.values())
    return {
        "vertices": n,
        "channels": c,
        "k": k,
        "dtype": "float32",
        "threads": threads,
        "sparse": sparse,
        "dense": _measured(n, c, None, "dot", threads),
        "one_dense_matrix_gib": n * n * 4 / 2**30,
        "gathered_features_gib": n * k * c * 4 / 2**30,
        "limit_gib": LIMIT_GIB,
        "worst_extra_gib": worst,
        "within_limit": worst < LIMIT_GIB,
    }


def _measured(n: int, c: int, k: int | None, kind: str, threads: int) -> dict[str, Any]:
    command = [sys.executable, "-c", _CHILD, json.dumps([n, c, k, kind, threads])]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    run = subprocess.run(command, capture_output=True, text=True, env=environment, check=True)
    found: dict[str, Any] = json.loads(run.stdout)
    return found


if __name__ == "__main__":
    print(json.dumps(soft_map_part(), indent=1))
