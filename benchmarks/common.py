"""What the benchmark scripts share: provenance of a number, files that appear whole, eigenbases kept between runs."""

import hashlib
import json
import multiprocessing
import os
import platform
import shlex
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchqm.geometry import Mesh
from torchqm.geometry.files import write_whole
from torchqm.native import available
from torchqm.spectral import SpectralBasis, mesh_basis
from torchqm.version import __version__

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
DOCS = ROOT / "docs"


def provenance() -> dict[str, Any]:
    """The command, versions and machine behind a result."""
    script = Path(sys.argv[0]).resolve()
    name = script.relative_to(ROOT).as_posix() if script.is_relative_to(ROOT) else script.name
    return {
        "command": shlex.join(["python", name, *sys.argv[1:]]),
        "versions": {
            "torchqm": __version__,
            "python": platform.python_version(),
            **{package: metadata.version(package) for package in ("torch", "numpy", "scipy")},
        },
        "machine": {
            "system": f"{platform.system()} {platform.machine()}",
            "processor": _processor(),
            "cpus": os.cpu_count(),
            "torch_threads": torch.get_num_threads(),
            "memory_gib": _memory_gib(),
            "compiled": available(),
        },
    }


def write_json(path: Path, result: Mapping[str, Any]) -> Path:
    """Write :func:`provenance` and a result; numbers of arrays are kept to six digits."""
    text = json.dumps({**provenance(), **_plain(result)}, indent=1, ensure_ascii=False, allow_nan=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: file.write((_one_line_lists(text) + "\n").encode()))
    return path


def peak_mib(call: Callable[..., Any], *args: Any) -> float:
    """Memory that a call takes at its peak, beyond what its process held before, in MiB; in a process of its own."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_peak, call, args, torch.get_num_threads()).result()


def _peak(call: Callable[..., Any], args: tuple[Any, ...], threads: int) -> float:
    torch.set_num_threads(threads)
    before = _status("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here (Linux)
    call(*args)
    return (_status("VmHWM") - before) / 1024


def _status(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith(f"{name}:")))


def cached_basis(mesh: Mesh, k: int, folder: Path | None = None) -> SpectralBasis:
    """The first ``k`` eigenpairs of a mesh, kept in ``folder`` under its name and a hash of its arrays and ``k``."""
    if folder is None:
        return mesh_basis(mesh, k)
    digest = hashlib.sha256(repr(("1", k)).encode())
    for array in mesh.numpy():
        digest.update(np.ascontiguousarray(array).tobytes())
    path = folder / f"{mesh.name}-{digest.hexdigest()[:16]}.npz"
    if path.is_file():
        with np.load(path, allow_pickle=False) as kept:
            return SpectralBasis(*(torch.from_numpy(kept[name]) for name in ("evals", "evecs", "mass")))
    basis = mesh_basis(mesh, k)
    arrays = {"evals": basis.evals.numpy(), "evecs": basis.evecs.numpy(), "mass": basis.mass.numpy()}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, lambda file: np.savez(file, **arrays))
    return basis


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, torch.Tensor):
        return _plain(value.detach().numpy())
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.6g}")
    return value.item() if isinstance(value, np.generic) else value


def _one_line_lists(text: str) -> str:
    """Lists of numbers on one line each, so that a curve does not take sixty."""
    out: list[str] = []
    for line in text.splitlines():
        if out and out[-1].rstrip().endswith(("[", ",")) and _is_number(line) and "[" in out[-1]:
            out[-1] += ("" if out[-1].endswith("[") else " ") + line.strip()
        elif out and line.strip() in ("]", "],") and "[" in out[-1] and _is_number(out[-1].rsplit("[", 1)[1]):
            out[-1] += line.strip()
        else:
            out.append(line)
    return "\n".join(out)


def _is_number(text: str) -> bool:
    words = text.strip().rstrip(",").split(",")
    try:
        return bool([float(word) for word in words])
    except ValueError:
        return False


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError, AttributeError):
        return None
