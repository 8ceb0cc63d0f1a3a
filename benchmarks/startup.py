"""How long torchqm takes to start: imports and --help, each in a process of its own, in alternation with import torch.

Wall time and CPU time (user and system, of the process) of every case are medians over the rounds; ``beyond_torch`` is
the median over the rounds of the difference to ``import torch`` in the same round. A first round is not counted: it
writes bytecode and fills the file cache. Another checkout can be measured in the same rounds::

    python benchmarks/startup.py [--rounds 7] [--against FOLDER] [--out FILE]
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

from common import RESULTS, ROOT, write_json

LIMITS = {"import torchqm, torch": 1.0, "torchqm --help": 1.5}
"""Seconds, wall: issue 7, section 5; the import beyond ``import torch``."""

_SOLVE = """
import torch
from torchqm.fmap import solve_fmap
a, evals = torch.eye(4, dtype=torch.float64), torch.arange(4.0, dtype=torch.float64)
solve_fmap(a, a, evals, evals, 1.0)
"""
_SUBPACKAGES = ("geometry", "nn", "data")

IMPORTS = {
    "import torchqm": "import torchqm",
    "import torchqm, torch": "import torchqm, torch",
    "torchqm.match": "import torchqm; torchqm.match",
    **{f"import torchqm.{name}": f"import torchqm.{name}" for name in _SUBPACKAGES},
    "first solve of a map": _SOLVE,
}
HELPS = ("--help", "match --help", "benchmark --help")


def run_once(command: list[str], folder: Path) -> tuple[float, float]:
    """Wall and CPU seconds of a process that imports torchqm from a folder."""
    start = time.perf_counter()
    # The folder is where it runs, too: that is looked into before PYTHONPATH.
    process = subprocess.Popen(command, cwd=folder, env=_environment(folder), stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise SystemExit(f"{command} failed in {folder}")
    return wall, usage.ru_utime + usage.ru_stime


def check_folder(folder: Path) -> None:
    """Stop unless the processes of a folder import its torchqm."""
    command = [sys.executable, "-c", "import torchqm; print(torchqm.__file__)"]
    run = subprocess.run(command, cwd=folder, env=_environment(folder), capture_output=True, text=True, check=True)
    if Path(run.stdout.strip()) != folder / "torchqm" / "__init__.py":
        raise SystemExit(f"{folder}: {run.stdout.strip()} was imported instead")


def _environment(folder: Path) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": str(folder)}


def measure(folders: dict[str, Path], rounds: int) -> dict[str, dict[str, dict[str, float]]]:
    """Medians by folder and case."""
    cases = {
        "import torch": ["-c", "import torch"],
        **{name: ["-c", code] for name, code in IMPORTS.items()},
        **{f"torchqm {words}": ["-m", "torchqm", *words.split()] for words in HELPS},
    }
    seen: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for number in range(rounds + 1):
        for case, words in cases.items():
            for which, folder in folders.items():
                times = run_once([sys.executable, *words], folder)
                if number:
                    seen.setdefault((which, case), []).append(times)
    out: dict[str, dict[str, dict[str, float]]] = {}
    for (which, case), times in seen.items():
        entry = {f"{kind}_s": median(pair[at] for pair in times) for at, kind in enumerate(("wall", "cpu"))}
        if case in IMPORTS:
            torch = seen[which, "import torch"]
            for at, kind in enumerate(("wall", "cpu")):
                beyond = [pair[at] - alone[at] for pair, alone in zip(times, torch, strict=True)]
                entry[f"beyond_torch_{kind}_s"] = median(beyond)
                entry[f"ratio_to_torch_{kind}"] = median(
                    pair[at] / alone[at] for pair, alone in zip(times, torch, strict=True)
                )
        out.setdefault(which, {})[case] = entry
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--against", type=Path, help="another checkout of torchqm, measured in the same rounds")
    parser.add_argument("--out", type=Path, default=RESULTS / "startup.json")
    arguments = parser.parse_args()
    folders = {"torchqm": ROOT} | ({"against": arguments.against} if arguments.against else {})
    folders = {which: folder.resolve() for which, folder in folders.items()}
    for folder in folders.values():
        check_folder(folder)
    load = os.getloadavg()[0]
    times = measure(folders, arguments.rounds)
    for case in times["torchqm"]:
        parts = []
        for which in folders:
            entry = times[which][case]
            parts.append(f"{which} wall {entry['wall_s']:6.3f} cpu {entry['cpu_s']:6.3f}")
            if "beyond_torch_wall_s" in entry:
                parts.append(f"beyond torch {entry['beyond_torch_wall_s']:6.3f} {entry['beyond_torch_cpu_s']:6.3f}")
        print(f"{case:28}", *parts)
    ours = times["torchqm"]
    reached = {
        "import torchqm, torch": ours["import torchqm, torch"]["beyond_torch_wall_s"],
        "torchqm --help": ours["torchqm --help"]["wall_s"],
    }
    goals = {
        case: {"limit_s": LIMITS[case], "wall_s": value, "met": value < LIMITS[case]} for case, value in reached.items()
    }
    about = {"rounds": arguments.rounds, "load_before": load, "load_after": os.getloadavg()[0]}
    print(write_json(arguments.out, {**about, "goals": goals, "times": times}))


if __name__ == "__main__":
    main()
