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
)


@pytest.mark.parametrize(
    ("module", "heavy"),
    [
        ("torchqm", ("torch", "numpy", "scipy", *HEAVY)),
        ("torchqm.cli.main", ("torch", "numpy", "scipy", *HEAVY)),
        (
            "torchqm.matching.baselines, torchqm.evaluate, torchqm.data, torchqm.viz, torchqm.testing, torchqm.learn",
            HEAVY,
        ),
    ],
)
def test_nothing_heavy_is_imported(module, heavy):
    script = f"import sys, {module}; print(*sorted(set({heavy!r}) & {{n.split('.')[0] for n in sys.modules}}))"
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.split() == []
