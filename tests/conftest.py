"""What all tests share: run-time type checks, one thread, a fixed Hypothesis profile, shapes with exact answers."""

import gc
import importlib
import os
import sys
from pathlib import Path

import jaxtyping
import pytest

gc.disable()  # imports and collection make a million objects that stay: looking at them again takes seconds
os.environ.pop("TORCHQM_CACHE", None)  # a developer's cache must not steer the tests
sys.path.insert(0, str(Path(__file__).parent))  # for `references`
# Before anything imports torchqm: annotations of its functions become checks, in the tests only.
jaxtyping.jaxtyped = importlib.import_module("references.checker").jaxtyped
jaxtyping.install_import_hook("torchqm", "references.checker.checked")


collect_ignore = ["references/compiled"]  # scripts for processes without the checks above


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session):
    """What takes seconds to import is not needed where tests are only given out to other processes."""
    if session.config.getoption("dist", "no") != "no" and not hasattr(session.config, "workerinput"):
        gc.enable()
        return
    with pytest.MonkeyPatch.context() as patch:  # pytest would rewrite all its asserts, which takes two seconds
        patch.setattr(sys, "meta_path", [f for f in sys.meta_path if type(f).__name__ != "AssertionRewritingHook"])
        import hypothesis
    import torch

    torch.set_num_threads(1)  # sums in one order, so that equal runs give equal bits
    hypothesis.settings.register_profile("torchqm", deadline=None, derandomize=True, max_examples=20, database=None)
    hypothesis.settings.load_profile("torchqm")


def pytest_collection_finish(session):
    """From here on garbage is collected, among what the tests make."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _work_done_once(tmp_path_factory):
    from references import once

    folder = tmp_path_factory.getbasetemp()
    folder = folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder
    with pytest.MonkeyPatch.context() as patch:
        once.share(patch, folder / "creatures")
        yield


@pytest.fixture(scope="session")
def exact_shapes():
    """The module of shapes whose answers are exact, imported when the first test needs it."""
    return importlib.import_module("references.shapes")


@pytest.fixture(scope="session")
def sphere(exact_shapes):
    """Unit icosphere, 642 vertices; spectrum l (l + 1)."""
    return exact_shapes.icosphere(3)


@pytest.fixture(scope="session", params=[1, 2, 4, 8], ids=lambda order: f"group{order}")
def blob(request, exact_shapes):
    """A bumpy ellipsoid and its exact group of 1, 2, 4 and 8 elements (642 vertices)."""
    return exact_shapes.blob(request.param)


@pytest.fixture(scope="session")
def mirror_blob(exact_shapes):
    """A bumpy ellipsoid with one exact mirror plane, x = 0."""
    return exact_shapes.blob(2)


@pytest.fixture(scope="session")
def box(exact_shapes):
    """A cuboid with its 8 exact symmetries."""
    return exact_shapes.box()


@pytest.fixture(scope="session")
def prism(exact_shapes):
    """A square prism with its 16 exact symmetries and pairs of equal eigenvalues."""
    return exact_shapes.prism()


@pytest.fixture(scope="session")
def rectangle(exact_shapes):
    """A flat rectangle ``[0, 1.5] x [0, 1]`` with boundary (Neumann spectrum)."""
    return exact_shapes.grid(24, 16, 1.5, 1.0)
