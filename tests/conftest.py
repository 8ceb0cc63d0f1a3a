"""What all tests share: run-time type checks, one thread, a fixed Hypothesis profile, shapes with exact answers."""

import functools
import gc
import importlib
import os
import pickle
import sys
from pathlib import Path

import jaxtyping

gc.disable()  # imports and collection make a million objects that stay: looking at them again takes seconds
os.environ.pop("TORCHQM_CACHE", None)  # a developer's cache must not steer the tests
sys.path.insert(0, str(Path(__file__).parent))  # for `references`
# Before anything imports torchqm: annotations of its functions become checks, in the tests only.
jaxtyping.jaxtyped = importlib.import_module("references.checker").jaxtyped
jaxtyping.install_import_hook("torchqm", "references.checker.checked")

import hypothesis  # noqa: E402
import pytest  # noqa: E402
import torch  # noqa: E402
from references import shapes  # noqa: E402

torch.set_num_threads(1)  # sums in one order, so that equal runs give equal bits
hypothesis.settings.register_profile("torchqm", deadline=None, derandomize=True, max_examples=20, database=None)
hypothesis.settings.load_profile("torchqm")


def pytest_collection_finish(session):
    """From here on garbage is collected, among what the tests make."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def _creatures_made_once(tmp_path_factory):
    """The meshes of the built-in creatures, seconds each, are made once in a run and shared by its processes."""
    from torchqm.data import synthetic
    from torchqm.geometry.files import write_whole

    folder = tmp_path_factory.getbasetemp()
    folder = (folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder) / "creatures"
    folder.mkdir(exist_ok=True)

    def shared(plain):
        @functools.lru_cache(None)
        @functools.wraps(plain)
        def made(*place):
            path = folder / "-".join(map(str, (plain.__name__, *place)))
            if path.exists():
                return pickle.loads(path.read_bytes())
            value = plain(*place)
            write_whole(path, lambda file: pickle.dump(value, file))
            return value

        return made

    with pytest.MonkeyPatch.context() as patch:
        for name in ("_body", "_retriangulated"):
            patch.setattr(synthetic, name, shared(getattr(synthetic, name).__wrapped__))
        yield


@pytest.fixture(autouse=True)
def _planes_found_once(monkeypatch):
    """Matching asks for the mirror planes of a few meshes again and again, half a second each.

    That they come out the same each time is tested where they are found (``tests/symmetry/test_extrinsic.py``).
    """
    from torchqm.matching import known

    monkeypatch.setattr(known, "find_reflections", _planes)


def _planes(mesh):
    from torchqm.symmetry import find_reflections

    key = mesh.verts.numpy().tobytes(), mesh.faces.numpy().tobytes()
    if key not in _PLANES:
        _PLANES[key] = find_reflections(mesh)
    return list(_PLANES[key])


_PLANES = {}


@pytest.fixture(scope="session")
def sphere():
    """Unit icosphere, 642 vertices; spectrum l (l + 1)."""
    return shapes.icosphere(3)


@pytest.fixture(scope="session", params=[1, 2, 4, 8], ids=lambda order: f"group{order}")
def blob(request):
    """A bumpy ellipsoid and its exact group of 1, 2, 4 and 8 elements (642 vertices)."""
    return shapes.blob(request.param)


@pytest.fixture(scope="session")
def mirror_blob():
    """A bumpy ellipsoid with one exact mirror plane, x = 0."""
    return shapes.blob(2)


@pytest.fixture(scope="session")
def box():
    """A cuboid with its 8 exact symmetries."""
    return shapes.box()


@pytest.fixture(scope="session")
def prism():
    """A square prism with its 16 exact symmetries and pairs of equal eigenvalues."""
    return shapes.prism()


@pytest.fixture(scope="session")
def rectangle():
    """A flat rectangle ``[0, 1.5] x [0, 1]`` with boundary (Neumann spectrum)."""
    return shapes.grid(24, 16, 1.5, 1.0)
