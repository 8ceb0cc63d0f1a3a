"""The layers compiled in one graph, exported and under vmap, with the results and gradients of plain calls."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import torchqm

TESTS = Path(__file__).resolve().parents[1]
SCRIPTS = sorted((TESTS / "references" / "compiled").glob("*.py"))

RUN = """
import runpy, sys, traceback
for path in sys.argv[1:]:
    print("====", path)
    try:
        runpy.run_path(path)
        print("succeeded")
    except (Exception, SystemExit):
        print(traceback.format_exc())
"""


@pytest.fixture(scope="module")
def outcomes():
    """What each script printed, run in one process without the suite's type checks, which break graphs."""
    paths = [str(Path(torchqm.__file__).parents[1]), str(TESTS)]
    command = [sys.executable, "-W", "ignore", "-c", RUN, *map(str, SCRIPTS)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths)}
    run = subprocess.run(command, capture_output=True, text=True, env=environment)
    parts = [part.partition("\n") for part in run.stdout.split("==== ")[1:]]
    return {Path(path).name: text for path, _, text in parts}


@pytest.mark.parametrize("name", [path.name for path in SCRIPTS])
def test_compiled_exported_and_vmapped(outcomes, name):
    assert outcomes[name].endswith("succeeded\n"), outcomes[name]
