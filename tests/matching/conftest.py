"""Shapes that the matching tests share; each is prepared once."""

import pytest
from references import pairs
from references.exact import Exact


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
