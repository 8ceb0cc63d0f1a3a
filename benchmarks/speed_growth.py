"""How seconds and memory of a basis and of a match grow with the number of vertices, on a built-in creature."""

import json
import os
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import matplotlib
import numpy as np
import torch
from common import DOCS, RESULTS, write_json

from torchqm import MatchParameters, match
from torchqm.data.synthetic import creature
from torchqm.geometry import Mesh, laplacian
from torchqm.spectral import eigenbasis, relative_residuals

K = 100
BASE = 1000
PARTS = ("basis", "match")


def mesh_of(n_verts: int, pose: int) -> Mesh:
    """A quadruped of about 1,000 or 4,000 vertices, each triangle cut in four until there are ``n_verts``."""
    import trimesh

    levels = round(np.log(n_verts / BASE) / np.log(4))
    verts, faces = creature("quadruped", round(n_verts / 4**levels), 0, pose).mesh.numpy()
    for _ in range(levels):
        verts, faces = trimesh.remesh.subdivide(verts, faces)
    return Mesh.from_arrays(verts, faces, f"quadruped-{len(verts)}").normalized()


def one(part: str, n_verts: int) -> dict[str, float]:
    """Seconds and peak memory of one part at one size; meant for a process of its own."""
    meshes = [mesh_of(n_verts, pose) for pose in ((1,) if part == "basis" else (1, 0))]
    before = _status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    begin = perf_counter()
    row: dict[str, float] = {"n_verts": meshes[0].n_verts}
    if part == "basis":
        operator = laplacian(meshes[0])
        basis = eigenbasis(operator, K)
        row |= {"seconds": perf_counter() - begin, "peak_mib": (_status("VmHWM") - before) / 1024}
        row["residual_max"] = float(relative_residuals(operator, basis).max())
    else:
        found = match(*meshes, parameters=MatchParameters(k_max=K))
        row |= {"seconds": perf_counter() - begin, "peak_mib": (_status("VmHWM") - before) / 1024}
        gap = (meshes[1].verts[found.maps[0]] - meshes[1].verts).norm(dim=1)  # the poses share their vertices
        row |= {"straight_error": float(gap.mean()), "n_maps": len(found.maps)}
    return row


def measure(sizes: list[int], largest_match: int = 1100000) -> None:
    """Each size in a process of its own, with the fitted exponents and a plot."""
    rows: dict[str, list[dict[str, float]]] = {part: [] for part in PARTS}
    for n_verts in sizes:
        for part in PARTS:
            if part == "match" and n_verts > largest_match:
                continue
            call = [sys.executable, __file__, part, str(n_verts), str(torch.get_num_threads())]
            done = subprocess.run(call, capture_output=True, text=True, check=False)
            if done.returncode:
                rows[part].append({"n_verts": n_verts, "failed": 1.0})
                print(part, n_verts, done.stderr[-500:], flush=True)
                continue
            rows[part].append(json.loads(done.stdout.splitlines()[-1]))
            print(part, rows[part][-1], flush=True)
    exponents = {f"{part}_{what}": exponent(rows[part], what) for part in PARTS for what in ("seconds", "peak_mib")}
    print(exponents)
    write_json(
        RESULTS / "speed_growth.json",
        {"k": K, "threads": torch.get_num_threads(), "rows": rows, "exponents": exponents},
    )
    draw(rows, exponents, DOCS / "speed_growth.png")


def exponent(rows: list[dict[str, float]], what: str) -> float:
    """Slope of the logarithms, sizes from 4,000 vertices on (below, start-up counts)."""
    good = [(row["n_verts"], row[what]) for row in rows if what in row and row["n_verts"] > 3000]
    x, y = np.log(np.array(good)).T
    return float(np.polyfit(x, y, 1)[0])


def draw(rows: dict[str, list[dict[str, float]]], exponents: dict[str, float], path: Path) -> None:
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
    words = {"basis": f"basis of {K} functions", "match": f"both maps of a pair, k = {K}, from two meshes"}
    for axis, what, unit in zip(axes, ("seconds", "peak_mib"), ("seconds", "peak memory (MiB)"), strict=True):
        for part in PARTS:
            good = [(row["n_verts"], row[what]) for row in rows[part] if what in row]
            label = f"{words[part]}: n^{exponents[f'{part}_{what}']:.2f}"
            axis.loglog(*zip(*good, strict=True), "o-", label=label)
        axis.set_xlabel("vertices")
        axis.set_ylabel(unit)
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(f"{name}:")))


if __name__ == "__main__":
    os.environ.pop("TORCHQM_CACHE", None)
    torch.set_num_threads(int(sys.argv[3]))
    torch.set_grad_enabled(False)
    print(json.dumps(one(sys.argv[1], int(sys.argv[2]))))
