"""Shapes that the matching tests share; each is prepared once, and its mirror planes are looked for once."""

import pytest
from references import pairs
from references.exact import Exact

from torchqm.matching import known
from torchqm.symmetry import find_reflections

PLANES = {}
"""Mirror planes of meshes with exactly these vertices and triangles. That they come out the same each time is tested
where they are found (``tests/symmetry/test_extrinsic.py``)."""


def planes_found_once(mesh):
    key = mesh.verts.numpy().tobytes(), mesh.faces.numpy().tobytes()
    if key not in PLANES:
        PLANES[key] = find_reflections(mesh)
    return list(PLANES[key])


@pytest.fixture(autouse=True)
def _planes_found_once(monkeypatch):
    monkeypatch.setattr(known, "find_reflections", planes_found_once)


@pytest.fixture(scope="session")
def exact():
    """A blob with one exact reflection and its renumbered copy."""
    return pairs.exact_pair()


@pytest.fixture(scope="session", params=[False, True], ids=["same", "mirrored"])
def either(request):
    """The exact pair, and the same with a mirrored target: the known vertex map is then the mirrored one."""
    return pairs.exact_pair(2, request.param)


@pytest.fixture(scope="session")
def biped():
    """A biped at rest with its functional maps."""
    return Exact("biped")


@pytest.fixture(scope="session")
def ellipsoid():
    """A body with three mirror planes at rest with its functional maps."""
    return Exact("ellipsoid")


@pytest.fixture(scope="session")
def octopus():
    """An octopus at rest with its functional maps."""
    return Exact("octopus")
