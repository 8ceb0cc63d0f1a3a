"""The floors of the package: each knows only those below it, and nothing heavy is loaded unasked."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def test_layer_contract():
    if not (ROOT / "pyproject.toml").exists():
        pytest.skip("the contract is in the source tree's pyproject.toml")
    script = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    run = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, env=environment)
    assert run.returncode == 0, run.stdout + run.stderr


HEAVY = (
    *("matplotlib", "gudhi", "sklearn", "skimage", "trimesh", "potpourri3d", "faiss", "robust_laplacian"),
    *("torchmetrics", "yaml", "joblib", "dask", "distributed", "pytorch_lightning", "jsonargparse"),
    *("torch._dynamo", "sympy", "pandas"),
    *("scipy.interpolate", "scipy.optimize", "scipy.sparse.csgraph", "scipy.spatial", "scipy.stats"),
)


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("torchqm; dir(torchqm)", ("torch", "numpy", "scipy", *HEAVY)),
        ("torchqm.cli.main", ("torch", "numpy", "scipy", *HEAVY)),
        ("torchqm.geometry, torchqm.evaluate, torchqm.viz, torchqm.testing", ("scipy.sparse", *HEAVY)),
        ("torchqm.matching.baselines, torchqm.data, torchqm.nn, torchqm.learn, torchqm.benchmark", HEAVY),
    ],
)
def test_nothing_heavy_is_imported(module, heavy):
    script = f"import sys, {module}; print(*sorted(set({heavy!r}) & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []


@pytest.mark.parametrize(
    "words",
    [
        *("--version", "--help", "demo --help", "match --help", "symmetry --help", "data --help", "data check --help"),
        *("prepare --help", "benchmark --help"),
    ],
)
def test_help_loads_no_torch(words):
    """By the interpreter's own list of what it imported, so that nothing can be missed."""
    command = [sys.executable, "-X", "importtime", "-m", "torchqm", *words.split()]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    loaded = {line.rpartition("|")[2].strip() for line in run.stderr.splitlines()}
    assert "torchqm.cli.main" in loaded
    assert loaded & {"torch", "numpy", "scipy", *HEAVY} == set()
    assert run.stdout.startswith("torchqm" if words == "--version" else "usage: torchqm")
